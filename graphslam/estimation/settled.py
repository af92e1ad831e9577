"""The estimate of a batch, moved to the exact minimum of the steps that it is reported with.

Batches end before that. Their motions are linear in the calibration around the last but one, and
their lines face where they were a round ago. What that leaves is far below the uncertainty; but
whoever optimises the graph of a result should find what the result says.
"""

from collections.abc import Sequence
from dataclasses import replace

import gtsam
import numpy as np

from graphslam.core.config import RobustConfig
from graphslam.core.geometry import adjoint, between
from graphslam.core.records import Estimate, Step, Trajectory
from graphslam.estimation import factors
from graphslam.estimation.joint_covariances import in_other_axes
from graphslam.estimation.optimisation import CONVERGED_ERROR, is_wide, optimise
from graphslam.estimation.recorded_graph import RecordedGraph

#: all variables together have settled when they move less than this, m and rad; rounds until then
#: at most, without a kernel, and with one, whose weights converge linearly; and where rounding
#: decides
SETTLED, ROUNDS, ROUNDS_ROBUST, ROUNDS_WIDE = 1e-7, 50, 1, 5


def settled(steps: Sequence[Step], estimate: Estimate, kernel: RobustConfig) -> Estimate:
    """The estimate at the minimum of its steps, from where it is; covariances stay as they are.

    Raises:
        EstimationError: the steps make it indeterminate.
    """
    builder, values = RecordedGraph(kernel), gtsam.Values()
    builder.sliding_lines = True
    builder.insert_all(steps, estimate, values)
    _hold_lines(builder, values)
    motions = [motion for step in steps for motion in step.motions.values()]
    closures = [closure for step in steps for closure in step.closures]
    use_qr = is_wide(motions, closures)
    # no factor has a kernel
    only_poses = not any(step.associations for step in steps) and all(c.verified for c in closures)
    try:
        if use_qr and only_poses:
            values = _best_of_several(builder.graph, values, kernel)
        else:
            for _ in range(ROUNDS if kernel.kernel == "none" else ROUNDS_ROBUST):
                before = values
                builder.rebuild_lines(values)
                values = optimise(builder.graph, values, kernel, use_qr=use_qr)
                if before.localCoordinates(values).norm() < SETTLED:
                    break
    except RuntimeError as error:
        raise builder.explain(error) from error
    states: dict[str, Trajectory] = {}
    for robot, before_it in estimate.states.items():
        poses = [factors.read(values, key, 3) for key in builder.state_keys(robot)]
        states[robot] = replace(before_it, poses=np.array(poses))
    landmarks = dict(estimate.landmarks)
    for landmark, dim in builder.landmark_dims.items():
        key = factors.landmark_key(landmark)
        landmarks[landmark] = factors.read(values, key, dim), estimate.landmarks[landmark][1]
    return replace(estimate, states=states, landmarks=landmarks)


def _best_of_several(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, kernel: RobustConfig
) -> gtsam.Values:
    """The best of some minima of relative poses alone, where information is wide.

    They differ by rounding: GTSAM's logarithm of a pose divides by a turn, which may be 1e-9 rad,
    and is then 1e-8 m off, where poses are known to 1e-6 m. A minimum is judged as it is reported,
    by positions and headings; the cosines and sines behind them may have an error too small.
    """
    best, least = values, graph.error(values)
    for _ in range(ROUNDS_WIDE):
        moved = optimise(graph, values, kernel, CONVERGED_ERROR, use_qr=True)
        values, keys = gtsam.Values(), list(moved.keys())
        for key in keys:
            values.insert(key, gtsam.Pose2(*factors.read(moved, key, 3)))
        error = graph.error(values)
        if error < least:
            best, least = values, error
    return best


def moved_to(minimum: Estimate, estimate: Estimate) -> Estimate:
    """The estimate with the poses and landmarks of its ``minimum``; covariances stay its own.

    Walls slide along themselves by decimetres, where nothing holds them. Their errors are along
    their own axes, at their own place, so the root of the information is given in the new ones: in
    the old ones it would hold a map that is turned as a whole.
    """
    states = {
        robot: replace(own, poses=minimum.states[robot].poses)
        for robot, own in estimate.states.items()
    }
    landmarks = {
        number: (minimum.landmarks[number][0], cov)
        for number, (_, cov) in estimate.landmarks.items()
    }
    root = estimate.root
    if root is not None:
        walls = [n for n in root.landmarks if len(estimate.landmarks[n][0]) == 3]
        old, new = (
            np.array([one.landmarks[n][0] for n in walls]).reshape(-1, 3)
            for one in (estimate, minimum)
        )
        moves = adjoint(between(old, new))
        root = in_other_axes(
            root, {root.landmarks[n]: m for n, m in zip(walls, moves, strict=True)}
        )
    return replace(estimate, states=states, landmarks=landmarks, root=root)


def _hold_lines(builder: RecordedGraph, values: gtsam.Values) -> None:
    """Replace the gauges of lines by those of the estimate; lines' other factors follow later."""
    for n in range(builder.graph.size()):
        factor = builder.graph.at(n)
        if isinstance(factor, gtsam.BetweenFactorPose2) and not factors.is_state(factor.keys()[1]):
            key, target = factor.keys()
            noise = factor.noiseModel()
            if isinstance(noise, gtsam.noiseModel.Gaussian) and not noise.R()[1, 1]:
                x, t = factors.read(values, key, 3), factors.read(values, target, 3)
                builder.graph.replace(n, factors.line_held_factor(key, target, x, t))
