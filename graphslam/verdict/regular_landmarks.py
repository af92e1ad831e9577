"""Doubts about landmarks without names that stand in rows or grids, as trees of an orchard do.

Where all landmarks look as if moved to their neighbours, a robot that comes back farther off than
half their distance may take each for the next one. The map is then consistent, and wrong by a
distance between neighbours: residuals do not show it.
"""

from collections.abc import Iterator

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.geometry import Array, between, compose, polar_points, rotation3
from graphslam.verdict.doubts import Reason
from graphslam.verdict.evidence import Evidence, RobotEvidence, Seen

#: landmarks without which nothing repeats; those mapped last are looked at, at most so many
FEWEST, MOST = 9, 500
#: share of the landmarks that are others' neighbours, all moved alike, where they are regular: of
#: those that stand at random it is 0.1
REGULAR = 0.6
#: of the distance between neighbours: how far a moved landmark may be off another one
NEAR = 0.2
#: s: a landmark that was not seen for so long is seen again
AGAIN_S = 10.0
#: of the distance between neighbours: how far off calibrated odometry may be when one is seen
#: again; from half on the next one is as near
CONFUSABLE = 0.5


def regular_landmark_doubts(evidence: Evidence) -> Iterator[Reason]:
    """Whether robots may have taken landmarks without names for their neighbours."""
    for robot in evidence.robots:
        found = _confusable(robot)
        if found is not None:
            apart, off = found
            text = (
                f"{robot.name}: its landmarks have no names and repeat every {apart:.1f} m, while "
                f"its calibrated odometry is off by {off:.1f} m when it sees some again: they may "
                "be taken for their neighbours"
            )
            yield Reason("doubtful", "sightings", robot.name, text)


def _confusable(robot: RobotEvidence) -> tuple[float, float] | None:
    """Distance after which landmarks repeat, and by how much odometry is off, m; None: no doubt."""
    seen = robot.seen
    named = [number for number, name in enumerate(seen.names) if name]
    use = np.flatnonzero(seen.stands & ~np.isin(seen.targets, named))
    if not len(use):
        return None
    apart = repetition(_places(seen, use))
    if apart is None:
        return None
    off = _off_when_seen_again(seen, use)
    return (apart, off) if off > CONFUSABLE * apart else None


def _places(seen: Seen, use: IntArray) -> Array:
    """Where landmarks (n, 2) are by the sightings ``use`` of them, in the result."""
    at = polar_points(seen.z[use, 1], seen.z[use, 0])
    points = compose(seen.poses[use], np.column_stack([at, np.zeros(len(at))]))[:, :2]
    _, index, count = np.unique(seen.targets[use], return_inverse=True, return_counts=True)
    sums = np.zeros((len(count), 2))
    np.add.at(sums, index, points)
    return np.asarray(sums / count[:, None])[-MOST:]


def repetition(points: Array) -> float | None:
    """The distance by which points (n, 2) can be moved onto each other; None if they cannot.

    The step that is tried is the most usual one from a point to the nearest other; O(n²).
    """
    if len(points) < FEWEST:
        return None
    offsets = points[None] - points[:, None]
    distance = np.hypot(offsets[..., 0], offsets[..., 1])
    np.fill_diagonal(distance, np.inf)
    nearest = distance.argmin(axis=1)
    steps = offsets[np.arange(len(points)), nearest]
    # the most usual one: that with most others like it, either way
    length = np.hypot(steps[:, 0], steps[:, 1])
    like = np.minimum(
        np.linalg.norm(steps[:, None] - steps, axis=2),
        np.linalg.norm(steps[:, None] + steps, axis=2),
    )
    step = steps[int((like < NEAR * length[:, None]).sum(axis=1).argmax())]
    apart = float(np.hypot(*step))
    moved = np.linalg.norm(points[:, None] + step - points, axis=2).min(axis=1) < NEAR * apart
    return apart if moved.mean() > REGULAR else None


def _off_when_seen_again(seen: Seen, use: IntArray) -> float:
    """How far calibrated odometry is off between two visits of one landmark, m, at most."""
    order = use[np.lexsort((seen.times_ns[use], seen.targets[use]))]
    a, b = order[:-1], order[1:]
    again = (seen.targets[a] == seen.targets[b]) & (
        seen.times_ns[b] - seen.times_ns[a] > AGAIN_S * 1e9
    )
    if not again.any():
        return 0.0
    times, first = np.unique(seen.times_ns[use], return_index=True)
    final = seen.poses[use[first]]
    calibrated = _calibrated(seen.odometry[use[first]], final)
    a, b = (times.searchsorted(seen.times_ns[each[again]]) for each in (a, b))
    off = between(calibrated[a], calibrated[b]) - between(final[a], final[b])
    return float(np.hypot(off[:, 0], off[:, 1]).max())


def _calibrated(odometry: Array, final: Array) -> Array:
    """Poses (n, 3) by odometry whose wheels and axle are as they fit the ``final`` ones best.

    The path has a factor, turning one too and a part of the path: a constant of the whole log is
    learned before anything is seen again.
    """
    its, ours = (between(poses[:-1], poses[1:]) for poses in (odometry, final))
    length = float(its[:, 0] @ ours[:, 0]) / max(float(its[:, 0] @ its[:, 0]), 1e-12)
    causes = np.column_stack([its[:, 2], np.abs(its[:, 0])])
    turning = causes @ np.linalg.lstsq(causes, ours[:, 2], rcond=None)[0]
    heading = final[0, 2] + np.concatenate([[0.0], np.cumsum(turning)])
    moved = (rotation3(heading[:-1])[:, :2, :2] @ (length * its[:, :2])[:, :, None])[:, :, 0]
    path = final[0, :2] + np.concatenate([np.zeros((1, 2)), np.cumsum(moved, axis=0)])
    return np.column_stack([path, heading])
