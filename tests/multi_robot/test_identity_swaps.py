"""Two subjects with swapped identities: detected by where they are seen, and corrected."""

import numpy as np
import pytest
from three_robots import LANDMARKS, STARTS, T0, pose, write

from graphslam.core.config_io import load_config
from graphslam.logs import open_logs
from graphslam.slam.smooth import smooth


def run(tmp_path, names):
    write(tmp_path / "log.mcap", seed=4, names=names)
    starts = [f"start.poses.{r}=[{x}, {y}, {phi}]" for r, (x, y, phi) in STARTS.items()]
    config = load_config(overrides=starts)
    return smooth(open_logs([tmp_path / "log.mcap"], config), config)


@pytest.mark.parametrize("pair", [(), ("b", "c"), ("b", "7")])
def test_swapped_identities_are_found_and_corrected(tmp_path, pair):
    """A robot with a robot, a robot with a landmark; where nothing is wrong nothing is changed."""
    result = run(tmp_path, dict(zip(pair, pair[::-1], strict=True)))
    told = [w for w in result.summary["warnings"] if "swapped" in w]
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


def test_swapped_landmarks_do_not_change_the_estimate(tmp_path):
    """Nothing in the log contradicts it, so nothing is reported and the paths are as good."""
    result = run(tmp_path, {"6": "7", "7": "6"})
    assert not [w for w in result.summary["warnings"] if "swapped" in w]
    found = {mark.identity: mark.position[:2] for mark in result.landmarks}
    np.testing.assert_allclose(found["6"], LANDMARKS["7"], atol=0.15)
