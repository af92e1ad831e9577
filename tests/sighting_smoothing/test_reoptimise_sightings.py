"""A log of sightings solved again: what is found of the robots' odometry without any truth."""

import numpy as np
import pytest

from graphslam.core.config_io import load_config
from graphslam.core.geometry import between, compose, exp
from graphslam.logs import LogWriter, open_logs
from graphslam.slam.smooth import smooth

S, T0 = 1_000_000_000, 10_000_000_000
LATENCY_S, LOSS_M2, SCALE = 0.2, 0.02, 0.95
LANDMARKS = {str(k): (3 * np.cos(k), 3 * np.sin(k)) for k in range(10, 16)}
STARTS = {"a": (0.0, 0.0, 0.0), "b": (1.0, -1.0, 2.0)}
NOTES = {
    "odometry.commanded_velocities": "true",
    "odometry.k_x_m": "1e-3",
    "odometry.k_phi_rad": "1e-3",
}
STEP_S, STEPS = 0.1, 3000


def commands(seed):
    """Velocities (n, 2), m/s and rad/s: changed every few seconds, as of a robot that
    wanders, more to the left, so that it stays among the landmarks."""
    rng = np.random.default_rng(seed)
    rows = [[rng.uniform(0.06, 0.1), rng.uniform(-0.15, 0.35)] for _ in range(STEPS // 25)]
    return np.repeat(rows, 25, axis=0)


def compounded(start, twists):
    poses = [np.array(start)]
    for twist in twists:
        poses.append(compose(poses[-1], exp(twist)))
    return np.array(poses)


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """Two robots drive late, turn less and lose path in turns; both have white camera noise."""
    path = tmp_path_factory.mktemp("commanded") / "log.mcap"
    rng = np.random.default_rng(2)
    late = round(LATENCY_S / STEP_S)
    true, told = {}, {}
    for seed, (robot, start) in enumerate(STARTS.items()):
        v, w = commands(seed).T
        curvature = w / v
        driven = np.column_stack([v * (1 - LOSS_M2 * curvature**2), 0 * v, SCALE * w]) * STEP_S
        driven = np.vstack([np.zeros((late, 3)), driven[:-late]])
        true[robot] = compounded(start, driven)
        told[robot] = compounded(np.zeros(3), np.column_stack([v, 0 * v, w]) * STEP_S)
    sigmas = np.array([0.01, 0.04])
    with LogWriter(path, NOTES) as log:
        for k in range(STEPS):
            stamp = T0 + round(k * STEP_S * S)
            for robot in STARTS:
                log.odometry(robot, stamp, told[robot][k])
            if k % 3:
                continue
            for robot in STARTS:
                for identity, at in LANDMARKS.items():
                    seen = between(true[robot][k], np.array([*at, 0.0]))
                    z = np.array([np.arctan2(seen[1], seen[0]), np.hypot(*seen[:2])])
                    if abs(z[0]) < 0.5:
                        z = z + sigmas * rng.normal(size=2)
                        log.sighting(robot, stamp, z, np.diag(sigmas**2), identity=identity)
    starts = [f"start.poses.{r}=[{x}, {y}, {phi}]" for r, (x, y, phi) in STARTS.items()]
    config = load_config(overrides=starts)
    return smooth(open_logs([path], config), config), true


@pytest.mark.parametrize("robot", STARTS)
def test_how_commands_are_driven_is_found(found, robot):
    """Latency, scale of turning and path lost in turns; left out, the path is too long by 15 %."""
    calibration = found[0].summary["calibration"]

    def value(name):
        return calibration[f"{robot}.{name}"]["value"]

    # a tenth, a fifth and a quarter of what is there; the speed's scale takes part of the last
    assert value("laser_latency_s") == pytest.approx(LATENCY_S, abs=0.02)
    assert value("rotation_scale") == pytest.approx(SCALE - 1, abs=0.01)
    assert value("turning_loss_m2") == pytest.approx(LOSS_M2, abs=0.005)


@pytest.mark.parametrize("robot", STARTS)
def test_the_path_is_as_good_as_the_camera(found, robot):
    """Some centimetres: with the nominal odometry it is decimetres off between sightings."""
    result, true = found
    trajectory = result.robots[robot].final
    times = (trajectory.stamps_ns - T0) * 1e-9 / STEP_S
    k = np.clip(np.rint(times).astype(int), 0, STEPS - 1)
    error = np.hypot(*(trajectory.poses[:, :2] - true[robot][k, :2]).T)
    assert np.sqrt(np.mean(error**2)) < 0.06
