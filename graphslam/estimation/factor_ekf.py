"""Horizon 0: the extended Kalman filter as a square root information filter on GTSAM factors.

The state is each robot's latest pose and every landmark; its square root information is kept as the
Bayes net that elimination leaves. Each factor is linearised once, at the estimate of its time, and
eliminated with that net. A robot's previous pose is marginalised out when its next one enters or,
as in `ekf`, a few states later (`EkfConfig.past_states`). Factors enter one at a time in recorded
order: those of a step taken together would be another filter.

z is the sum of all corrections so far, in the tangent space at each variable. The information about
z stays as it is while the estimate moves: no covariance reset, as in a filter with body-frame
errors. This is no limit of the fixed-lag smoother, which relinearises inside its window.
"""

import gtsam
import numpy as np

from graphslam.core.config import Config, RobustConfig
from graphslam.core.geometry import Array
from graphslam.core.records import Estimate, Step
from graphslam.estimation import factors
from graphslam.estimation.factor_graph import (
    UNDERDETERMINED,
    FactorGroup,
    GraphBackend,
    GraphBuilder,
    root_covariance,
    square_root,
)
from graphslam.estimation.input_checks import indeterminate
from graphslam.estimation.m_estimators import robust_weight


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
        self._values = gtsam.Values()
        self._order: list[int] = []  # robots, then landmarks: a motion changes the first rows only
        self._net = gtsam.GaussianBayesNet()  # square root information of z, in that order
        self._z = gtsam.VectorValues()
        self._root: tuple[Array, dict[int, slice]] | None = None  # the net as a matrix
        self._causal: dict[int, tuple[Array, Array]] = {}  # states after their own step
        self._error = 0.0

    def value(self, key: int, dim: int) -> Array:
        """See `GraphBackend`."""
        return factors.read(self._values, key, dim)

    def covariance(self, keys: list[int]) -> Array:
        """See `GraphBackend`."""
        return root_covariance(*self._matrix(), keys)

    def _matrix(self) -> tuple[Array, dict[int, slice]]:
        """Square root information and each variable's columns."""
        if self._root is None:
            dims = {key: self._z.at(key).size for key in self._order}
            self._root = square_root(self._net, dims)
        return self._root

    def add(self, step: Step) -> None:
        """See `Backend`."""
        for group in self.builder.factor_groups(step, self.value):
            self._joints.clear()
            if group.new is not None:
                self._insert(*group.new, group.replaces)
            leaving = self._leaving(group)
            self._update(group, leaving)
            if leaving is not None:
                self._erase(leaving)
        for robot in {**step.starts, **step.motions}:
            key = self.builder.latest_key(robot)
            self._causal[key] = self.value(key, 3), self.covariance([key])

    def _leaving(self, group: FactorGroup) -> int | None:
        """The robot's state that leaves the filter when ``group`` adds its next one."""
        if group.replaces is None:
            return None
        index, number = factors.number_of(group.replaces)
        assert index is not None  # only states are replaced
        robot, oldest = self.builder.robots[index], number - self._past_states
        self.builder.oldest[robot] = max(oldest + 1, 0)
        return self.builder.state_key(robot, oldest) if oldest >= 0 else None

    def _insert(self, key: int, value: Array, replaces: int | None) -> None:
        """Insert a variable into the order: a robot's next state behind the one before."""
        factors.write(self._values, key, value)
        poses = sum(map(factors.is_state, self._order))
        if replaces is not None:
            self._order.insert(self._order.index(replaces) + 1, key)
        elif factors.is_state(key):
            self._order.insert(poses, key)
        else:
            self._order.append(key)
        self._z.insert(key, np.zeros(len(value)))

    def _update(self, group: FactorGroup, leaving: int | None) -> None:
        """Add factors, and marginalise the state ``leaving`` out."""
        if leaving is not None:
            self._order.remove(leaving)
        linear = [self._linear(factor) for factor in group.factors]
        if group.robust and group.new is None and self._kernel.kernel != "none":
            linear = [self._weighted(linear[0])]
        graph = gtsam.GaussianFactorGraph()
        graph.push_back(self._net)
        for factor in linear:
            graph.push_back(factor)
        try:
            rest = graph
            if leaving is not None:
                first = gtsam.Ordering([leaving])
                _, rest = graph.eliminatePartialSequential(first, gtsam.EliminateQR)
            self._net = rest.eliminateSequential(gtsam.Ordering(self._order), gtsam.EliminateQR)
        except RuntimeError as error:
            raise indeterminate(group.what, UNDERDETERMINED) from error
        self._root = None
        if group.new is not None:
            # its factors have no error at its initial value: nothing moves
            diagonal = np.abs(np.diag(self._matrix()[0]))
            if not (np.isfinite(diagonal).all() and diagonal.min() > 0):
                raise indeterminate(group.what, UNDERDETERMINED)
            return
        z = self._net.optimize()
        delta = z.subtract(self._z)
        if not np.isfinite(delta.norm()):
            raise indeterminate(group.what, UNDERDETERMINED)
        self._error += graph.error(z)
        self._values, self._z = self._values.retract(delta), z

    def _erase(self, key: int) -> None:
        """Remove a marginalised state from values and corrections."""
        self._values.erase(key)
        kept = gtsam.VectorValues()
        for other in self._order:
            kept.insert(other, self._z.at(other))
        self._z = kept

    def _linear(self, factor: gtsam.NonlinearFactor) -> gtsam.JacobianFactor:
        """``factor`` at the estimate, in terms of z: A (z - z_now) = b is A z = b + A z_now."""
        linear = factor.linearize(self._values)
        A, b = linear.jacobian()
        keys = linear.keys()
        b = b + A @ self._z.vector(keys)
        return factors.jacobian_factor(A, b, {key: self._z.at(key).size for key in keys})

    def _weighted(self, linear: gtsam.JacobianFactor) -> gtsam.JacobianFactor:
        """``linear``, A z = b with unit noise, scaled by the root of its `robust_weight`."""
        A, b = linear.jacobian()
        keys = linear.keys()
        innovation = b - A @ self._z.vector(keys)
        HPHt = A @ self.covariance(list(keys)) @ A.T
        root = np.sqrt(robust_weight(innovation, HPHt, np.eye(len(b)), self._kernel))
        return factors.jacobian_factor(
            root * A, root * b, {key: self._z.at(key).size for key in keys}
        )

    def finish(self) -> Estimate:
        """See `Backend`: every state as its own step left it."""
        marginals = dict(self._causal)
        for key in self._order:
            if key not in marginals:
                value = self.value(key, self._z.at(key).size)
                marginals[key] = value, self.covariance([key])
        return self.builder.estimate(marginals, self._error)
