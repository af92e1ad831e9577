"""Which loop closures say nothing that landmarks do not say, as both come from the same scans."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from graphslam.core.geometry import Array, unit_vectors
from graphslam.core.records import Closure, Step
from graphslam.mapping.landmark_map import LandmarkMap
from graphslam.mapping.submaps import State

#: least information, in walls, about the weakest direction of a position: two walls that meet at 25
#: degrees have as much
MIN_INFORMATION = 0.1

#: first and last time of a submap's scans, ns
Span = tuple[int, int]


def closures_not_in_landmarks(
    closures: Sequence[Closure],
    spans: Mapping[State, Span],
    steps: Iterable[Step],
    landmarks: LandmarkMap,
) -> list[Closure]:
    """The closures whose two submaps see too few common landmarks to fix their relative pose.

    Args:
        closures: between submaps.
        spans: state in the middle of a submap -> when its scans were taken.
        steps: with landmarks of different visits tied.
        landmarks: as estimated.
    """
    seen = _SeenLandmarks(steps)
    out = []
    for closure in closures:
        one, other = (
            seen.during(robot, spans[robot, time_ns])
            for robot, time_ns in (
                (closure.robot, closure.time_ns),
                (closure.other, closure.other_time_ns),
            )
        )
        if not _determine_pose(
            [
                landmarks.entries[n].mean
                for n in one & other
                if landmarks.entries[n].kind != "point"
            ],
            sum(landmarks.entries[n].kind == "point" for n in one & other),
        ):
            out.append(closure)
    return out


def _determine_pose(walls: Sequence[Array], points: int) -> bool:
    """Whether common walls (3,) and a number of points determine a relative pose."""
    if len(walls) + points < 2:
        return False
    normals = unit_vectors(np.array([wall[2] for wall in walls]) + np.pi / 2).reshape(-1, 2)
    information = normals.T @ normals + points * np.eye(2)
    return bool(np.linalg.eigvalsh(information)[0] >= MIN_INFORMATION)


class _SeenLandmarks:
    """Which landmarks each robot saw when."""

    def __init__(self, steps: Iterable[Step]) -> None:
        found: dict[str, list[tuple[int, int]]] = {}
        for step in steps:
            for a in step.associations:
                if isinstance(a.target, int):
                    found.setdefault(a.robot, []).append((a.time_ns, a.target))
        self._seen = {
            robot: np.array(sorted(pairs), dtype=np.int64) for robot, pairs in found.items()
        }

    def during(self, robot: str, span: Span) -> set[int]:
        """Landmarks that a robot saw within a span, both ends included."""
        if robot not in self._seen:
            return set()
        times, numbers = self._seen[robot].T
        first, last = np.searchsorted(times, [span[0], span[1] + 1])
        return set(numbers[first:last].tolist())
