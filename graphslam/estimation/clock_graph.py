"""Errors of the robots' clocks as variables of the linearised graph of all states.

An observation of one robot by another relates their states at one time. If the target's clock is
ahead by e, the target is seen where it is e later by its own clock: at its state moved by e times
its velocity. That is the column of e in the linear factor of the observation; the column of the
observer's clock is minus that.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from graphslam.core.config import RobustConfig
from graphslam.core.geometry import Array
from graphslam.core.observation_models import MODELS
from graphslam.core.records import Association, Estimate, Step
from graphslam.estimation.recorded_graph import RecordedGraph

#: prior sigmas of the offset, s, and the drift, s/s, which are also the units of the variables: the
#: offset is practically free, and 100 ppm is more than any crystal drifts
OFFSET_S, DRIFT = 10.0, 1e-4


@dataclass(frozen=True, slots=True, eq=False)
class ClockErrors:
    """Mean (2n,) and covariance (2n, 2n) of (offset s, drift s/s) of each robot's clock."""

    robots: tuple[str, ...]
    mean: Array
    cov: Array

    def of(self, robot: str) -> tuple[Array, Array]:
        """Mean (2,) and covariance (2, 2) of a robot's offset and drift."""
        at = slice(2 * self.robots.index(robot), 2 * self.robots.index(robot) + 2)
        return self.mean[at], self.cov[at, at]


def robot_associations(steps: Sequence[Step]) -> list[tuple[int, Association]]:
    """Observations of robots in steps, with the time of the observed robot's state."""
    return [
        (step.time_ns, a) for step in steps for a in step.associations if isinstance(a.target, str)
    ]


def clock_errors(
    steps: Sequence[Step],
    estimate: Estimate,
    velocities: Array,
    after_s: Array,
    prior: Mapping[str, Array],
    kernel: RobustConfig,
) -> ClockErrors:
    """One Gauss-Newton step for the clocks, with all states and landmarks as variables.

    ``velocities`` (n, 3) are the twists per second of the observed robots, along their own axes, in
    the order of `robot_associations`; ``after_s`` (n,) is the time since the clocks' epoch.
    ``prior``: robot -> correction (2,) so far, of the clocks to estimate; others are correct.

    Raises:
        EstimationError: the estimate is indeterminate.
    """
    builder, values = RecordedGraph(kernel), gtsam.Values()
    builder.insert_all(steps, estimate, values)
    builder.rebuild_lines(values)
    robots = tuple(sorted(prior))
    clock = int(gtsam.symbol("t", 0))
    size, units = 2 * len(robots), np.array([OFFSET_S, DRIFT])
    unit = gtsam.noiseModel.Unit.Create(size)
    rows = {model.rows: gtsam.noiseModel.Unit.Create(model.rows) for model in MODELS.values()}
    nonlinear = [builder.graph.at(index) for index, _ in builder.robot_observations]
    for index, _ in builder.robot_observations:
        builder.graph.remove(index)
    linear = builder.graph.linearize(values)
    so_far = np.concatenate([prior[robot] / units for robot in robots])
    linear.add(gtsam.JacobianFactor(clock, np.eye(size), -so_far, unit))
    columns = np.column_stack([np.ones(len(after_s)), after_s]) * units
    number = {seen: n for n, (_, seen) in enumerate(robot_associations(steps))}
    place = {robot: 2 * k for k, robot in enumerate(robots)}
    for observed, (_, (key, target, seen)) in zip(
        nonlinear, builder.robot_observations, strict=True
    ):
        n, factor = number[seen], observed.linearize(values)
        A, b = factor.jacobian()
        first = factor.keys()[0] == key
        A_key, A_target = (A[:, :3], A[:, 3:]) if first else (A[:, 3:], A[:, :3])
        C = np.zeros((len(b), size))
        along = (A_target @ velocities[n])[:, None] * columns[n]
        if (at := place.get(str(seen.target))) is not None:
            C[:, at : at + 2] += along
        if (at := place.get(seen.robot)) is not None:
            C[:, at : at + 2] -= along
        linear.add(gtsam.JacobianFactor(key, A_key, target, A_target, clock, C, b, rows[len(b)]))
    try:
        order = gtsam.Ordering.ColamdConstrainedLastGaussianFactorGraph(linear, [clock])
        net = linear.eliminateSequential(order)
    except RuntimeError as error:
        raise builder.explain(error) from error
    last = net.at(net.size() - 1)
    R_inv = np.linalg.inv(last.R())
    scale = np.tile(units, len(robots))
    mean = scale * (R_inv @ last.d())
    return ClockErrors(robots, mean, scale[:, None] * (R_inv @ R_inv.T) * scale)
