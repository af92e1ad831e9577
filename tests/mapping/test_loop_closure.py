"""Loops that are closed by matching: which closures are believed, and what they do to a run."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from walls import L_ROOM, cloud

from graphslam.core.config import Config, LoopClosureConfig
from graphslam.core.geometry import between, compose
from graphslam.core.records import Closure, KeyframeScan, Trajectory
from graphslam.mapping.corridor_direction import wall_direction
from graphslam.mapping.loop_closure import (
    SubmapPair,
    Verified,
    candidates,
    consistent_closures,
    fix_position,
    inflate_covariances,
    known_part,
    leave_open,
    loop_closures,
    verify_match,
    verify_match_across,
    verify_pairs,
    violated,
)
from graphslam.mapping.submaps import SubmapPose, build_submaps
from graphslam.perception.scan_matching import Match, make_submap

COV = np.diag([0.02, 0.02, 0.005]) ** 2
CONFIG = LoopClosureConfig()


def drive(poses, seen_from):
    """Trajectory at ``poses`` (n, 3) and scans as seen from ``seen_from`` (n, 3)."""
    stamps = np.arange(len(poses), dtype=np.int64) * 1_000_000_000
    states = {"robot": Trajectory(stamps, poses, np.zeros((len(poses), 3, 3)))}
    keyframe_scans = [
        KeyframeScan("robot", int(t), cloud(p, L_ROOM).astype(np.float32))
        for t, p in zip(stamps, seen_from, strict=True)
    ]
    return states, keyframe_scans


def round_trip():
    """36 m in circles of 1 m radius about (-2.5, 1): true poses (n, 3)."""
    angle = np.arange(0.0, 36.0, 0.25)
    return np.column_stack([
        -2.5 + np.cos(angle), 1.0 + np.sin(angle), angle + np.pi / 2
    ])  # fmt: skip


def drifting(true, per_metre=0.004):
    """The same path by an odometry that turns too much."""
    moves = between(true[:-1], true[1:])
    moves[:, 2] += per_metre * np.hypot(moves[:, 0], moves[:, 1])
    out = [true[0]]
    for move in moves:
        out.append(compose(out[-1], move))
    return np.array(out)


def test_a_drifted_run_meets_itself():
    """Breaks if closures are of the wrong pair, the wrong way round, or not found at all: each one
    found says where the later place truly lies in the earlier."""
    true = round_trip()
    states, keyframe_scans = drive(drifting(true), true)
    found = build_submaps(states, keyframe_scans, Config())
    P = np.kron(np.eye(len(found)), np.diag([0.05, 0.05, 0.03]) ** 2)
    closures, _ = loop_closures(found, P, {}, CONFIG, verify_pairs)
    assert len(closures) >= 3
    at = {int(t): k for k, t in enumerate(states["robot"].stamps_ns)}
    for c in closures:
        truth = between(true[at[c.other_time_ns]], true[at[c.time_ns]])
        off = between(truth, c.delta)
        # a submap is bent by the drift within its 6 m: 0.004 * 6 rad at most
        assert np.hypot(off[0], off[1]) < 0.06
        assert abs(off[2]) < 0.024


def test_a_run_that_is_right_needs_no_closure():
    """Breaks with closures where nothing is to be closed: what is there is only confirmed."""
    true = round_trip()
    states, keyframe_scans = drive(true, true)
    found = build_submaps(states, keyframe_scans, Config())
    P = np.kron(np.eye(len(found)), np.diag([0.05, 0.05, 0.03]) ** 2)
    assert candidates(found, P, CONFIG)
    lost, confirmed = loop_closures(found, P, {}, CONFIG, verify_pairs)
    assert lost == []
    for c in confirmed:
        at = {place.state: place.pose for place in found}
        off = between(c.delta, between(at[c.pair[1]], at[c.pair[0]]))
        assert np.hypot(off[0], off[1]) < 0.05  # what the matching is allowed to be off


def test_a_pair_is_looked_at_once():
    """Breaks if rounds cost as much as the first one where nothing has moved."""
    true = round_trip()
    states, keyframe_scans = drive(drifting(true), true)
    found = build_submaps(states, keyframe_scans, Config())
    P = np.kron(np.eye(len(found)), np.diag([0.05, 0.05, 0.03]) ** 2)
    looked = {}
    assert loop_closures(found, P, looked, CONFIG, verify_pairs)[0]
    assert loop_closures(found, P, looked, CONFIG, verify_pairs) == ([], [])


GOOD = Match(np.zeros(3), COV, same=0.7, absent=0.03)


@pytest.mark.parametrize(
    "bad",
    [
        [replace(GOOD, same=0.3)],
        [replace(GOOD, absent=0.2)],
        [replace(GOOD, cov=np.diag([1.0, 0.02, 0.005]) ** 2)],
        [GOOD, replace(GOOD, pose=np.ones(3), same=0.65)],
        [],
    ],
    ids=["little overlap", "looked through", "free along a wall", "a second place", "nothing"],
)
def test_what_makes_a_match_unbelievable(bad):
    """Breaks with any of the conditions left out."""
    assert verify_match([GOOD]) is GOOD
    assert verify_match(bad) is None


def closed_loops(poses, true):
    """Places along ``poses`` where ``true`` ones were driven, true poses of them, true closures."""
    states, keyframe_scans = drive(poses, true)
    found = build_submaps(states, keyframe_scans, Config())
    at = {int(t): k for k, t in enumerate(states["robot"].stamps_ns)}
    where = np.array([true[at[p.state[1]]] for p in found])
    good = [
        Closure(*found[i].state, *found[i - 6].state, between(where[i - 6], where[i]), COV)
        for i in range(6, len(found))
    ]
    return found, where, good


def random_walk(n, sigmas):
    """Joint covariance (3n, 3n) of n places; ``sigmas`` (3,) m, m, rad from place to place."""
    walk = np.minimum.outer(np.arange(n) + 1.0, np.arange(n) + 1.0)
    return np.kron(walk, np.diag(sigmas) ** 2)


def random_closures(found, true, rng, groups):
    """False closures: ``groups`` of three that agree with each other, moved as one by metres."""
    made = []
    for _ in range(groups):
        i, j = (int(k) for k in rng.choice(len(found) - 3, 2, replace=False))
        shift = np.array([*rng.uniform(1.0, 3.0, 2), rng.uniform(0.2, 0.6)])
        for k in range(3):
            later, earlier = found[i + k], found[j]
            delta = compose(shift, between(true[j], true[i + k]))
            made.append(Closure(*later.state, *earlier.state, delta, COV))
    return made


@pytest.mark.parametrize("share", [0.1, 0.3, 0.5])
def test_false_closures_are_left_out(share):
    """10, 30 and 50 % false ones among true ones, in groups of three that agree with each other:
    all true ones are kept, no false one. Breaks with a gate on single closures alone (the joint is
    wide here: it lets metres pass), or with the first consistent group instead of the largest."""
    rng = np.random.default_rng(7)
    true = round_trip()
    found, where, good = closed_loops(drifting(true), true)
    # a random walk, as wide as it gets: 0.5 m and 0.1 rad from place to place
    P = random_walk(len(found), [0.5, 0.5, 0.1]) / 16
    count = round(len(good) * share / (1 - share) / 3)
    false = random_closures(found, where, rng, max(1, count))
    mixed = [*good, *false]
    order = rng.permutation(len(mixed))
    kept = consistent_closures([mixed[k] for k in order], found, P)
    assert not any(c in kept for c in false)
    assert sum(c in kept for c in good) >= 0.95 * len(good)


def test_a_bend_that_the_estimate_does_not_know_of_is_believed_of_many_closures():
    """The path turns by 0.1 rad halfway, where a wall was taken for another, and the estimate is
    sure of it to less than a hundredth of that. True closures across the bend are kept; closures
    off by metres, each for itself, are not. Breaks if only the estimate's own covariance counts."""
    rng = np.random.default_rng(3)
    true = round_trip()
    bend = 70
    turned = compose(compose(true[bend], np.array([0.0, 0.0, 0.1])), between(true[bend], true))
    poses = np.where(np.arange(len(true))[:, None] < bend, true, turned)
    found, where, good = closed_loops(poses, true)
    across = [c for c in good if c.other_time_ns < found[0].state[1] + bend * 10**9 <= c.time_ns]
    assert len(across) >= 4
    P = random_walk(len(found), [0.002, 0.002, 0.0005])
    false = [c for _ in range(3) for c in random_closures(found, where, rng, 1)[:1]]
    kept = consistent_closures([*good, *false], found, P)
    assert all(c in kept for c in across)
    assert not any(c in kept for c in false)


def test_slack_closures_draw_within_three_sigmas():
    """Breaks if a verified closure enters so tight that a robust kernel takes it for wrong, or if
    one that fits is widened."""
    states = {"robot": Trajectory(np.array([0, 1]), np.zeros((2, 3)), np.zeros((2, 3, 3)))}
    far = Closure("robot", 1, "robot", 0, np.array([1.0, 0.0, 0.3]), COV)
    near = Closure("robot", 1, "robot", 0, np.array([0.01, 0.0, 0.0]), COV)
    drawn = inflate_covariances([far, near], states)
    assert drawn[1] is near
    assert violated([far, near], states, (0.1, 0.1)) == [True, False]
    r = np.array([1.0, 0.0, 0.3])
    assert r @ np.linalg.solve(drawn[0].cov, r) == pytest.approx(9.0, rel=0.1)


# ------------------------------------------------------------ along a corridor


def behind_each_other(*along, across=0.0, turn=0.0):
    """Matches as good as `GOOD`, so far along the x axis of the earlier submap."""
    return [replace(GOOD, pose=GOOD.pose + np.array([x, across, turn])) for x in along]


def corridor(direction=0.0):
    """A submap of two walls 2 m apart, with scattered points and a niche, in a direction, rad."""
    x = np.linspace(-6.0, 6.0, 400)
    walls = np.concatenate([np.column_stack([x, np.full(400, y)]) for y in (-1.0, 1.0)])
    walls[(walls[:, 1] > 0) & (np.abs(walls[:, 0] - 2.0) < 0.5), 1] += 0.1
    walls += np.random.default_rng(0).normal(0.0, 0.02, walls.shape)
    c, s = np.cos(direction), np.sin(direction)
    return make_submap(np.zeros((1, 3)), [walls @ np.array([[c, s], [-s, c]])])


def open_direction(cov):
    """In which direction, rad, a covariance (3, 3) is largest."""
    x, y = np.linalg.eigh(cov[:2, :2])[1][:, 1]
    return np.arctan(y / x)


def test_matches_one_behind_the_other_leave_that_direction_open():
    """The best is used for what all of them say: across and heading. Along, nothing is known."""
    assert verify_match([GOOD, *behind_each_other(0.6, -0.5)]) is None
    found = verify_match_across([GOOD, *behind_each_other(0.6, -0.5)], corridor())
    assert found is not None
    assert np.sqrt(found.cov[0, 0]) > 4.0
    # the direction of the walls is known to a few milliradians: 15 mm across at a sigma along
    across = np.sqrt(GOOD.cov[1, 1] + 0.015**2 + (4.0 * open_direction(found.cov)) ** 2)
    assert np.sqrt(np.linalg.eigvalsh(found.cov[:2, :2])[0]) <= 1.01 * across
    assert found.cov[2, 2] == GOOD.cov[2, 2]


@pytest.mark.parametrize("direction", [0.0, 0.7, -1.3])
def test_what_is_open_is_the_direction_of_the_walls(direction):
    """Not that of a match 0.7 m on and 3 cm aside: 40 mrad off, 5 m on the match would be 0.2 m
    off across, with a sigma of centimetres. 5 mrad: what the noise of the points leaves."""
    c, s = np.cos(direction), np.sin(direction)
    on = np.array([c * 0.7 - s * 0.03, s * 0.7 + c * 0.03, 0.0])
    rival = replace(GOOD, pose=GOOD.pose + on)
    found = verify_match_across([GOOD, rival], corridor(direction))
    assert found is not None
    assert open_direction(found.cov) == pytest.approx(direction, abs=0.005)


def test_where_few_points_show_walls_the_matches_show_the_direction():
    """Breaks if an empty or cluttered place has a direction of walls."""
    scattered = np.random.default_rng(1).uniform(-5.0, 5.0, (200, 2))
    place = make_submap(np.zeros((1, 3)), [scattered])
    near = np.array([np.cos(0.4), np.sin(0.4)])
    np.testing.assert_array_equal(wall_direction(place, near), near)


@pytest.mark.parametrize("other", [{"across": 0.3}, {"turn": 0.1}])
def test_matches_that_differ_otherwise_are_rivals(other):
    """Also when one of several does: another corridor, or the same the other way round."""
    rivals = [*behind_each_other(0.6), *behind_each_other(0.3, **other)]
    assert verify_match_across([GOOD, *rivals], corridor()) is None


def test_between_parallel_walls_a_match_is_open_along_them_and_in_a_room_it_is_not():
    """However it was found: points that fit as well 0.3 m on tell nothing of that direction."""
    x = np.linspace(-6, 6, 400)
    walls = np.concatenate([np.column_stack([x, np.full(400, y)]) for y in (-1.0, 1.0)])
    y = np.linspace(-1, 1, 80)
    ends = np.concatenate([np.column_stack([np.full(80, x), y]) for x in (-2, 3)])
    for points, is_open in ((walls, True), (np.concatenate([walls, ends]), False)):
        submap = make_submap(np.zeros((1, 3)), [points])
        cov = np.diag([0.05, 0.02, 0.005]) ** 2
        place = SubmapPose(("robot", 0), np.zeros(3), 0.0, (0, 0), submap)
        pair = SubmapPair(place, place, np.zeros(3), np.zeros(3))
        missing, found = leave_open([pair, pair], [None, Verified(np.zeros(3), cov, True)])
        assert missing is None
        assert bool(np.sqrt(found.cov[0, 0]) > 4.0) is is_open
        # across, what is open along adds the 15 mm of its direction's 3 mrad
        assert np.sqrt(found.cov[1, 1]) == pytest.approx(0.025 if is_open else 0.02)


def test_what_a_closure_leaves_open_is_no_residual():
    cov = np.diag([25.0, 4e-4, 1e-5])
    closures = [
        Closure("a", 2, "a", 1, np.zeros(3), cov),
        Closure("a", 2, "a", 1, np.zeros(3), np.diag([4e-4, 4e-4, 1e-5])),
    ]
    r = np.tile([1.5, 0.1, 0.01], (2, 1))
    np.testing.assert_allclose(known_part(r, closures), [[0.0, 0.1, 0.01], [1.5, 0.1, 0.01]])
    assert fix_position(closures) == [False, True]


@pytest.mark.skipif(
    sys.platform != "linux" or len(os.sched_getaffinity(0)) < 2,
    reason="a second process is only used on Linux with two cores",
)
def test_the_second_process_verifies_the_same_to_the_last_bit(tmp_path):
    """Breaks if a result depends on the pairs that it is computed with, or on its place."""
    program = """
import sys
import numpy as np
sys.path[:0] = sys.argv[1:]
from test_loop_closure import drive, drifting, round_trip
from graphslam.core.config import Config
from graphslam.core.geometry import between
from graphslam.core.worker import allow_fork
from graphslam.mapping.loop_closure import PairVerifier, SubmapPair, verify_pairs
from graphslam.mapping.submaps import build_submaps
states, scans = drive(drifting(round_trip()), round_trip())
found = build_submaps(states, scans, Config())
window = np.array([0.6, 0.6, 0.15])
pairs = [
    SubmapPair(a, b, between(b.pose, a.pose), window)
    for k, a in enumerate(found) for b in found[:k]
]
alone = verify_pairs(pairs, along=True)
allow_fork()
with PairVerifier(found, along=True) as verify:
    print(verify.forked)
    for _ in range(2):
        for one, other in zip(alone, verify(pairs), strict=True):
            assert (one is None) == (other is None)
            if one is not None:
                assert np.array_equal(one.pose, other.pose) and np.array_equal(one.cov, other.cov)
                assert one.is_searched == other.is_searched
print(sum(one is not None for one in alone) > 5)
"""
    here = Path(__file__).parent
    done = subprocess.run(
        [sys.executable, "-c", program, str(here), str(here.parent)],
        check=False, capture_output=True, text=True, cwd=tmp_path, timeout=60,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    assert done.stdout.split() == ["True", "True"], done.stderr
