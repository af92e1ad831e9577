"""What every back end with GTSAM factors shares: factors from steps, marginals from variables.

`GraphBuilder` maps states and landmarks to keys and makes the factors of a step, one group after
another, so that a filter can use each before the next is built. `GraphBackend` implements the
queries of `Backend` for any store of values and covariances.
"""

import math
import re
from abc import ABC, abstractmethod
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

import gtsam
import numpy as np

from graphslam.core.config import RobustConfig
from graphslam.core.errors import EstimationError
from graphslam.core.geometry import Array, compose, rotate_cov, rotation3
from graphslam.core.known_landmarks import KnownLandmarks
from graphslam.core.observation_models import MODELS
from graphslam.core.records import Association, Closure, Estimate, Step, Trajectory
from graphslam.estimation import factors
from graphslam.estimation.backend import (
    LATE_EVIDENCE,
    PAST_CLOSURE,
    PAST_OBSERVATION,
    JointMarginal,
    StateTable,
    block_slices,
)
from graphslam.estimation.input_checks import (
    describe,
    describe_motion,
    describe_start,
    indeterminate,
)
from graphslam.estimation.joint_covariances import information_root
from graphslam.estimation.optimisation import joint_marginal
from graphslam.estimation.selected_inverse import CliqueRows

#: current estimate of a variable, by its key and size
Estimates = Callable[[int, int], Array]

#: why a graph is indeterminate
UNDERDETERMINED = "it has too few or too weak observations"
#: what landmarks are of that no observation made
KNOWN = "the known map"
#: variables whose marginals are read together
READ_AT_ONCE = 32
_UNUSED = np.zeros(3)


@dataclass(frozen=True, slots=True, eq=False)
class FactorGroup:
    """Factors that must be added together: without one of them a new variable is indeterminate.

    ``what`` names them in terms of the log, unless they are of an observation. ``new`` is the
    variable that they introduce, with its initial value (2,) or (3,); ``replaces`` the robot's
    previous state, where that variable is its next one. ``observed`` is the association of the last
    factor, with its two keys; ``robust`` whether a kernel applies to that factor.
    """

    factors: tuple[gtsam.NonlinearFactor, ...]
    what: str
    new: tuple[int, Array] | None = None
    replaces: int | None = None
    observed: tuple[int, int, Association] | None = None
    robust: bool = False

    @property
    def name(self) -> str:
        """What the factors are of, in terms of the log."""
        return self.what if self.observed is None else describe(self.observed[2])


class GraphBuilder:
    """Turns steps into factors and initial values, and keeps the keys of states and landmarks.

    ``rows`` counts the residual rows that carry information: GTSAM counts a line's empty row too.
    ``oldest`` is the number of each robot's oldest state that is still estimated; what refers to
    older ones is left out and counted in ``skipped``, by reason; but for those that are ``kept``.
    """

    def __init__(
        self, kernel: RobustConfig, *, late: bool = True, wide: bool = True, lines: bool = True
    ) -> None:
        """Begin an empty graph.

        ``late``: whether late evidence is used; ``wide``: see `line_gauge_factor`; ``lines``:
        whether to make the factors of lines, or leave them to the caller.
        """
        self.kernel = kernel
        self.states = StateTable()
        self.robots: list[str] = []
        self._first_keys: dict[str, int] = {}  # of every robot's first state
        self.landmark_dims: dict[int, int] = {}
        self.rows = 0
        self.oldest: dict[str, int] = defaultdict(int)
        self.kept: set[int] = set()
        self.skipped: Counter[str] = Counter()
        self._late, self._wide, self.makes_lines = late, wide, lines
        self._first_seen: dict[int, Association] = {}  # landmark -> its first observation

    def state_key(self, robot: str, number: int) -> int:
        """Key of a robot's state."""
        return self._first_keys[robot] + number

    def latest_key(self, robot: str, at_ns: int | None = None) -> int:
        """Key of a robot's latest state, see `StateTable.latest`."""
        return self.state_key(robot, self.states.latest(robot, at_ns))

    def dim(self, key: int) -> int:
        """Dimension of a variable."""
        robot, number = factors.number_of(key)
        return self.landmark_dims[number] if robot is None else 3

    def dims(self) -> dict[int, int]:
        """Every variable with its dimension."""
        dims = {key: 3 for robot in self.robots for key in self.state_keys(robot)}
        dims.update((factors.landmark_key(i), d) for i, d in self.landmark_dims.items())
        return dims

    def state_keys(self, robot: str, first: int = 0) -> list[int]:
        """Keys of a robot's states from number ``first`` on, which counts from the end if < 0."""
        key = self._first_keys[robot]
        return list(range(key, key + len(self.states.times[robot]))[first:])

    def factor_groups(self, step: Step, estimate: Estimates) -> Iterator[FactorGroup]:
        """The factors of a step, group by group in recorded order.

        ``estimate`` is called for existing variables when a group is made, which is after the
        caller has used the groups before.

        Raises:
            EstimationError: a covariance is not positive definite and finite, or a state that the
                step refers to was never made.
        """
        if step.known is not None:
            yield from self._known(step.known)
        for robot, start in step.starts.items():
            self._first_keys[robot] = factors.state_key(len(self.robots), 0)
            self.robots.append(robot)
            key = self.state_key(robot, self.states.append(robot, step.time_ns))
            what = describe_start(robot, step.time_ns)
            with covariance_of(what, start.cov):
                factor = factors.start_factor(key, start)
            self.rows += 3
            yield FactorGroup((factor,), what, (key, start.pose))
        for robot, motion in step.motions.items():
            last = self.latest_key(robot, step.time_ns)
            key = self.state_key(robot, self.states.append(robot, step.time_ns))
            what = describe_motion(robot, step.time_ns)
            with covariance_of(what, motion.cov):
                factor = factors.motion_factor(last, key, motion, self.kernel)
            self.rows += 3
            new = key, compose(estimate(last, 3), motion.delta)
            yield FactorGroup((factor,), what, new, last)
        for seen in step.associations:
            group = self._observation(seen, step.time_ns, estimate)
            if group is not None:
                yield group
        yield from self.closure_groups(step.closures)

    def _known(self, known: KnownLandmarks) -> Iterator[FactorGroup]:
        """What is known of landmarks beforehand; each is a variable from its group on."""
        for numbers, row in known.rows():
            mean = known.means[numbers[0]]
            self.landmark_dims[numbers[0]] = len(mean)
            self.rows += len(mean)
            factor = factors.known_landmark_factor(numbers, row, known.means)
            yield FactorGroup((factor,), KNOWN, (factors.landmark_key(numbers[0]), mean))

    def _observation(
        self, seen: Association, time_ns: int, estimate: Estimates
    ) -> FactorGroup | None:
        number = self.states.number(seen.robot, seen.time_ns)
        if seen.late and not self._late:
            self.skipped[LATE_EVIDENCE] += 1
            return None
        if number < self.oldest[seen.robot]:
            self.skipped[PAST_OBSERVATION] += 1
            return None
        key, model = self.state_key(seen.robot, number), MODELS[seen.model]
        if isinstance(seen.target, int):
            target, known = factors.landmark_key(seen.target), seen.target in self.landmark_dims
        else:
            observed = self.states.number(seen.target, time_ns)
            target, known = self.state_key(seen.target, observed), True
        self.rows += model.rows
        if known and seen.model == "line" and not self.makes_lines:
            return FactorGroup((), "", observed=(key, target, seen))  # its factor is made later
        # only new landmarks and lines need an estimate, which is expensive
        x = t = _UNUSED
        made: list[gtsam.NonlinearFactor] = []
        new = None
        if not known:
            x = estimate(key, 3)
            t = model.invert(seen.z, x)
            new = (target, t)
        elif seen.model == "line":
            x, t = estimate(key, 3), estimate(target, model.dim)
        # there are many: no words are made for errors that do not occur
        try:
            _check_finite(seen.cov)
            if new is not None and seen.model == "line":
                made.append(factors.line_gauge_factor(key, target, seen, wide=self._wide))
                self.rows += 1
            if self.makes_lines or seen.model != "line":
                made.append(factors.observation_factor(key, target, seen, self.kernel, x, t))
        except (EstimationError, np.linalg.LinAlgError) as error:
            raise EstimationError(f"{describe(seen)}: {error}") from error
        if new is not None:
            self.introduce(seen)
        return FactorGroup(tuple(made), "", new, observed=(key, target, seen), robust=True)

    def introduce(self, seen: Association) -> None:
        """A landmark is a variable from its first observation on."""
        if isinstance(seen.target, int):
            self.landmark_dims[seen.target] = MODELS[seen.model].dim
            self._first_seen[seen.target] = seen

    def closure_groups(self, closures: Iterable[Closure]) -> Iterator[FactorGroup]:
        """Factors of closures between states that are still estimated."""
        for closure in closures:
            numbers = [(robot, self.states.number(robot, t)) for robot, t in closure.pair]
            left = {self.state_key(r, n) for r, n in numbers if n < self.oldest[r]}
            if not left <= self.kept:
                self.skipped[PAST_CLOSURE] += 1
                continue
            key, other = (self.state_key(*number) for number in numbers)
            what = describe(closure)
            with covariance_of(what, closure.cov):
                factor = factors.closure_factor(key, other, closure, self.kernel)
            self.rows += 3
            yield FactorGroup((factor,), what, robust=not closure.verified)

    def line_factors_at_estimate(
        self, observed: Sequence[tuple[int, int, Association]], estimate: Estimates
    ) -> list[gtsam.NonlinearFactor]:
        """The factors of observations of lines, built again at the current estimate.

        A line's measurement is slid along the line to face the landmark's origin at the estimate
        (see `LineModel`). It must follow when the estimate moves, or the factor would carry false
        information along the line.
        """
        if not observed:
            return []
        keys, targets, seen = zip(*observed, strict=True)
        z, cov = np.array([each.z for each in seen]), np.array([each.cov for each in seen])
        x, t = (np.array([estimate(key, 3) for key in ends]) for ends in (keys, targets))
        return factors.line_factors(keys, targets, z, cov, x, t, self.kernel)

    def value_in(self, estimate: Estimate, key: int) -> Array:
        """Value (2,) or (3,) of a variable in an estimate of the same steps."""
        robot, number = factors.number_of(key)
        if robot is None:
            return estimate.landmarks[number][0]
        return np.asarray(estimate.states[self.robots[robot]].poses[number])

    def explain(self, error: RuntimeError) -> EstimationError:
        """GTSAM's error about an indeterminate variable, in terms of the log."""
        # the symbol itself has only the first digits of the key
        found = re.search(r"(\d+) \(Symbol: [xl]", str(error))
        return self.indeterminate_at(int(found[1]) if found else None)

    def indeterminate_at(self, key: int | None) -> EstimationError:
        """The error that a variable is indeterminate, in terms of the log; None: some variable."""
        what = "some variable"
        if key is not None:
            robot, number = factors.number_of(key)
            if robot is None:
                seen = self._first_seen.get(number)
                what = KNOWN if seen is None else describe(seen)
            else:
                name = self.robots[robot]
                what = f"robot {name} at {self.states.times[name][number]} ns"
        return indeterminate(what, UNDERDETERMINED)

    def diagnose(
        self, graph: gtsam.NonlinearFactorGraph | gtsam.GaussianFactorGraph, values: gtsam.Values
    ) -> EstimationError:
        """Which variable is indeterminate: QR returns NaN for all of them, Cholesky names one."""
        try:
            marginals = gtsam.Marginals(graph, values)
            for key in values.keys():  # noqa: SIM118 (GTSAM's values are no mapping)
                marginals.marginalCovariance(key)
        except RuntimeError as error:
            return self.explain(error)
        return self.explain(RuntimeError(""))

    def covariance(
        self, tree: gtsam.ISAM2, graph: gtsam.NonlinearFactorGraph, keys: list[int]
    ) -> Array:
        """Joint marginal covariance (D, D) of variables by the ``tree`` of ``graph``.

        Raises:
            EstimationError: it is indeterminate.
        """
        try:
            cov = joint_marginal(tree, keys)
        except RuntimeError as error:
            raise self.explain(error) from error
        if not np.isfinite(cov).all():
            raise self.diagnose(graph, tree.calculateBestEstimate())
        return cov

    def estimate(
        self,
        marginals: Mapping[int, tuple[Array, Array]],
        half_error: float,
        rows: Sequence[CliqueRows] | None = None,
        mounts: Mapping[str, tuple[int, Sequence[int]]] = MappingProxyType({}),
    ) -> Estimate:
        """An `Estimate` of every state and landmark.

        ``marginals``: key -> mean and covariance, errors in body frames; ``half_error``: half the
        weighted squared residual; ``rows``: root of the information, if it is to be kept, with
        ``mounts``, see `information_root`.
        """
        states, unknowns = {}, 0
        for robot in sorted(self.robots):
            means, covs = zip(*(marginals[key] for key in self.state_keys(robot)), strict=True)
            poses = np.array(means)
            turned = rotate_cov(np.array(covs), poses[:, 2])
            states[robot] = Trajectory(self.states.stamps(robot), poses, turned)
            unknowns += 3 * len(poses)
        landmarks = {}
        for landmark, dim in self.landmark_dims.items():
            mean, cov = marginals[factors.landmark_key(landmark)]
            landmarks[landmark] = (mean, rotate_cov(cov, mean[2]) if dim == 3 else cov)
            unknowns += dim
        keys = {robot: self.state_keys(robot) for robot in states}
        marks = {number: factors.landmark_key(number) for number in landmarks}
        root = None if rows is None else information_root(rows, keys, marks, mounts)
        return Estimate(states, landmarks, half_error, self.rows - unknowns, root)


@contextmanager
def covariance_of(what: str, cov: Array) -> Iterator[None]:
    """Checks a covariance (k, k); errors inside name ``what`` it is of.

    Raises:
        EstimationError: it is not finite, or not positive definite inside.
    """
    try:
        _check_finite(cov)
        yield
    except (EstimationError, np.linalg.LinAlgError) as error:
        raise EstimationError(f"{what}: {error}") from error


def _check_finite(cov: Array) -> None:
    # the sum of finite numbers is finite; for so few Python is faster than NumPy
    if not math.isfinite(sum(map(sum, cov.tolist()))):
        raise EstimationError(
            f"its covariance is not finite, so it determines nothing: {cov.tolist()}"
        )


class GraphBackend(ABC):
    """The queries of `Backend`, from `value` and `covariance` of variables by their keys."""

    error_frame: Literal["body", "world"] = "body"

    def __init__(self, builder: GraphBuilder) -> None:
        self.builder = builder
        self._joints: dict[str, JointMarginal] = {}  # queried since the last step

    @property
    def skipped(self) -> Counter[str]:
        """See `Backend`."""
        return self.builder.skipped

    @abstractmethod
    def value(self, key: int, dim: int) -> Array:
        """Current estimate (dim,) of a variable, m and rad."""

    def values(self, keys: Sequence[int], dims: Sequence[int]) -> list[Array]:
        """`value` of variables: (2,) or (3,) each, m and rad."""
        return [self.value(key, dim) for key, dim in zip(keys, dims, strict=True)]

    @abstractmethod
    def covariance(self, keys: list[int]) -> Array:
        """Joint marginal covariance (D, D) of variables in this order, errors in body frames.

        Raises:
            EstimationError: it is indeterminate.
        """

    def marginals(self, dims: Mapping[int, int]) -> dict[int, tuple[Array, Array]]:
        """Mean (d,) and covariance (d, d) of variables, given with their dimensions d."""
        out, keys = {}, list(dims)
        for first in range(0, len(keys), READ_AT_ONCE):
            some = keys[first : first + READ_AT_ONCE]
            cov, end = self.covariance(some), 0
            for key in some:
                begin, end = end, end + dims[key]
                out[key] = self.value(key, dims[key]), cov[begin:end, begin:end]
        return out

    def joint(
        self, robot: str, landmarks: Sequence[int], others: Sequence[str] = ()
    ) -> JointMarginal:
        """See `Backend`; for a pose alone it uses the latest joint since the last step, if any."""
        builder = self.builder
        key = builder.latest_key(robot)
        if robot in self._joints and not landmarks and not others:
            cached = self._joints[robot]
            return JointMarginal(cached.pose, (), cached.cov[:3, :3], ())
        dims = [builder.landmark_dims[i] for i in landmarks] + [3] * len(others)
        keys = [factors.landmark_key(i) for i in landmarks]
        keys += [builder.latest_key(other) for other in others]
        means = self.values([key, *keys], [3, *dims])
        cov = self.covariance([key, *keys])
        turn = np.eye(len(cov))
        for block, mean in zip((slice(0, 3), *block_slices(dims)), means, strict=True):
            if len(mean) == 3:
                turn[block, block] = rotation3(mean[2])
        self._joints[robot] = JointMarginal.of(means, len(landmarks), turn @ cov @ turn.T)
        return self._joints[robot]

    def pose_covariances(self, robots: Sequence[str]) -> Array:
        """Covariances (n, 3, 3) of the latest poses of robots, along world axes.

        Raises:
            EstimationError: one is indeterminate.
        """
        if not robots:
            return np.zeros((0, 3, 3))
        keys = [self.builder.latest_key(robot) for robot in robots]
        cov = self.covariance(keys).reshape(len(keys), 3, len(keys), 3)
        heading = np.array([self.value(key, 3)[2] for key in keys])
        each = range(len(keys))
        return rotate_cov(cov[each, :, each], heading)

    def state_mean(self, robot: str) -> Array:
        """See `Backend`."""
        return self.value(self.builder.latest_key(robot), 3)

    def landmark_means(self, landmarks: Sequence[int]) -> list[Array]:
        """See `Backend`."""
        dims = self.builder.landmark_dims
        return self.values(
            [factors.landmark_key(i) for i in landmarks], [dims[i] for i in landmarks]
        )
