"""The runs of an experiment: which there are, and what one of them gives.

A run is random by its seed alone. `graphslam.campaigns.experiment` runs all of them.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from graphslam.evaluation.monte_carlo_bench import draw_run, run_seed
from graphslam.evaluation.monte_carlo_bench_run import run_bench
from graphslam.evaluation.monte_carlo_definition import Definition
from graphslam.evaluation.monte_carlo_log_run import run_log, scratch_folder
from graphslam.evaluation.thesis_experiments import EXPERIMENTS

Row = dict[str, Any]


@dataclass(frozen=True)
class Job:
    """Identifies a run. ``scenario`` and ``front_end`` are empty on the bench."""

    scenario: str
    front_end: str
    scale: float
    variant: str
    run: int


def list_jobs(definition: Definition) -> list[Job]:
    """Every run of an experiment; all variants of a run are neighbours."""
    if definition.chapter is not None:
        chapter = definition.chapter
        sources = [(name, f) for name in chapter.experiments for f in chapter.front_ends]
    elif definition.logs is None:
        sources = [("", "")]
    else:
        sources = [(s, f) for s in definition.logs.scenarios for f in definition.logs.front_ends]
    return [
        Job(scenario, front_end, scale, variant, run)
        for run in range(definition.runs)
        for scenario, front_end in sources
        for scale in definition.noise_scales
        for variant in definition.variants
    ]


def run_job(definition: Definition, job: Job) -> Row:
    """The results of a run, as a row without its identification.

    Raises:
        GraphSlamError: the run failed.
    """
    sequence = run_seed(definition.seed, job.scale, job.run)
    if definition.bench is not None:
        rng = np.random.default_rng(sequence)
        slip = definition.bench.slip
        told = slip is not None and job.variant in slip.told
        run = draw_run(definition.bench, job.scale, rng, told=told)
        # other messages are lost in every run
        return run_bench(run, definition.config(job.variant, f"network.seed={job.run}"))
    config = definition.config(job.variant, f"front_end.name={job.front_end}")
    if definition.chapter is not None:
        with scratch_folder() as folder:
            experiment = EXPERIMENTS[job.scenario]
            return {"values": experiment(definition.seed + job.run, folder, config)}
    drawn = definition.logs is not None and definition.logs.draw_starts
    seed = int(sequence.generate_state(1)[0])
    return run_log(job.scenario, job.scale, seed, config, draw_starts=drawn)
