"""The interface of every estimator, and what they share: which state is which."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from graphslam.core.errors import EstimationError
from graphslam.core.geometry import Array
from graphslam.core.records import Estimate, Step


@dataclass(frozen=True, slots=True, eq=False)
class Joint:
    """Joint marginal of a robot's latest pose, some landmarks and other robots, world frame.

    ``pose`` (3,), ``landmarks`` one array (2,) or (3,) each, ``others`` latest poses (3,) of other
    robots; ``cov`` (D, D) of additive world-axis errors, the pose first, then the landmarks in
    order, then the others; ``slices`` is where the block of each landmark, then of each other lies.
    """

    pose: Array
    landmarks: tuple[Array, ...]
    cov: Array
    slices: tuple[slice, ...]
    others: tuple[Array, ...] = ()


class Backend(Protocol):
    """An estimator that takes steps in time order and can be asked at any time.

    ``error_frame`` says in which errors its covariances are Gaussian, which matters beyond first
    order: ``world`` = additive along world axes (thesis), ``body`` = of the exponential map at each
    pose (GTSAM). Whatever it says, covariances are handed out along world axes.
    """

    @property
    def smooths(self) -> bool:
        """Whether all data have a say in all of its final estimate."""
        ...

    @property
    def error_frame(self) -> Literal["body", "world"]:
        """See the class."""
        ...

    @property
    def skipped(self) -> Mapping[str, int]:
        """What of the steps could not be used, counted by reason: a filter has no past."""
        ...

    def add(self, step: Step) -> None:
        """Take in everything of one step.

        Raises:
            EstimationError: the step makes the estimate indeterminate.
        """
        ...

    def joint(self, robot: str, landmarks: Sequence[int], others: Sequence[str] = ()) -> Joint:
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
    """Which states each robot has: their times, in order."""

    def __init__(self) -> None:
        self.times: dict[str, list[int]] = {}
        self._number: dict[tuple[str, int], int] = {}

    def append(self, robot: str, time_ns: int) -> int:
        """Number of a new state."""
        times = self.times.setdefault(robot, [])
        self._number[robot, time_ns] = len(times)
        times.append(time_ns)
        return len(times) - 1

    def number(self, robot: str, time_ns: int) -> int:
        """Number of the state of ``robot`` at exactly ``time_ns``.

        Raises:
            EstimationError: there is none, or the robot has not started.
        """
        self.latest(robot, time_ns)
        try:
            return self._number[robot, time_ns]
        except KeyError:
            raise EstimationError(
                f"robot {robot} has no state at {time_ns} ns: a step refers to a state that no "
                "earlier step made"
            ) from None

    def latest(self, robot: str, at_ns: int | None = None) -> int:
        """Number of the robot's latest state; ``at_ns`` is when it is needed, for the message.

        Raises:
            EstimationError: the robot has not started.
        """
        if robot not in self.times:
            needed = "" if at_ns is None else f", needed at {at_ns} ns"
            raise EstimationError(f"robot {robot} has no start{needed}: give one with --start")
        return len(self.times[robot]) - 1

    def stamps(self, robot: str) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
        """Times (n,) of the robot's states, ns."""
        return np.array(self.times[robot], dtype=np.int64)


def block_slices(dims: Sequence[int]) -> tuple[slice, ...]:
    """Where blocks of sizes ``dims`` lie behind a pose block of three."""
    ends = 3 + np.cumsum(dims, dtype=int)
    return tuple(slice(int(e - d), int(e)) for d, e in zip(dims, ends, strict=True))
