"""Recorded steps replayed through a back end, so that all estimators get the same evidence.

Data association was decided when the steps were recorded; a replay compares estimation alone.
"""

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from graphslam.core.geometry import Array
from graphslam.core.records import Estimate, Step, Trajectory
from graphslam.estimation.backend import Backend, TrajectoryRecorder


@dataclass(frozen=True, slots=True, eq=False)
class Replay:
    """The result of a replay.

    ``causal[robot]`` has each state as estimated from the data up to its own time. ``step_ms`` (n,)
    is the time of each step, including the query of the new poses (not of their covariances);
    ``finish_ms`` that of `Backend.finish`. ``late`` counts associations from before their
    landmark's promotion.
    """

    causal: Mapping[str, Trajectory]
    estimate: Estimate
    step_ms: Array
    finish_ms: float
    late: int


def replay(
    steps: Iterable[Step],
    backend: Backend,
    watch: Callable[[Step, Backend], None] = lambda _step, _backend: None,
) -> Replay:
    """Give ``steps`` to a fresh ``backend`` in order.

    ``watch`` is called after each step, outside the measured time.

    Raises:
        EstimationError: the steps make the estimate indeterminate.
    """
    causal = TrajectoryRecorder()
    step_ms: list[float] = []
    late = 0
    for step in steps:
        began = time.perf_counter()
        backend.add(step)
        moved = sorted({*step.starts, *step.motions})
        means = [backend.state_mean(robot) for robot in moved]
        step_ms.append(1e3 * (time.perf_counter() - began))
        late += sum(seen.late for seen in step.associations)
        for robot, mean in zip(moved, means, strict=True):
            causal.append(robot, step.time_ns, mean, backend.joint(robot, []).cov)
        watch(step, backend)
    began = time.perf_counter()
    estimate = backend.finish()
    finish_ms = 1e3 * (time.perf_counter() - began)
    return Replay(causal.trajectories(), estimate, np.array(step_ms), finish_ms, late)
