"""All scans of a path aligned with each other: what they tell, and what they leave as it was."""

import numpy as np
import pytest
from walls import CORRIDOR, L_ROOM, cloud

from graphslam.core.config import ScanMatchingConfig
from graphslam.core.geometry import Array, between, compose, rotate_cov, wrap
from graphslam.perception import scan_bundle
from graphslam.perception.scan_bundle import align_all

CONFIG = ScanMatchingConfig()
#: information of a motion that is known to 2 cm and 6 mrad
MOTION = np.diag(1.0 / np.square([0.02, 0.02, 0.006]))
#: a corridor with doors in niches 10 cm deep, every 2 m on either side
NICHES = np.concatenate([
    [[[x, 1], [x + 1.1, 1]], [[x + 1.1, 1], [x + 1.1, 1.1]], [[x + 1.1, 1.1], [x + 2, 1.1]],
     [[x + 2, 1.1], [x + 2, 1]],
     [[x, -1], [x, -1.1]], [[x, -1.1], [x + 0.9, -1.1]], [[x + 0.9, -1.1], [x + 0.9, -1]],
     [[x + 0.9, -1], [x + 2, -1]]]
    for x in range(-60, 60, 2)
])  # fmt: skip


def aligned(walls, truth, begin, rng=None, motion=MOTION, limit=20.0):
    """The bundle of scans from true poses (n, 3), of which others (n, 3) are known to begin."""
    clouds = [cloud(pose, walls, rng, limit) for pose in truth]
    scan = np.repeat(np.arange(len(clouds)), [len(c) for c in clouds])
    points = np.concatenate(clouds)
    between_poses = np.broadcast_to(motion, (len(truth) - 1, 3, 3))
    return align_all(points, np.zeros_like(points), scan, begin, between_poses, CONFIG)


def off(found: Array, truth: Array) -> Array:
    """Errors (n, 3) of poses seen from the first, along the axes of the true ones."""
    errors = between(between(truth[0], truth), between(found[0], found))
    errors[:, 2] = wrap(errors[:, 2])
    return errors


def straight(n: int, step_m: float = 0.4) -> Array:
    return np.column_stack([step_m * np.arange(n) - 3.0, np.full(n, 0.1), np.zeros(n)])


def shaken(truth: Array, seed: int, sigma_m: float = 0.01, sigma_rad: float = 0.004) -> Array:
    noise = np.random.default_rng(seed).normal(size=truth.shape) * [sigma_m, sigma_m, sigma_rad]
    noise[0] = 0.0
    return truth + noise


def test_without_noise_poses_come_to_the_truth():
    """To 0.3 mm, from 1 cm off. Breaks if the lines are eliminated wrongly."""
    truth = np.array([compose([-2.0, -1.5, 0.4], [0.1 * k, 0.03 * k, 0.05 * k]) for k in range(15)])
    found = aligned(L_ROOM, truth, shaken(truth, 1), motion=1e-6 * MOTION).poses
    assert np.abs(off(shaken(truth, 1), truth)[:, :2]).max() > 0.01
    assert np.abs(off(found, truth)).max() < 3e-4


@pytest.mark.parametrize("seed", range(3))
def test_door_niches_tell_how_far_a_robot_went(seed):
    """A scan has one return or two of each side of a niche. From 1 cm off to 5 mm along a corridor,
    which has nothing else. Breaks if the sides are taken for a part of the wall."""
    truth = straight(40)
    found = aligned(NICHES, truth, shaken(truth, seed), np.random.default_rng(seed), limit=8.0)
    before, after = off(shaken(truth, seed), truth), off(found.poses, truth)
    assert before[:, 0].std() > 0.008
    assert after.std(axis=0) == pytest.approx(np.zeros(3), abs=0.005)


def test_along_bare_walls_the_motion_is_what_it_was():
    """Nothing tells how far the robot went there: it is as before, and the information says so.
    Across the walls it is known. Breaks if the noise of surfaces holds or moves a robot."""
    truth = straight(30)
    begin = truth + np.column_stack(
        [0.03 * np.arange(30), 0.01 * (-1) ** np.arange(30), 0 * truth[:, 0]]
    )
    found = aligned(CORRIDOR, truth, begin, np.random.default_rng(4), limit=10.0)
    steps = np.diff(found.poses[:, 0])
    assert steps == pytest.approx(np.full(29, 0.43), abs=0.003)
    assert np.abs(np.diff(found.poses[:, 1])).max() < 0.005 < np.abs(np.diff(begin[:, 1])).max()
    along, across = np.diagonal(found.information, axis1=1, axis2=2)[:, :2].T
    assert np.all(along < 0.02 * across)


def test_two_visits_of_a_place_lie_on_each_other():
    """The second time 3 cm beside the first, by poses: to 4 mm. Breaks if each visit has lines of
    its own."""
    truth = np.concatenate([straight(25), np.add(straight(25)[::-1], [0.1, 0.2, 0.0])])
    truth[25:, 2] = np.pi
    begin = truth.copy()
    begin[25:, 1] += 0.03
    found = aligned(NICHES, truth, begin, np.random.default_rng(5), limit=8.0)
    assert off(begin, truth)[25:, 1].mean() == pytest.approx(-0.03, abs=1e-6)
    assert abs(off(found.poses, truth)[25:, 1].mean()) < 0.004


def test_information_is_what_the_errors_show():
    """Errors of poses against the map are as large as stated, within a factor of two: each scan's
    own information, by the noise of the residuals, not by the one that is configured."""
    errors, stated = [], []
    for seed in range(4):
        truth = np.array([[0.05 * k - 2.0, 0.03 * k - 1.0, 0.1 * k] for k in range(30)])
        found = aligned(L_ROOM, truth, shaken(truth, seed), np.random.default_rng(seed))
        relative = off(found.poses, truth)
        relative -= relative.mean(axis=0)
        errors.append(relative[:, :2])
        cov = np.linalg.inv(found.information)
        stated.append(
            np.mean([np.diag(rotate_cov(c, -t[2]))[:2] for c, t in zip(cov, truth, strict=True)])
        )
    assert 0.5 < np.sqrt(np.mean(np.square(errors)) / np.mean(stated)) < 2.0


def test_a_wall_seen_from_both_sides_is_two_surfaces():
    """A thin wall 3 cm thick, passed on either side. Breaks if its sides are averaged."""
    wall = np.array([[[-8, 0.015], [8, 0.015]], [[-8, -0.015], [8, -0.015]]])
    room = np.concatenate([wall, [[[-8, -3], [8, -3]], [[-8, 3], [8, 3]], [[8, -3], [8, 3]]]])
    one, other = straight(20, 0.3), straight(20, 0.3)
    one[:, 1], other[:, 1] = 1.5, -1.5
    truth = np.concatenate([one, other])
    found = aligned(room, truth, truth, np.random.default_rng(6), limit=10.0)
    beside = off(found.poses, truth)[:, 1]
    assert abs(beside[20:].mean() - beside[:20].mean()) < 0.005


def test_scans_that_see_no_surface_change_nothing():
    """Two returns in each: the poses are those given, and nothing is known of them."""
    begin = straight(5)
    points = np.tile([[1.0, 2.0], [3.0, -2.0]], (5, 1))
    scan = np.repeat(np.arange(5), 2)
    motion = np.broadcast_to(MOTION, (4, 3, 3))
    found = align_all(points, np.zeros_like(points), scan, begin, motion, CONFIG)
    assert np.array_equal(found.poses, begin) and not found.information.any()


def test_neighbours_are_found_in_blocks(monkeypatch):
    """Breaks if the size of what is in memory at once tells in the result."""
    truth = straight(20)
    args = (NICHES, truth, shaken(truth, 7))
    whole = aligned(*args, np.random.default_rng(7), limit=8.0)
    monkeypatch.setattr(scan_bundle, "BLOCK", 100)
    pieces = aligned(*args, np.random.default_rng(7), limit=8.0)
    assert np.array_equal(whole.poses, pieces.poses)
