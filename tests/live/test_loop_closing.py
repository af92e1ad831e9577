"""Loops that are closed while a robot drives: found, agreed upon, entered, and forgotten."""

import numpy as np
import pytest
from walls import L_ROOM, cloud

from graphslam.core.config import BackendConfig, Config
from graphslam.core.geometry import between, wrap
from graphslam.core.records import KeyframeScan, Motion, Start, Step
from graphslam.estimation.fixed_lag import FixedLagBackend
from graphslam.live.loop_closing import LoopCloser

S = 1_000_000_000


CONFIG = Config(backend=BackendConfig(name="isam2", horizon_s=10.0))
COV = np.diag([0.01, 0.01, 0.01]) ** 2


def circles(length_m):
    """True poses (n, 3), 0.25 m apart, of a robot in circles of 1 m radius."""
    angle = np.arange(0.0, length_m, 0.25)
    return np.column_stack([
        -2.5 + np.cos(angle), 1.0 + np.sin(angle), angle + np.pi / 2
    ])  # fmt: skip


def lived(true, turned_per_m, walls=L_ROOM, closes=True):
    """How far off (n, 3) poses are, live, by odometry that turns too much; closures; the closer."""
    backend = FixedLagBackend(CONFIG)
    closer = LoopCloser(CONFIG, backend, {"robot": "robot"})
    moves = between(true[:-1], true[1:])
    moves[:, 2] += turned_per_m * np.hypot(moves[:, 0], moves[:, 1])
    off, closures = [], []
    for k, pose in enumerate(true):
        if k:
            motion = Motion((k - 1) * S, k * S, moves[k - 1], COV, np.zeros((3, 0)), 0.25)
            backend.add(Step(k * S, motions={"robot": motion}))
        else:
            backend.add(Step(0, starts={"robot": Start(pose, 1e-6 * np.eye(3))}))
        points = cloud(pose, walls).astype(np.float32)
        if closes:
            closer.add([KeyframeScan("robot", k * S, points)])
            found = closer.closures(k * S)
            if found:
                backend.add(Step(k * S, closures=found))
                closures.append(found)
        off.append(between(true[k], backend.state_mean("robot")))
        backend.forget()
    return np.array(off), closures, closer


def test_a_place_that_is_passed_again_takes_the_drift_away():
    """By what scans of it say, though no landmark is there: 1 m and more after 60 m, 0.1 m with it.

    0.1 m: the path drifts by 0.03 m and 0.06 rad from one place to the one that is recognised."""
    true = circles(60.0)
    drifted = np.hypot(*lived(true, 0.01, closes=False)[0][:, :2].T)
    off, closures, _ = lived(true, 0.01)
    assert closures
    assert drifted[-40:].max() > 0.5
    assert np.hypot(*off[-40:, :2].T).max() < 0.25
    at = {k * S: pose for k, pose in enumerate(true)}
    for c in (c for together in closures for c in together):
        # a submap of 6 m is bent by the drift within it
        miss = between(between(at[c.other_time_ns], at[c.time_ns]), c.delta)
        assert np.hypot(miss[0], miss[1]) < 0.1
        assert abs(miss[2]) < 0.06


def test_closures_are_not_surer_than_what_they_are_made_of():
    """Scans around a place lie along the path as it was then, which drifts by itself.

    Breaks if a closure enters with the covariance of its match: 66, where chi-square of three has
    16.3 at 99.9 %; now it is 4."""
    true = circles(60.0)
    _, closures, _ = lived(true, 0.02)
    assert closures
    at = {k * S: pose for k, pose in enumerate(true)}
    for c in (c for together in closures for c in together):
        miss = between(at[c.other_time_ns], at[c.time_ns]) - c.delta  # along the axes of ``cov``
        miss[2] = wrap(miss[2])
        assert miss @ np.linalg.solve(c.cov, miss) < 16.3


def test_a_path_that_is_right_is_not_moved():
    """Breaks with closures where there is nothing to close."""
    off, closures, _ = lived(circles(40.0), 0.0)
    assert not closures
    assert np.abs(off).max() < 1e-6


def test_one_place_alone_closes_nothing():
    """Two must agree: breaks if a single match moves the estimate."""
    _, closures, _ = lived(circles(60.0), 0.01)
    assert closures
    assert all(len({c.time_ns for c in together}) >= 2 for together in closures)


def test_rounds_over_the_same_places_keep_no_more_of_them():
    """Memory is that of the map: five times the path, as many places."""
    kept = [len(lived(circles(length), 0.0)[2]._places) for length in (60.0, 120.0)]
    assert kept[1] <= kept[0] + 2


@pytest.mark.parametrize("back", [False, True])
def test_other_places_are_not_taken_for_it(back):
    """Along a corridor that is driven up, and down again: no place is another one."""
    x = np.arange(0.0, 40.0, 0.25)
    true = np.column_stack([x, 0.3 * np.sin(0.2 * x), 0.06 * np.cos(0.2 * x)])
    if back:
        turned = true[::-1] + np.array([0.0, 0.0, np.pi])
        true = np.concatenate([true, turned])
    ends = np.array([[[-10, -1.2], [60, -1.2]], [[60, 1.2], [-10, 1.2]]], dtype=float)
    off, _, _ = lived(true, 0.0, ends)
    assert np.abs(off).max() < 0.05


def test_where_nothing_is_in_reach_there_is_no_place():
    """A laser outdoors: scans without returns are no error, and nothing is kept of them."""
    backend = FixedLagBackend(CONFIG)
    closer = LoopCloser(CONFIG, backend, {"robot": "robot"})
    backend.add(Step(0, starts={"robot": Start(np.zeros(3), 1e-4 * np.eye(3))}))
    ahead = np.array([0.25, 0.0, 0.0])
    for k in range(1, 100):
        motion = Motion((k - 1) * S, k * S, ahead, COV, np.zeros((3, 0)), 0.25)
        backend.add(Step(k * S, motions={"robot": motion}))
        closer.add([KeyframeScan("robot", k * S, np.zeros((0, 2), dtype=np.float32))])
        assert closer.closures(k * S) == ()
        backend.forget()
    assert len(backend.builder.kept) <= 3  # of the last metres, not judged yet


def test_a_kept_state_changes_nothing_and_can_be_dropped():
    """It is one more variable, and marginalising it out is exact: 1e-8 is what rounding leaves."""
    true = circles(30.0)
    moves = between(true[:-1], true[1:])
    found = []
    for kept in ((), (8, 40), (8, 40, 41)):
        backend = FixedLagBackend(CONFIG)
        backend.add(Step(0, starts={"robot": Start(true[0], 1e-4 * np.eye(3))}))
        for k, move in enumerate(moves, start=1):
            motion = Motion((k - 1) * S, k * S, move, COV, np.zeros((3, 0)), 0.25)
            backend.add(Step(k * S, motions={"robot": motion}))
            if k in kept:
                backend.keep("robot", k * S)
            if k == 80 and 41 in kept:
                backend.drop("robot", 8 * S)
        found.append((backend.state_mean("robot"), backend.joint("robot", []).cov))
        if 41 in kept:
            with pytest.raises(RuntimeError):
                backend.poses([("robot", 8 * S)])
            assert len(backend.poses([("robot", 40 * S), ("robot", 41 * S)])[0]) == 2
    for mean, cov in found[1:]:
        np.testing.assert_allclose(mean, found[0][0], atol=1e-8)
        np.testing.assert_allclose(cov, found[0][1], rtol=1e-6, atol=1e-12)
