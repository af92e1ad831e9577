"""Landmarks without names in a grid: whether a robot may take them for their neighbours."""

from types import SimpleNamespace

import numpy as np
import pytest

from graphslam.core.geometry import between, compose
from graphslam.verdict.evidence import Seen
from graphslam.verdict.regular_landmarks import regular_landmark_doubts, repetition

APART = 1.5
GRID = APART * np.array([(i, j) for i in range(12) for j in range(8)], dtype=float)
SCATTERED = np.random.default_rng(0).uniform(0, 12 * APART, (96, 2))
S = 1_000_000_000


def test_what_repeats_is_told_from_what_does_not():
    rng = np.random.default_rng(1)
    for points in (GRID, GRID[::8], GRID @ [[0.8, 0.6], [-0.6, 0.8]]):
        noisy = points + rng.normal(0, 0.03, points.shape)
        assert repetition(noisy) == pytest.approx(APART, abs=0.1)
    assert repetition(SCATTERED) is None
    assert repetition(GRID[:5]) is None  # too few to say


def seen_twice(points, *, length=1.0, bend=0.0, named=False):
    """Sightings of all points within 3 m on two rounds, with odometry of another ``length`` that
    turns by ``bend`` too much at one place, rad."""
    t = np.arange(0, 100, 0.5)
    a = 2 * np.pi * t / 50
    radius = 4 + np.sin(3 * a)  # turning is not all explained by the path
    at = points.mean(axis=0) + radius[:, None] * np.column_stack([np.cos(a), np.sin(a)])
    along = np.gradient(at, axis=0)
    final = np.column_stack([at, np.arctan2(along[:, 1], along[:, 0])])
    moved = between(final[:-1], final[1:]) * [length, 1.0, 1.0]
    moved[60, 2] += bend
    odometry = [final[0]]
    for one in moved:
        odometry.append(compose(odometry[-1], one))
    rows = [
        (k, i, np.arctan2(*off[::-1]) - x[2], np.hypot(*off))
        for k, x in enumerate(final)
        for i, off in enumerate(points - x[:2])
        if np.hypot(*off) < 3.0
    ]
    k, target, bearing, range_m = (np.array(column) for column in zip(*rows, strict=True))
    seen = Seen(
        times_ns=(t * S).astype(np.int64)[k],
        targets=target,
        stands=np.ones(len(k), dtype=bool),
        z=np.column_stack([bearing, range_m]),
        sigmas=np.full((len(k), 2), 0.02),
        odometry=np.array(odometry)[k],
        calibrated=np.array(odometry)[k],
        poses=final[k],
        d2=np.ones(len(k)),
        names=tuple(f"p{i}" if named else "" for i in range(len(points))),
    )
    return SimpleNamespace(robots=(SimpleNamespace(name="robot", seen=seen),))


@pytest.mark.parametrize(
    ("points", "options", "doubted"),
    [
        (GRID, {"bend": 0.6}, True),
        (GRID, {"bend": 0.05}, False),  # 0.2 m off where half the distance is 0.75 m
        (GRID, {"length": 1.1}, False),  # constants are learned before anything is seen again
        (GRID, {"bend": 0.6, "named": True}, False),
        (SCATTERED, {"bend": 0.6}, False),  # each has neighbours of its own
    ],
)
def test_a_robot_that_comes_back_far_off_may_take_trees_for_their_neighbours(
    points, options, doubted
):
    """Such maps were 0.5 m wrong with sigmas of millimetres, and called good."""
    found = list(regular_landmark_doubts(seen_twice(points, **options)))
    assert bool(found) == doubted
    if doubted:
        assert found[0].level == "doubtful" and "repeat every 1.5 m" in found[0].text
