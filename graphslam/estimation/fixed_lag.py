"""Fixed-lag smoothing: states older than the horizon are marginalised out, landmarks stay.

The window is a nonlinear graph, optimised at every step; the size of the map bounds its cost. When
a state leaves, its factors are linearised for the last time and it is eliminated from them. What
remains of them about its neighbours, mostly landmarks, is a linear factor, the prior.

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

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from graphslam.core.config import Config, RobustConfig
from graphslam.core.geometry import Array
from graphslam.core.records import Association, Estimate, Step
from graphslam.estimation import factors
from graphslam.estimation.factor_graph import (
    GraphBackend,
    GraphBuilder,
    joint_marginal,
    root_covariance,
    square_root,
)

#: largest number of Gauss-Newton iterations per step, and the norm of the update (m, rad) that ends
#: them. A step starts where the last one ended, so two are the rule.
MAX_ITERATIONS, CONVERGED = 6, 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class WindowFactor:
    """A factor of the window and its keys.

    ``observed``: its association with both keys, if any; ``robust``: whether the kernel applies;
    ``prior``: whether it is what marginalised states left.
    """

    factor: gtsam.NonlinearFactor
    keys: tuple[int, ...]
    observed: tuple[int, int, Association] | None = None
    robust: bool = False
    prior: bool = False


class FixedLagBackend(GraphBackend):
    """The smoother; see the module's docstring.

    At the end, states that left have the estimate and covariance with which they left: smoothed
    with the data within the horizon. What refers to a state that has left is skipped and counted.
    """

    def __init__(self, config: Config) -> None:
        # weights are of residuals at the current estimate, so the kernel is applied here
        super().__init__(GraphBuilder(RobustConfig(kernel="none"), wide=False))
        self._kernel = config.robust
        self._horizon_ns = round(1e9 * config.backend.horizon_s)
        self._values = gtsam.Values()
        self._dims: dict[int, int] = {}
        self._window: list[WindowFactor] = []
        self._first: dict[int, Array] = {}  # linearisation points of what the prior involves
        self._tree: gtsam.GaussianBayesTree | None = None
        self._past: dict[int, tuple[Array, Array]] = {}  # states that left
        self._qr = False

    def value(self, key: int, dim: int) -> Array:
        """See `GraphBackend`."""
        return factors.read(self._values, key, dim)

    def add(self, step: Step) -> None:
        """See `Backend`."""
        self._joints.clear()
        self._tree = None
        for group in self.builder.factor_groups(step, self.value):
            if group.new is not None:
                key, value = group.new
                factors.write(self._values, key, value)
                self._dims[key] = len(value)
            *others, last = group.factors
            self._window += [WindowFactor(factor, tuple(factor.keys())) for factor in others]
            keys = tuple(last.keys())
            self._window.append(WindowFactor(last, keys, group.observed, group.robust))
        self._optimise()
        self._marginalise_before(step.time_ns - self._horizon_ns)

    def _optimise(self) -> None:
        for _ in range(MAX_ITERATIONS):
            delta = self._eliminated().optimize()
            size = delta.norm()
            if not np.isfinite(size):
                raise self.builder.diagnose(self._linear(self._window), self._values)
            self._values, self._tree = self._values.retract(delta), None
            if size < CONVERGED:
                break

    def _eliminated(self) -> gtsam.GaussianBayesTree:
        """The window, linearised and eliminated: by Cholesky, or by QR where that fails."""
        if self._tree is None:
            linear, order = self._linear(self._window), gtsam.Ordering.OrderingType.COLAMD
            by_qr = (order, gtsam.EliminateQR) if self._qr else ()
            try:
                self._tree = linear.eliminateMultifrontal(*by_qr)
            except RuntimeError as error:
                if self._qr:
                    raise self.builder.explain(error) from error
                self._qr = True
                return self._eliminated()
        return self._tree

    def _linear(self, window: Iterable[WindowFactor]) -> gtsam.GaussianFactorGraph:
        """Factors with residuals at the estimate and first-estimates Jacobians (see `_first`)."""
        first = gtsam.Values(self._values)
        for key, value in self._first.items():
            first.update(key, factors.pose2(value) if len(value) == 3 else value)
        graph = gtsam.GaussianFactorGraph()
        for each in window:
            linear = each.factor.linearize(self._values)
            if not each.prior:
                involved = not self._first.keys().isdisjoint(each.keys)
                weighted = each.robust and self._kernel.kernel != "none"
                if involved or weighted:
                    A, b = linear.jacobian()
                    if involved:
                        A = each.factor.linearize(first).jacobian()[0]
                    root = np.sqrt(self._noise(len(b)).weight(b)) if weighted else 1.0
                    dims = {key: self._dims[key] for key in each.keys}
                    linear = factors.jacobian_factor(root * A, root * b, dims)
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
            return joint_marginal(tree, keys)
        except RuntimeError:
            self._qr, self._tree = True, None
            return self.covariance(keys)

    def _qr_covariance(self, keys: list[int]) -> Array:
        """By QR throughout: a tree computes marginals by Cholesky, however it was made."""
        linear = self._linear(self._window)
        others = gtsam.Ordering([key for key in self._dims if key not in keys])
        rest = linear.eliminatePartialSequential(others, gtsam.EliminateQR)[1]
        net = rest.eliminateSequential(gtsam.Ordering(keys), gtsam.EliminateQR)
        R, columns = square_root(net, self._dims)
        if not (np.isfinite(R).all() and np.diag(R).all()):
            raise self.builder.diagnose(linear, self._values)
        return root_covariance(R, columns, keys)

    def _marginalise_before(self, before_ns: int) -> None:
        """Marginalise the states before ``before_ns`` out, but no robot's latest."""
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
        involved = [f for f in self._window if not set(leaving).isdisjoint(f.keys)]
        # lines are built a last time, at the best estimate that there will be
        linear, order = self._linear(map(self._rebuilt, involved)), gtsam.Ordering(list(leaving))
        by_qr = (gtsam.EliminateQR,) if self._qr else ()
        _, rest = linear.eliminatePartialSequential(order, *by_qr)
        self._window = [f for f in self._window if set(leaving).isdisjoint(f.keys)]
        prior = gtsam.LinearContainerFactor.ConvertLinearGraph(rest, self._values)
        for n in range(prior.size()):
            factor = prior.at(n)
            keys = tuple(factor.keys())
            self._window.append(WindowFactor(factor, keys, prior=True))
            for key in keys:
                self._first.setdefault(key, self.value(key, self._dims[key]))
        for key in leaving:
            self._values.erase(key)
            self._first.pop(key, None)
            del self._dims[key]

    def _rebuilt(self, old: WindowFactor) -> WindowFactor:
        """A line's factor at the current estimate; others as they are."""
        if old.observed is None or old.observed[2].model != "line":
            return old
        return replace(old, factor=self.builder.factor_at_estimate(old.observed, self.value))

    def finish(self) -> Estimate:
        """See `Backend`."""
        marginals = dict(self._past)
        for key, dim in self._dims.items():
            marginals[key] = self.value(key, dim), self.covariance([key])
        return self.builder.estimate(marginals, self._half_error())

    def _half_error(self) -> float:
        """Half the weighted squared residuals, including those in the prior."""
        total = 0.0
        for each in self._window:
            if each.robust:
                b = each.factor.linearize(self._values).jacobian()[1]
                total += self._noise(len(b)).loss(float(b @ b))
            else:
                total += each.factor.error(self._values)
        return total
