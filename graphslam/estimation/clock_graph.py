"""How much robots' clocks are off, as unknowns beside all states.

Two robots that see each other are where both say they are at one time. If the clock of the one seen
is ahead by e, it is seen where it is e later by its own: its state moved by e times its speed. That
is the column of e in the linear factor of each sighting, and minus that of the observer's clock.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from graphslam.core.config import RobustConfig
from graphslam.core.geometry import Array
from graphslam.core.records import Association, Estimate, Step
from graphslam.estimation.isam2 import WholeGraph

#: what a unit of the unknowns is: s of offset, s/s of drift. Also their sigmas before any sighting:
#: no clock is off by more than the drift, and the offset is free
OFFSET_S, DRIFT = 10.0, 1e-4


@dataclass(frozen=True, slots=True, eq=False)
class ClockErrors:
    """What is left of clocks' errors, (offset s, drift s/s) of each robot: (2n,) and (2n, 2n)."""

    robots: tuple[str, ...]
    mean: Array
    cov: Array

    def of(self, robot: str) -> tuple[Array, Array]:
        """Mean (2,) and covariance (2, 2) of a robot's offset and drift."""
        at = slice(2 * self.robots.index(robot), 2 * self.robots.index(robot) + 2)
        return self.mean[at], self.cov[at, at]


def robot_associations(steps: Sequence[Step]) -> list[tuple[int, Association]]:
    """Sightings of robots in steps, with the time of the state that was seen."""
    return [
        (step.time_ns, a) for step in steps for a in step.associations if isinstance(a.target, str)
    ]


def clock_errors(
    steps: Sequence[Step],
    estimate: Estimate,
    speeds: Array,
    after_s: Array,
    prior: Mapping[str, Array],
    kernel: RobustConfig,
) -> ClockErrors:
    """One Gauss-Newton step for the clocks, all states and landmarks free.

    Args:
        steps: as recorded.
        estimate: of all their states and landmarks.
        speeds: (n, 3) twists per second of the robots that were seen, along their own axes, in the
            order of `robot_associations`.
        after_s: (n,) time since the clocks' epoch.
        prior: robot -> what its clock has been corrected by so far (2,), of those whose clock is
            unknown; the others' are right.
        kernel: for observations.

    Raises:
        EstimationError: the estimate is indeterminate.
    """
    builder, values = WholeGraph(kernel, faced_later=True), gtsam.Values()
    for step in steps:
        builder.insert(step, estimate, values)
    builder.face_lines(values)
    robots = tuple(sorted(prior))
    clock = int(gtsam.symbol("t", 0))
    size, units = 2 * len(robots), np.array([OFFSET_S, DRIFT])
    unit = gtsam.noiseModel.Unit.Create(size)
    met = [builder.graph.at(place) for place, _ in builder.meetings]
    for place, _ in builder.meetings:
        builder.graph.remove(place)
    linear = builder.graph.linearize(values)
    so_far = np.concatenate([prior[robot] / units for robot in robots])
    linear.add(gtsam.JacobianFactor(clock, np.eye(size), -so_far, unit))
    columns = np.column_stack([np.ones(len(after_s)), after_s]) * units
    for n, (_, (key, target, seen)) in enumerate(builder.meetings):
        factor = met[n].linearize(values)
        A, b = factor.jacobian()
        first = factor.keys()[0] == key
        A_key, A_target = (A[:, :3], A[:, 3:]) if first else (A[:, 3:], A[:, :3])
        C = np.zeros((len(b), size))
        along = np.outer(A_target @ speeds[n], columns[n])
        for robot, sign in ((str(seen.target), 1.0), (seen.robot, -1.0)):
            if robot in prior:
                at = 2 * robots.index(robot)
                C[:, at : at + 2] += sign * along
        rows = gtsam.noiseModel.Unit.Create(len(b))
        linear.add(gtsam.JacobianFactor(key, A_key, target, A_target, clock, C, b, rows))
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
