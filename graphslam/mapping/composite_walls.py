"""Walls that are two: parts beside each other whose observations were taken for those of one.

A closed door lies a decimetre behind the wall that it is in. Segments that go across the step, and
ends that are uncertain, tie both: one wall is estimated, which is turned by what lies between the
parts, and the path with it. No single observation contradicts that by much. All together do: on
either side of the step they have a line of their own, and the two lines do not meet.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from graphslam.core.geometry import Array, between, compose, rotation3
from graphslam.core.record import replace
from graphslam.core.records import Association, Estimate, Step
from graphslam.mapping.gating import IntArray
from graphslam.mapping.landmark_map import LandmarkMap, observed_from, retarget

#: observations of a part, at least
LEAST = 4
#: by how much two lines fit better than one, at least, in squared sigmas; they have two unknowns
#: more, and the place of the step
BETTER = 40.0
#: m, share of the part that was seen less: observations on both sides of the step, at most
ACROSS_M, ACROSS_SHARE = 0.5, 0.3
#: m: the step between the parts, at least: less bends nothing
STEP_M = 0.02
#: m: one of the parts is shorter, as doors and cabinets are. That two long ones are in line says
#: more of the direction of a corridor than all else
SHORT_M = 2.5


@dataclass(frozen=True, slots=True, eq=False)
class Observed:
    """Observations (n,) of one wall in its frame, sorted along it.

    ``along`` (n,) m, of their middles; ``measured`` (n, 2): across, m, and direction, rad;
    ``weight`` (n, 2, 2): its information; ``ends`` (n, 2) m, along the wall; ``index`` (n,): of the
    observation.
    """

    along: Array
    measured: Array
    weight: Array
    ends: Array
    index: IntArray

    def only(self, which: slice) -> "Observed":
        """Some of them."""
        return Observed(
            self.along[which], self.measured[which], self.weight[which], self.ends[which],
            self.index[which],
        )  # fmt: skip


def split_composites(
    steps: tuple[Step, ...], estimate: Estimate, landmarks: LandmarkMap
) -> tuple[tuple[Step, ...], Estimate]:
    """Steps in which the parts of such walls are landmarks of their own.

    The map and the estimate get these; their covariances are unknown. Landmarks of an earlier map
    stay as they are. The work grows with the number of observations.
    """
    seen: dict[int, list[Association]] = defaultdict(list)
    for step in steps:
        for a in step.associations:
            if a.model == "line" and a.extent is not None and a.target in estimate.landmarks:
                seen[int(a.target)].append(a)
    marks, targets = dict(estimate.landmarks), dict[int, int]()
    for wall, own in seen.items():
        if wall in landmarks.known or len(own) < 2 * LEAST:
            continue
        mean = marks[wall][0]
        rest, *parts = sorted(parts_of(observed(own, estimate, mean)), key=lambda p: -len(p.along))
        if parts:
            marks[wall] = _line(rest, mean)
        for part in parts:
            number = landmarks.next_number
            landmarks.split(wall, number)
            marks[number] = _line(part, mean)
            targets |= {id(own[k]): number for k in part.index.tolist()}
    if not targets:
        return steps, estimate
    made = tuple(replace(s, associations=_renamed(s.associations, targets)) for s in steps)
    return made, replace(estimate, landmarks=marks)


def observed(seen: Sequence[Association], estimate: Estimate, mean: Array) -> Observed:
    """Observations of a wall in the frame of its pose ``mean`` (3,)."""
    z = np.array([a.z for a in seen])
    at = between(mean, compose(observed_from(seen, estimate.states), z))
    back = np.cos(at[:, 2]) < 0  # of the opposite direction
    direction = np.where(back, at[:, 2] - np.copysign(np.pi, at[:, 2]), at[:, 2])
    turned = rotation3(-z[:, 2])
    cov = (turned @ np.array([a.cov for a in seen]) @ turned.mT)[:, 1:, 1:]
    cov[back, 0, 1] *= -1.0
    cov[back, 1, 0] *= -1.0
    order = np.argsort(at[:, 0], kind="stable")
    measured = np.column_stack([at[:, 1], direction])
    ends = np.sort(at[:, :1] + np.cos(at[:, 2:]) * np.array([a.extent for a in seen]), axis=1)
    weight = np.linalg.inv(cov[order])
    return Observed(at[order, 0], measured[order], weight, ends[order], order)


def parts_of(wall: Observed) -> list[Observed]:
    """The parts of a wall, in their order along it; itself if it is one."""
    cut = step_of(wall)
    if cut is None:
        return [wall]
    return [*parts_of(wall.only(slice(cut))), *parts_of(wall.only(slice(cut, None)))]


def step_of(wall: Observed) -> int | None:
    """Index of the first observation behind a step; None without one."""
    n = len(wall.along)
    cuts = np.arange(LEAST, n - LEAST + 1)
    if not len(cuts):
        return None
    A, b = _normal_equations(wall)
    A, b = np.cumsum(A, axis=0), np.cumsum(b, axis=0)
    sides = [(A[cuts - 1], b[cuts - 1]), (A[-1] - A[cuts - 1], b[-1] - b[cuts - 1])]
    lines = [np.linalg.solve(M, v[:, :, None])[:, :, 0] for M, v in sides]
    # what lines take off the squared error
    two = sum(np.einsum("ni,ni->n", v, line) for (_, v), line in zip(sides, lines, strict=True))
    gain = np.asarray(two) - b[-1] @ np.linalg.solve(A[-1], b[-1])
    best = int(gain.argmax())
    cut = int(cuts[best])
    edge = float(wall.along[cut - 1 : cut + 1].mean())
    # of a wall that is bent, as its path is, most are across the edge
    across = (wall.ends[:, 0] < edge - ACROSS_M) & (wall.ends[:, 1] > edge + ACROSS_M)
    apart = np.count_nonzero(across) <= ACROSS_SHARE * min(cut, n - cut)
    high = abs(np.array([1.0, edge]) @ (lines[1][best] - lines[0][best])) > STEP_M
    short = min(_length(wall.ends[:cut]), _length(wall.ends[cut:])) < SHORT_M
    return cut if apart and high and short and gain[best] > BETTER else None


def _length(ends: Array) -> float:
    """Length, m, of a part by the ends (n, 2) of its observations, but for a few."""
    low, high = np.quantile(ends[:, 0], 0.2), np.quantile(ends[:, 1], 0.8)
    return float(high - low)


def _normal_equations(wall: Observed) -> tuple[Array, Array]:
    """Of the line, by how far across and in what direction it is at 0: (n, 2, 2) and (n, 2)."""
    J = np.zeros((len(wall.along), 2, 2))
    J[:, 0, 0] = J[:, 1, 1] = 1.0
    J[:, 0, 1] = wall.along
    weighted = J.mT @ wall.weight
    return weighted @ J, (weighted @ wall.measured[:, :, None])[:, :, 0]


def _line(part: Observed, mean: Array) -> tuple[Array, Array]:
    """The pose (3,) of a part, in the middle of its observations; its covariance is unknown."""
    A, b = (of.sum(axis=0) for of in _normal_equations(part))
    across, direction = np.linalg.solve(A, b)
    along = float(part.along.mean())
    pose = np.array([along, across + along * direction, direction])
    return compose(mean, pose), np.full((3, 3), np.nan)


def _renamed(seen: Sequence[Association], targets: Mapping[int, int]) -> tuple[Association, ...]:
    return tuple(retarget(a, targets[id(a)], "line") if id(a) in targets else a for a in seen)
