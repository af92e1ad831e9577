"""Doubts about points that vanish: passed again, they are not seen, and others are where none were.

Points without names that are not recognised are in the map once more, elsewhere. Odometry that
slips for a moment, or turns while the robot stands, does that to all of them at once; the two maps
fit what was seen, each in its time. What tells is that the first one is never seen again.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from graphslam.core.arrays import BoolArray, IntArray
from graphslam.core.geometry import polar_points, transform_each
from graphslam.mapping.points_in_sight import points_in_sight
from graphslam.verdict.doubts import Reason, seconds
from graphslam.verdict.evidence import Evidence, RobotEvidence

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
    pairs = points_in_sight(places, poses[first], image, z)
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
