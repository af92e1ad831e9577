"""Batch smoothing with the robots' calibration as variables of the same graph.

A scale or a latency of odometry is one constant of the whole run. Estimated separately, given the
trajectory, it is biased towards the calibration that the trajectory was made with. As a variable it
is estimated jointly, and its uncertainty is in every covariance.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import gtsam
import numpy as np

from graphslam.core.config import RobustConfig
from graphslam.core.geometry import Array, adjoint, between, inverse, log, rotation3
from graphslam.core.motion_models import HELD_SIGMA, Calibration
from graphslam.core.records import Estimate, Step
from graphslam.estimation import factors
from graphslam.estimation.isam2 import CONVERGED_ERROR_ROUGH, BatchGraph, marginals_of, with_means

IntArray = np.ndarray[Any, np.dtype[np.int64]]

#: relative decrease of the error at which optimisation ends
CONVERGED_ERROR = 1e-5


def solve_calibrated(
    steps: Sequence[Step],
    start: Estimate,
    priors: Mapping[str, Calibration],
    now: Mapping[str, Calibration],
    kernel: RobustConfig,
    *,
    rough: bool = False,
) -> tuple[Estimate, dict[str, Calibration]]:
    """Optimise all states, landmarks and calibrations together.

    Motions are linear in the calibration, around the one that they were computed with, and
    linearised in their states at ``start``: recompute them and solve again from the result. Their
    covariances must not include the calibration's.

    Args:
        steps: all steps.
        start: an estimate of every variable.
        priors: robot -> its calibration before any data.
        now: robot -> the calibration that the motions were computed with.
        kernel: of observations.
        rough: stop early, see `Reoptimiser.solve`; covariances are NaN.

    Returns:
        The estimate and each robot's calibration.

    Raises:
        EstimationError: a covariance is not positive definite, or a state is unknown.
    """
    builder, values = BatchGraph(kernel, defer_lines=True), gtsam.Values()
    graph = builder.graph
    keys = {robot: int(gtsam.symbol("c", k)) for k, robot in enumerate(sorted(priors))}
    free = {r: np.flatnonzero(np.diag(c.cov) > HELD_SIGMA**2) for r, c in priors.items()}
    for robot, prior in priors.items():
        key, use = keys[robot], free[robot]
        if len(use):
            values.insert(key, now[robot].mean[use])
            noise = factors.gaussian(prior.cov[np.ix_(use, use)])
            graph.add(gtsam.PriorFactorVector(key, prior.mean[use], noise))

    unit = gtsam.noiseModel.Unit.Create(3)
    linear = {
        robot: _linear_motions(steps, robot, start.states[robot].poses, use)
        for robot, use in free.items()
    }
    for step in steps:
        builder.insert(Step(step.time_ns, step.starts), start, values)
        for robot, motion in step.motions.items():
            last = builder.latest_key(robot, step.time_ns)
            number = builder.states.append(robot, step.time_ns)
            key = builder.state_key(robot, number)
            values.insert(key, factors.pose2(start.states[robot].poses[number]))
            builder.rows += 3
            if len(free[robot]):
                A_x, R, A_c, b = next(linear[robot])
                row = gtsam.JacobianFactor(last, A_x, key, R, keys[robot], A_c, b, unit)
                graph.add(gtsam.LinearContainerFactor(row, values))
            else:
                graph.add(factors.motion_factor(last, key, motion))
        rest = Step(step.time_ns, {}, {}, step.associations, step.closures)
        builder.insert(rest, start, values)
    builder.rebuild_lines(values)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(CONVERGED_ERROR_ROUGH if rough else CONVERGED_ERROR)
    parameters.setMaxIterations(50)
    try:
        values = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
        covs = {} if rough else marginals_of(graph, values).marginals
    except RuntimeError as error:
        raise builder.explain(error) from error
    marginals = with_means(values, builder.dims(), covs)
    estimate = builder.estimate(marginals, float(graph.error(values)))
    calibrations = {}
    for robot, prior in priors.items():
        mean, cov, use = prior.mean.copy(), prior.cov.copy(), free[robot]
        if len(use):
            mean[use] = values.atVector(keys[robot])
            cov[np.ix_(use, use)] = np.nan if rough else covs[keys[robot]]
        calibrations[robot] = Calibration(prior.names, mean, cov)
    return estimate, calibrations


def _linear_motions(
    steps: Sequence[Step], robot: str, poses: Array, use: IntArray
) -> Iterator[tuple[Array, Array, Array, Array]]:
    """Motions of a robot as A_x x + R y + A_c c = b around ``poses`` (n + 1, 3): A_x, R, A_c, b.

    Error log(delta(c)⁻¹ x⁻¹ y) along the axes of the measured end, whitened; ``use`` (p,) are the
    indices of the parameters that are not held.
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
