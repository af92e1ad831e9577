"""What of the noise of measurements is left in the residuals of a solution."""

import numpy as np
import pytest

from graphslam.core.config import RobustConfig
from graphslam.core.geometry import compose, rotation3
from graphslam.core.motion_models import Calibration
from graphslam.core.records import Association, Estimate, Motion, Start, Step, Trajectory
from graphslam.estimation.calibration_graph import CalibrationGraph

S, N = 1_000_000_000, 30
POINTS = {1: np.array([1.0, 2.0]), 2: np.array([-1.0, 1.5])}
START, SCALE = 0.02, 0.03


def solved(sigma):
    """The graph, solved, of a robot on an arc with a scale and one parameter that is held, motions
    of a ``sigma`` (m and rad), from a start that is 0.1 rad off."""
    rng = np.random.default_rng(1)
    true, poses = np.zeros((N + 1, 3)), np.zeros((N + 1, 3))
    start = Start(true[0], np.diag([START**2] * 3))
    steps = [Step(0, {"r": start}, {}, associations(rng, true[0], 0))]
    for k in range(N):
        delta = np.array([0.15, 0.0, 0.1])
        true[k + 1] = compose(true[k], delta)
        measured = delta * [1.02, 1.0, 1.0] + sigma * rng.normal(size=3)
        D = np.zeros((3, 2))
        D[0, 0] = -measured[0]
        motion = Motion(k * S, (k + 1) * S, measured, sigma**2 * np.eye(3), D, 0.15)
        seen = associations(rng, true[k + 1], (k + 1) * S)
        steps.append(Step((k + 1) * S, {}, {"r": motion}, seen))
        poses[k + 1] = compose(poses[k], measured + np.array([0.0, 0.0, 0.1 / N]))
    covs = np.full((N + 1, 3, 3), np.nan)
    states = {"r": Trajectory(S * np.arange(N + 1), poses, covs)}
    begin = Estimate(states, {n: (p, np.full((2, 2), np.nan)) for n, p in POINTS.items()}, 0.0, 0)
    cov = np.diag([SCALE**2, 1e-18])
    prior = {"r": Calibration(("translation_scale", "rotation_scale"), np.zeros(2), cov)}
    graph = CalibrationGraph(steps, begin, prior, prior, RobustConfig(kernel="none"))
    graph.calibrate_motions(steps, prior)
    graph.optimise(1e-12)
    return graph


def associations(rng, pose, time_ns):
    noise = np.array([0.02, 0.05])
    return tuple(
        Association(
            "r", time_ns, n, "point", seen(pose, p) + noise * rng.normal(size=2), np.diag(noise**2)
        )
        for n, p in POINTS.items()
    )


def seen(pose, point):
    x, y = rotation3(-pose[2])[:2, :2] @ (point - pose[:2])
    return np.array([np.arctan2(y, x), np.hypot(x, y)])


@pytest.mark.parametrize("sigma", [0.05, 0.01, 1e-3, 1e-4])
def test_what_is_left_in_all_residuals_are_the_redundant_measurements(sigma):
    """Shares of the noise that are left add up to measurements less unknowns, however stiff the
    path. Breaks if the calibration, which follows the motions too, is left out, or if the motions'
    rows are those around a start whose poses have turned since."""
    graph = solved(sigma)
    posterior = graph.posterior()
    of_motions = posterior.motions("r", posterior.made["r"])
    of_points = posterior.sightings(("r", "point"))
    left = [1.0 - of.absorbed / of.variance for of in (of_motions, of_points)]
    assert min(map(np.min, left)) > 0.0
    state = posterior.blocks.marginals[posterior.builder.state_key("r", 0)]
    scale = graph.calibration_covariances(posterior)["r"][0, 0]
    of_priors = 4 - np.trace(state) / START**2 - scale / SCALE**2
    measurements, unknowns = 3 * N + 2 * len(POINTS) * (N + 1) + 4, 3 * (N + 1) + 4 + 1
    total = sum(map(np.sum, left)) + of_priors
    np.testing.assert_allclose(total, measurements - unknowns, rtol=1e-6)
