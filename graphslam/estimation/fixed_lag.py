"""Finite horizons: smoothing of a window of states, at a cost that the map's size bounds.

Poses older than the horizon are marginalised out; landmarks stay for ever. The window is a
nonlinear graph, optimised at every step. When a state leaves, the factors that touch it are
linearised for the last time and it is eliminated from them; what they say about the variables next
to it, most of all landmarks, stays as one linear factor, the prior.

The prior knows nothing about where the whole map lies and how it is turned, as long as the
directions in which that does not matter are the same for every factor. They depend on where one
linearises; so a variable keeps the place at which the prior first touched it for its Jacobians
(first-estimates Jacobians), while residuals are always those of the estimate of now. With Jacobians
of now, prior and window would disagree about the turn that costs nothing and by that claim to know
it: measured 20 times as far from batch. A landmark gets its place when the first state that saw it
leaves: smoothed over the horizon, not as it was first seen.

Source: G. Huang, A. Mourikis, S. Roumeliotis, Observability-based rules for designing consistent
EKF SLAM estimators, IJRR 2010, https://doi.org/10.1177/0278364909353640.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from graphslam.core.config import Config, RobustConfig
from graphslam.core.errors import EstimationError
from graphslam.core.geometry import Array
from graphslam.core.records import Association, Estimate, Step
from graphslam.estimation import factors
from graphslam.estimation.factor_graph import (
    GraphBackend,
    GraphBuilder,
    jacobian_factor,
    read,
    root_covariance,
    square_root,
    update,
    write,
)

#: rounds of Gauss-Newton per step at most, and the norm of the movement (m, rad) that ends them.
#: A step starts where the last one ended, so two are the rule.
ROUNDS, STILL = 6, 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """A factor of the window: its keys, whether observed or odometry, or the linear prior."""

    factor: gtsam.NonlinearFactor
    keys: tuple[int, ...]
    observed: tuple[int, int, Association] | None = None
    robust: bool = False
    prior: bool = False


class FixedLagBackend(GraphBackend):
    """The smoother; see the module's docstring.

    At the end, states that left keep the estimate and covariance with which they left: smoothed
    with what came within the horizon. What refers to a state that has left is skipped and counted.
    """

    def __init__(self, config: Config) -> None:
        # weights are those of residuals now, so the kernel is applied here
        super().__init__(GraphBuilder(RobustConfig(kernel="none"), wide=False))
        self._kernel = config.robust
        self._horizon_ns = round(1e9 * config.backend.horizon_s)
        self._values = gtsam.Values()
        self._dims: dict[int, int] = {}
        self._window: list[Placed] = []
        self._first: dict[int, Array] = {}  # where Jacobians of what the prior touches are taken
        self._tree: gtsam.GaussianBayesTree | None = None
        self._past: dict[int, tuple[Array, Array]] = {}
        self._qr = False

    def value(self, key: int, dim: int) -> Array:
        """See `GraphBackend`."""
        return read(self._values, key, dim)

    def add(self, step: Step) -> None:
        """See `Backend`."""
        self._joints.clear()
        self._tree = None
        for part in self.builder.parts(step, self.value):
            if part.new is not None:
                key, value = part.new
                write(self._values, key, value)
                self._dims[key] = len(value)
            for factor in part.factors:
                last = factor is part.factors[-1]
                observed = part.observed if last else None
                keys, robust = tuple(factor.keys()), last and part.robust
                self._window.append(Placed(factor, keys, observed, robust))
        self._optimise()
        self._let_go(step.time_ns - self._horizon_ns)

    def _optimise(self) -> None:
        for _ in range(ROUNDS):
            moved = self._eliminated().optimize()
            size = moved.norm()
            if not np.isfinite(size):
                raise self._diagnose()
            self._values, self._tree = self._values.retract(moved), None
            if size < STILL:
                break

    def _eliminated(self) -> gtsam.GaussianBayesTree:
        """The window, linearised and eliminated: by Cholesky, or by QR where that gives up."""
        if self._tree is None:
            linear = self._linear(self._window)
            try:
                self._tree = self._qr_tree(linear) if self._qr else linear.eliminateMultifrontal()
            except RuntimeError as error:
                if self._qr:
                    raise self.builder.explain(error) from error
                self._qr = True
                return self._eliminated()
        return self._tree

    @staticmethod
    def _qr_tree(linear: gtsam.GaussianFactorGraph) -> gtsam.GaussianBayesTree:
        return linear.eliminateMultifrontal(gtsam.Ordering.OrderingType.COLAMD, gtsam.EliminateQR)

    def _diagnose(self) -> EstimationError:
        """Which variable is indeterminate: QR answers NaN for all of them, Cholesky names one."""
        try:
            self._linear(self._window).eliminateMultifrontal()
        except RuntimeError as error:
            return self.builder.explain(error)
        return self.builder.explain(RuntimeError(""))

    def _linear(self, pieces: Iterable[Placed]) -> gtsam.GaussianFactorGraph:
        """Factors with the residuals of now and, where `_first` says so, the Jacobians of then."""
        then = gtsam.Values(self._values)
        for key, value in self._first.items():
            update(then, key, value)
        graph = gtsam.GaussianFactorGraph()
        for placed in pieces:
            linear = placed.factor.linearize(self._values)
            if not placed.prior:
                was = not self._first.keys().isdisjoint(placed.keys)
                weighed = placed.robust and self._kernel.kernel != "none"
                if was or weighed:
                    A, b = linear.jacobian()
                    if was:
                        A = placed.factor.linearize(then).jacobian()[0]
                    root = np.sqrt(self._noise(len(b)).weight(b)) if weighed else 1.0
                    dims = {key: self._dims[key] for key in placed.keys}
                    linear = jacobian_factor(root * A, root * b, dims)
            graph.push_back(linear)
        return graph

    def _noise(self, rows: int) -> gtsam.noiseModel.Base:
        """The kernel on whitened residuals (rows,)."""
        return factors.robust(gtsam.noiseModel.Unit.Create(rows), self._kernel)

    def covariance(self, keys: list[int]) -> Array:
        """See `GraphBackend`."""
        tree = self._eliminated()
        if self._qr:
            return self._qr_covariance(keys)
        try:
            if len(keys) == 1:
                return np.asarray(tree.marginalCovariance(keys[0]))
            return np.asarray(tree.jointMarginalCovariance(keys).fullMatrix())
        except RuntimeError:
            self._qr, self._tree = True, None
            return self.covariance(keys)

    def _qr_covariance(self, keys: list[int]) -> Array:
        """By QR all along: the tree answers by Cholesky, however it was made."""
        linear = self._linear(self._window)
        others = gtsam.Ordering([key for key in self._dims if key not in keys])
        rest = linear.eliminatePartialSequential(others, gtsam.EliminateQR)[1]
        net = rest.eliminateSequential(gtsam.Ordering(keys), gtsam.EliminateQR)
        R, place = square_root(net, self._dims)
        if not (np.isfinite(R).all() and np.diag(R).all()):
            raise self._diagnose()
        return root_covariance(R, place, keys)

    def _let_go(self, before_ns: int) -> None:
        """Marginalise the states before ``before_ns``, but no robot's latest."""
        leaving: list[int] = []
        for robot in self.builder.robots:
            times, oldest = self.builder.states.times[robot], self.builder.oldest[robot]
            while times[oldest] < before_ns and oldest < len(times) - 1:
                leaving.append(self.builder.state_key(robot, oldest))
                oldest += 1
            self.builder.oldest[robot] = oldest
        if leaving:
            for key in leaving:
                self._past[key] = self.value(key, 3), self.covariance([key])
            self._marginalise(leaving)

    def _marginalise(self, leaving: Sequence[int]) -> None:
        touched = [p for p in self._window if not set(leaving).isdisjoint(p.keys)]
        # the last chance to build a line's factor at the best estimate there will be
        linear, order = self._linear(map(self._faced, touched)), gtsam.Ordering(list(leaving))
        if self._qr:
            rest = linear.eliminatePartialSequential(order, gtsam.EliminateQR)[1]
        else:
            rest = linear.eliminatePartialSequential(order)[1]
        self._window = [p for p in self._window if set(leaving).isdisjoint(p.keys)]
        prior = gtsam.LinearContainerFactor.ConvertLinearGraph(rest, self._values)
        for place in range(prior.size()):
            factor = prior.at(place)
            keys = tuple(factor.keys())
            self._window.append(Placed(factor, keys, prior=True))
            for key in keys:
                self._first.setdefault(key, self.value(key, self._dims[key]))
        for key in leaving:
            self._values.erase(key)
            self._first.pop(key, None)
            del self._dims[key]

    def _faced(self, placed: Placed) -> Placed:
        if placed.observed is None or placed.observed[2].model != "line":
            return placed
        factor = self.builder.faced(placed.observed, self.value)
        return Placed(factor, placed.keys, placed.observed, placed.robust)

    def finish(self) -> Estimate:
        """See `Backend`."""
        means = {key: mean for key, (mean, _) in self._past.items()}
        covs = {key: cov for key, (_, cov) in self._past.items()}
        for key, dim in self._dims.items():
            means[key], covs[key] = self.value(key, dim), self.covariance([key])
        return self._estimate(means, covs, self._half_squares())

    def _half_squares(self) -> float:
        """Half the weighted squared residuals, of what has left too."""
        total = 0.0
        for placed in self._window:
            if placed.robust:
                b = placed.factor.linearize(self._values).jacobian()[1]
                total += self._noise(len(b)).loss(float(b @ b))
            else:
                total += placed.factor.error(self._values)
        return total
