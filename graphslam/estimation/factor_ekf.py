"""Horizon 0: the extended Kalman filter, made of GTSAM factors.

The state is each robot's latest pose and every landmark, and its density a square root information
matrix, kept as the Bayes net that eliminating the variables leaves. Each factor is linearised once,
at the estimate of its moment, eliminated with what is known so far, and the estimate moved; a
robot's last pose is eliminated as its next one enters, or, as in `ekf`, a few states later
(`EkfConfig.past_states`). One factor at a time in recorded order: taking those of a step together
would be another filter.

With z the sum of all corrections so far, in the tangent space at each variable, the information
about z is left as it is while the estimate moves: no covariance reset, as in a filter with
body-frame errors. This is no limit of the fixed-lag smoother, which linearises anew inside its
window.
"""

import gtsam
import numpy as np

from graphslam.core.config import Config, RobustConfig
from graphslam.core.geometry import Array
from graphslam.core.records import Estimate, Step
from graphslam.estimation import factors
from graphslam.estimation.factor_graph import (
    GraphBackend,
    GraphBuilder,
    Part,
    indeterminate,
    jacobian_factor,
    read,
    root_covariance,
    square_root,
    write,
)

#: relative change of a weight at which it is settled; rounds at most (convergence is linear)
SETTLED, MAX_ROUNDS = 1e-4, 100


class FactorEkfBackend(GraphBackend):
    """The filter; see the module's docstring. Its final estimate is its causal one.

    What refers to a state that has left is skipped and counted.
    """

    def __init__(self, config: Config) -> None:
        # kernels are dealt with here: GTSAM would weigh a factor by its innovation alone, however
        # uncertain the prediction is
        self._kept = config.ekf.past_states
        builder = GraphBuilder(RobustConfig(kernel="none"), late=self._kept > 0, wide=False)
        super().__init__(builder)
        self._kernel = config.robust
        self._values = gtsam.Values()
        self._order: list[int] = []  # robots, then landmarks: a motion touches the first rows only
        self._net = gtsam.GaussianBayesNet()  # square root information of z, in that order
        self._z = gtsam.VectorValues()
        self._root: tuple[Array, dict[int, slice]] | None = None  # the net as a matrix
        self._causal: dict[int, tuple[Array, Array]] = {}  # states as their own step left them
        self._error = 0.0

    def value(self, key: int, dim: int) -> Array:
        """See `GraphBackend`."""
        return read(self._values, key, dim)

    def covariance(self, keys: list[int]) -> Array:
        """See `GraphBackend`."""
        return root_covariance(*self._matrix(), keys)

    def _matrix(self) -> tuple[Array, dict[int, slice]]:
        """Square root information and where each variable's columns are."""
        if self._root is None:
            dims = {key: self._z.at(key).size for key in self._order}
            self._root = square_root(self._net, dims)
        return self._root

    def add(self, step: Step) -> None:
        """See `Backend`."""
        for part in self.builder.parts(step, self.value):
            self._joints.clear()
            if part.new is not None:
                self._enter(*part.new, part.replaces)
            gone = self._gone(part)
            self._update(part, gone)
            if gone is not None:
                self._forget(gone)
        for robot in {**step.starts, **step.motions}:
            key = self.builder.latest_key(robot)
            self._causal[key] = self.value(key, 3), self.covariance([key])

    def _gone(self, part: Part) -> int | None:
        """The state that leaves with this part: its robot has a next one and enough others."""
        if part.replaces is None:
            return None
        index, number = factors.number_of(part.replaces)
        assert index is not None  # only states are replaced
        robot, oldest = self.builder.robots[index], number - self._kept
        self.builder.oldest[robot] = max(oldest + 1, 0)
        return self.builder.state_key(robot, oldest) if oldest >= 0 else None

    def _enter(self, key: int, value: Array, replaces: int | None) -> None:
        """Make room for a variable: a robot's next state behind the one before."""
        write(self._values, key, value)
        poses = sum(map(factors.is_state, self._order))
        if replaces is not None:
            self._order.insert(self._order.index(replaces) + 1, key)
        elif factors.is_state(key):
            self._order.insert(poses, key)
        else:
            self._order.append(key)
        self._z.insert(key, np.zeros(len(value)))

    def _update(self, part: Part, gone: int | None) -> None:
        """Take in a part, and marginalise the state ``gone`` out."""
        if gone is not None:
            self._order.remove(gone)
        linear = [self._linear(factor) for factor in part.factors]
        if part.robust and part.new is None and self._kernel.kernel != "none":
            linear = [self._weighed(linear[0])]
        graph = gtsam.GaussianFactorGraph()
        graph.push_back(self._net)
        for found in linear:
            graph.push_back(found)
        try:
            rest = graph
            if gone is not None:
                first = gtsam.Ordering([gone])
                _, rest = graph.eliminatePartialSequential(first, gtsam.EliminateQR)
            self._net = rest.eliminateSequential(gtsam.Ordering(self._order), gtsam.EliminateQR)
        except RuntimeError as error:
            raise indeterminate(part.what) from error
        self._root = None
        if part.new is not None:
            # its first value is where its factors have no error: nothing moves
            diagonal = np.abs(np.diag(self._matrix()[0]))
            if not (np.isfinite(diagonal).all() and diagonal.min() > 0):
                raise indeterminate(part.what)
            return
        z = self._net.optimize()
        moved = z.subtract(self._z)
        if not np.isfinite(moved.norm()):
            raise indeterminate(part.what)
        self._error += graph.error(z)
        self._values, self._z = self._values.retract(moved), z

    def _forget(self, key: int) -> None:
        """Take a state out of the values; what is known of the others stays."""
        self._values.erase(key)
        kept = gtsam.VectorValues()
        for other in self._order:
            kept.insert(other, self._z.at(other))
        self._z = kept

    def _linear(self, factor: gtsam.NonlinearFactor) -> gtsam.JacobianFactor:
        """``factor`` at the estimate, in terms of z: A (z - z_now) = b is A z = b + A z_now."""
        found = factor.linearize(self._values)
        A, b = found.jacobian()
        keys = found.keys()
        b = b + A @ self._z.vector(keys)
        return jacobian_factor(A, b, {key: self._z.at(key).size for key in keys})

    def _weighed(self, linear: gtsam.JacobianFactor) -> gtsam.JacobianFactor:
        """``linear`` scaled by what the kernel makes of its residual *after* the update.

        Iteratively reweighted least squares on one factor, linearised once: with the innovation
        -b and S = A P Aᵀ the whitened residual left by weight w is (1 + w S)⁻¹ b, and w is the
        kernel's weight of that. It starts at w = 1: an innovation that the state's uncertainty
        explains is no outlier, however many sigmas of the sensor it is.
        """
        A, b = linear.jacobian()
        keys = linear.keys()
        innovation = b - A @ self._z.vector(keys)
        S = A @ self.covariance(list(keys)) @ A.T
        noise = factors.robust(gtsam.noiseModel.Unit.Create(len(b)), self._kernel)
        w, identity = 1.0, np.eye(len(b))
        for _ in range(MAX_ROUNDS):
            before, w = w, noise.weight(np.linalg.solve(identity + w * S, innovation))
            if before - w <= SETTLED * before:
                break
        root = np.sqrt(w)
        return jacobian_factor(root * A, root * b, {key: self._z.at(key).size for key in keys})

    def finish(self) -> Estimate:
        """See `Backend`: every state as its own step left it."""
        means = {key: mean for key, (mean, _) in self._causal.items()}
        covs = {key: cov for key, (_, cov) in self._causal.items()}
        for key in self._order:
            if key not in means:
                means[key] = self.value(key, self._z.at(key).size)
                covs[key] = self.covariance([key])
        return self._estimate(means, covs, self._error)
