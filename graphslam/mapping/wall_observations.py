"""All observations of a wall in its own frame, and the line that they show.

What a solution has made of them can be seen there without solving again: whether parts of them, or
those of one visit, show another line than the others (`composite_walls`, `moved_walls`).
"""

from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from graphslam.core.arrays import BoolArray, IntArray
from graphslam.core.geometry import Array, between, compose, rotation3
from graphslam.core.record import replace
from graphslam.core.records import Association, Estimate, Step
from graphslam.mapping.landmark_map import LandmarkMap, observed_from, retarget

#: m, rad: error of a visit's path where it sees a wall
PATH_M, PATH_RAD = 0.005, 0.002


@dataclass(frozen=True, slots=True, eq=False)
class WallObservations:
    """Observations (n,) of one wall in its frame, sorted along it.

    ``along`` (n,) m, of their middles; ``measured`` (n, 2): across, m, and direction, rad;
    ``weight`` (n, 2, 2): its information; ``ends`` (n, 2) m, along the wall; ``index`` (n,): of the
    observation; ``robot`` (n,) who made it.
    """

    along: Array
    measured: Array
    weight: Array
    ends: Array
    index: IntArray
    robot: np.ndarray[Any, np.dtype[np.str_]]

    def only(self, which: BoolArray) -> "WallObservations":
        """Some of them (n,)."""
        return WallObservations(
            self.along[which], self.measured[which], self.weight[which], self.ends[which],
            self.index[which], self.robot[which],
        )  # fmt: skip

    @property
    def seen_from_to(self) -> tuple[float, float]:
        """What they show by their ends, but for a few: from and to along the wall, m."""
        return float(np.quantile(self.ends[:, 0], 0.2)), float(np.quantile(self.ends[:, 1], 0.8))

    @property
    def length(self) -> float:
        """Length, m, of what they show by their ends, but for a few."""
        low, high = self.seen_from_to
        return high - low

    def normal_equations(self) -> tuple[Array, Array]:
        """Of the line, by how far across and in what direction it is at 0: (n, 2, 2), (n, 2)."""
        J = np.zeros((len(self.along), 2, 2))
        J[:, 0, 0] = J[:, 1, 1] = 1.0
        J[:, 0, 1] = self.along
        weighted = J.mT @ self.weight
        return weighted @ J, (weighted @ self.measured[:, :, None])[:, :, 0]

    def line(self) -> tuple[Array, Array]:
        """How far across, m, and in what direction, rad, the line is at 0 (2,); its covariance."""
        A, b = (of.sum(axis=0) for of in self.normal_equations())
        return np.asarray(np.linalg.solve(A, b)), np.asarray(np.linalg.inv(A))

    def landmark(self, mean: Array) -> tuple[Array, Array]:
        """The pose (3,) of a landmark that they are all of, in their middle; covariance unknown.

        ``mean`` (3,) is the pose in whose frame they are.
        """
        (across, direction), _ = self.line()
        along = float(self.along.mean())
        pose = np.array([along, across + along * direction, direction])
        return compose(mean, pose), np.full((3, 3), np.nan)


def walls_seen(
    steps: Sequence[Step], estimate: Estimate, models: Collection[str]
) -> dict[int, list[Association]]:
    """Observations of each wall of the estimate whose ends are known, of some ``models``."""
    seen: dict[int, list[Association]] = defaultdict(list)
    for step in steps:
        for a in step.associations:
            if a.model in models and a.extent is not None and a.target in estimate.landmarks:
                seen[int(a.target)].append(a)
    return seen


def wall_observations(
    seen: Sequence[Association], estimate: Estimate, mean: Array
) -> WallObservations:
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
    robot = np.array([a.robot for a in seen])[order]
    return WallObservations(at[order, 0], measured[order], weight, ends[order], order, robot)


def retargeted(
    steps: Sequence[Step], targets: Mapping[int, int], landmarks: LandmarkMap
) -> tuple[Step, ...]:
    """Steps in which associations, by their ``id``, are of other landmarks of the map."""

    def of(a: Association) -> Association:
        number = targets.get(id(a))
        return a if number is None else retarget(a, number, landmarks.entries[number].kind)

    return tuple(replace(step, associations=tuple(map(of, step.associations))) for step in steps)
