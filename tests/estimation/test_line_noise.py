"""The noise of lines that a solution's residuals show."""

import numpy as np
import pytest

from graphslam.core.config import RobustConfig
from graphslam.core.geometry import between, compose, path_length, rotate_cov
from graphslam.core.motion_models import Calibration
from graphslam.core.records import Association, Estimate, Motion, Start, Step, Trajectory
from graphslam.estimation.calibration_graph import CalibrationGraph
from graphslam.estimation.line_noise import AS_STATED, SHARED_M, fit_line_noise

S, N = 1_000_000_000, 400
#: walls of a room of 10 m: poses along them, the room on their right
WALLS = [
    np.array([5.0 * np.cos(a), 5.0 * np.sin(a), a - np.pi / 2]) for a in np.arange(4) * np.pi / 2
]
STATED = np.array([0.01, 0.004])


def posterior(draw, states=N):
    """Of a robot on a circle of 2 m, which sees two walls of four every 0.25 m.

    ``draw`` (rng, path m, wall) -> errors (2,), in sigmas as stated.
    """
    rng = np.random.default_rng(2)
    turn = 0.25 / 2.0
    true = np.array(
        [[2 * np.sin(turn * k), -2 * np.cos(turn * k), turn * k] for k in range(states)]
    )
    path, steps = path_length(true), []
    for k, pose in enumerate(true):
        seen = []
        for n in (k // 40 % 4, (k // 40 + 1) % 4):
            off, angle = STATED * draw(rng, float(path[k]), n)
            z = compose(between(pose, WALLS[n]), np.array([0.0, off, angle]))
            cov = rotate_cov(np.diag([1.0, *STATED**2]), z[2])
            seen.append(Association("r", k * S, n, "line", z, cov))
        if not k:
            steps.append(Step(0, {"r": Start(pose, np.diag([1e-4] * 3))}, {}, tuple(seen)))
            continue
        moved = between(true[k - 1], pose) + 0.005 * rng.normal(size=3)
        motion = Motion((k - 1) * S, k * S, moved, 2.5e-5 * np.eye(3), np.zeros((3, 0)), 0.25)
        steps.append(Step(k * S, {}, {"r": motion}, tuple(seen)))
    paths = {"r": Trajectory(S * np.arange(states), true, np.full((states, 3, 3), np.nan))}
    walls = {n: (wall, np.full((3, 3), np.nan)) for n, wall in enumerate(WALLS)}
    nothing = {"r": Calibration((), np.zeros(0), np.zeros((0, 0)))}
    start = Estimate(paths, walls, 0.0, 0)
    graph = CalibrationGraph(steps, start, nothing, nothing, RobustConfig(kernel="none"))
    graph.calibrate_motions(steps, nothing)
    graph.optimise(1e-9)
    return graph.line_residuals()


@pytest.mark.parametrize("factor", [0.1, 1.0, 10.0])
def test_white_noise_is_found(factor):
    """A factor by 150 sums is known to 12 %, and what is stated counts too. Directions tell theirs.
    Of normal offsets, which decide where the robot is, what the residuals show lies between their
    own factor and that of odometry, which is as stated. Breaks if residuals are taken for errors,
    of which the path absorbs half, or if offsets are those where a line faces its landmark, which
    directions move."""
    found = fit_line_noise(posterior(lambda rng, *_: np.sqrt(factor) * rng.normal(size=2), 1000))[
        "r"
    ]
    expected = (150 * factor + AS_STATED) / (150 + AS_STATED)
    assert found[1] == pytest.approx(expected, rel=0.4)
    assert abs(np.log(found[0] / factor)) < 0.75 * abs(np.log(factor)) + 0.35


def test_errors_that_consecutive_scans_share_count_as_one():
    """Uneven walls: the error of a wall is the same for 3 m of path, twelve observations."""
    errors = {}

    def draw(rng, path, wall):
        return errors.setdefault((wall, path // SHARED_M), rng.normal(size=2))

    found = fit_line_noise(posterior(draw, 1000))["r"]
    # a path follows what all its observations say; as independent ones they would be 1
    assert (found > 1.5).all()


def test_a_few_observations_tell_little():
    """Two metres of path past two walls: what is stated hardly changes."""
    found = fit_line_noise(posterior(lambda rng, *_: 0.1 * rng.normal(size=2), 10))["r"]
    assert ((found > 0.5) & (found <= 1.0)).all()
