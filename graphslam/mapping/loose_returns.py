"""Returns that are in no segment of their scan, as observations of walls that are known.

Of a wall that a scan sees at grazing incidence, in short pieces between doors or behind furniture,
it has a few returns: too few for a segment, or for one that is worth something. Once the map is
known, they lie on its walls. Far along a wall they tell the direction in which the robot looks;
near ones tell where it is by walls of which it has no segment.

Returns are few per scan and walls are found in a tree, so that the work grows with the log.
"""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from operator import is_
from typing import NamedTuple

import numpy as np

from graphslam.core.arrays import BoolArray, IntArray
from graphslam.core.config import FrontEndConfig
from graphslam.core.geometry import Array, between, rotation3, transform_each, unit_vectors, wrap
from graphslam.core.record import replace
from graphslam.core.records import Association, Estimate, KeyframeScan, Step
from graphslam.mapping.landmark_map import Entry, observed_from
from graphslam.mapping.returns_on_walls import OnWalls, WallTree, returns_on_walls
from graphslam.mapping.submaps import State
from graphslam.perception.beam_noise import largest_deviation

#: rad: how well the direction of a scan is known before (one sigma)
HEADING_RAD = 0.003
#: sigmas that a return may lie off a wall. With three, returns of doors in niches and of posts are
#: among them, and headings in the simulated office are 10 % worse
GATE = 1.7
#: m beyond the ends of a segment where returns may be of it, and of a wall where they may be on it
MARGIN_M = 0.2
#: m, rad: along a wall, and its direction, of which returns say nothing
OPEN_M, OPEN_RAD = 1.0, 0.2
#: returns on a wall that has no observation in the scan yet; such walls per scan, those with the
#: most returns first. More hardly tell more (two: 2 % of the error), and cost as much again. The
#: scan at a start has all of them
LEAST_RETURNS, MOST_WALLS = 2, 1
#: scans that are looked at together: their observations are compared with all their returns
BLOCK = 64


def with_loose_returns(
    steps: Sequence[Step],
    estimate: Estimate,
    scans: Sequence[KeyframeScan],
    entries: Mapping[int, Entry],
    config: FrontEndConfig,
) -> tuple[Step, ...]:
    """Steps whose observations of walls have the loose returns on these, and a few more of them.

    Args:
        steps: with observations of lines and segments, associated with landmarks.
        estimate: of all states and landmarks, near the truth.
        scans: seen from the states.
        entries: the landmarks, as they are estimated.
        config: noise of returns and of surfaces.
    """
    walls = [e for i, e in entries.items() if i in estimate.landmarks and e.kind != "point"]
    used = list({(scan.robot, scan.time_ns): scan for scan in scans if len(scan.points)}.values())
    if not walls or not used:
        return tuple(steps)
    row = {wall.id: k for k, wall in enumerate(walls)}
    seen: dict[State, list[Association]] = defaultdict(list)
    for step in steps:
        for a in step.associations:
            if a.extent is not None and a.target in row:
                seen[a.robot, a.time_ns].append(a)
    numbers = np.array([wall.id for wall in walls])
    tree = WallTree.from_walls(
        np.array([wall.mean for wall in walls]), np.array([wall.extent for wall in walls])
    )
    changed: dict[int, Association] = {}
    new: dict[State, list[Association]] = {}
    begins = _first_states(steps, estimate)
    for begin in range(0, len(used), BLOCK):
        views = _Views.of(used[begin : begin + BLOCK], estimate)
        most = np.where([state in begins for state in views.states], len(walls), MOST_WALLS)
        own = _Seen.of(seen, views, row)
        for before, after in _observed(views, own, tree, numbers, most, config):
            if before is not None:
                changed[id(before)] = after
            else:
                new.setdefault((after.robot, after.time_ns), []).append(after)
    return tuple(_changed(step, changed, new) for step in steps)


def _first_states(steps: Sequence[Step], estimate: Estimate) -> set[State]:
    """Those of which the starts of robots are priors.

    By their scans alone the direction of all that was driven is known where a start is told.
    """
    return {
        (robot, int(estimate.states[robot].stamps_ns[0]))
        for step in steps
        for robot in step.starts
        if robot in estimate.states
    }


def _observed(
    views: "_Views",
    seen: "_Seen",
    tree: WallTree,
    numbers: IntArray,
    most: IntArray,
    config: FrontEndConfig,
) -> Iterator[tuple[Association | None, Association]]:
    """Observations of walls with the loose returns on these, each with that before, if any.

    ``numbers`` (n,): of the landmarks that the walls of the tree are. ``most`` (k,): walls of each
    scan of the views that get an observation.
    """
    walls = len(numbers)
    loose = np.flatnonzero(~_in_segments(seen, views, config))
    found = _on_walls(loose, views, tree, config)
    if not len(found.row):
        return
    pair, of = np.unique(views.scan[found.row] * walls + found.wall, return_inverse=True)
    scan, wall = pair // walls, pair % walls
    known = seen.among(pair, walls)
    # around what the deviations of returns are measured: the wall as observed, or as predicted
    line = between(views.poses[scan], tree.means[wall])
    middle = np.bincount(of, found.along) / np.bincount(of)
    line[:, :2] += middle[:, None] * unit_vectors(line[:, 2])
    V = np.tile(np.diag([OPEN_M**2, np.inf, OPEN_RAD**2]), (len(pair), 1, 1))
    has = known >= 0
    line[has] = seen.z[known[has]]
    turn = rotation3(line[has, 2])
    V[has] = turn.mT @ seen.cov[known[has]] @ turn
    z, cov = _measured(line, V, of, found, views.points[found.row], config.floor_normal_m)
    low, high = np.full(len(pair), np.inf), np.full(len(pair), -np.inf)
    np.minimum.at(low, of, found.along)
    np.maximum.at(high, of, found.along)
    for n, k in zip(np.flatnonzero(has).tolist(), known[has].tolist(), strict=True):
        before = seen.associations[k]
        yield before, before.with_measurement(z[n], cov[n])
    for n in _most_seen(np.bincount(of), scan, ~has, most).tolist():
        robot, time_ns = views.states[scan[n]]
        extent = np.array([low[n], high[n]]) - middle[n]
        number = int(numbers[wall[n]])
        yield None, Association(robot, time_ns, number, "line", z[n], cov[n], extent=extent)


def _changed(
    step: Step, changed: Mapping[int, Association], new: dict[State, list[Association]]
) -> Step:
    """A step with its changed observations, and the new ones of its states, which are taken."""
    made = [changed.get(id(a), a) for a in step.associations]
    for state in dict.fromkeys((a.robot, a.time_ns) for a in step.associations):
        made += new.pop(state, ())
    same = len(made) == len(step.associations) and all(map(is_, made, step.associations))
    return step if same else replace(step, associations=tuple(made))


class _Views(NamedTuple):
    """Scans, with all their returns: ``states`` (k) from which they are seen, at ``poses`` (k, 3).

    ``points`` (n, 2) in the frame of the state of their ``scan`` (n,), whose laser is at ``lasers``
    (k, 2) there; those of a scan begin at ``first`` (k,) and are ``number`` (k,).
    """

    states: list[State]
    poses: Array
    lasers: Array
    points: Array
    scan: IntArray
    first: IntArray
    number: IntArray

    @classmethod
    def of(cls, scans: Sequence[KeyframeScan], estimate: Estimate) -> "_Views":
        """Those of scans with returns, of different states."""
        poses = observed_from(scans, estimate.states)
        number = np.array([len(scan.points) for scan in scans])
        points = np.concatenate([scan.points for scan in scans]).astype(float)
        lasers = np.array([scan.sensor[:2] for scan in scans])
        return cls(
            [(scan.robot, scan.time_ns) for scan in scans], poses, lasers, points,
            np.repeat(np.arange(len(scans)), number), np.cumsum(number) - number, number,
        )  # fmt: skip


class _Seen(NamedTuple):
    """Observations (m) of walls: ``z`` (m, 3), ``cov`` (m, 3, 3), ``extents`` (m, 2).

    They are in ``scan`` (m,), row of `_Views`, and of ``wall`` (m,).
    """

    associations: list[Association]
    scan: IntArray
    wall: IntArray
    z: Array
    cov: Array
    extents: Array

    @classmethod
    def of(
        cls, seen: Mapping[State, Sequence[Association]], views: _Views, row: Mapping[int, int]
    ) -> "_Seen":
        """Those ``seen`` from the states of views, of walls (number -> ``row``)."""
        found = [(k, a) for k, state in enumerate(views.states) for a in seen.get(state, ())]
        return cls(
            [a for _, a in found],
            np.array([k for k, _ in found], dtype=np.int64),
            np.array([row[int(a.target)] for _, a in found], dtype=np.int64),
            np.array([a.z for _, a in found]).reshape(-1, 3),
            np.array([a.cov for _, a in found]).reshape(-1, 3, 3),
            np.array([a.extent for _, a in found]).reshape(-1, 2),
        )

    def among(self, pairs: IntArray, walls: int) -> IntArray:
        """Of sorted pairs (p,) of scan and wall the observation (p,), -1 where there is none."""
        found = np.full(len(pairs), -1)
        own = self.scan * walls + self.wall
        at = np.minimum(np.searchsorted(pairs, own), len(pairs) - 1)
        there = pairs[at] == own
        found[at[there]] = np.flatnonzero(there)
        return found


def _in_segments(seen: _Seen, views: _Views, config: FrontEndConfig) -> BoolArray:
    """Which returns (n,) are on a part of a wall that was seen as a segment."""
    number = views.number[seen.scan]
    i = np.repeat(np.arange(len(seen.scan)), number)
    p = np.arange(len(i)) + np.repeat(views.first[seen.scan] + number - np.cumsum(number), number)
    along, across = _along_and_across(views.points[p], seen.z, i)
    low, high = seen.extents.T
    inside = (along > (low - MARGIN_M)[i]) & (along < (high + MARGIN_M)[i])
    square_ranges = ((views.points - views.lasers[views.scan]) ** 2).sum(axis=1)
    reach_m = np.broadcast_to(largest_deviation(config, square_ranges), len(views.points))
    found = np.zeros(len(views.points), dtype=np.bool_)
    found[p[inside & (np.abs(across) < reach_m[p])]] = True
    return found


def _on_walls(loose: IntArray, views: _Views, tree: WallTree, config: FrontEndConfig) -> OnWalls:
    """Loose returns (rows of `_Views.points`) that lie on one wall as it is predicted."""
    scan = views.scan[loose]
    world = transform_each(views.poses[scan], views.points[loose])
    lasers = transform_each(views.poses, views.lasers)[scan]
    found = returns_on_walls(
        tree.near(world), world, lasers, tree, config,
        gate=GATE, margin_m=MARGIN_M, heading_rad=HEADING_RAD,
    )  # fmt: skip
    return found._replace(row=loose[found.row])


def _measured(
    line: Array, V: Array, of: IntArray, found: OnWalls, points: Array, floor_m: float
) -> tuple[Array, Array]:
    """Lines (m, 3) corrected by returns: the linear update of offset and direction.

    Args:
        line: in the frames of the states.
        V: (m, 3, 3) their covariances, each along the axes of its line; the variance across is
            infinite where nothing is known yet.
        of: the line (k,) of each return.
        found: the returns.
        points: (k, 2) where they are.
        floor_m: deviation of a surface, which all of its returns share.

    Returns:
        The lines, and their covariances along the axes of the states' frames.
    """
    along, across = _along_and_across(points, line, of)
    weight = found.weights(of, floor_m)
    information = np.zeros((len(line), 2, 2))
    known = np.isfinite(V[:, 1, 1])
    information[known] = np.linalg.inv(V[known, 1:, 1:])
    information[~known, 1, 1] = 1.0 / V[~known, 2, 2]
    for i, j, power in ((0, 0, weight), (0, 1, weight * along), (1, 1, weight * along**2)):
        information[:, i, j] += np.bincount(of, power, len(line))
    information[:, 1, 0] = information[:, 0, 1]
    pull = [np.bincount(of, weight * across, len(line))]
    pull.append(np.bincount(of, weight * along * across, len(line)))
    V = V.copy()
    V[:, 1:, 1:] = np.linalg.inv(information)
    V[:, 0, 1:] = V[:, 1:, 0] = 0.0
    shift = (V[:, 1:, 1:] @ np.column_stack(pull)[:, :, None])[:, :, 0]
    moved = line.copy()
    moved[:, 0] -= np.sin(line[:, 2]) * shift[:, 0]
    moved[:, 1] += np.cos(line[:, 2]) * shift[:, 0]
    moved[:, 2] = wrap(line[:, 2] + shift[:, 1])
    turn = rotation3(moved[:, 2])
    return moved, turn @ V @ turn.mT


def _most_seen(count: IntArray, scan: IntArray, new: BoolArray, most: IntArray) -> IntArray:
    """Rows of the new walls to be observed: of each ``scan`` the ``most`` with most returns."""
    rows = np.flatnonzero(new & (count >= LEAST_RETURNS))
    rows = rows[np.lexsort((-count[rows], scan[rows]))]
    rank = np.arange(len(rows)) - np.searchsorted(scan[rows], scan[rows])
    return np.asarray(rows[rank < most[scan[rows]]])


def _along_and_across(points: Array, lines: Array, of: IntArray) -> tuple[Array, Array]:
    """Where points (n, 2) are along their lines (row ``of``) and how far to the left of them, m."""
    # the sines of lines, which are fewer than points
    x, y, c, s = (v[of] for v in (*lines[:, :2].T, np.cos(lines[:, 2]), np.sin(lines[:, 2])))
    dx, dy = points[:, 0] - x, points[:, 1] - y
    return c * dx + s * dy, c * dy - s * dx
