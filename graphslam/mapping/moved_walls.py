"""Things that stand a little aside on another visit: their landmarks are not one.

Landmarks of two visits are tied where they lie within centimetres of each other (`visits`), and so
is a cabinet that was pushed by less. Tied, it pulls the paths of the visits together, and is mapped
where it never stood. Once all is solved, what each visit saw of it shows a line of its own.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array, compose, exp
from graphslam.core.known_landmarks import KnownLandmarks
from graphslam.core.record import replace
from graphslam.core.records import Association, Estimate, Step
from graphslam.mapping.building import LONGEST_M
from graphslam.mapping.landmark_map import LandmarkMap
from graphslam.mapping.wall_observations import (
    PATH_M,
    PATH_RAD,
    WallObservations,
    retargeted,
    wall_observations,
    walls_seen,
)

#: two lines that differ by more are not of one thing at one place
GATE = chi2_quantile(0.99, 2)


@dataclass(frozen=True, slots=True, eq=False)
class _Line:
    """How far across, m, and in what direction, rad, a line is at the origin (2,); (2, 2)."""

    mean: Array
    cov: Array

    def agrees(self, other: "_Line") -> bool:
        """Whether both may be the same."""
        off = other.mean - self.mean
        return bool(off @ np.linalg.solve(self.cov + other.cov, off) <= GATE)

    def fused(self, other: "_Line") -> "_Line":
        """The line by both."""
        gain = self.cov @ np.linalg.inv(self.cov + other.cov)
        return _Line(self.mean + gain @ (other.mean - self.mean), self.cov - gain @ self.cov)


def part_moved(
    steps: tuple[Step, ...],
    estimate: Estimate,
    landmarks: LandmarkMap,
    known: KnownLandmarks | None = None,
) -> tuple[tuple[Step, ...], Estimate, dict[int, int]]:
    """Steps in which what was moved between visits is a landmark for each place.

    A visit is what one robot name saw, as sessions have one each; ``known`` is what an earlier map
    says. The first visit keeps the landmark. The work grows with the number of observations.

    Returns:
        The steps, the estimate with the new landmarks, whose covariances are unknown, and these:
        new number -> that of the landmark where it was before. The map gets them too.
    """
    before = {} if known is None else known.given_the_others(estimate.landmarks)
    if not before and len(estimate.states) < 2:
        return steps, estimate, {}
    places = {}
    for wall, seen in walls_seen(steps, estimate, ("line", "segment")).items():
        mean = estimate.landmarks[wall][0]
        # what visits say of the direction of a long wall is worth more than one that moved costs
        if _length(wall, wall_observations(seen, estimate, mean), landmarks) > LONGEST_M:
            continue
        prior = None
        if wall in before:
            # without the error of this day, which is in the line of this day too
            own = before[wall][1][1:, 1:] - np.diag([landmarks.bias_m**2, 0.0])
            prior = _Line(before[wall][0][1:], own)
        places[wall] = _places(seen, estimate, mean, prior, landmarks.bias_m)
    return separated(steps, estimate, landmarks, places, before)


def separated(
    steps: tuple[Step, ...],
    estimate: Estimate,
    landmarks: LandmarkMap,
    places: Mapping[int, Sequence[Sequence[Association]]],
    before: Mapping[int, tuple[Array, Array]],
) -> tuple[tuple[Step, ...], Estimate, dict[int, int]]:
    """Steps in which walls are a landmark for each of their ``places``, the first one as it was.

    Args:
        steps: with observations of the walls.
        estimate: of all states and landmarks.
        landmarks: the map, which gets the new ones.
        places: wall -> its observations at each place.
        before: of walls of an earlier map, see `KnownLandmarks.given_the_others`.

    Returns:
        As `part_moved`.
    """
    marks, targets, made = dict(estimate.landmarks), dict[int, int](), dict[int, int]()
    for wall, (stayed, *moved) in places.items():
        mean = marks[wall][0]
        for part in moved:
            number = landmarks.next_number
            landmarks.split(wall, number)
            landmarks.recount(number, part)
            marks[number] = wall_observations(part, estimate, mean).landmark(mean)
            targets |= {id(a): number for a in part}
            made[number] = wall
        if moved:
            landmarks.recount(wall, stayed)
            if wall in before:
                marks[wall] = compose(mean, exp(before[wall][0])), marks[wall][1]
            else:
                marks[wall] = wall_observations(stayed, estimate, mean).landmark(mean)
    if not made:
        return steps, estimate, {}
    return retargeted(steps, targets, landmarks), replace(estimate, landmarks=marks), made


def _length(number: int, wall: WallObservations, landmarks: LandmarkMap) -> float:
    """Length, m, of what was ever seen of a wall."""
    known = landmarks.known.get(number)
    return wall.length if known is None else max(wall.length, float(np.ptp(known.extent)))


def _places(
    seen: list[Association], estimate: Estimate, mean: Array, prior: _Line | None, bias_m: float
) -> list[list[Association]]:
    """What was seen at each place; the first is that of ``prior``, if there is one."""
    visits: dict[str, list[Association]] = defaultdict(list)
    for a in sorted(seen, key=lambda a: a.time_ns):
        visits[a.robot].append(a)
    places: list[tuple[_Line, list[Association]]] = [] if prior is None else [(prior, [])]
    for own in visits.values():
        line = _line_of(wall_observations(own, estimate, mean), bias_m)
        for k, (there, others) in enumerate(places):
            if there.agrees(line):
                places[k] = there.fused(line), others + own
                break
        else:
            places.append((line, own))
    return [own for _, own in places]


def _line_of(wall: WallObservations, bias_m: float) -> _Line:
    """What one visit saw of it, by all its errors: where it saw it, its surface looked nearer."""
    mean, cov = wall.line()
    back = np.array([[1.0, -float(wall.along.mean())], [0.0, 1.0]])
    there = np.diag([bias_m**2 + PATH_M**2, PATH_RAD**2])
    return _Line(mean, cov + back @ there @ back.T)
