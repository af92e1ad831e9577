"""Scans without a state, matched to the walls of the map."""

import numpy as np
import pytest

from graphslam.core.config import FrontEndConfig
from graphslam.core.geometry import between, compose, inverse, transform, wrap
from graphslam.mapping.returns_on_walls import WallTree
from graphslam.mapping.scan_to_map import ScanReturns, match_to_walls

CONFIG = FrontEndConfig()
#: poses of the walls of a room of 8 m x 6 m, the room on their left
ROOM = np.array([[4, 0, 0], [8, 3, np.pi / 2], [4, 6, np.pi], [0, 3, -np.pi / 2]])
EXTENTS = np.array([[-4, 4], [-3, 3], [-4, 4], [-3, 3.0]])
CORRIDOR = np.array([[0, 0, 0], [0, 2, np.pi]]), np.array([[-50, 50], [-50, 50.0]])
#: m, m, rad: what odometry leaves open
PRIOR = np.diag([0.02, 0.02, 0.02]) ** 2
LASER = np.array([0.2, -0.1])


def cast(pose, walls, beams=60, rng=None, reach_m=25.0, sigma_m=CONFIG.range_sigma_m):
    """Returns (n, 2) in the frame of a pose (3,): of walls in front of a laser, with its noise."""
    means, extents = walls
    laser = transform(pose, LASER[None])[0]
    angle = pose[2] + np.linspace(-np.pi, np.pi, beams, endpoint=False)
    d = np.column_stack([np.cos(angle), np.sin(angle)])
    best = np.full(beams, np.inf)
    for (x, y, phi), (low, high) in zip(means, extents, strict=True):
        t, n = np.array([np.cos(phi), np.sin(phi)]), np.array([-np.sin(phi), np.cos(phi)])
        with np.errstate(divide="ignore"):
            r = ((np.array([x, y]) - laser) @ n) / (d @ n)
        along = (laser + r[:, None] * d - [x, y]) @ t
        best = np.where((r > 0) & (along >= low) & (along <= high), np.minimum(best, r), best)
    if rng is not None:
        best = best + rng.normal(0, sigma_m, beams)
    seen = best < reach_m
    return transform(inverse(pose), laser + best[seen, None] * d[seen])


def returns_of(points):
    return ScanReturns(
        np.array([len(own) for own in points], dtype=np.int64),
        np.concatenate(points).astype(np.float32),
        np.tile(LASER, (len(points), 1)),
    ).only


def tried(walls, n, seed, known=None):
    """True poses, odometry's, those found, and their covariances, (n, ...) each."""
    rng = np.random.default_rng(seed)
    box = np.array([[2, 6], [1.5, 4.5], [-3, 3]]) if walls is ROOM else None
    low, high = ([2, 1.5, -3], [6, 4.5, 3]) if box is not None else ([-5, 0.7, -3], [5, 1.3, 3])
    true = rng.uniform(low, high, size=(n, 3))
    around = (ROOM, EXTENTS) if walls is ROOM else walls
    points = [cast(pose, around, rng=rng) for pose in true]
    prior = compose(true, rng.multivariate_normal(np.zeros(3), PRIOR, size=n))
    covs = np.tile(PRIOR, (n, 1, 1))
    tree = WallTree.from_walls(*(known or around))
    found, left, _ = match_to_walls(prior, covs, returns_of(points), tree, CONFIG)
    return true, prior, found, left


def test_in_a_room_returns_tell_where_a_scan_was():
    """A fifth of what odometry leaves open, and the covariances say by how much it is off: 95 %
    bounds of the mean of 600 x 3 squares, which are wide since walls have no bias here."""
    true, prior, found, left = tried(ROOM, 600, 0)
    off, before = between(true, found), between(true, prior)
    assert np.all(np.sqrt(np.mean(off**2, axis=0)) < 0.3 * np.sqrt(np.mean(before**2, axis=0)))
    nees = np.einsum("ni,nij,nj->n", off, np.linalg.inv(left), off) / 3
    # surfaces could be off by `floor_normal_m`, and here are not
    assert 0.15 < nees.mean() < 1.1


def test_along_a_corridor_odometry_is_believed():
    """No wall tells how far along it a scan was; heading and place across it are better."""
    true, prior, found, left = tried(CORRIDOR, 200, 1)
    moved = found - prior
    assert np.abs(moved[:, 0]).max() < 0.2 * np.sqrt(PRIOR[0, 0])
    assert np.sqrt(np.mean((found - true)[:, 1] ** 2)) < 0.4 * np.sqrt(PRIOR[1, 1])
    assert np.sqrt(np.mean(wrap(found - true)[:, 2] ** 2)) < 0.3 * np.sqrt(PRIOR[2, 2])
    world = compose(np.zeros(3), found)[:, 2]
    along = np.array([np.cos(world), -np.sin(world)]).T  # the corridor's axis, from the scan
    kept = np.einsum("ni,nij,nj->n", along, left[:, :2, :2], along)
    np.testing.assert_allclose(kept, PRIOR[0, 0], rtol=0.2)


def test_what_is_not_in_the_map_moves_nothing():
    """Half of the room's walls are gone and a shelf stands 15 cm before a third: its returns are
    farther from that wall than any return of it."""
    true, _, found, _ = tried(ROOM, 200, 2, known=(ROOM[:2], EXTENTS[:2]))
    assert np.sqrt(np.mean(between(true, found)[:, :2] ** 2)) < 0.01
    rng = np.random.default_rng(3)
    pose = np.array([3.0, 2.0, 0.5])
    moved = ROOM.copy()
    moved[0, 1] = 0.15  # the wall at y = 0 is hidden
    points = cast(pose, (moved, EXTENTS), rng=rng)
    tree = WallTree.from_walls(ROOM, EXTENTS)
    (found,), *_ = match_to_walls(pose[None], PRIOR[None], returns_of([points]), tree, CONFIG)
    assert np.all(np.abs(between(pose, found)) < [0.02, 0.02, 0.006])


def test_blocks_are_as_good_as_all_at_once(monkeypatch):
    """The noise of the prior is that of all scans."""
    whole = tried(ROOM, 30, 4)
    monkeypatch.setattr("graphslam.mapping.scan_to_map.BLOCK", 7)
    parts = tried(ROOM, 30, 4)
    for a, b in zip(whole, parts, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)


def test_odometry_that_is_worse_than_it_states_is_believed_less():
    """Where a third of the true sigmas is stated, what is found is as good as where all is. Breaks
    if the noise of the prior is taken at its word: 0.012 rad instead of 0.001."""
    rng = np.random.default_rng(5)
    true = rng.uniform([2, 1.5, -3], [6, 4.5, 3], size=(300, 3))
    points = returns_of([cast(pose, (ROOM, EXTENTS), rng=rng) for pose in true])
    prior = compose(true, rng.multivariate_normal(np.zeros(3), PRIOR, size=300))
    tree = WallTree.from_walls(ROOM, EXTENTS)
    good, bad = (
        np.sqrt(np.mean(between(true, found) ** 2, axis=0))
        for found, *_ in (
            match_to_walls(prior, np.tile(PRIOR / s**2, (300, 1, 1)), points, tree, CONFIG)
            for s in (1.0, 3.0)
        )
    )
    assert np.all(bad < 1.2 * good)


@pytest.mark.parametrize("points", [np.zeros((0, 2)), np.array([[1.0, 1.0]])])
def test_a_scan_without_returns_on_walls_stays(points):
    pose, walls = np.array([[3.0, 2.0, 0.5]]), WallTree.from_walls(ROOM, EXTENTS)
    found, left, _ = match_to_walls(pose, PRIOR[None], returns_of([points]), walls, CONFIG)
    np.testing.assert_allclose(found, pose, atol=1e-12)
    np.testing.assert_allclose(left[0], PRIOR, rtol=1e-3, atol=1e-12)


def test_a_laser_that_is_noisier_than_settings_say_is_believed_less():
    """Five times: places by the map are no worse than odometry that is known to 5 mm. Breaks if
    the noise of returns is taken at its word: 8 mm and more."""
    rng = np.random.default_rng(6)
    true = rng.uniform([2, 1.5, -3], [6, 4.5, 3], size=(300, 3))
    noisy = [cast(pose, (ROOM, EXTENTS), rng=rng, sigma_m=0.1) for pose in true]
    cov = np.diag([0.005, 0.005, 0.005]) ** 2
    prior = compose(true, rng.multivariate_normal(np.zeros(3), cov, size=300))
    tree = WallTree.from_walls(ROOM, EXTENTS)
    covs = np.tile(cov, (300, 1, 1))
    found, left, _ = match_to_walls(prior, covs, returns_of(noisy), tree, CONFIG)
    off = between(true, found)
    assert np.all(np.sqrt(np.mean(off**2, axis=0)) < 1.1 * np.sqrt(np.diag(cov)))
    assert np.mean(np.einsum("ni,nij,nj->n", off, np.linalg.inv(left), off)) / 3 < 1.5


def test_scans_that_do_not_find_their_place_stay_with_what_was_known():
    """One in ten is turned by 25 degrees, beyond any gate. Breaks if what a few returns say by
    chance is taken for its pose, with a sigma of a milliradian."""
    rng = np.random.default_rng(7)
    true = rng.uniform([2, 1.5, -3], [6, 4.5, 3], size=(200, 3))
    points = returns_of([cast(pose, (ROOM, EXTENTS), rng=rng) for pose in true])
    prior = compose(true, rng.multivariate_normal(np.zeros(3), 0.25 * PRIOR, size=200))
    prior[::10, 2] += np.radians(25.0)
    tree = WallTree.from_walls(ROOM, EXTENTS)
    covs = np.tile(0.25 * PRIOR, (200, 1, 1))
    found, left, _ = match_to_walls(prior, covs, points, tree, CONFIG)
    off = np.abs(between(true, found))
    lost = np.arange(200) % 10 == 0
    assert off[~lost, 2].max() < 0.02
    assert np.all((off[lost, 2] < 0.02) | (left[lost, 2, 2] >= 0.9 * covs[0, 2, 2]))


def test_a_scan_far_off_is_brought_home():
    """By 4 degrees, which odometry that stops does; two rounds are not enough."""
    rng = np.random.default_rng(8)
    true = rng.uniform([2, 1.5, -3], [6, 4.5, 3], size=(200, 3))
    points = returns_of([cast(pose, (ROOM, EXTENTS), rng=rng) for pose in true])
    prior = compose(true, rng.multivariate_normal(np.zeros(3), PRIOR, size=200))
    prior[::10, 2] += np.radians(4.0)
    tree = WallTree.from_walls(ROOM, EXTENTS)
    found, left, _ = match_to_walls(prior, np.tile(PRIOR, (200, 1, 1)), points, tree, CONFIG)
    home = np.abs(between(true, found)[:, 2]) < 0.02
    assert np.count_nonzero(home[::10]) >= 17  # of 20: some are 6 degrees off by their noise
    assert np.all(home | (left[:, 2, 2] > 0.9 * PRIOR[2, 2]))
