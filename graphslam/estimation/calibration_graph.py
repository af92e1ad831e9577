"""Batch smoothing with the robots' calibration errors as unknowns of the same graph.

A scale or a latency of odometry is one constant of the whole run. Learned beside the estimate it is
pulled towards what the estimate already believes; as a variable it is found together with the
trajectory, and its uncertainty is in every covariance.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from graphslam.core.config import RobustConfig
from graphslam.core.geometry import Array, adjoint, between, inverse, log, rotate_cov, rotation3
from graphslam.core.motion_models import HELD_SIGMA, Calibration
from graphslam.core.records import Estimate, Step, Trajectory
from graphslam.estimation import factors
from graphslam.estimation.factor_graph import read
from graphslam.estimation.isam2 import CONVERGED_ERROR_ROUGH, WholeGraph, marginals_of

IntArray = np.ndarray[Any, np.dtype[np.int64]]

#: relative decrease of the error at which optimising ends
CONVERGED_ERROR = 1e-5


@dataclass(frozen=True, slots=True, eq=False)
class CalibratedEstimate:
    """The estimate, and per robot the calibration found with it."""

    estimate: Estimate
    calibrations: Mapping[str, Calibration]


def solve_calibrated(
    steps: Sequence[Step],
    start: Estimate,
    priors: Mapping[str, Calibration],
    now: Mapping[str, Calibration],
    kernel: RobustConfig,
    *,
    rough: bool = False,
) -> CalibratedEstimate:
    """Optimise all states, landmarks and calibrations together.

    Motions are linear in the calibration, around the one that they were made with, and linearised
    in their states at ``start``: solve again from the result, with motions made anew.

    Args:
        steps: all steps; the covariances of their motions must leave out the calibration.
        start: an estimate of every variable.
        priors: per robot what is known of its calibration before any data.
        now: per robot the calibration that the motions were made with.
        kernel: for observations.
        rough: to what a next round can go on from, in a fraction of the time: covariances are NaN.

    Raises:
        EstimationError: a covariance is not positive definite, or a state is unknown.
    """
    builder, values = WholeGraph(kernel, faced_later=True), gtsam.Values()
    graph = builder.graph
    numbers = {robot: k for k, robot in enumerate(sorted(priors))}
    free = {r: np.flatnonzero(np.diag(c.cov) > HELD_SIGMA**2) for r, c in priors.items()}
    for robot, prior in priors.items():
        if len(free[robot]):
            key, use = _key(numbers[robot]), free[robot]
            values.insert(key, now[robot].mean[use])
            noise = factors.gaussian(prior.cov[np.ix_(use, use)])
            graph.add(gtsam.PriorFactorVector(key, prior.mean[use], noise))

    places: dict[str, int] = dict.fromkeys(priors, 0)
    unit = gtsam.noiseModel.Unit.Create(3)
    linear = {
        robot: _linear_motions(steps, robot, start.states[robot].poses, use)
        for robot, use in free.items()
    }
    for step in steps:
        bare = Step(step.time_ns, step.starts, {}, (), ())
        builder.insert(bare, start, values)
        for robot, motion in step.motions.items():
            last = builder.latest_key(robot, step.time_ns)
            key = builder.state_key(robot, builder.states.append(robot, step.time_ns))
            places[robot] += 1
            n = places[robot]
            values.insert(key, factors.pose2(start.states[robot].poses[n]))
            builder.rows += 3
            if len(free[robot]):
                A_x, R, A_c, b = next(linear[robot])
                c = _key(numbers[robot])
                row = gtsam.JacobianFactor(last, A_x, key, R, c, A_c, b, unit)
                graph.add(gtsam.LinearContainerFactor(row, values))
            else:
                graph.add(factors.motion_factor(last, key, motion))
        rest = Step(step.time_ns, {}, {}, step.associations, step.closures)
        builder.insert(rest, start, values)
    builder.face_lines(values)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(CONVERGED_ERROR_ROUGH if rough else CONVERGED_ERROR)
    parameters.setMaxIterations(50)
    try:
        values = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
        marginals = None if rough else gtsam.Marginals(graph, values)
        return _result(builder, graph, values, marginals, priors, free, numbers)
    except RuntimeError as error:
        raise builder.explain(error) from error


def _key(number: int) -> int:
    return int(gtsam.symbol("c", number))


def _linear_motions(
    steps: Sequence[Step], robot: str, poses: Array, use: IntArray
) -> Iterator[tuple[Array, Array, Array, Array]]:
    """Motions of a robot as A_x x + R y + A_c c = b around ``poses`` (n + 1, 3): A_x, R, A_c, b.

    Error log(delta(c)⁻¹ x⁻¹ y) along the axes of the measured end, whitened; ``use`` (p,) are the
    parameters of the calibration that are unknown.
    """
    motions = [step.motions[robot] for step in steps if robot in step.motions]
    if not motions:
        return iter(())
    delta = np.array([m.delta for m in motions])
    cov = np.array([m.cov for m in motions])
    D = np.array([m.d_delta_d_calibration[:, use] for m in motions])
    back = rotation3(-delta[:, 2])
    R = np.linalg.cholesky(np.linalg.inv(back @ cov @ back.mT)).mT
    h = between(poses[: len(motions)], poses[1 : len(motions) + 1])
    b = -(R @ log(between(delta, h))[:, :, None])[:, :, 0]
    return zip(R @ -adjoint(inverse(h)), R, R @ (-back @ D), b, strict=True)


def _result(
    builder: WholeGraph,
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    marginals: gtsam.Marginals | None,
    priors: Mapping[str, Calibration],
    free: Mapping[str, IntArray],
    numbers: Mapping[str, int],
) -> CalibratedEstimate:
    """Means and marginal covariances of everything, as records."""
    covs = {} if marginals is None else marginals_of(marginals, graph.keyVector())

    def marginal(key: int, dim: int) -> Array:
        return covs[key] if covs else np.full((dim, dim), np.nan)

    states = {}
    for robot in sorted(builder.robots):
        keys = [builder.state_key(robot, n) for n in range(len(builder.states.times[robot]))]
        poses = np.array([read(values, k, 3) for k in keys])
        found = np.array([marginal(k, 3) for k in keys])
        states[robot] = Trajectory(
            builder.states.stamps(robot), poses, rotate_cov(found, poses[:, 2])
        )
    landmarks = {}
    for landmark, dim in builder.landmark_dims.items():
        key = factors.landmark_key(landmark)
        mean, cov = read(values, key, dim), marginal(key, dim)
        landmarks[landmark] = (mean, rotate_cov(cov, mean[2]) if dim == 3 else cov)
    calibrations = {}
    for robot, prior in priors.items():
        mean, cov, use = prior.mean.copy(), prior.cov.copy(), free[robot]
        if len(use):
            key = _key(numbers[robot])
            mean[use] = values.atVector(key)
            cov[np.ix_(use, use)] = marginal(key, len(use))
        calibrations[robot] = Calibration(prior.names, mean, cov)
    dof = (
        builder.rows
        - sum(3 * len(t) for t in states.values())
        - sum(len(mean) for mean, _ in landmarks.values())
    )
    estimate = Estimate(states, landmarks, float(graph.error(values)), dof)
    return CalibratedEstimate(estimate, calibrations)
