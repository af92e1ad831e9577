"""Monte Carlo experiments: many seeded runs of several estimators, and what they add up to.

`definition` says what an experiment is (a TOML file). `bench` draws the steps of a run and
`bench_run` takes them through an estimator; `log_run` does both by way of a simulated log.
`campaign` runs all of it on all cores and keeps the rows. `bound` is the Cramér-Rao bound,
`summary` makes tables and curves of the rows and `folder` writes them.
"""

from graphslam.experiments.campaign import jobs_of, run_campaign
from graphslam.experiments.definition import EXPERIMENTS, Definition, load_definition
from graphslam.experiments.folder import save_summary
from graphslam.experiments.summary import summarise

__all__ = [
    "EXPERIMENTS",
    "Definition",
    "jobs_of",
    "load_definition",
    "run_campaign",
    "save_summary",
    "summarise",
]
