"""The runs of an experiment: which there are, and what one of them gives.

A run is random by its seed alone. `graphslam.campaigns.experiment` runs all of them.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from graphslam.core.config import Config
from graphslam.core.memory_limit import limited_memory
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
        GraphSlamError: the run failed, or needed more memory than its settings allow.
    """
    # other messages are lost in every run of the bench, which has no front end
    more = f"network.seed={job.run}" if definition.bench else f"front_end.name={job.front_end}"
    config = definition.config(job.variant, more)
    with limited_memory(config.limits.memory_mb):
        return _run(definition, job, config)


def _run(definition: Definition, job: Job, config: Config) -> Row:
    """What a run of these settings gives."""
    sequence = run_seed(definition.seed, job.scale, job.run)
    if definition.bench is not None:
        rng = np.random.default_rng(sequence)
        slip = definition.bench.slip
        told = slip is not None and job.variant in slip.told
        return run_bench(draw_run(definition.bench, job.scale, rng, told=told), config)
    if definition.chapter is not None:
        with scratch_folder() as folder:
            experiment = EXPERIMENTS[job.scenario]
            return {"values": experiment(definition.seed + job.run, folder, config)}
    drawn = definition.logs is not None and definition.logs.draw_starts
    seed = int(sequence.generate_state(1)[0])
    return run_log(job.scenario, job.scale, seed, config, draw_starts=drawn)
