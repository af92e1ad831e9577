"""Walls that are two: parts beside each other whose observations were taken for those of one.

A closed door lies a decimetre behind the wall that it is in. Segments that go across the step, and
ends that are uncertain, tie both: one wall is estimated, which is turned by what lies between the
parts, and the path with it. No single observation contradicts that by much. All together do: on
either side of the step they have a line of their own, and the two lines do not meet.
"""

import numpy as np

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
    """The parts of a wall, in their order along it; itself if it is one."""
    cut = step_of(wall, bias_m)
    if cut is None:
        return [wall]
    return [
        *parts_of(wall.only(slice(cut)), bias_m),
        *parts_of(wall.only(slice(cut, None)), bias_m),
    ]


def step_of(wall: WallObservations, bias_m: float) -> int | None:
    """Index of the first observation behind a step; None without one.

    ``bias_m``: sigma, m, of the error across the wall that all observations of a visit share.
    """
    n = len(wall.along)
    cuts = np.arange(LEAST, n - LEAST + 1)
    if not len(cuts):
        return None
    A, b = wall.normal_equations()
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
    least = STEP_M
    if not set(wall.robot[:cut]) & set(wall.robot[cut:]):
        least = max(least, VISITS_SIGMAS * np.hypot(bias_m, PATH_M))
    high = abs(np.array([1.0, edge]) @ (lines[1][best] - lines[0][best])) > least
    short = min(wall.only(slice(cut)).length, wall.only(slice(cut, None)).length) < SHORT_M
    return cut if apart and high and short and gain[best] > BETTER else None
