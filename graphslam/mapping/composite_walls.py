"""Walls that are two: parts beside each other whose observations were taken for those of one.

A closed door lies a decimetre behind the wall that it is in. Segments that go across the step, and
ends that are uncertain, tie both: one wall is estimated, which is turned by what lies between the
parts, and the path with it. No single observation contradicts that by much. All together do: on
either side of the step they have a line of their own, and the two lines do not meet. A door has the
wall on both sides, or on one.
"""

import numpy as np

from graphslam.core.arrays import BoolArray, IntArray
from graphslam.core.geometry import Array
from graphslam.core.record import replace
from graphslam.core.records import Estimate, Step
from graphslam.mapping.landmark_map import LandmarkMap
from graphslam.mapping.wall_observations import (
    PATH_M,
    WallObservations,
    retargeted,
    wall_observations,
    walls_seen,
)

#: observations of a part, at least
LEAST = 4
#: by how much two lines fit better than one, at least, in squared sigmas; they have two unknowns
#: more, and the place of the step
BETTER = 40.0
#: m, share of the part that was seen less: observations on both sides of the step, at most
ACROSS_M, ACROSS_SHARE = 0.5, 0.3
#: m: the step between the parts, at least: less bends nothing
STEP_M = 0.02
#: sigmas of one visit's error that the step is higher than, where each visit saw one part: three of
#: the difference of two
VISITS_SIGMAS = 3.0 * np.sqrt(2.0)
#: m: one of the parts is shorter, as doors and cabinets are. That two long ones are in line says
#: more of the direction of a corridor than all else
SHORT_M = 2.5
#: m: parts are told apart to this
CELL_M = 0.1


def split_composites(
    steps: tuple[Step, ...], estimate: Estimate, landmarks: LandmarkMap
) -> tuple[tuple[Step, ...], Estimate]:
    """Steps in which the parts of such walls are landmarks of their own.

    The map and the estimate get these; their covariances are unknown. Landmarks of an earlier map
    stay as they are. The work grows with the number of observations.
    """
    marks, targets = dict(estimate.landmarks), dict[int, int]()
    for wall, own in walls_seen(steps, estimate, ("line",)).items():
        if wall in landmarks.known or len(own) < 2 * LEAST:
            continue
        mean = marks[wall][0]
        parts = parts_of(wall_observations(own, estimate, mean), landmarks.bias_m)
        rest, *parts = sorted(parts, key=lambda part: -len(part.along))
        for part in parts:
            number = landmarks.next_number
            landmarks.split(wall, number)
            landmarks.recount(number, [own[k] for k in part.index.tolist()])
            marks[number] = part.landmark(mean)
            targets |= {id(own[k]): number for k in part.index.tolist()}
        if parts:
            landmarks.recount(wall, [own[k] for k in rest.index.tolist()])
            marks[wall] = rest.landmark(mean)
    if not targets:
        return steps, estimate
    return retargeted(steps, targets, landmarks), replace(estimate, landmarks=marks)


def parts_of(wall: WallObservations, bias_m: float) -> list[WallObservations]:
    """The parts of a wall; itself if it is one."""
    aside = find_offset_part(wall, bias_m)
    if aside is None:
        return [wall]
    return [*parts_of(wall.only(~aside), bias_m), *parts_of(wall.only(aside), bias_m)]


def find_offset_part(wall: WallObservations, bias_m: float) -> BoolArray | None:
    """Which observations (n,) show a part that stands aside from the others; None without one.

    A part at an end is looked for first, then one with the others on both sides. ``bias_m``: sigma,
    m, of the error across the wall that all observations of a visit share. The work grows with the
    length of the wall and the number of observations.
    """
    n = len(wall.along)
    cuts = np.arange(LEAST, n - LEAST + 1)
    for first, end in ((np.zeros_like(cuts), cuts), _inner_runs(wall.along)):
        if len(first):
            part = _best_part(wall, first, end, bias_m)
            if part is not None:
                return part
    return None


def _best_part(
    wall: WallObservations, first: IntArray, end: IntArray, bias_m: float
) -> BoolArray | None:
    """Which observations (n,) are in the run whose line and that of the others fit best.

    ``first`` and ``end`` (m,) are the runs. None where they are no two things.
    """
    n = len(wall.along)
    A, b = (np.concatenate([0.0 * of[:1], np.cumsum(of, axis=0)]) for of in wall.normal_equations())
    M, v = A[end] - A[first], b[end] - b[first]
    sides = ((M, v), (A[-1] - M, b[-1] - v))
    gain = sum(_explained(M, v) for M, v in sides) - _explained(A[-1], b[-1])
    best = int(gain.argmax())
    if not gain[best] > BETTER:
        return None
    part = np.zeros(n, dtype=np.bool_)
    part[first[best] : end[best]] = True
    ends = np.array([k for k in (first[best], end[best]) if 0 < k < n])
    edges = 0.5 * (wall.along[ends - 1] + wall.along[ends])
    # of a wall that is bent, as its path is, most are across an edge
    over = (wall.ends[:, :1] < edges - ACROSS_M) & (wall.ends[:, 1:] > edges + ACROSS_M)
    fewer = min(np.count_nonzero(part), np.count_nonzero(~part))
    if np.count_nonzero(over.any(axis=1)) > ACROSS_SHARE * fewer:
        return None
    least = STEP_M
    if not set(wall.robot[part]) & set(wall.robot[~part]):
        least = max(least, VISITS_SIGMAS * np.hypot(bias_m, PATH_M))
    lines = [np.linalg.solve(M[best], v[best]) for M, v in sides]
    off = lines[0] - lines[1]
    if not (abs(off[0] + edges * off[1]) > least).all():
        return None
    return part if min(wall.only(part).length, wall.only(~part).length) < SHORT_M else None


def _explained(M: Array, v: Array) -> Array:
    """What the lines of normal equations (..., 2, 2), (..., 2) take off the squared error (...)."""
    p, q = v[..., 0], v[..., 1]
    a, b, d = M[..., 0, 0], M[..., 0, 1], M[..., 1, 1]
    return np.asarray((d * p**2 - 2.0 * b * p * q + a * q**2) / (a * d - b**2))


def _inner_runs(along: Array) -> tuple[IntArray, IntArray]:
    """First (m,) and end (m,) of short runs of observations (n,), with others on both sides.

    ``along`` (n,) m, sorted, is where these are. Their number grows with the length of the wall.
    """
    cells = np.arange(along[0], along[-1], CELL_M)[1:]
    cuts = np.unique(np.searchsorted(along, cells))
    cuts = cuts[(cuts >= LEAST) & (len(along) - cuts >= LEAST)]
    if not len(cuts):
        return cuts, cuts
    steps = np.arange(1, int(SHORT_M / CELL_M) + 1)
    i, j = (of.ravel() for of in np.broadcast_arrays(np.arange(len(cuts))[:, None], steps))
    i, j = i[i + j < len(cuts)], (i + j)[i + j < len(cuts)]
    first, end = cuts[i], cuts[j]
    may = (end - first >= LEAST) & (along[end - 1] - along[first] <= SHORT_M)
    return first[may], end[may]
