"""What closures do to an estimate that is wrong and sure of itself, and what false ones do not."""

from dataclasses import replace

import numpy as np
import pytest

import graphslam
from graphslam.core.config import Config, OdometryConfig, RobotConfig
from graphslam.core.geometry import between, compose, inverse
from graphslam.core.records import Association, Closure, Motion, OdometryPose, Start, Step
from graphslam.estimation.isam2 import Isam2Backend
from graphslam.mapping.loop_closure import residuals, violated
from graphslam.odometry.interpolation import origin_shift
from graphslam.odometry.preintegration import Track
from graphslam.scan_smoothing.reoptimise_scans import (
    _with_observed_motion_noise,
    with_sensor_starts,
)
from graphslam.scan_smoothing.solver import Solver
from graphslam.scan_smoothing.submap_closing import solve_with_tightening
from graphslam.simulation import load_scenario, simulate

SECOND = 10**9
MOTION_COV = np.diag([0.01, 0.01, 0.02]) ** 2
CLOSURE_COV = np.diag([0.03, 0.03, 0.005]) ** 2
#: m, rad: closures that come out worse than this are taken back
BORNE_OUT = (0.2, 0.03)


def corridor(turn_rad, steps=40):
    """A corridor with a bend halfway, its two walls taken for one; true poses (n, 3) and steps.

    Each state sees the wall on its left, 1 m off, to 2 cm and 5 mrad; odometry is right.
    """
    true = [np.zeros(3)]
    for k in range(steps):
        bend = turn_rad if k == steps // 2 else 0.0
        true.append(compose(true[-1], np.array([0.5, 0.0, bend])))
    walls = [compose(true[k], np.array([0.0, 1.0, 0.0])) for k in (0, steps // 2 + 1)]
    made = [Step(0, {"r": Start(np.zeros(3), 1e-6 * np.eye(3))})]
    for k in range(1, steps + 1):
        delta = between(true[k - 1], true[k])
        motion = Motion((k - 1) * SECOND, k * SECOND, delta, MOTION_COV, np.zeros((3, 0)), 0.5)
        z = between(true[k], walls[k > steps // 2])
        seen = Association("r", k * SECOND, 0, "line", z, np.diag([1.0, 0.02, 0.005]) ** 2)
        made.append(Step(k * SECOND, {}, {"r": motion}, (seen,)))
    return np.array(true), tuple(made)


def closures(true, off=(0.0, 0.0, 0.0)):
    """Closures between both ends, true but for ``off`` (m, m, rad) of the last one."""
    n = len(true) - 1
    pairs = [(n - 2 * k, 2 * k) for k in range(4)]
    found = [
        Closure("r", i * SECOND, "r", j * SECOND, between(true[j], true[i]), CLOSURE_COV)
        for i, j in pairs
    ]
    return [*found[:-1], replace(found[-1], delta=compose(found[-1].delta, np.array(off)))]


def solved(steps):
    """An estimate of the steps and what solves them again."""
    backend = Isam2Backend(Config())
    for step in steps:
        backend.add(step)
    solve = Solver(Config())
    return solve, solve(steps, backend.finish())


@pytest.mark.parametrize("turn_rad", [0.15, 0.3])
def test_true_closures_undo_what_is_wrong_and_sure_of_itself(turn_rad):
    """The wall pulls the bend straight, metres off at the ends. Breaks if closures are only drawn
    as far as they fit the estimate: then none of them moves it, and all are taken back."""
    true, steps = corridor(turn_rad)
    solve, estimate = solved(steps)
    told = closures(true)
    assert all(violated(told, estimate.states, BORNE_OUT))
    estimate = solve_with_tightening(steps, told, estimate, solve)
    assert not any(violated(told, estimate.states, BORNE_OUT))


def test_a_false_closure_moves_nothing():
    """A straight corridor, one closure a metre off: the true ones hold, it is missed by a metre.
    Breaks if what is held first stays as it was held."""
    true, steps = corridor(0.0)
    solve, estimate = solved(steps)
    told = closures(true, off=(0.0, 1.0, 0.1))
    estimate = solve_with_tightening(steps, told, estimate, solve)
    assert violated(told, estimate.states, BORNE_OUT) == [False, False, False, True]
    # 0.2: a fifth of how far off it is
    assert np.abs(residuals(told, estimate.states)[-1, 1]) == pytest.approx(1.0, abs=0.2)


def test_motions_become_as_noisy_as_they_are():
    """Headings three times as noisy as believed, beside a wall that is known well. Breaks if the
    estimate is asked once: it believed the motions, and shows them twice as noisy as they say."""
    rng = np.random.default_rng(1)
    _, steps = corridor(0.0, steps=200)
    noisy = tuple(
        replace(
            step,
            motions={
                robot: replace(m, delta=m.delta + np.array([0.0, 0.0, 0.06 * rng.normal()]))
                for robot, m in step.motions.items()
            },
        )
        for step in steps
    )
    solve, estimate = solved(noisy)
    made, _ = _with_observed_motion_noise(noisy, estimate, solve)
    scale = np.sqrt(np.diag(made[1].motions["r"].cov) / np.diag(MOTION_COV))
    # the median of 200 is good to 0.2; asking ends where a tenth more would come
    assert scale[2] == pytest.approx(3.0, abs=0.5)
    assert scale[0] == pytest.approx(1.0, abs=0.1)


TOLD = {"a": np.array([1.0, 2.0, 0.3]), "b": np.array([20.0, -5.0, -2.0])}
BASE_COV = np.diag([1e-4, 1e-4, 1e-4])


def starting(base_cov):
    """Steps of robots whose starts are as uncertain as their sensors' mounts are at first."""
    starts = {robot: Start(pose, np.eye(3), base_cov) for robot, pose in TOLD.items()}
    return [Step(0, starts), Step(1, {})]


def tracks_mounted_at(**mounts):
    tracks = {robot: Track(OdometryConfig(), RobotConfig(), mounted=True) for robot in TOLD}
    for robot, track in tracks.items():
        track.add(OdometryPose(robot, 0, 0, np.zeros(3)))
        mean = track.calibration.mean.copy()
        mean[-4:-1] = mounts.get(robot, 0.0)
        track.calibration = replace(track.calibration.held(), mean=mean)
    return tracks


@pytest.mark.parametrize("mounts", [{}, {"b": (0.1, 0.0, 0.02)}, {"a": (0.0, 0.2, -0.05)}])
def test_bases_begin_where_they_were_told_wherever_their_sensors_sit(mounts):
    """In the world where the mount of the first robot puts it; breaks if the mount of one is left
    out, or if the starts stay as uncertain as mounts are before anything is known."""
    tracks = tracks_mounted_at(**mounts)
    made, rest = with_sensor_starts(starting(BASE_COV), tracks, {"a": "a", "b": "a"})
    world = origin_shift(TOLD["a"], tracks["a"].mount)
    for robot, track in tracks.items():
        sensor = compose(world, made.starts[robot].pose)
        base = compose(sensor, inverse(track.mount))
        np.testing.assert_allclose(between(TOLD[robot], base), 0.0, atol=1e-12)
        np.testing.assert_allclose(made.starts[robot].cov, BASE_COV, atol=1e-12)
    assert not rest.starts


def test_starts_that_were_found_stay_as_they_are():
    steps = starting(None)
    assert with_sensor_starts(steps, tracks_mounted_at(), {"a": "a", "b": "a"}) == tuple(steps)


def test_what_was_not_seen_for_long_is_in_the_final_map_again(tmp_path):
    """A filter forgets it, a smoother does not: lab walls that were deleted after 5 s out of sight
    are in the final solution (it ended in a KeyError)."""
    log = tmp_path / "lab.mcap"
    simulate(load_scenario("lab"), log, 3)
    found = {
        age: graphslam.smooth(log, **{"backend.name": "isam2", "association.delete_s": age})
        for age in (5.0, float("inf"))
    }
    assert found[5.0].summary["dropped"]["landmark: not seen again for association.delete_s"] > 5
    # a wall more or less: those that come back are associated anew, in another order
    assert abs(len(found[5.0].landmarks) - len(found[float("inf")].landmarks)) <= 2
