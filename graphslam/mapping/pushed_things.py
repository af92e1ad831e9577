"""Things that were pushed alike between two visits, told from the building around them.

One thing that stands aside is told by its own observations (`moved_walls`). Many that were pushed
alike drag the path of a visit: in the solution none of them is far from where it was, and the
building is off by the rest. So around each thing two motions of the visit are fitted: the one that
lays the building on what was seen of it before, and the one that lays the things there. Where they
contradict each other, the building is right (`building`). How well surfaces are seen where they
were before is not stated, but what both motions leave of all of them tells (an empirical null, as
in `change_detection.beam_evidence`).

Every visit is compared once with those before it, and a thing with what is around it, so that the
work grows with what was seen.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from graphslam.core.arrays import BoolArray, IntArray
from graphslam.core.geometry import Array, unit_vectors
from graphslam.core.known_landmarks import KnownLandmarks
from graphslam.core.record import replace
from graphslam.core.records import Association, Estimate, Step
from graphslam.mapping.building import of_building
from graphslam.mapping.landmark_map import LandmarkMap
from graphslam.mapping.moved_walls import separated
from graphslam.mapping.wall_observations import (
    PATH_RAD,
    WallObservations,
    wall_observations,
    walls_seen,
)

#: m: what is compared around a thing. Long walls are, piece by piece
AROUND_M, PIECE_M = 8.0, 4.0
#: m: sigma across of what is seen again, at first, at least and at most
REPEATED_M, LEAST_REPEATED_M, MOST_REPEATED_M = 0.008, 0.004, 0.02
#: m: sigma of a wall of an earlier map, at least
SEEN_M = 0.001
#: m, m, rad: sigmas of a motion before anything is compared
FREE = np.array([0.1, 0.1, 0.02])
#: two motions whose squared distance is larger are not one. Six sigmas, as surfaces that are seen
#: from the same places err alike: where nothing was pushed, distances reach five
GATE = 36.0
#: m: things that were pushed by less are left as they are
LEAST_PUSHED_M = 0.01
#: things near each other that were pushed, at least
LEAST_ALIKE = 3
#: pieces of the building that tell a motion, and what is around a thing that tells what is left
LEAST_PIECES, LEAST_AROUND = 3, 12
#: sigma of a normal distribution by the median of its absolute values
MEDIAN_SIGMA = 1.4826
#: rounds of weights of a motion, and the squared distance of which a piece counts a quarter
ROUNDS, HALF_D2 = 4, 9.0


def part_pushed(
    steps: tuple[Step, ...],
    estimate: Estimate,
    landmarks: LandmarkMap,
    known: KnownLandmarks | None = None,
    least: int = LEAST_ALIKE,
) -> tuple[tuple[Step, ...], Estimate, dict[int, int]]:
    """Steps in which what was pushed between visits is another landmark from then on.

    Visits and ``known`` are those of `moved_walls.part_moved`. All visits for which a thing was
    pushed have one landmark of it: solved again, they show whether it was pushed once more.

    Returns:
        As `moved_walls.part_moved`.
    """
    before = {} if known is None else known.given_the_others(estimate.landmarks)
    if not before and len(estimate.states) < 2:
        return steps, estimate, {}
    seen = walls_seen(steps, estimate, ("line", "segment"))
    places: dict[int, tuple[list[Association], list[Association]]] = {}
    pushed = {
        visit: _pushed(compared, least)
        for visit, compared in _visits(seen, estimate, landmarks, before)
        if len(compared.wall)
    }
    for wall in sorted(set().union(*pushed.values())):
        there = [a for a in seen[wall] if wall in pushed.get(a.robot, ())]
        places[wall] = [a for a in seen[wall] if wall not in pushed.get(a.robot, ())], there
    return separated(steps, estimate, landmarks, places, before)


@dataclass(frozen=True, slots=True, eq=False)
class _Compared:
    """Pieces of walls (n) that a visit and one before it saw.

    ``at`` (n, 2) m; ``normal`` (n, 2); ``off`` (n, 2): across, m, and in direction, rad, how far
    off what was seen before; ``cov`` (n, 2, 2) without what surfaces do; ``wall`` (n,);
    ``stays`` (n,): of the building; ``repeated_m``: sigma of a surface seen again.
    """

    at: Array
    normal: Array
    off: Array
    cov: Array
    wall: IntArray
    stays: BoolArray
    repeated_m: float = REPEATED_M

    @property
    def information(self) -> Array:
        """Of ``off`` (n, 2, 2)."""
        noise = np.diag([self.repeated_m**2, 2 * PATH_RAD**2])
        return np.asarray(np.linalg.inv(self.cov + noise))

    def jacobians(self, centre: Array) -> Array:
        """(n, 2, 3) of ``off`` by a motion of the visit about a centre (2,), m, m, rad."""
        arm, (x, y) = self.at - centre, self.normal.T
        J = np.zeros((len(arm), 2, 3))
        J[:, 0, :2] = self.normal
        J[:, 0, 2] = arm[:, 0] * y - arm[:, 1] * x
        J[:, 1, 2] = 1.0
        return J

    def only(self, which: IntArray) -> "_Compared":
        """Some of them (n,)."""
        return replace(
            self, at=self.at[which], normal=self.normal[which], off=self.off[which],
            cov=self.cov[which], wall=self.wall[which], stays=self.stays[which],
        )  # fmt: skip

    def motion(self, centre: Array) -> tuple[Array, Array]:
        """The motion (3,) about a centre that explains most of them, and its covariance."""
        J, W = self.jacobians(centre), self.information
        trust, motion, A = np.ones(len(J)), np.zeros(3), np.eye(3)
        for _ in range(ROUNDS):
            weighted = J.mT @ (W * trust[:, None, None])
            A = (weighted @ J).sum(axis=0) + np.diag(FREE**-2)
            motion = np.linalg.solve(A, (weighted @ self.off[:, :, None]).sum(axis=0)[:, 0])
            left = self.off - J @ motion
            trust = (1.0 + np.einsum("ni,nij,nj->n", left, W, left) / HALF_D2) ** -2
        return motion, np.asarray(np.linalg.inv(A))


class _Around(NamedTuple):
    """A thing (row of `_Compared`), and the motions of the building and of things around it."""

    row: int
    building: tuple[Array, Array]
    things: tuple[Array, Array]
    left_m: float


def _around(c: _Compared) -> Iterator[_Around]:
    """What is around each thing; ``left_m``: what is left across, but for the worst."""
    tree = cKDTree(c.at)
    for row in np.flatnonzero(~c.stays).tolist():
        near = np.array(tree.query_ball_point(c.at[row], AROUND_M))
        building, things = c.only(near[c.stays[near]]), c.only(near[~c.stays[near]])
        if len(building.wall) < LEAST_PIECES:
            continue
        stays, moves = building.motion(c.at[row]), things.motion(c.at[row])
        left = np.concatenate([
            (group.off - group.jacobians(c.at[row]) @ motion)[:, 0]
            for group, (motion, _) in ((building, stays), (things, moves))
        ])  # fmt: skip
        left_m = np.nan
        if len(left) >= LEAST_AROUND:  # each motion fits three pieces whatever they are
            factor = MEDIAN_SIGMA * np.sqrt(len(left) / (len(left) - 6))
            left_m = float(factor * np.median(np.abs(left)))
        yield _Around(row, stays, moves, left_m)


def _pushed(c: _Compared, least: int) -> set[int]:
    """The walls of a visit that were pushed before it."""
    left = np.array([around.left_m for around in _around(c)])
    if np.isfinite(left).any():
        repeated = np.clip(np.nanmedian(left), LEAST_REPEATED_M, MOST_REPEATED_M)
        c = replace(c, repeated_m=float(repeated))
    W, alike = c.information, np.zeros(len(c.wall), dtype=np.bool_)
    for row, (stays, P), (moves, Q), _ in _around(c):
        apart = moves - stays
        J = c.jacobians(c.at[row])[row]
        by = J @ apart
        if apart @ np.linalg.solve(P + Q, apart) <= GATE or abs(by[0]) < LEAST_PUSHED_M:
            continue
        own = c.off[row] - J @ stays
        alike[row] = (own - by) @ W[row] @ (own - by) < own @ W[row] @ own
    # a few do not drag a path, and by themselves are told better
    rows = np.flatnonzero(alike)
    near = np.hypot(*(c.at[rows, None] - c.at[rows]).T) <= AROUND_M
    return set(c.wall[rows[near.sum(axis=0) >= least]].tolist())


def _visits(
    seen: Mapping[int, Sequence[Association]],
    estimate: Estimate,
    landmarks: LandmarkMap,
    before: Mapping[int, tuple[Array, Array]],
) -> Iterator[tuple[str, _Compared]]:
    """Each visit, compared with the first one that saw a wall, or with an earlier map."""
    walls = [landmarks.entries[n] for n in seen]
    stays = dict(zip(seen, of_building(walls).tolist(), strict=True))
    found: dict[str, list[_Piece]] = {}
    for number, every in seen.items():
        mean = estimate.landmarks[number][0]
        of_all = wall_observations(every, estimate, mean)
        known = None
        if number in before:
            across, cov = before[number][0][1:], before[number][1].diagonal()[1:]
            # without the biases of its surface, by day, which are in what the motions leave
            own = max(cov[0] - 2 * landmarks.bias_m**2, SEEN_M**2)
            known = across, np.diag([own, cov[1]])
        names = sorted({a.robot for a in every}, key=lambda name: _began(estimate, name))
        length = PIECE_M if stays[number] else np.inf
        for visit in names[known is None :]:
            for piece in _pieces(of_all, visit, names[0], known, length):
                at = mean[:2] + piece.along * unit_vectors(mean[2])
                found.setdefault(visit, []).append(piece._replace(number=number, at=at))
    for visit, pieces in found.items():
        numbers = np.array([piece.number for piece in pieces])
        turned = np.array([estimate.landmarks[n][0][2] for n in numbers.tolist()]) + np.pi / 2
        yield (
            visit,
            _Compared(
                np.array([piece.at for piece in pieces]), unit_vectors(turned),
                np.array([piece.off for piece in pieces]),
                np.array([piece.cov for piece in pieces]), numbers,
                np.array([stays[n] for n in numbers.tolist()]),
            ),
        )  # fmt: skip


class _Piece(NamedTuple):
    """One row of `_Compared`, of wall ``number``, ``along`` m from its mean."""

    along: float
    off: Array
    cov: Array
    number: int = -1
    at: Array = np.zeros(2)


def _pieces(
    of_all: WallObservations,
    visit: str,
    first: str,
    known: tuple[Array, Array] | None,
    length: float,
) -> Iterator[_Piece]:
    """A wall as a visit saw it, against the ``first`` one or what is ``known`` of it.

    Piece by piece, each of a ``length``, m.
    """
    number = np.floor(of_all.along / length)
    for k in np.unique(number[of_all.robot == visit]):
        own = of_all.only((of_all.robot == visit) & (number == k))
        at = float(own.along.mean())
        there = known
        if there is None:
            others = (of_all.robot == first) & (number == k)
            if not others.any():
                continue
            there = of_all.only(others).line()
        line, cov = _moved_along(*own.line(), at)
        before, cov_before = _moved_along(*there, at)
        yield _Piece(at, line - before, cov + cov_before)


def _began(estimate: Estimate, name: str) -> tuple[int, str]:
    return int(estimate.states[name].stamps_ns[0]), name


def _moved_along(line: Array, cov: Array, at: float) -> tuple[Array, Array]:
    """A line that is given at 0 (2,), with covariance (2, 2), at a place along it, m."""
    F = np.array([[1.0, at], [0.0, 1.0]])
    return F @ line, F @ cov @ F.T
