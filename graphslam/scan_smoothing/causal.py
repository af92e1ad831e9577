"""Causal trajectories of a log of scans: what an incremental estimator knew at each time.

The batch decides with later data what belongs together, so its decisions cannot be used. The log is
read by the pipeline step by step instead, which associates, closes loops and calibrates with the
data up to each time. It runs in the second process while the batch is solved.
"""

from collections.abc import Mapping
from dataclasses import replace

from graphslam.core.config import Config
from graphslam.logs import LogSet
from graphslam.pipeline.log_pass import LogPass, PriorKnowledge
from graphslam.pipeline.pipeline import Pipeline
from graphslam.pipeline.robot_state import Causal


def causal_trajectories(log: LogSet, config: Config, known: PriorKnowledge) -> dict[str, Causal]:
    """Robot -> its causal trajectories, by the incremental back end.

    Raises:
        EstimationError: the estimate is indeterminate.
    """
    pipeline = Pipeline(log, replace(config, backend=replace(config.backend, name="isam2")), known)
    pipeline.run(lambda _count: None)
    pipeline.record_covariances()
    return causal_of(pipeline)


def causal_of(done: LogPass) -> dict[str, Causal]:
    """Robot -> its causal trajectories, after a pass that went step by step."""
    starts: Mapping[str, str] = done.frames.of
    return {
        name: run.causal(done.starts[starts[name]].pose, done.frames.away.get(starts[name], 0.0))
        for name, run in done.started.items()
    }
