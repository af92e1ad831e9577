"""What every back end with GTSAM factors shares: from a step to factors, from variables to answers.

`GraphBuilder` knows which key is which state or landmark and makes the factors of a step, one part
after another, so that a filter can take in each before the next is built. `GraphBackend` answers
the questions of `Backend` from any store of variables and covariances.
"""

import math
import re
from abc import ABC, abstractmethod
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import gtsam
import numpy as np
from scipy.linalg.blas import dtrsm

from graphslam.core.config import RobustConfig
from graphslam.core.errors import EstimationError
from graphslam.core.geometry import Array, compose, rotate_cov
from graphslam.core.observation_models import MODELS
from graphslam.core.records import Association, Closure, Estimate, Step, Trajectory
from graphslam.estimation import factors
from graphslam.estimation.backend import Joint, StateTable, block_slices

#: current estimate of a variable, by its key and size
Estimates = Callable[[int, int], Array]


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """What enters an estimate at once.

    ``factors`` belong together: without one of them a new variable might be indeterminate.
    ``what`` says it in terms of the log. ``new`` is the variable that they bring, with its first
    value (2,) or (3,); ``replaces`` the robot's state before, where that variable is its next one.
    ``observed`` is the association behind the last factor, with its two keys; ``robust`` whether a
    kernel belongs on that factor.
    """

    factors: tuple[gtsam.NonlinearFactor, ...]
    what: str
    new: tuple[int, Array] | None = None
    replaces: int | None = None
    observed: tuple[int, int, Association] | None = None
    robust: bool = False


class GraphBuilder:
    """Turns steps into factors and first values; remembers which key is what.

    ``kernel`` is put on what is observed. ``rows`` counts the residual rows that carry information:
    GTSAM counts a line's empty row too. ``oldest`` is the number of each robot's oldest state that
    is still estimated; what refers to older ones is left out and counted in ``skipped``, by reason.
    ``late``: whether late evidence is used. ``wide``: the gauge of lines, see `line_gauge_factor`:
    wide where everything is linearised anew.
    """

    def __init__(
        self, kernel: RobustConfig, *, late: bool = True, wide: bool = True, lines: bool = True
    ) -> None:
        self.kernel = kernel
        self.states = StateTable()
        self.robots: list[str] = []
        self.landmark_dims: dict[int, int] = {}
        self.rows = 0
        self.oldest: dict[str, int] = defaultdict(int)
        self.skipped: Counter[str] = Counter()
        self._late, self._wide, self._lines = late, wide, lines
        self._first_seen: dict[int, tuple[str, int]] = {}

    def state_key(self, robot: str, number: int) -> int:
        """Key of a robot's state."""
        return factors.state_key(self.robots.index(robot), number)

    def latest_key(self, robot: str, at_ns: int | None = None) -> int:
        """Key of a robot's latest state, see `StateTable.latest`."""
        return self.state_key(robot, self.states.latest(robot, at_ns))

    def dim(self, key: int) -> int:
        """Size of a variable."""
        robot, number = factors.number_of(key)
        return self.landmark_dims[number] if robot is None else 3

    def dims(self) -> dict[int, int]:
        """Every variable there is, with its size."""
        found = {
            self.state_key(robot, n): 3
            for robot in self.robots
            for n in range(len(self.states.times[robot]))
        }
        found.update((factors.landmark_key(i), d) for i, d in self.landmark_dims.items())
        return found

    def parts(self, step: Step, estimate: Estimates) -> Iterator[Part]:
        """The parts of a step, in recorded order.

        Args:
            step: what to take in.
            estimate: asked for existing variables when a part is made, that is after whoever
                iterates has done with the parts before.

        Raises:
            EstimationError: a covariance is not positive definite and finite, or a state that the
                step refers to was never made.
        """
        for robot, start in step.starts.items():
            self.robots.append(robot)
            key = self.state_key(robot, self.states.append(robot, step.time_ns))
            what = f"start of robot {robot} at {step.time_ns} ns"
            with _named(what, start.cov):
                factor = factors.start_factor(key, start)
            self.rows += 3
            yield Part((factor,), what, (key, start.pose))
        for robot, motion in step.motions.items():
            last = self.latest_key(robot, step.time_ns)
            key = self.state_key(robot, self.states.append(robot, step.time_ns))
            what = f"motion of robot {robot} to {step.time_ns} ns"
            with _named(what, motion.cov):
                factor = factors.motion_factor(last, key, motion)
            self.rows += 3
            yield Part((factor,), what, (key, compose(estimate(last, 3), motion.delta)), last)
        for seen in step.associations:
            part = self._observation(seen, step.time_ns, estimate)
            if part is not None:
                yield part
        for closure in step.closures:
            part = self._closure(closure)
            if part is not None:
                yield part

    def _observation(self, seen: Association, time_ns: int, estimate: Estimates) -> Part | None:
        number = self.states.number(seen.robot, seen.time_ns)
        if seen.late and not self._late:
            self.skipped["late evidence"] += 1
            return None
        if number < self.oldest[seen.robot]:
            self.skipped["observation from a past state"] += 1
            return None
        key, model = self.state_key(seen.robot, number), MODELS[seen.model]
        known = not isinstance(seen.target, int) or seen.target in self.landmark_dims
        if isinstance(seen.target, int):
            kind, target = "landmark", factors.landmark_key(seen.target)
        else:
            kind = "robot"
            target = self.state_key(seen.target, self.states.number(seen.target, time_ns))
        self.rows += model.rows
        if known and seen.model == "line" and not self._lines:
            return Part((), "", observed=(key, target, seen))  # its factor is made later
        # only new ones, and lines, are built at an estimate, which is dear to ask for
        x = t = np.zeros(3)
        what = f"{kind} {seen.target}, seen from robot {seen.robot} at {seen.time_ns} ns"
        made: list[gtsam.NonlinearFactor] = []
        new = None
        if not known:
            x = estimate(key, 3)
            t = model.invert(seen.z, x)
            new = (target, t)
        elif seen.model == "line":
            x, t = estimate(key, 3), estimate(target, model.dim)
        with _named(what, seen.cov):
            if new is not None and seen.model == "line":
                made.append(factors.line_gauge_factor(key, target, seen, wide=self._wide))
                self.rows += 1
            if self._lines or seen.model != "line":
                made.append(factors.observation_factor(key, target, seen, self.kernel, x, t))
        if new is not None and isinstance(seen.target, int):
            self.landmark_dims[seen.target] = model.dim
            self._first_seen[seen.target] = (seen.robot, seen.time_ns)
        return Part(tuple(made), what, new, observed=(key, target, seen), robust=True)

    def _closure(self, closure: Closure) -> Part | None:
        ends = (closure.robot, closure.time_ns), (closure.other, closure.other_time_ns)
        numbers = [self.states.number(*end) for end in ends]
        if any(n < self.oldest[robot] for n, (robot, _) in zip(numbers, ends, strict=True)):
            self.skipped["closure to a past state"] += 1
            return None
        key, other = (self.state_key(r, n) for n, (r, _) in zip(numbers, ends, strict=True))
        what = f"closure of robot {closure.robot} at {closure.time_ns} ns"
        with _named(what, closure.cov):
            factor = factors.closure_factor(key, other, closure, self.kernel)
        self.rows += 3
        return Part((factor,), what, robust=not closure.verified)

    def faced(
        self, observed: tuple[int, int, Association], estimate: Estimates
    ) -> gtsam.NonlinearFactor:
        """An observation's factor, built at the estimate of now.

        A line's measurement was moved along the line to face the landmark's origin as estimated at
        its time (see `LineModel`); where the estimate has moved since, so must the measurement, or
        it claims some knowledge along the line.
        """
        key, target, seen = observed
        x, t = estimate(key, 3), estimate(target, MODELS[seen.model].dim)
        return factors.observation_factor(key, target, seen, self.kernel, x, t)

    def value_in(self, estimate: Estimate, key: int) -> Array:
        """Value (2,) or (3,) of a variable in an estimate of the same steps."""
        robot, number = factors.number_of(key)
        if robot is None:
            return estimate.landmarks[number][0]
        return np.asarray(estimate.states[self.robots[robot]].poses[number])

    def explain(self, error: RuntimeError) -> EstimationError:
        """GTSAM's complaint about a variable, said in terms of the log."""
        # as a symbol only the first digits of a key are told
        found = re.search(r"(\d+) \(Symbol: [xl]", str(error))
        if not found:
            return indeterminate("some variable")
        robot, number = factors.number_of(int(found[1]))
        if robot is None:
            return indeterminate(self.landmark_name(number))
        name = self.robots[robot]
        return indeterminate(f"robot {name} at {self.states.times[name][number]} ns")

    def landmark_name(self, landmark: int) -> str:
        """A landmark, and who saw it first and when."""
        robot, time_ns = self._first_seen[landmark]
        return f"landmark {landmark}, seen from robot {robot} at {time_ns} ns"


class _named:  # noqa: N801 (used as a function)
    """Say what it is that has a bad covariance ``cov`` (k, k)."""

    def __init__(self, what: str, cov: Array) -> None:
        self._what, self._cov = what, cov

    def __enter__(self) -> None:
        # the sum of finite numbers is finite; of so few Python finds it sooner than NumPy
        if not math.isfinite(sum(map(sum, self._cov.tolist()))):
            raise EstimationError(
                f"{self._what}: its covariance is not finite, so it determines nothing: "
                f"{self._cov.tolist()}"
            )

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> None:
        if isinstance(error, (EstimationError, np.linalg.LinAlgError)):
            raise EstimationError(f"{self._what}: {error}") from error


def indeterminate(where: str) -> EstimationError:
    """The error of a graph that does not determine the variable ``where``."""
    return EstimationError(
        f"the estimate is indeterminate at {where}: it has too few or too weak observations"
    )


class GraphBackend(ABC):
    """The answers of `Backend`, from `value` and `covariance` of variables by their keys."""

    smooths = False
    error_frame: Literal["body", "world"] = "body"

    def __init__(self, builder: GraphBuilder) -> None:
        self.builder = builder
        self._joints: dict[str, Joint] = {}  # since the last step

    @property
    def skipped(self) -> Counter[str]:
        """See `Backend`."""
        return self.builder.skipped

    @abstractmethod
    def value(self, key: int, dim: int) -> Array:
        """Current estimate (dim,) of a variable, m and rad."""

    @abstractmethod
    def covariance(self, keys: list[int]) -> Array:
        """Joint marginal covariance (D, D) of variables in this order, errors in body frames.

        Raises:
            EstimationError: it is indeterminate.
        """

    def joint(self, robot: str, landmarks: Sequence[int], others: Sequence[str] = ()) -> Joint:
        """See `Backend`; asked for the pose alone after more, it answers from what it has."""
        builder = self.builder
        key = builder.latest_key(robot)
        if not landmarks and not others:
            if robot in self._joints:
                known = self._joints[robot]
                return Joint(known.pose, (), known.cov[:3, :3], ())
            alone = self.value(key, 3)
            cov = rotate_cov(self.covariance([key]), alone[2])
            self._joints[robot] = Joint(alone, (), cov, ())
            return self._joints[robot]
        dims = [builder.landmark_dims[i] for i in landmarks] + [3] * len(others)
        keys = [factors.landmark_key(i) for i in landmarks]
        keys += [builder.latest_key(other) for other in others]
        pose = self.value(key, 3)
        means = tuple(self.value(k, d) for k, d in zip(keys, dims, strict=True))
        cov = self.covariance([key, *keys])
        slices = block_slices(dims)
        turn = np.eye(len(cov))
        for block, mean in zip((slice(0, 3), *slices), (pose, *means), strict=True):
            if len(mean) == 3:
                turn[block, block] = factors.world_from_body(float(mean[2]))
        n = len(landmarks)
        self._joints[robot] = Joint(pose, means[:n], turn @ cov @ turn.T, slices, means[n:])
        return self._joints[robot]

    def state_mean(self, robot: str) -> Array:
        """See `Backend`."""
        return self.value(self.builder.latest_key(robot), 3)

    def landmark_means(self, landmarks: Sequence[int]) -> list[Array]:
        """See `Backend`."""
        return [
            self.value(factors.landmark_key(i), self.builder.landmark_dims[i]) for i in landmarks
        ]

    def _estimate(
        self, means: Mapping[int, Array], covs: Mapping[int, Array], error: float
    ) -> Estimate:
        """An `Estimate` of every state and landmark, by key; ``covs`` have errors in body frames.

        ``error`` is half the weighted squared residual.
        """
        builder, unknowns = self.builder, 0
        states = {}
        for robot in sorted(builder.robots):
            keys = [builder.state_key(robot, n) for n in range(len(builder.states.times[robot]))]
            poses = np.array([means[k] for k in keys])
            turned = rotate_cov(np.array([covs[k] for k in keys]), poses[:, 2])
            states[robot] = Trajectory(builder.states.stamps(robot), poses, turned)
            unknowns += 3 * len(keys)
        landmarks = {}
        for landmark, dim in builder.landmark_dims.items():
            key = factors.landmark_key(landmark)
            mean, cov = means[key], covs[key]
            landmarks[landmark] = (mean, rotate_cov(cov, mean[2]) if dim == 3 else cov)
            unknowns += dim
        return Estimate(states, landmarks, error, builder.rows - unknowns)


def square_root(
    net: gtsam.GaussianBayesNet, dims: Mapping[int, int]
) -> tuple[Array, dict[int, slice]]:
    """Upper triangular square root information R (D, D) of a Bayes net; each variable's columns.

    ``dims`` are the variables' sizes. The net has its own order of them: elimination goes through
    unconnected parts one by one.
    """
    keys = [net.at(n).firstFrontalKey() for n in range(net.size())]
    ends = np.cumsum([dims[key] for key in keys])
    place = {k: slice(int(e - dims[k]), int(e)) for k, e in zip(keys, ends, strict=True)}
    return net.matrix()[0], place


def root_covariance(R: Array, place: Mapping[int, slice], keys: Sequence[int]) -> Array:
    """Joint covariance (d, d) of ``keys``, in this order: their rows of R⁻¹ R⁻ᵀ."""
    wanted = np.concatenate([np.arange(place[k].start, place[k].stop) for k in keys])
    columns = np.zeros((len(R), len(wanted)))
    columns[wanted, np.arange(len(wanted))] = 1.0
    # not solve_triangular: LAPACK's wakes every core for a matrix of any size
    columns = dtrsm(1.0, R, columns, trans_a=1)
    return np.asarray(columns.T @ columns)


def read(values: gtsam.Values, key: int, dim: int) -> Array:
    """A variable (dim,) of GTSAM's values."""
    if dim == 3:
        return factors.array3(values.atPose2(key))
    return np.asarray(values.atPoint2(key))


def write(values: gtsam.Values, key: int, value: Array) -> None:
    """A new variable (2,) or (3,) for GTSAM's values."""
    values.insert(key, factors.pose2(value) if len(value) == 3 else value)


def update(values: gtsam.Values, key: int, value: Array) -> None:
    """Another value (2,) or (3,) for a variable of GTSAM's values."""
    values.update(key, factors.pose2(value) if len(value) == 3 else value)


def jacobian_factor(A: Array, b: Array, dims: Mapping[int, int]) -> gtsam.JacobianFactor:
    """Whitened rows A (k, D) z = b (k,) over one or two variables of sizes ``dims``, in order."""
    unit = gtsam.noiseModel.Unit.Create(len(b))
    first, *second = dims
    dim = dims[first]
    if not second:
        return gtsam.JacobianFactor(first, A, b, unit)
    return gtsam.JacobianFactor(first, A[:, :dim], second[0], A[:, dim:], b, unit)
