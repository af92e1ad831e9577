"""Surfaces of a single scan: seen by few returns far away, in between them, and not across gaps."""

import numpy as np
import pytest
from walls import cast, rectangles

from graphslam.core.config import Config, ScanMatchingConfig
from graphslam.core.geometry import compose
from graphslam.core.records import Scan
from graphslam.odometry.laser_odometry import LaserOdometry
from graphslam.perception.scan_surfaces import SPACING_M, scan_surfaces

STEP = np.radians(1.0)
ANGLES = np.arange(-90, 91) * STEP
HERE = np.zeros(2)
CONFIG = ScanMatchingConfig()
#: a corridor that ends 25 m ahead, where beams are 0.44 m apart
CORRIDOR = rectangles((-20.0, -1.1, 25.0, 1.1))


def ranges_seen(walls, pose=(0.0, 0.0, 0.0), seed=0):
    rng = np.random.default_rng(seed)
    return cast(walls, ANGLES, np.array(pose), 30.0) + rng.normal(0, 0.015, len(ANGLES))


def points_seen(walls, seed=0):
    ranges = ranges_seen(walls, seed=seed)
    points = ranges[:, None] * np.column_stack([np.cos(ANGLES), np.sin(ANGLES)])
    return points[np.isfinite(ranges)]


def test_the_end_of_a_corridor_is_a_surface():
    """Of five returns; it has points as often as other surfaces, whose information is across.
    Breaks if neighbours are looked for within a fixed distance."""
    points, information = scan_surfaces(points_seen(CORRIDOR), HERE, STEP, CONFIG)
    end = points[:, 0] > 24.5
    assert np.ptp(points[end][:, 1]) > 1.6
    assert np.diff(np.sort(points[end][:, 1])).max() < 1.5 * SPACING_M
    across = 1 / CONFIG.point_sigma_m**2
    assert np.abs(points[end][:, 0] - 25.0).max() < 0.05
    assert np.all(information[end][:, 0, 0] > 0.95 * across)


def test_nothing_is_seen_between_two_surfaces():
    """A wall, and one 10 cm behind it, as in door frames: no point is made in the gap between."""
    walls = np.concatenate([rectangles((1.0, -5.0, 1.2, 0.0)), rectangles((1.1, 0.0, 1.2, 5.0))])
    points, _ = scan_surfaces(points_seen(walls), HERE, STEP, CONFIG)
    x = points[np.abs(points[:, 1]) < 4.0][:, 0]
    assert len(x) > 100 and np.all((np.abs(x - 1.0) < 0.04) | (np.abs(x - 1.1) < 0.04))


@pytest.mark.parametrize("seed", range(3))
def test_a_flat_wall_is_less_noisy_than_its_returns(seed):
    seen = points_seen(rectangles((2.0, -30.0, 2.5, 30.0)), seed=seed)
    points, _ = scan_surfaces(seen, HERE, STEP, CONFIG)
    near = np.abs(seen[:, 1]) < 2.0
    # of 25 returns along the wall, noise of a line at a point is a fifth to two fifths of theirs
    assert points[: len(seen)][near][:, 0].std() < 0.5 * seen[near][:, 0].std()


def test_few_returns_have_no_surface():
    for n in range(3):
        points, information = scan_surfaces(np.ones((n, 2)), HERE, STEP, CONFIG)
        assert len(points) == n and not information.any()


@pytest.mark.parametrize("seed", range(3))
def test_the_end_of_a_corridor_tells_how_far_the_robot_went(seed):
    """3 m along bare walls, 25 m from their end: to 10 cm in 24 scans, two sigmas of the end's five
    returns, and it is known. Without the end nothing tells, and metres are stated."""
    laser, pose, found = LaserOdometry(Config()), np.zeros(3), []
    way = np.cumsum(np.minimum(0.03 * np.arange(24), 0.15))  # it starts as robots do
    for k, x in enumerate(way):
        stamp = k * 300_000_000
        ranges = ranges_seen(CORRIDOR, (x, 0.0, 0.0), seed=[seed, k])
        found += laser.add(Scan("r", stamp, stamp, ranges, ANGLES[0], STEP, np.zeros(3)))
    found += laser.finish()
    for one in found:
        pose = compose(pose, one.delta)
    assert pose == pytest.approx([way[-1], 0.0, 0.0], abs=0.1)
    assert sum(one.cov[0, 0] for one in found) < 0.5**2
