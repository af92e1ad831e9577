"""Scan matching in rooms of straight walls."""

import numpy as np
import pytest
from walls import CORRIDOR, L_ROOM, cloud

from graphslam.core.geometry import between, compose
from graphslam.perception.scan_matching import (
    agreement,
    align,
    align_pairs,
    make_submap,
    match,
    match_pairs,
    search,
)


def submap(middle, walls, rng=None, shift=0.5):
    """A submap around ``middle`` (3,), of three scans."""
    poses = np.array([compose(middle, np.array([x, 0.0, 0.0])) for x in (-shift, 0.0, shift)])
    return make_submap(between(middle, poses), [cloud(pose, walls, rng) for pose in poses])


def test_a_room_is_found_again_from_elsewhere():
    """Breaks with a sign in the search, the alignment, or the frames of a match. The guess is 1.1 m
    and 10 degrees off; with 1 cm of noise it ends within 2 cm and 0.3 degrees."""
    target = submap(np.array([-2.0, 1.0, 0.3]), L_ROOM)
    for seed in range(5):
        there = np.array([1.0, -1.5, -0.6])
        truth = between(np.array([-2.0, 1.0, 0.3]), there)
        source = submap(there, L_ROOM, np.random.default_rng(seed))
        guess = truth + np.array([0.8, -0.8, 0.17])
        found = match(source, target, guess, np.array([1.5, 1.5, 0.3]))
        assert np.hypot(*(found[0].pose - truth)[:2]) < 0.02
        assert abs(found[0].pose[2] - truth[2]) < 0.005
        assert found[0].same > 0.7
        assert found[0].absent < 0.05


def test_a_place_where_hardly_a_point_lies_on_another_is_none():
    """Breaks with a search that forgets ``min_score``, or takes it of the best place instead of all
    points. On the room itself 0.7 of them lie (a neighbouring cell counts half), on a corridor less
    than a tenth: 0.5 is between the two."""
    here, there = np.array([-2.0, 1.0, 0.3]), np.array([1.0, -1.5, -0.6])
    source, same = submap(there, L_ROOM), submap(here, L_ROOM)
    other = submap(np.zeros(3), CORRIDOR)
    guess, window = between(here, there), np.array([0.6, 0.6, 0.1])
    assert search(source, same, guess, window, 0.5)
    assert search(source, other, np.zeros(3), np.array([3.0, 3.0, 0.1]))
    assert not search(source, other, np.zeros(3), np.array([3.0, 3.0, 0.1]), 0.5)


def test_the_covariance_of_a_match_covers_its_error():
    """Breaks with a covariance that counts every point as independent of all others and has no
    floor, or that is in another frame. It is cautious here (a real submap is bent, and walls are of
    several materials), so only bounded above: chi-square's 99.9 % over 20 seeds and 3 rows."""
    target_at, there = np.array([-2.0, 1.0, 0.3]), np.array([0.5, 1.5, 1.0])
    truth, d2 = between(target_at, there), []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        source, target = submap(there, L_ROOM, rng), submap(target_at, L_ROOM, rng)
        pose, cov = align(source, target, truth + np.array([0.1, -0.1, 0.03]))
        d2.append((pose - truth) @ np.linalg.solve(cov, pose - truth) / 3)
    assert np.mean(d2) < 1.66


def test_along_a_corridor_nothing_is_known():
    """Breaks with an alignment that invents a place along parallel walls, or says that it knows it:
    ends of the laser's reach look like ends of the wall."""
    source, target = (submap(np.array([x, 0.0, 0.0]), CORRIDOR) for x in (3.0, 0.0))
    pose, cov = align(source, target, np.array([2.0, 0.1, 0.05]))
    assert abs(pose[1]) < 0.01
    assert abs(pose[2]) < 0.005
    assert np.sqrt(cov[0, 0]) > 5 * np.sqrt(cov[1, 1])


@pytest.mark.parametrize(("moved", "absent"), [(0.0, 0.02), (1.0, 0.1)])
def test_what_is_looked_through_counts_against_a_place(moved, absent):
    """Breaks with an agreement that counts matches only: the same room put a metre off confirms
    less, and is looked through a lot."""
    a, b = (submap(np.array([x, 1.0, 0.0]), L_ROOM) for x in (-2.0, -1.0))
    same, missing = agreement(b, a, np.array([1.0 + moved, 0.0, 0.0]))
    assert (missing < absent) if moved == 0 else (missing > absent)
    assert (same > 0.8) if moved == 0 else (same < 0.7)


def pairs_of_all_kinds():
    """Four pairs: the same room twice, a corridor, and two places with nothing in common."""
    room = [submap(np.array([x, 1.0, 0.3]), L_ROOM) for x in (-2.0, -1.5, -1.0)]
    corridor = [submap(np.array([x, 0.0, 0.0]), CORRIDOR) for x in (3.0, 0.0)]
    sources = [room[0], room[2], corridor[0], room[1]]
    targets = [room[1], room[1], corridor[1], corridor[0]]
    near = [between(np.array([-1.5, 1.0, 0.3]), np.array([x, 1.1, 0.32])) for x in (-2.0, -1.0)]
    return sources, targets, [*near, np.array([2.0, 0.1, 0.05]), np.array([50.0, 0.0, 0.0])]


def test_a_pair_is_aligned_the_same_whatever_is_aligned_beside_it():
    """To the last bit, so that it does not matter which process aligns what. Breaks with sums over
    all points of a batch, and if a pair that has converged, or has no neighbours, holds up another.
    """
    sources, targets, guesses = pairs_of_all_kinds()
    poses, covs, shares = align_pairs(sources, targets, guesses)
    for k in range(4):
        one = align_pairs(sources[k : k + 1], targets[k : k + 1], guesses[k : k + 1])
        for together, alone in zip((poses, covs, shares), one, strict=True):
            assert np.array_equal(together[k], alone[0])
    assert shares[:3].min() > 0.7
    assert shares[3] == 0.0
    assert np.array_equal(poses[3], guesses[3])
    assert covs[3, 0, 0] > 100.0


def test_pairs_are_matched_as_each_alone():
    """Breaks if the starts of one pair are aligned with the submaps of another."""
    sources, targets, guesses = pairs_of_all_kinds()
    window = [np.array([1.0, 1.0, 0.1])] * 4
    together = match_pairs(sources, targets, guesses, window)
    assert together[0] and not together[3]
    for k in range(4):
        alone = match(sources[k], targets[k], guesses[k], window[k])
        assert len(alone) == len(together[k])
        for a, b in zip(alone, together[k], strict=True):
            assert np.array_equal(a.pose, b.pose)
            assert (a.same, a.absent) == (b.same, b.absent)


def test_the_guess_is_a_match_where_many_places_are_alike():
    """Bays of one shape, a metre apart, nine in the window; the search returns four places at most,
    those with most in common. Breaks if the guess, three bays off these, is no match."""
    bays = [((x, 0.0), (x, 0.4)) for x in np.arange(-6.0, 6.5)]
    walls = [*bays, ((-6.0, 0.0), (6.0, 0.0)), ((-6.0, 4.0), (6.0, 4.0))]
    rng = np.random.default_rng(3)
    before = submap(np.array([0.0, 1.5, 0.0]), walls, rng)
    now = submap(np.array([0.0, 1.5, 0.0]), walls, rng)
    for guess in np.array([[-3.0, 0.0, 0.0], [3.0, 0.0, 0.0]]):
        found = match(now, before, guess, np.array([4.4, 0.3, 0.1]))
        assert any(np.hypot(*(m.pose - guess)[:2]) < 0.1 for m in found)
