"""Doubts about points that vanish: passed again, they are not seen, and others are where none were.

Points without names that are not recognised are in the map once more, elsewhere. Odometry that
slips for a moment, or turns while the robot stands, does that to all of them at once; the two maps
fit what was seen, each in its time. What tells is that the first one is never seen again.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from graphslam.core.arrays import BoolArray, IntArray
from graphslam.core.geometry import Array, between, polar_points, transform_each, wrap
from graphslam.verdict.doubts import Reason, seconds
from graphslam.verdict.evidence import Evidence, RobotEvidence

#: share of the largest range in an image, and rad from its outermost bearings: what is within is in
#: sight, since what is behind it or beside it is seen
NEARER, MARGIN_RAD = 0.9, 0.05
#: images that should show a point and do not, at least
LEAST_IMAGES = 10
#: share of the images with a point in sight that show it, at least: others are hardly seen anyway
SHOWN = 0.5
#: points that vanish, and that appear, at least, and as a share of all
LEAST_POINTS, LEAST_SHARE = 4, 0.08


def vanished_doubts(evidence: Evidence) -> Iterator[Reason]:
    """Robots for which much of the map vanishes and as much appears; with scans walls hide points.

    The work grows with the number of images times that of the points in sight of each.
    """
    for robot in evidence.robots:
        if len(robot.scans_ns) or not robot.seen.stands.any():
            continue
        found = _visible(robot)
        gone, new = int(found.vanished.sum()), int(found.appeared.sum())
        points = len(found.vanished)
        if min(gone, new) < max(LEAST_POINTS, LEAST_SHARE * points):
            continue
        since = int(np.median(found.last_ns[found.vanished]))
        text = (
            f"{robot.name}: {gone} of {points} points are not seen again where it passes, mostly "
            f"from {seconds(since, int(robot.readings_ns[0]))} on, and {new} are where none were: "
            "its odometry slipped and part of the map is there twice, or much was moved"
        )
        yield Reason("doubtful", "points", robot.name, text)


@dataclass(frozen=True, slots=True, eq=False)
class _Visible:
    """Points (n,): whether they vanish and appear; when each was seen last, ns."""

    vanished: BoolArray
    appeared: BoolArray
    last_ns: IntArray


def _visible(robot: RobotEvidence) -> _Visible:
    """What one robot's images say of the points that it saw."""
    seen = robot.seen
    own = seen.stands
    times, z, poses = seen.times_ns[own], seen.z[own], seen.poses[own]
    _, point = np.unique(seen.targets[own], return_inverse=True)
    _, first, image = np.unique(times, return_index=True, return_inverse=True)
    n, m = int(point.max()) + 1, len(first)
    at = transform_each(poses, polar_points(z[:, 1], z[:, 0]))
    count = np.bincount(point, minlength=n)
    places = np.column_stack([np.bincount(point, w) for w in at.T]) / count[:, None]
    pairs = _in_sight(places, poses[first], image, z)
    shows = np.isin(pairs[:, 0] * n + pairs[:, 1], image * n + point)
    begin, end = np.full(n, m), np.zeros(n, dtype=np.int64)
    np.minimum.at(begin, point, image)
    np.maximum.at(end, point, image)
    missed = pairs[~shows]
    after = missed[:, 0] > end[missed[:, 1]]
    before = missed[:, 0] < begin[missed[:, 1]]
    meanwhile = np.bincount(missed[~after & ~before, 1], minlength=n)
    known = count >= SHOWN * (count + meanwhile)
    many = [np.bincount(missed[which, 1], minlength=n) >= LEAST_IMAGES for which in (after, before)]
    return _Visible(many[0] & known, many[1] & known, times[first][end])


def _in_sight(places: Array, poses: Array, image: IntArray, z: Array) -> IntArray:
    """Pairs (k, 2) of image and point such that the image shows others behind and beside it.

    ``places`` (n, 2) m are the points, ``poses`` (m, 3) those of the images; ``image`` (s,) and
    ``z`` (s, 2), bearing rad and range m, are the sightings.
    """
    m = len(poses)
    reach = np.zeros(m)
    np.maximum.at(reach, image, NEARER * z[:, 1])
    middle = np.arctan2(*(np.bincount(image, f(z[:, 0]), m) for f in (np.sin, np.cos)))
    low, high = np.full(m, np.inf), np.full(m, -np.inf)
    beside = wrap(z[:, 0] - middle[image])
    np.minimum.at(low, image, beside + MARGIN_RAD)
    np.maximum.at(high, image, beside - MARGIN_RAD)
    near = cKDTree(places).query_ball_point(poses[:, :2], reach)
    size = np.array([len(found) for found in near])
    pairs = np.column_stack([
        np.repeat(np.arange(m), size), np.concatenate([np.array(f, dtype=np.int64) for f in near])
    ])  # fmt: skip
    k = pairs[:, 0]
    x, y = between(poses[k], np.column_stack([places[pairs[:, 1]], np.zeros(len(k))]))[:, :2].T
    bearing = wrap(np.arctan2(y, x) - middle[k])
    return np.asarray(pairs[(bearing > low[k]) & (bearing < high[k])])
