"""The interface of every estimator, the table of states, and a recorder of trajectories."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.errors import EstimationError
from graphslam.core.geometry import Array
from graphslam.core.records import Estimate, Step, Trajectory

#: why a back end could not use something, the keys of `Backend.skipped`
LATE_EVIDENCE = "late evidence"
PAST_OBSERVATION = "observation from a past state"
PAST_CLOSURE = "closure to a past state"


@dataclass(frozen=True, slots=True, eq=False)
class JointMarginal:
    """Joint marginal of a robot's latest pose, landmarks and other robots' latest poses, in world.

    ``pose`` (3,); ``landmarks`` one array (2,) or (3,) each; ``others`` (3,) each. ``cov`` (D, D)
    is of additive errors along world axes: the pose, then the landmarks, then the others.
    ``slices`` are the blocks of the landmarks and the others in it.
    """

    pose: Array
    landmarks: tuple[Array, ...]
    cov: Array
    slices: tuple[slice, ...]
    others: tuple[Array, ...] = ()

    @classmethod
    def of(cls, means: Sequence[Array], landmarks: int, cov: Array) -> "JointMarginal":
        """From the means of the pose, so many landmarks and others, and their covariance."""
        n, slices = 1 + landmarks, block_slices([len(mean) for mean in means[1:]])
        return cls(means[0], tuple(means[1:n]), cov, slices, tuple(means[n:]))


class Backend(Protocol):
    """An estimator that takes steps in time order and can be queried between any two.

    ``error_frame`` is the definition of pose errors that it takes as Gaussian, which matters beyond
    first order: ``world`` = additive along world axes (thesis), ``body`` = exponential map at the
    pose (GTSAM). Covariances are returned along world axes in either case.
    """

    @property
    def error_frame(self) -> Literal["body", "world"]:
        """See the class."""
        ...

    @property
    def skipped(self) -> Mapping[str, int]:
        """Number of observations and closures that could not be used, by reason."""
        ...

    def add(self, step: Step) -> None:
        """Add one step: starts, motions, associations, closures.

        Raises:
            EstimationError: the step makes the estimate indeterminate.
        """
        ...

    def joint(
        self, robot: str, landmarks: Sequence[int], others: Sequence[str] = ()
    ) -> JointMarginal:
        """Joint marginal of the robot's latest pose, landmarks and others, from data so far."""
        ...

    def state_mean(self, robot: str) -> Array:
        """Current estimate (3,) of the robot's latest pose, without covariance (cheap)."""
        ...

    def landmark_means(self, landmarks: Sequence[int]) -> list[Array]:
        """Current estimates (2,) or (3,) of the landmarks, without covariance (cheap)."""
        ...

    def finish(self) -> Estimate:
        """The final estimate from all steps."""
        ...


class StateTable:
    """The states of every robot: ``times`` in order, and their numbers by time."""

    def __init__(self) -> None:
        self.times: dict[str, list[int]] = {}
        self._number: dict[tuple[str, int], int] = {}

    def append(self, robot: str, time_ns: int) -> int:
        """Add a state; returns its number."""
        times = self.times.setdefault(robot, [])
        self._number[robot, time_ns] = len(times)
        times.append(time_ns)
        return len(times) - 1

    def number(self, robot: str, time_ns: int) -> int:
        """Number of the state of ``robot`` at exactly ``time_ns``.

        Raises:
            EstimationError: there is none, or the robot has not started.
        """
        number = self._number.get((robot, time_ns))
        if number is None:
            self.latest(robot, time_ns)  # raises if it has not started
            raise EstimationError(
                f"robot {robot} has no state at {time_ns} ns: a step refers to a state that no "
                "earlier step made"
            )
        return number

    def numbers(self, robot: str, times_ns: IntArray) -> IntArray:
        """`number` of the states at n times, given (n,) and returned as (n,).

        Raises:
            EstimationError: see `number`.
        """
        own = self.stamps(robot) if robot in self.times else np.zeros(0, dtype=np.int64)
        found = np.searchsorted(own, times_ns)
        known = found < len(own)
        known[known] = own[found[known]] == times_ns[known]
        for missing in times_ns[~known].tolist():
            self.number(robot, missing)  # raises
        return found

    def latest(self, robot: str, at_ns: int | None = None) -> int:
        """Number of the robot's latest state; ``at_ns``, for the message, is when it is needed.

        Raises:
            EstimationError: the robot has not started.
        """
        if robot not in self.times:
            needed = "" if at_ns is None else f", needed at {at_ns} ns"
            raise EstimationError(f"robot {robot} has no start{needed}: give one with --start")
        return len(self.times[robot]) - 1

    def stamps(self, robot: str) -> IntArray:
        """Times (n,) of the robot's states, ns."""
        return np.array(self.times[robot], dtype=np.int64)


class TrajectoryRecorder:
    """Trajectories that grow state by state: ``poses`` and ``covs``, lists per robot."""

    def __init__(self) -> None:
        self.poses: dict[str, list[Array]] = defaultdict(list)
        self.covs: dict[str, list[Array]] = defaultdict(list)
        self._times: dict[str, list[int]] = defaultdict(list)

    def append(self, robot: str, time_ns: int, pose: Array, cov: Array) -> None:
        """Add a state: pose (3,), covariance (3, 3)."""
        self._times[robot].append(time_ns)
        self.poses[robot].append(pose)
        self.covs[robot].append(cov)

    def trajectories(self) -> dict[str, Trajectory]:
        """Robot -> trajectory, robots in alphabetical order."""
        return {
            robot: Trajectory(
                np.array(times, dtype=np.int64),
                np.array(self.poses[robot]),
                np.array(self.covs[robot]),
            )
            for robot, times in sorted(self._times.items())
        }


def block_slices(dims: Sequence[int]) -> tuple[slice, ...]:
    """Slices of blocks of sizes ``dims`` behind a pose, which has the first three rows."""
    ends = 3 + np.cumsum(dims, dtype=int)
    return tuple(slice(int(e - d), int(e)) for d, e in zip(dims, ends, strict=True))
