"""Horizon 0: the extended Kalman filter as a square root information filter on GTSAM factors.

The state is each robot's latest pose and every landmark. Each factor is linearised once, at the
estimate of its time, and eliminated with the information so far. A robot's previous pose is
marginalised out when its next one enters or, as in `ekf`, a few states later
(`EkfConfig.past_states`). Factors enter one at a time in recorded order: those of a step taken
together would be another filter.

z is the sum of all corrections so far, in the tangent space at each variable. The information about
z stays as it is while the estimate moves: no covariance reset, as in a filter with body-frame
errors. This is no limit of the fixed-lag smoother, which relinearises inside its window.

Only what changes is eliminated anew. Once per step the variables that its factors involve are
moved to the end of the elimination order, the others are eliminated given them, and each factor
then changes the small square root of the involved ones. The others follow by their gain. Landmarks
that no state in the filter has seen are given the variables in use (`dormant_variables`).
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence

import gtsam
import numpy as np
from scipy.linalg.blas import dtrsm

from graphslam.core.config import Config, RobustConfig
from graphslam.core.geometry import Array, compose, exp
from graphslam.core.records import Estimate, Step
from graphslam.estimation import factors
from graphslam.estimation.dormant_variables import DormantVariables, covariance
from graphslam.estimation.factor_graph import (
    UNDERDETERMINED,
    FactorGroup,
    GraphBackend,
    GraphBuilder,
)
from graphslam.estimation.input_checks import indeterminate
from graphslam.estimation.m_estimators import robust_weight
from graphslam.estimation.square_root import Rows, column_slices, columns_of, stacked, triangular


class InvolvedVariables:
    """The variables that the factors of one step involve, of which each factor changes all.

    ``dims`` are the variables. ``values`` has their estimates and is changed; ``z`` (n,) are their
    corrections, R z = d the square root information of z. ``changes`` are those of z, by factor.
    """

    def __init__(
        self, root: Rows, z: Array, values: dict[int, Array], kernel: RobustConfig
    ) -> None:
        self.dims, self.R, self.d = dict(root.dims), root.A, root.b
        self.z, self.values = z, values
        self.changes: list[Array] = []
        self.error = 0.0
        self._kernel = kernel
        self._place()

    def _place(self) -> None:
        """Where each variable is in z, and where all poses and points are."""
        self._slices = column_slices(self.dims)
        self._blocks = [
            (keys, columns_of(keys, self._slices).reshape(-1, dim))
            for dim in (2, 3)
            if (keys := [key for key, d in self.dims.items() if d == dim])
        ]

    def add(self, group: FactorGroup) -> None:
        """Add the factors of a group.

        Raises:
            EstimationError: they do not determine their variables.
        """
        before = len(self.z)
        if group.new is not None:
            key, value = group.new
            self.values[key], self.dims[key] = value, len(value)
            self.z = np.append(self.z, np.zeros(len(value)))
            self._place()
        A = [np.zeros((before, len(self.z)))]
        A[0][:, :before] = self.R
        b = [self.d]
        for each in group.factors:
            rows = linear(each, self.values, self.correction)
            H = np.zeros((len(rows.b), len(self.z)))
            H[:, columns_of(rows.dims, self._slices)] = rows.A
            root = 1.0
            if group.new is None and group.robust and self._kernel.kernel != "none":
                root = math.sqrt(self._weight(H, rows.b))
            A.append(root * H)
            b.append(root * rows.b)
        self.R, self.d, lost = determined(np.concatenate(A), np.concatenate(b), group.name)
        if group.new is not None:
            return  # its factors have no error at its initial value: nothing moves
        z = dtrsm(1.0, self.R, self.d[:, None])[:, 0]
        change, self.z = z - self.z, z
        if not np.isfinite(change).all():
            raise indeterminate(group.name, UNDERDETERMINED)
        self.error += 0.5 * lost**2
        self.changes.append(change)
        for keys, columns in self._blocks:
            x = np.array([self.values[key] for key in keys])
            self.values.update(zip(keys, factors.retracted(x, change[columns]), strict=True))

    def correction(self, key: int) -> Array:
        """Z (d,) of a variable."""
        return self.z[self._slices[key]]

    def _weight(self, H: Array, b: Array) -> float:
        """`robust_weight` of rows H z = b with unit noise."""
        half = dtrsm(1.0, self.R, H.T, trans_a=1)
        return robust_weight(b - H @ self.z, half.T @ half, np.eye(len(b)), self._kernel)


class FactorEkfBackend(GraphBackend):
    """The filter; see the module's docstring. Its final estimate is its causal one.

    What refers to a state that was marginalised out is skipped and counted.
    """

    def __init__(self, config: Config) -> None:
        # kernels are applied by `robust_weight`: GTSAM would weigh a factor by its innovation
        # alone, however uncertain the prediction is
        self._past_states = config.ekf.past_states
        builder = GraphBuilder(RobustConfig(kernel="none"), late=self._past_states > 0, wide=False)
        super().__init__(builder)
        self._kernel = config.robust
        self._values: dict[int, Array] = {}
        # square root information of z, upper triangular: variables in use, the last used last
        self._root = Rows({}, np.zeros((0, 0)), np.zeros(0))
        self._z: dict[int, Array] = {}  # of variables in use
        self._dormant = DormantVariables()
        self._used: dict[int, int] = {}  # landmark -> number of the step that used it last
        self._step = 0
        self._causal: dict[int, tuple[Array, Array]] = {}  # states after their own step
        self._error = 0.0

    def value(self, key: int, dim: int) -> Array:
        """See `GraphBackend`."""
        return self._values[key]

    def covariance(self, keys: list[int]) -> Array:
        """See `GraphBackend`."""
        return covariance(self._root.A, column_slices(self._root.dims), self._dormant, keys)

    def add(self, step: Step) -> None:
        """See `Backend`."""
        self._joints.clear()
        self._step += 1
        seen = {
            factors.landmark_key(a.target) for a in step.associations if isinstance(a.target, int)
        }
        self._wake([key for key in seen if key in self._dormant])
        self._put_to_sleep(seen)
        self._used |= dict.fromkeys(seen, self._step)
        new_states: list[FactorGroup] = []
        involved: InvolvedVariables | None = None
        for group in self.builder.factor_groups(step, self.value):
            if group.new is not None and factors.is_state(group.new[0]):
                self._values[group.new[0]] = group.new[1]
                new_states.append(group)
                self._drop_old(group)
                continue
            if involved is None:
                involved = self._involved(step, new_states)
            involved.add(group)
        self._settle(involved or self._involved(step, new_states))
        for robot in {**step.starts, **step.motions}:
            key = self.builder.latest_key(robot)
            self._causal[key] = self.value(key, 3), self.covariance([key])

    def _wake(self, keys: Sequence[int]) -> None:
        """Take dormant landmarks that are seen again into use."""
        if keys:
            z = self._dormant.solve(self._z.__getitem__)
            self._z |= {key: z[key] for key in keys}
            woken = {key: len(z[key]) for key in keys}
            parts = [self._root, *self._dormant.wake(keys)]
            self._root = stacked(parts, {**self._root.dims, **woken})

    def _put_to_sleep(self, needed: Iterable[int]) -> None:
        """Make landmarks dormant that no state in the filter has used, nor the next step."""
        unused = [
            key
            for key in self._root.dims
            if key in self._used and self._step - self._used[key] > self._past_states
        ]
        keys = self._dormant.due(
            [key for key in unused if key not in needed], filter(self._is_past, self._root.dims)
        )
        if keys:
            self._root = self._dormant.add(self._root, keys)
            for key in keys:
                del self._z[key]

    def _is_past(self, key: int) -> bool:
        """Whether a variable is a state that has left the filter."""
        index, number = factors.number_of(key)
        return index is not None and number < self.builder.oldest[self.builder.robots[index]]

    def _drop_old(self, group: FactorGroup) -> None:
        """The robot's oldest state leaves when ``group`` adds its next one."""
        if group.replaces is not None:
            index, number = factors.number_of(group.replaces)
            assert index is not None  # only states are replaced
            self.builder.oldest[self.builder.robots[index]] = max(number - self._past_states + 1, 0)

    def _involved(self, step: Step, new_states: Sequence[FactorGroup]) -> InvolvedVariables:
        """New states added, old ones marginalised out, and what the step involves put last."""
        parts, what = [self._root], ""
        for group in new_states:
            assert group.new is not None
            self._z[group.new[0]] = np.zeros(3)
            parts += [linear(each, self._values, self._z.__getitem__) for each in group.factors]
            what = group.name
        gone = {key for key in self._z if self._is_past(key)} - self._dormant.anchors
        last = self._keys_of(step)
        dims = {key: len(z) for key, z in self._z.items()}
        first = {key: dims[key] for key in self._root.dims if key not in last and key not in gone}
        first |= {key: d for key, d in dims.items() if key not in {*self._root.dims, *last, *gone}}
        order = {**dict.fromkeys(gone, 3), **first, **{key: dims[key] for key in last}}
        rows = stacked(parts, order)
        R, d = rows.A, rows.b
        if order:
            R, d, _ = determined(R, d, what)
        begin = 3 * len(gone)
        for key in gone:
            del self._z[key], self._values[key]
        kept = {key: d for key, d in order.items() if key not in gone}
        self._root = Rows(kept, R[begin:, begin:], d[begin:])
        at = sum(first.values())
        own = Rows({key: dims[key] for key in last}, self._root.A[at:, at:], self._root.b[at:])
        z = np.concatenate([self._z[key] for key in last]) if last else np.zeros(0)
        return InvolvedVariables(own, z, self._values, self._kernel)

    def _keys_of(self, step: Step) -> list[int]:
        """The variables in use that a step's associations and closures are about."""
        builder = self.builder
        keys: dict[int, None] = {}
        ends = [(a.robot, a.time_ns) for a in step.associations]
        ends += [(a.target, step.time_ns) for a in step.associations if isinstance(a.target, str)]
        for closure in step.closures:
            ends += [(closure.robot, closure.time_ns), (closure.other, closure.other_time_ns)]
        for robot, time_ns in dict.fromkeys(ends):
            keys[builder.state_key(robot, builder.states.number(robot, time_ns))] = None
        for a in step.associations:
            if isinstance(a.target, int):
                keys[factors.landmark_key(a.target)] = None
        return [key for key in keys if key in self._z and not self._is_past(key)]

    def _settle(self, involved: InvolvedVariables) -> None:
        """Take over what the step's factors changed; the other variables follow."""
        self._error += involved.error
        slices = column_slices(self._root.dims)
        new = {key: d for key, d in involved.dims.items() if key not in slices}
        n, own = len(self._root.b), len(involved.z) - sum(new.values())
        at = n - own  # where the involved ones begin
        R, S, b = self._root.A[:at, :at], self._root.A[:at, at:], self._root.b[:at]
        if involved.changes and at:
            changes = np.array([change[:own] for change in involved.changes]).T
            follow = -dtrsm(1.0, R, S @ changes)
            z = dtrsm(1.0, R, (b - S @ involved.z[:own])[:, None])[:, 0]
            others = {key: place for key, place in slices.items() if place.stop <= at}
            self._z |= {key: z[place] for key, place in others.items()}
            every = np.concatenate([follow, changes])
            moved = {key: follow[place] for key, place in others.items()}
            if self._dormant.dims:
                moved |= self._dormant.solve(lambda key: every[slices[key]], changes=every.shape[1])
            correct(self._values, moved)
        self._z |= {key: involved.correction(key) for key in involved.dims}
        A = np.zeros((at + len(involved.z),) * 2)
        A[:at, :at], A[:at, at:n], A[at:, at:] = R, S, involved.R
        self._root = Rows({**self._root.dims, **new}, A, np.append(b, involved.d))

    def finish(self) -> Estimate:
        """See `Backend`: every state as its own step left it."""
        dims = {key: len(value) for key, value in self._values.items() if key not in self._causal}
        return self.builder.estimate(self._causal | self.marginals(dims), self._error)


def linear(
    factor: gtsam.NonlinearFactor, values: Mapping[int, Array], z: Callable[[int], Array]
) -> Rows:
    """``factor`` at the estimate, in terms of z (d,): A (z - z_now) = b is A z = b + A z_now."""
    keys = factor.keys()
    if isinstance(factor, gtsam.BetweenFactorPose2) and factors.turns_little(factor, values):
        A, b = factors.linearised(factor, values)
    else:
        here = gtsam.Values()
        for key in keys:
            factors.write(here, key, values[key])
        made = factor.linearize(here)
        A, b = made.jacobian()
        keys = made.keys()
    now = np.concatenate([z(key) for key in keys])
    return Rows({key: len(values[key]) for key in keys}, A, b + A @ now)


def determined(A: Array, b: Array, what: str) -> tuple[Array, Array, float]:
    """`triangular` R (n, n) and d (n,) of rows A (m, n) and b (m,), and the length of what is left.

    Raises:
        EstimationError: ``what`` does not determine its variables.
    """
    try:
        R, d, lost = triangular(A, b)
    except RuntimeError as error:
        raise indeterminate(what, UNDERDETERMINED) from error
    diagonal = np.abs(np.diag(R))
    if not (np.isfinite(diagonal).all() and diagonal.all()):
        raise indeterminate(what, UNDERDETERMINED)
    return R, d, lost


def correct(values: dict[int, Array], changes: Mapping[int, Array]) -> None:
    """Correct poses and points by changes (d, k) in their tangent spaces, one after another."""
    poses = [key for key, change in changes.items() if len(change) == 3]
    if poses:
        x = np.array([values[key] for key in poses])
        for move in exp(np.array([changes[key].T for key in poses]).swapaxes(0, 1)):
            x = compose(x, move)
        values.update(zip(poses, x, strict=True))
    for key, change in changes.items():
        if len(change) == 2:
            values[key] = values[key] + change.sum(axis=1)
