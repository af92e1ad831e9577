"""Recorded steps through a back end: the same evidence for every estimator.

What an estimator makes of given steps is estimation and nothing else: which observation belongs to
which landmark was decided before.
"""

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from graphslam.core.geometry import Array
from graphslam.core.records import Estimate, Step, Trajectory
from graphslam.estimation.backend import Backend


@dataclass(frozen=True, slots=True, eq=False)
class Replay:
    """What a back end made of the steps.

    ``causal[robot]`` is each state from the data up to its own time; ``step_ms`` (n,) the time that
    each step took, reading the new poses (not their covariances) included, ``finish_ms``
    that of the end; ``late`` counts associations from before their landmark's promotion.
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
    """Give ``steps`` to ``backend`` in order.

    Args:
        steps: as recorded.
        backend: a fresh one.
        watch: called after each step, outside the time that is taken.

    Raises:
        EstimationError: the steps make the estimate indeterminate.
    """
    times: dict[str, list[int]] = {}
    poses: dict[str, list[Array]] = {}
    covs: dict[str, list[Array]] = {}
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
            times.setdefault(robot, []).append(step.time_ns)
            poses.setdefault(robot, []).append(mean)
            covs.setdefault(robot, []).append(backend.joint(robot, []).cov)
        watch(step, backend)
    began = time.perf_counter()
    estimate = backend.finish()
    finish_ms = 1e3 * (time.perf_counter() - began)
    causal = {
        robot: Trajectory(
            np.array(times[robot], dtype=np.int64), np.array(poses[robot]), np.array(covs[robot])
        )
        for robot in sorted(times)
    }
    return Replay(causal, estimate, np.array(step_ms), finish_ms, late)
