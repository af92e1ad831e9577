"""Fixed-lag smoothing: states older than the horizon are marginalised out, landmarks stay.

The window is a nonlinear graph, optimised at every step. When a state leaves, its factors are
linearised for the last time and it is eliminated from them. What remains of them about its
neighbours, mostly landmarks, is linear, the prior. Landmarks of the prior that no state of the
window sees are eliminated from it, too, but kept as a Gaussian given the others, which loses
nothing (`dormant_variables`). So a step costs what its window costs, however large the map is.

The prior has no information on the position and heading of the whole map, as long as the null space
is the same for every factor. It depends on the linearisation point, so a variable that the prior
involves keeps the point it had when it first became involved for all its Jacobians (first-estimates
Jacobians), while residuals are at the current estimate. With current Jacobians the null spaces of
prior and window would differ, which is false information on the heading: measured 20 times as far
from batch. A landmark's point is its estimate when the first state that saw it leaves, which is
smoothed over the horizon.

Source: G. Huang, A. Mourikis, S. Roumeliotis, Observability-based rules for designing consistent
EKF SLAM estimators, IJRR 2010, https://doi.org/10.1177/0278364909353640.
"""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from graphslam.core.config import Config, RobustConfig
from graphslam.core.geometry import Array, rotate_cov
from graphslam.core.known_landmarks import KnownLandmarks
from graphslam.core.records import Association, Estimate, Step
from graphslam.estimation import factors
from graphslam.estimation.dormant_variables import DormantVariables, covariance
from graphslam.estimation.factor_graph import FactorGroup, GraphBackend, GraphBuilder
from graphslam.estimation.square_root import Rows, eliminate, stacked
from graphslam.estimation.window import IndeterminateWindowError, Window, WindowFactor

#: steps of a solution after which states leave in a `Restart`, and by how many it comes nearer to
#: the latest step with each part
REPLAYED_AT_ONCE, CAUGHT_UP_AT_ONCE = 20, 2
NO_CORRECTIONS: Mapping[int, Array] = MappingProxyType({})


class FixedLagBackend(GraphBackend):
    """The smoother; see the module's docstring.

    At the end, states that left have the estimate and covariance with which they left: smoothed
    with the data within the horizon. What refers to a state that has left is skipped and counted.
    ``most_states``: if there are more in the window the oldest leave before the horizon; one of
    each robot stays.
    """

    most_states: int | None = None

    def __init__(self, config: Config) -> None:
        # weights are of residuals at the current estimate, so the window applies the kernel
        super().__init__(GraphBuilder(RobustConfig(kernel="none"), wide=False))
        self._config = config
        self._horizon_ns = round(1e9 * config.backend.horizon_s)
        self._kept: dict[tuple[str, int], int] = {}  # robot and time -> a state that stays
        self._window = Window(config.robust)
        self._dormant = DormantVariables()
        self._points: dict[int, Array] = {}  # linearisation points of dormant landmarks
        self._z: dict[int, Array] | None = None  # their corrections, if computed since the step
        self._past: dict[int, tuple[Array, Array]] = {}  # states that left

    def value(self, key: int, dim: int) -> Array:
        """See `GraphBackend`."""
        if key not in self._dormant:
            return factors.read(self._window.values, key, dim)
        return factors.retracted(self._points[key], self._corrections()[key])

    def values(self, keys: Sequence[int], dims: Sequence[int]) -> list[Array]:
        """See `GraphBackend`; most of many landmarks are dormant, and are corrected at once."""
        poses = [k for k, d in zip(keys, dims, strict=True) if d == 3 and k in self._dormant]
        found: dict[int, Array] = {}
        if poses:
            z = self._corrections()
            points, moved = (np.array([of[key] for key in poses]) for of in (self._points, z))
            found = dict(zip(poses, factors.retracted(points, moved), strict=True))
        both = zip(keys, dims, strict=True)
        return [found[key] if key in found else self.value(key, dim) for key, dim in both]

    def _corrections(self) -> dict[int, Array]:
        """Z of all dormant variables."""
        if self._z is None:
            self._z = self._dormant.solve(self._window.z.__getitem__)
        return self._z

    def covariance(self, keys: list[int]) -> Array:
        """See `GraphBackend`."""
        return covariance(self._window.root, self._window.slices, self._dormant, keys)

    def add(self, step: Step) -> None:
        """See `Backend`."""
        self._joints.clear()
        seen = self._seen_in(step)
        if step.known is not None:
            self._take_known(step.known)
            step = replace(step, known=None)
        needed = [key for key in seen if key in self._dormant]
        if needed:
            self._wake(needed, self._corrections())
        self._put_to_sleep(seen)
        window = self._window
        for group in self.builder.factor_groups(step, self.value):
            if group.new is not None:
                window.insert(*group.new)
            window.factors += _window_factors(group)
        self.optimise()
        self._marginalise_before(step.time_ns - self._horizon_ns, self.covariance)

    def _seen_in(self, step: Step) -> set[int]:
        """The landmarks, and the states that are kept, of which a step tells."""
        seen = {
            factors.landmark_key(a.target) for a in step.associations if isinstance(a.target, int)
        }
        ends = {end for closure in step.closures for end in closure.pair}
        return seen | {self._kept[end] for end in ends & self._kept.keys()}

    def optimise(self) -> None:
        """Solve the window.

        Raises:
            EstimationError: it is indeterminate.
        """
        self._z = None
        try:
            self._window.optimise()
        except IndeterminateWindowError as error:
            raise self.builder.indeterminate_at(error.key) from error

    def current_estimate(self) -> Estimate:
        """Means of all states, those that left as they were then, and of landmarks.

        Covariances are NaN. Only before the first `forget`.
        """
        means = {
            key: self._past[key][0] if key in self._past else self.value(key, dim)
            for key, dim in self.builder.dims().items()
        }
        nothing = {key: (mean, np.full((len(mean),) * 2, np.nan)) for key, mean in means.items()}
        return self.builder.estimate(nothing, self._window.half_error())

    def restart(self, steps: Sequence[Step], start: Estimate) -> None:
        """Forget all; go on after ``steps``, linearised where ``start`` has their variables.

        ``start`` should be the solution of the steps: past states leave what they tell there. See
        `Restart`, which does it piece by piece.
        """
        begun = self.begin_restart(len(steps), start)
        while not begun.advance(steps):
            pass
        self.finish_restart(begun)

    def begin_restart(self, count: int, start: Estimate) -> "Restart":
        """Begin to build the window again, where ``start`` has the variables of ``count`` steps."""
        made = FixedLagBackend(self._config)
        made.most_states = self.most_states
        return Restart(made, start, count, self._kept.keys())

    def finish_restart(self, begun: "Restart") -> None:
        """Go on with what was built, once it has all steps."""
        made = begun.backend
        for state in self._kept.keys() - made._kept.keys():  # since its step was added
            made.keep(*state)
        for state in made._kept.keys() - self._kept.keys():
            made.drop(*state)
        self._joints.clear()
        self.builder, self._window, self._dormant = made.builder, made._window, made._dormant
        self._points, self._z, self._past = made._points, made._z, made._past
        self._kept = made._kept

    def replay(
        self, steps: Sequence[Step], start: Estimate, kept: Collection[tuple[str, int]]
    ) -> None:
        """Take in steps of the past, linearised where ``start`` has their variables."""
        window = self._window
        lines: list[tuple[int, int, Association]] = []
        seen = {key for step in steps for key in self._seen_in(step)}
        self._wake([key for key in seen if key in self._dormant])
        self._put_to_sleep(seen)
        for step in steps:
            for group in self.builder.factor_groups(
                step, lambda key, _dim: self.builder.value_in(start, key)
            ):
                if group.new is not None:
                    window.insert(group.new[0], self.builder.value_in(start, group.new[0]))
                if group.observed is not None and group.observed[2].model == "line":
                    lines.append(group.observed)
                    made = replace(group, observed=None, robust=False)  # at most that of a gauge
                    window.factors += _window_factors(made)
                else:
                    window.factors += _window_factors(group)
            self.keep_of(step, kept)
        of_lines = self.builder.line_factors_at_estimate(lines, self.value)
        window.factors += [
            WindowFactor(factor, tuple(factor.keys()), observed, robust=True)
            for factor, observed in zip(of_lines, lines, strict=True)
        ]
        window.order()
        unknown = np.full((3, 3), np.nan)
        self._marginalise_before(steps[-1].time_ns - self._horizon_ns, lambda _keys: unknown)

    def _take_known(self, known: KnownLandmarks) -> None:
        """Known landmarks begin in the prior, at their means; what is not seen becomes dormant."""
        for number, mean in known.means.items():
            self.builder.landmark_dims[number] = len(mean)
            self.builder.rows += len(mean)
            self._window.insert(factors.landmark_key(number), mean)
        rows = []
        for numbers, row in known.rows():
            dims = {factors.landmark_key(n): len(known.means[n]) for n in numbers}
            rows.append(Rows(dims, row, np.zeros(len(row))))
        self._window.absorb(rows)

    def _wake(self, keys: Sequence[int], z: Mapping[int, Array] = NO_CORRECTIONS) -> None:
        """Take dormant landmarks that are seen again into the window, with these corrections."""
        for key in keys:
            self._window.insert(key, self._points.pop(key), z.get(key))
        self._window.absorb(self._dormant.wake(keys))

    def _put_to_sleep(self, needed: Iterable[int]) -> None:
        """Make landmarks dormant that the window does not see, nor the next step."""
        window = self._window
        seen = {*needed, *(key for each in window.factors for key in each.keys)}
        kept = {key for key in self.builder.kept if self._has_left(key)}
        idle = [
            key
            for key in window.prior.dims
            if key not in seen and (key in kept or not factors.is_state(key))
        ]
        past = [key for key in window.prior.dims if key in self._past and key not in kept]
        keys = self._dormant.due(idle, past)
        if keys:
            self._points |= {key: window.point(key) for key in keys}
            window.prior = self._dormant.add(window.prior, keys)
            window.remove(keys)

    def _marginalise_before(self, before_ns: int, covariance: Callable[[list[int]], Array]) -> None:
        """Marginalise the states before ``before_ns`` out, but no robot's latest.

        ``covariance``: with which each is remembered.
        """
        if self.most_states is not None:
            inside = [
                time
                for robot, times in self.builder.states.times.items()
                for time in times[self.builder.oldest[robot] :]
            ]
            if len(inside) > self.most_states:
                before_ns = max(before_ns, sorted(inside)[-self.most_states])
        leaving: list[int] = []
        for robot in self.builder.robots:
            times, oldest = self.builder.states.times[robot], self.builder.oldest[robot]
            while times[oldest] < before_ns and oldest < len(times) - 1:
                leaving.append(self.builder.state_key(robot, oldest))
                oldest += 1
            self.builder.oldest[robot] = oldest
        if leaving:
            for key in leaving:
                self._past[key] = self.value(key, 3), covariance([key])
            self._marginalise(set(leaving))

    def _marginalise(self, leaving: set[int]) -> None:
        """Turn the factors of states into prior, and eliminate those that no block is given."""
        window = self._window
        involved = [each for each in window.factors if not leaving.isdisjoint(each.keys)]
        window.factors = [each for each in window.factors if leaving.isdisjoint(each.keys)]
        # lines are built a last time, at the best estimate that there will be
        window.absorb(window.weighted_rows(self._rebuilt(involved)))
        leaving = leaving - self.builder.kept
        self._eliminate([key for key in window.prior.dims if key in leaving])

    def _eliminate(self, states: Sequence[int]) -> None:
        """Eliminate states from the prior that no factor involves, unless a block is given them."""
        window = self._window
        gone = [key for key in states if key not in self._dormant.anchors]
        if gone:
            first = dict.fromkeys(gone, 3)
            order = {**first, **{k: d for k, d in window.prior.dims.items() if k not in first}}
            window.prior = eliminate(stacked([window.prior], order), len(gone))
            window.remove(gone)

    def landmark_estimates(self, landmarks: Sequence[int]) -> dict[int, tuple[Array, Array]]:
        """Means (2,) or (3,) and covariances along world axes of landmarks.

        Raises:
            EstimationError: one is indeterminate.
        """
        dims = {factors.landmark_key(i): self.builder.landmark_dims[i] for i in landmarks}
        found = self.marginals(dims).values()
        return {
            i: (mean, rotate_cov(cov, mean[2]) if len(mean) == 3 else cov)
            for i, (mean, cov) in zip(landmarks, found, strict=True)
        }

    def keep(self, robot: str, time_ns: int) -> None:
        """Estimate a state of the window on when it is behind the horizon, like a landmark."""
        self._kept[robot, time_ns] = self._key(robot, time_ns)
        self.builder.kept = set(self._kept.values())

    def keep_of(self, step: Step, kept: Collection[tuple[str, int]]) -> None:
        """Keep the states of a step that are among ``kept``."""
        for robot in step.motions:
            if (robot, step.time_ns) in kept:
                self.keep(robot, step.time_ns)

    def drop(self, robot: str, time_ns: int) -> bool:
        """Keep a state no longer; one that is dormant, and costs no step anything, stays so.

        Returns:
            Whether that was possible: not while others in use, or dormant ones, are given it.
        """
        key, window = self._kept[robot, time_ns], self._window
        in_use = self._has_left(key) and key not in self._dormant
        if in_use and (
            any(key in each.keys for each in window.factors) or self._dormant.is_given(key)
        ):
            return False
        del self._kept[robot, time_ns]
        self.builder.kept = set(self._kept.values())
        if in_use:
            self._joints.clear()
            self._eliminate([key])
            self._z = None
            window.optimise()
        return True

    def poses(self, states: Sequence[tuple[str, int]]) -> tuple[Array, Array]:
        """Poses (n, 3) of states that are estimated, and their joint covariance (3n, 3n).

        Errors are along each one's own axes. ``states``: robots and times.
        """
        keys = [self._key(*state) for state in states]
        means = self.values(keys, [3] * len(keys))
        return np.array(means).reshape(-1, 3), self.covariance(keys)

    def pose_of(self, robot: str, time_ns: int) -> Array:
        """The pose (3,) of a state, also of one that has just left the window."""
        key = self._key(robot, time_ns)
        if key in self._window.dims or key in self._dormant:
            return self.value(key, 3)
        return self._past[key][0]

    def _has_left(self, key: int) -> bool:
        """Whether a state is behind the horizon."""
        robot, number = factors.number_of(key)
        return robot is not None and number < self.builder.oldest[self.builder.robots[robot]]

    def _key(self, robot: str, time_ns: int) -> int:
        """The key of a state."""
        return self.builder.state_key(robot, self.builder.states.number(robot, time_ns))

    def forget(self) -> None:
        """Drop the estimates of states that left, which only `finish` needs."""
        known = self._window.prior.dims.keys() | self._dormant.anchors
        self._past = {key: self._past[key] for key in known & self._past.keys()}

    def _rebuilt(self, old: Sequence[WindowFactor]) -> list[WindowFactor]:
        """The factors of lines at the current estimate; others as they are."""
        lines = [
            (key, target, seen)
            for key, target, seen in (each.observed for each in old if each.observed is not None)
            if seen.model == "line"
        ]
        made = iter(self.builder.line_factors_at_estimate(lines, self.value))
        return [
            replace(each, factor=next(made), rows=None)
            if each.observed is not None and each.observed[2].model == "line"
            else each
            for each in old
        ]

    def finish(self) -> Estimate:
        """See `Backend`."""
        dims = {**self._window.dims, **self._dormant.dims}
        left = {key: dim for key, dim in dims.items() if key not in self._past}
        return self.builder.estimate(self._past | self.marginals(left), self._window.half_error())


class Restart:
    """A smoother that is built at a solution of its steps, beside the one that is in use.

    Nothing is solved until it has the steps of the solution, so it takes a third of the time of
    adding them; the later ones are added as usual. States that left have no covariance.
    """

    def __init__(
        self,
        backend: FixedLagBackend,
        start: Estimate,
        count: int,
        kept: Collection[tuple[str, int]],
    ) -> None:
        """Of a ``backend`` without steps; ``start`` solves the first ``count`` of them.

        ``kept``: robots and times of the states that are to stay, see `FixedLagBackend.keep`.
        """
        self.backend = backend
        self._start, self._count, self._kept = start, count, kept
        self._done, self._known = 0, count  # steps that were taken in, and that there were
        backend.builder.makes_lines = False

    def advance(self, steps: Sequence[Step]) -> bool:
        """Take in some more of all ``steps`` so far; whether it has them all.

        Raises:
            EstimationError: a covariance is not positive definite and finite, or the window is
                indeterminate.
        """
        backend = self.backend
        if self._done < self._count:
            end = min(self._done + REPLAYED_AT_ONCE, self._count)
            backend.replay(steps[self._done : end], self._start, self._kept)
            if end == self._count:
                backend.builder.makes_lines = True
                backend.optimise()
        else:
            # so it gets there however many come with each part
            new = len(steps) - self._known
            end = min(self._done + new + CAUGHT_UP_AT_ONCE, len(steps))
            for step in steps[self._done : end]:
                backend.add(step)
                backend.keep_of(step, self._kept)
        self._done, self._known = end, len(steps)
        return end == len(steps)


def _window_factors(group: FactorGroup) -> list[WindowFactor]:
    """The factors of a group; its kernel and its observation are those of the last one."""
    made = [WindowFactor(factor, tuple(factor.keys())) for factor in group.factors]
    if made:
        made[-1].observed, made[-1].robust = group.observed, group.robust
    return made
