"""Two subjects under each other's names: found from where they are seen, and put right."""

import numpy as np
import pytest

from graphslam.config import load_config
from graphslam.geometry import between, compose, exp
from graphslam.logs import LogWriter, open_logs
from graphslam.slam import smooth

S, T0 = 1_000_000_000, 10_000_000_000
STARTS = {"a": (0.0, 0.0, 0.0), "b": (5.0, 0.0, 2.0), "c": (2.0, 5.0, -1.5)}
LANDMARKS = {"6": (3.0, 2.0), "7": (-1.0, 4.0), "8": (6.0, 5.0)}
TWISTS = {"a": (0.3, 0.0, 0.2), "b": (0.25, 0.0, -0.15), "c": (0.3, 0.0, 0.1)}


def pose(robot, seconds):
    return compose(np.array(STARTS[robot]), exp(np.array(TWISTS[robot]) * seconds))


def write(path, names, seed=4):
    """Three robots on circles see each other and three landmarks, under ``names`` where given."""
    rng = np.random.default_rng(seed)
    sigmas = np.array([0.01, 0.05])
    with LogWriter(path) as log:
        for k in range(600):
            stamp = T0 + k * S // 10
            for robot in STARTS:
                turned = exp(np.array([1.0, 1.0, 1.02]) * TWISTS[robot] * k / 10)
                log.odometry(robot, stamp, turned)
            if k % 5:
                continue
            for robot in STARTS:
                x = pose(robot, k / 10)
                for name, at in {**LANDMARKS, **{r: pose(r, k / 10)[:2] for r in STARTS}}.items():
                    called = names.get(name, name)
                    if robot in (name, called):  # nobody sees itself, or uses its own code
                        continue
                    seen = between(x, np.array([*at, 0.0]))
                    z = np.array([np.arctan2(seen[1], seen[0]), np.hypot(*seen[:2])])
                    z = z + sigmas * rng.normal(size=2)
                    subject = {"seen_robot" if called in STARTS else "identity": called}
                    log.sighting(robot, stamp, z, np.diag(sigmas**2), **subject)


def run(tmp_path, names):
    write(tmp_path / "log.mcap", names)
    starts = [f"start.poses.{r}=[{x}, {y}, {phi}]" for r, (x, y, phi) in STARTS.items()]
    config = load_config(overrides=starts)
    return smooth(open_logs([tmp_path / "log.mcap"], config), config)


@pytest.mark.parametrize("pair", [(), ("b", "c"), ("b", "7")])
def test_exchanged_names_are_found_and_put_right(tmp_path, pair):
    """A robot with a robot, a robot with a landmark; where nothing is wrong nothing is changed."""
    result = run(tmp_path, dict(zip(pair, pair[::-1], strict=True)))
    told = [w for w in result.summary["warnings"] if "exchanged" in w]
    assert len(told) == bool(pair)
    assert all(name in told[0] for name in pair)
    for name, robot in result.robots.items():
        seconds = (robot.final.stamps_ns - T0) * 1e-9
        true = np.array([pose(name, t) for t in seconds])
        # a few cm are what is left of sightings with 5 cm noise; a false name costs decimetres
        error = np.hypot(*(robot.final.poses[:, :2] - true[:, :2]).T)
        assert np.sqrt(np.mean(error**2)) < 0.1
    found = {mark.identity: mark.position[:2] for mark in result.landmarks}
    assert set(found) == set(LANDMARKS)
    for identity, at in LANDMARKS.items():
        np.testing.assert_allclose(found[identity], at, atol=0.15)


def test_landmarks_exchanged_among_themselves_are_only_names(tmp_path):
    """Nothing in the log contradicts it, so nothing is claimed and the paths are as good."""
    result = run(tmp_path, {"6": "7", "7": "6"})
    assert not [w for w in result.summary["warnings"] if "exchanged" in w]
    found = {mark.identity: mark.position[:2] for mark in result.landmarks}
    np.testing.assert_allclose(found["6"], LANDMARKS["7"], atol=0.15)
