"""What the filters on NumPy arrays share: the order of a step, its checks, and causal states."""

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Mapping, Sequence

from graphslam.core.errors import EstimationError
from graphslam.core.geometry import Array, rotate_cov
from graphslam.core.records import Association, Closure, Estimate, Motion, Start, Step
from graphslam.estimation.backend import (
    LATE_EVIDENCE,
    PAST_CLOSURE,
    PAST_OBSERVATION,
    JointMarginal,
    StateTable,
    TrajectoryRecorder,
)
from graphslam.estimation.input_checks import (
    check_finite,
    describe,
    describe_motion,
    describe_start,
)

#: part of a filter's state: a robot's latest pose by its name, one of its past ones, or a landmark
Member = str | tuple[str, int] | int


class FilterBackend(ABC):
    """A filter of each robot's latest pose, perhaps a few poses before, and landmarks.

    The ``past_states`` poses before the latest one of a robot are ``(robot, number modulo
    past_states)``; older ones are not in the state any more. What refers to them cannot be used and
    is counted in ``skipped``, by reason.
    """

    def __init__(self, past_states: int = 0) -> None:
        self._past_states = past_states
        self._states = StateTable()
        self._track = TrajectoryRecorder()
        self._twice_error, self._dof = 0.0, 0
        self.skipped: Counter[str] = Counter()

    def add(self, step: Step) -> None:
        """See `Backend`.

        Raises:
            EstimationError: a state that was never made, or noise without a valid covariance.
        """
        for robot, start in step.starts.items():
            check_finite(describe_start(robot, step.time_ns), start.pose, start.cov)
            self._states.append(robot, step.time_ns)
            self._start(robot, start)
        self._advance(step)
        for landmark in step.deleted:
            self.remove(landmark)
        for robot in {**step.starts, **step.motions}:
            joint = self.joint(robot, ())
            self._track.append(robot, step.time_ns, joint.pose, joint.cov)

    def _advance(self, step: Step) -> None:
        """Use the step's motions, then its associations and closures."""
        for robot, motion in step.motions.items():
            self._move_to(robot, step.time_ns, motion)
        self._observe_step(step)

    def _move_to(self, robot: str, time_ns: int, motion: Motion) -> None:
        """Make the robot's next state, at ``time_ns``."""
        self._states.latest(robot, time_ns)  # raises if it has not started
        check_finite(describe_motion(robot, time_ns), motion.delta, motion.cov)
        self._states.append(robot, time_ns)
        self._move(robot, motion)

    def remove(self, landmark: int) -> None:  # noqa: B027 (a filter need not: nothing else changes)
        """Drop a landmark that no later step observes; here it stays."""

    @abstractmethod
    def _start(self, robot: str, start: Start) -> None:
        """Add a robot's first pose."""

    @abstractmethod
    def _move(self, robot: str, motion: Motion) -> None:
        """System update of a robot's latest pose."""

    @abstractmethod
    def _observe_step(self, step: Step) -> None:
        """Use the step's associations and closures."""

    @abstractmethod
    def joint(
        self, robot: str, landmarks: Sequence[int], others: Sequence[str] = ()
    ) -> JointMarginal:
        """See `Backend`."""

    @abstractmethod
    def _landmark_marginals(self) -> Mapping[int, tuple[Array, Array]]:
        """Landmark -> mean (2,) or (3,) and covariance, along world axes."""

    def _state(self, robot: str, time_ns: int) -> Member | None:
        """The member that is the robot's state at ``time_ns``; None if it has left the filter."""
        number, latest = self._states.number(robot, time_ns), self._states.latest(robot)
        if number == latest:
            return robot
        kept = self._past_states
        return (robot, number % kept) if number >= latest - kept else None

    def _ends(self, seen: Association, time_ns: int) -> tuple[Member, Member] | None:
        """Observer and target of an observation; None, and counted, if it cannot be used."""
        source: Member | None = self._state(seen.robot, seen.time_ns)
        target: Member | None = seen.target
        if isinstance(seen.target, str):
            target = self._state(seen.target, time_ns)
        if seen.late and not self._past_states:
            self.skipped[LATE_EVIDENCE] += 1
        elif source is None or target is None:
            self.skipped[PAST_OBSERVATION] += 1
        else:
            check_finite(describe(seen), seen.z, seen.cov)
            return source, target
        return None

    def _closure_ends(self, closure: Closure) -> tuple[Member, Member] | None:
        """``other`` and ``robot`` of a closure, as observer and target; None as in `_ends`."""
        target = self._state(closure.robot, closure.time_ns)
        source = self._state(closure.other, closure.other_time_ns)
        if source is None or target is None:
            self.skipped[PAST_CLOSURE] += 1
            return None
        check_finite(describe(closure), closure.delta, closure.cov)
        return source, target

    def finish(self) -> Estimate:
        """See `Backend`: a filter does not revise the past, so final states are the causal ones.

        The error is half the sum of the squared normalised innovations (of particles: their mean),
        which in a linear problem is the smoother's error; so are the degrees of freedom.
        """
        landmarks = dict(self._landmark_marginals())
        return Estimate(self._track.trajectories(), landmarks, 0.5 * self._twice_error, self._dof)


def unknown_landmark(landmark: int) -> EstimationError:
    """The error of a query for a landmark that the filter does not have."""
    return EstimationError(
        f"landmark {landmark} is not in the filter: deleted, or without usable observations"
    )


def with_sigma_along_line(seen: Association, sigma_m: float) -> Array:
    """Covariance (3, 3) of a line's middle with ``sigma_m`` along the line: 4.33-4.34."""
    own = rotate_cov(seen.cov, -seen.z[2])
    own[0, :] = own[:, 0] = 0.0
    own[0, 0] = sigma_m**2
    return rotate_cov(own, seen.z[2])
