"""Walls of the building that stand twice, displaced alike: things lie on things that were pushed.

Where much of the furniture of a room was pushed alike, and farther than what is tied as one
(`visits`), a later visit is closed with an earlier one by the furniture, and its walls stand beside
those that were seen before. Nothing contradicts that: each wall is seen well, by one of the visits.
But walls of a building do not move (`building`). So of every visit one displacement is looked for
that lays its walls on those that were seen before. If hardly any lie there as they are, and nearly
all do if displaced, it is the visit that is displaced.

There is one for all of a visit: closures in a room that contradict those in others are refused
(`sequential_closing`). The work grows with what was seen, but for pieces that are near each other.
"""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from graphslam.core.arrays import BoolArray, IntArray
from graphslam.core.geometry import Array, between, unit_vectors
from graphslam.core.records import Association, Estimate, Step
from graphslam.mapping.building import of_building
from graphslam.mapping.landmark_map import Entry, LandmarkMap, observed_from
from graphslam.mapping.seen_sides import seen_sides
from graphslam.mapping.submaps import SubmapPose
from graphslam.mapping.wall_observations import wall_observations, walls_seen

#: m: walls are compared in pieces of at most and at least this length
PIECE_M, SHORTEST_M = 4.0, 0.3
#: m, rad: pieces that lie on each other differ by less
ON_M, ON_RAD = 0.03, 0.05
#: m: how far displacements are looked for, in which steps, and refined how often
REACH_M, STEP_M, ROUNDS = 0.6, 0.02, 3
#: m: what is displaced by less is tied, and solved, where it belongs
LEAST_M = 0.04
#: m: of walls that stand twice, at least, and how wide an area they enclose: one wall alone may be
#: seen from both of its sides. Seen from one it stands twice, or is a long row of cupboards, which
#: is a doubt. That it is longer than furniture is known (`building`), but not all is in sight: in
#: the lab 2.5 to 3.5 m of 5 m, as furniture stands in front
LEAST_TWICE_M, LEAST_WIDE_M, LEAST_FACED_M = 3.0, 1.0, 2.0
#: how many times as long as what lies on others only as it is must be what does so only if
#: displaced: for a doubt, and for a displacement. In the simulated office on five days and in
#: Intel's thirds nothing does; where all furniture of the lab was pushed alike nearly all
DOUBT_FACTOR, CLEAR_FACTOR = 0.5, 4.0
#: middle (2,) m, direction rad, length m and side of a piece, see `Pieces`
_Piece = tuple[Array, float, float, float]


class Pieces(NamedTuple):
    """Pieces (n) of walls: middles (n, 2) m, directions (n,) rad and lengths (n,) m.

    ``side`` (n,): 1 if it was seen from where its normal points, -1 from behind, 0 not known.
    """

    at: Array
    direction: Array
    length: Array
    side: Array

    @property
    def ends(self) -> Array:
        """Both ends of each (n, 2, 2), m."""
        half = 0.5 * self.length[:, None] * unit_vectors(self.direction)
        return np.stack([self.at - half, self.at + half], axis=1)


class Displacement(NamedTuple):
    """What lays the walls of a visit on those seen before, ``by`` (2,) m in the world.

    ``twice_m``: length of walls that lie on others only then, ``once_m``: only as they are;
    ``wide_m``: how wide what stands twice is, across the direction in which it extends farthest;
    ``faced_m``: length of what both visits saw from the same side of it.
    """

    by: Array
    twice_m: float
    once_m: float
    wide_m: float
    faced_m: float

    @property
    def is_doubtful(self) -> bool:
        """Whether walls stand twice, nearly as many as stand once: one of two groups was moved.

        Of one plane only if hardly any stand once: that is easily a single thing that was moved.
        """
        if self.wide_m > LEAST_WIDE_M:
            return self._is_above(DOUBT_FACTOR)
        return self.faced_m > LEAST_FACED_M and self._is_above(CLEAR_FACTOR, LEAST_FACED_M)

    @property
    def is_clear(self) -> bool:
        """Whether the walls stand twice, in more than one plane, and hardly any once."""
        return self.wide_m > LEAST_WIDE_M and self._is_above(CLEAR_FACTOR)

    def _is_above(self, factor: float, least_m: float = LEAST_TWICE_M) -> bool:
        return bool(
            np.hypot(*self.by) > LEAST_M and self.twice_m > max(least_m, factor * self.once_m)
        )


def displacements(
    steps: Sequence[Step],
    estimate: Estimate,
    landmarks: LandmarkMap,
    places: Sequence[SubmapPose] = (),
) -> dict[str, Displacement]:
    """What lays the walls of each visit on those seen before; without those that saw no others.

    A visit is what one robot name saw, as sessions have one each. Each is compared with all before
    it, where their walls belong, and with landmarks that an earlier map knows. Its ``places`` tell
    from which side it saw them; without them that is not known, and one plane alone is no doubt.
    """
    if not landmarks.known and len(estimate.states) < 2:
        return {}
    found = {}
    before, visits = _building(steps, estimate, landmarks, places)
    for visit, own in visits:
        displacement = compare(own, before)
        placed = own
        if displacement is not None:
            found[visit] = displacement
            if displacement.is_clear:
                placed = own._replace(at=own.at + displacement.by)
        before = Pieces(*map(np.concatenate, zip(before, placed, strict=True)))
    return found


def compare(own: Pieces, before: Pieces) -> Displacement | None:
    """What lays pieces on those seen before; None if they are nowhere near."""
    which, normal, off, is_faced = _beside(own, before)
    if not len(which):
        return None
    first = np.flatnonzero(np.diff(which, prepend=-1))
    beside = Pieces(*(column[which[first]] for column in own))
    length = beside.length

    def on(by: Array, others: BoolArray | bool = True) -> BoolArray:
        """Which pieces (m,) lie on one of some that were seen before, displaced by (2,)."""
        near = (np.abs(off - normal @ by) < ON_M) & others
        return np.asarray(np.logical_or.reduceat(near, first), dtype=np.bool_)

    by = _best(normal, off, first, length)
    for _ in range(ROUNDS):
        left = off - normal @ by
        weighted = np.where(np.abs(left) < ON_M, own.length[which], 0.0)[:, None] * normal
        by = by + np.linalg.lstsq(weighted.T @ normal, weighted.T @ left, rcond=1e-3)[0]
    here, there = on(np.zeros(2)), on(by)
    twice = there & ~here
    wide_m = _width(beside.ends[twice].reshape(-1, 2))
    lengths = (float(length[which].sum()) for which in (here & ~there, twice & on(by, is_faced)))
    once_m, faced_m = lengths
    return Displacement(by, float(length[twice].sum()), once_m, wide_m, faced_m)


def _width(points: Array) -> float:
    """How wide points (n, 2) extend, m, across the direction in which they extend farthest."""
    if not len(points):
        return 0.0
    axes = np.linalg.eigh(np.cov(points.T))[1]
    return float(np.ptp(points @ axes[:, 0]))


def _best(normal: Array, off: Array, first: IntArray, length: Array) -> Array:
    """The displacement (2,) on a grid by which most of the length lies on what was seen before."""
    steps = np.arange(-REACH_M, REACH_M + STEP_M / 2, STEP_M)
    best, by = 0.0, np.zeros(2)
    for x in steps:
        left = (off - normal[:, 0] * x)[:, None] - normal[:, 1:] * steps
        near = np.maximum(1.0 - (left / ON_M) ** 2, 0.0)
        score = length @ np.maximum.reduceat(near, first, axis=0)
        k = int(np.argmax(score))
        if score[k] > best:
            best, by = float(score[k]), np.array([x, steps[k]])
    return by


def _beside(own: Pieces, before: Pieces) -> tuple[IntArray, Array, Array, BoolArray]:
    """Pairs (m) of pieces that may be one, sorted by the own one.

    Returns:
        Numbers of the own ones (m,), their normals (m, 2), how far across they have to be displaced
        to lie on the others (m,), m, and whether both were seen from the same side (m,).
    """
    near = cKDTree(own.at).query_ball_tree(cKDTree(before.at), PIECE_M + REACH_M)
    i = np.repeat(np.arange(len(near)), [len(found) for found in near])
    j = np.array([k for found in near for k in found], dtype=np.int64)
    parallel = np.abs(np.sin(before.direction[j] - own.direction[i])) < np.sin(ON_RAD)
    i, j = i[parallel], j[parallel]
    longer = own.length[i] > before.length[j]  # its direction is the one to be believed
    direction = np.where(longer, own.direction[i], before.direction[j])
    normal, apart = unit_vectors(direction + np.pi / 2), before.at[j] - own.at[i]
    off = (normal * apart).sum(axis=1)
    along = np.abs((unit_vectors(direction) * apart).sum(axis=1))
    shared = 0.5 * (own.length[i] + before.length[j]) - along
    may = np.abs(off) < REACH_M + ON_M
    may &= shared > 0.5 * np.minimum(own.length[i], before.length[j])
    turned = np.cos(before.direction[j] - own.direction[i]) < 0
    is_faced = own.side[i] * before.side[j] * np.where(turned, -1, 1) > 0
    return i[may], normal[may], off[may], is_faced[may]


def _building(
    steps: Sequence[Step],
    estimate: Estimate,
    landmarks: LandmarkMap,
    places: Sequence[SubmapPose],
) -> tuple[Pieces, list[tuple[str, Pieces]]]:
    """The building as an earlier map has it, and as each visit saw it, by time."""
    of_map: list[_Piece] = []
    found: dict[str, list[_Piece]] = defaultdict(list)
    known = [e for e in landmarks.known.values() if e.kind != "point"]
    for wall, stays in zip(known, of_building(known).tolist(), strict=True):
        if stays:
            of_map += _known_pieces(wall)
    seen = walls_seen(steps, estimate, ("line", "segment"))
    stays = of_building([landmarks.entries[n] for n in seen])
    for (number, every), stay in zip(seen.items(), stays.tolist(), strict=True):
        if stay:
            for visit, piece in _seen_pieces(every, estimate, estimate.landmarks[number][0]):
                found[visit].append(piece)
    first = {name: int(states.stamps_ns[0]) for name, states in estimate.states.items()}
    visits = sorted(first, key=lambda name: (first[name], name))
    before = _pieces(of_map)
    walls = np.column_stack([before.at, before.direction])
    before = before._replace(side=seen_sides(walls, before.length, places))
    return before, [(name, _pieces(found[name])) for name in visits]


def _pieces(found: Sequence[_Piece]) -> Pieces:
    at, *columns = zip(*found, strict=True) if found else ((), (), (), ())
    return Pieces(np.array(at).reshape(-1, 2), *(np.array(column, float) for column in columns))


def _known_pieces(wall: Entry) -> Iterator[_Piece]:
    """A wall of an earlier map in pieces, whose side its landmark does not tell."""
    first, last = wall.extent.tolist()
    ends = np.linspace(first, last, 1 + max(1, int(np.ceil((last - first) / PIECE_M))))
    for low, high in pairwise(ends.tolist()):
        middle = wall.mean[:2] + 0.5 * (low + high) * unit_vectors(wall.mean[2])
        yield middle, float(wall.mean[2]), high - low, 0.0


def _seen_pieces(
    seen: Sequence[Association], estimate: Estimate, mean: Array
) -> Iterator[tuple[str, _Piece]]:
    """A wall in pieces as each visit saw it by itself: the visit, and the piece."""
    viewers = between(mean, observed_from(seen, estimate.states))[:, 1]
    of_all = wall_observations(seen, estimate, mean)
    e, n = unit_vectors(mean[2]), unit_vectors(mean[2] + np.pi / 2)
    for visit in np.unique(of_all.robot).tolist():
        own = of_all.only(of_all.robot == visit)
        ends = own.seen_from_to
        number = np.floor(own.along / PIECE_M)
        for k in np.unique(number).tolist():
            low, high = max(ends[0], k * PIECE_M), min(ends[1], (k + 1) * PIECE_M)
            if high - low < SHORTEST_M:
                continue
            piece = own.only(number == k)
            (across, turn), _ = piece.line()
            middle = 0.5 * (low + high)
            at = mean[:2] + middle * e + (across + turn * middle) * n
            side = float(np.sign(np.median(viewers[piece.index])))
            yield visit, (at, float(mean[2] + turn), high - low, side)
