"""Batch optimisation of a graph to convergence, whatever its noise.

Cholesky factorises the information matrix, whose condition is the square of that of the factors:
where information spans more than ten decades it loses the weakest, finds no step, or calls the
graph indeterminate. QR factorises the factors themselves, at about twice the cost.
"""

import math
from collections.abc import Collection, Sequence

import gtsam
import numpy as np

from graphslam.core.config import RobustConfig
from graphslam.core.geometry import Array
from graphslam.core.records import Closure, Motion
from graphslam.estimation.path_retraction import PathRetraction
from graphslam.estimation.selected_inverse import (
    CliqueRows,
    CovarianceBlocks,
    covariance_blocks,
    root_rows,
)

#: relative decrease of the error at which optimisation ends: without a kernel; with one
#: (reweighting converges linearly: beyond 1e-6 hundreds of iterations move nothing that shows); and
#: where another round follows anyway
CONVERGED_ERROR, CONVERGED_ERROR_ROBUST, CONVERGED_ERROR_ROUGH = 1e-10, 1e-6, 1e-3
CONVERGED_ABSOLUTE = 1e-9
#: information of motions and closures, of the strongest direction relative to the weakest, beyond
#: which QR is used: Cholesky then has less than six digits of the weakest left
WIDE_INFORMATION = 1e9
#: largest damping: GTSAM's own, and where information is as large as 1e12
MAX_DAMPING, MAX_DAMPING_QR = 1e5, 1e20
MAX_ITERATIONS = 200
#: with a kernel steps are extrapolated where the error falls by a smaller share than this, and they
#: keep their direction (cosine) and shrink; by so much at most
NEAR, SAME_DIRECTION, SHRINKING, MAX_FACTOR = 1e-2, 0.9, 0.95, 5.0
#: error per factor from which a start is too far for stiff factors: Levenberg-Marquardt would
#: creep along the curved valley that they leave. All are then first taken as no stiffer than these
#: sigmas, m and rad
FAR, SOFT_SIGMAS = 2.0, (1e-2, 1e-4)


def is_wide(motions: Sequence[Motion], closures: Sequence[Closure]) -> bool:
    """Whether the information of relative poses spans more than `WIDE_INFORMATION`.

    A closure may leave a direction open: motions determine the states of its ends as well.
    """
    of_motions, of_closures = _variances(motions), _variances(closures)
    variances = np.concatenate([of_motions, of_closures[:, :1]], axis=None)
    if not len(variances) or not np.isfinite(variances).all():
        return False
    return bool(variances.max() > WIDE_INFORMATION * variances.min())


def _variances(measured: Sequence[Motion] | Sequence[Closure]) -> Array:
    """Variances (n, 3) along the principal axes of relative poses, the smallest first."""
    covs = np.array([one.cov for one in measured]).reshape(-1, 3, 3)
    if not np.isfinite(covs).all():
        return np.full((1, 3), np.nan)
    return np.asarray(np.linalg.eigvalsh(covs))


def optimise(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    kernel: RobustConfig,
    converged: float | None = None,
    *,
    use_qr: bool = False,
    soften: bool = True,
) -> gtsam.Values:
    """Optimise from ``values`` until the relative decrease of the error is small.

    By Levenberg-Marquardt; with a kernel first by `reweighted` Gauss-Newton as far as that goes.
    ``converged`` is that limit: by default `CONVERGED_ERROR`, whose 1e-10 costs nothing where
    convergence is quadratic, or `CONVERGED_ERROR_ROBUST` with a kernel. ``use_qr``: see the module;
    ``soften``: see `FAR`.

    Raises:
        RuntimeError: the graph is indeterminate.
    """
    if converged is None:
        converged = CONVERGED_ERROR if kernel.kernel == "none" else CONVERGED_ERROR_ROBUST
    if kernel.kernel != "none" and not use_qr:
        values, _, is_done = reweighted(graph, values, converged)
        if is_done:
            return values
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(converged)
    parameters.setAbsoluteErrorTol(CONVERGED_ABSOLUTE)
    parameters.setMaxIterations(MAX_ITERATIONS)
    if use_qr:
        if soften and graph.error(values) > FAR * graph.size():
            for sigma in SOFT_SIGMAS:
                soft = softened(graph, sigma)
                values = optimise(soft, values, kernel, CONVERGED_ERROR_ROUGH, soften=False)
        parameters.setLinearSolverType("MULTIFRONTAL_QR")
        parameters.setlambdaUpperBound(MAX_DAMPING_QR)
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)
    values = optimizer.optimize()
    # it gives up where no damping helps: at a minimum, or because Cholesky fails
    if not use_qr and optimizer.lambda_() >= MAX_DAMPING and _can_fall(graph, values, converged):
        return optimise(graph, values, kernel, converged, use_qr=True, soften=soften)
    return values


def reweighted(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, converged: float
) -> tuple[gtsam.Values, float, bool]:
    """Gauss-Newton under kernels, until the relative decrease of the error is small.

    Weights of a kernel converge linearly: near the end each step is a constant part of the one
    before. Where this shows, the sum of all steps to come is taken instead (A. Aitken, 1926), if
    the error agrees. That takes a third less iterations and ends nearer to the minimum.

    A step that raises the error is taken along the paths instead (`PathRetraction`), else half of
    it. One that Cholesky does not find is found by QR: damped steps would creep along the weak
    directions of a long path, which are those that Cholesky loses.

    Returns:
        The best values, the error there, and whether they have converged: not where half a step
        raises the error, or the graph is indeterminate. Damping is needed there.
    """
    ordering: gtsam.Ordering | None = None
    error, before, share = graph.error(values), None, math.inf
    along_paths: PathRetraction | None = None
    for _ in range(MAX_ITERATIONS):
        linear = graph.linearize(values)
        ordering = ordering or gtsam.Ordering.ColamdGaussianFactorGraph(linear)
        try:
            step = _undamped(linear, ordering)
        except RuntimeError:
            return values, error, False
        factor = 1.0
        if before is not None and share < NEAR:
            factor = _extrapolation(before, step)
        moved = values.retract(step.scale(factor))
        now = graph.error(moved)
        if factor > 1.0 and not now < error:
            factor, moved = 1.0, values.retract(step)
            now = graph.error(moved)
        is_straight = now <= error
        if not is_straight:
            along_paths = along_paths or PathRetraction(graph)
            moved = along_paths(values, step)
            now = graph.error(moved)
        if not now <= error:
            moved = values.retract(step.scale(0.5))
            now = graph.error(moved)
            if not now <= error:
                return values, error, False
        before = step if factor == 1.0 and is_straight else None
        decrease, error, values = error - now, now, moved
        share = decrease / error if error > 0.0 else 0.0
        if share < converged or decrease < CONVERGED_ABSOLUTE:
            return values, error, True
    return values, error, True


def _undamped(linear: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering) -> gtsam.VectorValues:
    """The minimum of a linear graph, by Cholesky, or by QR where that fails.

    Raises:
        RuntimeError: the graph is indeterminate.
    """
    try:
        return linear.optimize(ordering)
    except RuntimeError:
        step = linear.optimize(ordering, gtsam.EliminateQR)
    if not math.isfinite(step.norm()):  # QR does not fail
        raise RuntimeError("indeterminate")
    return step


def _extrapolation(before: gtsam.VectorValues, step: gtsam.VectorValues) -> float:
    """By how much a step is too short if it and the one before begin a geometric series."""
    lengths = before.norm(), step.norm()
    if not min(lengths) > 0.0:
        return 1.0
    cosine, ratio = before.dot(step) / (lengths[0] * lengths[1]), lengths[1] / lengths[0]
    if cosine < SAME_DIRECTION or ratio > SHRINKING:
        return 1.0
    return float(min(1.0 / (1.0 - ratio * cosine), MAX_FACTOR))


def softened(graph: gtsam.NonlinearFactorGraph, sigma: float) -> gtsam.NonlinearFactorGraph:
    """The graph with a sigma, m and rad, added to the noise of relative poses."""
    soft = gtsam.NonlinearFactorGraph()
    for factor in (graph.at(n) for n in range(graph.size())):
        if isinstance(factor, gtsam.BetweenFactorPose2):
            noise = _softened(factor.noiseModel(), sigma)
            if noise is not None:
                a, b = factor.keys()
                soft.add(gtsam.BetweenFactorPose2(a, b, factor.measured(), noise))
                continue
        soft.add(factor)
    return soft


def _softened(noise: gtsam.noiseModel.Base, sigma: float) -> gtsam.noiseModel.Base | None:
    """A noise model with a sigma added; None where a direction has no information."""
    if isinstance(noise, gtsam.noiseModel.Robust):
        plain = _softened(noise.noise(), sigma)
        return plain and gtsam.noiseModel.Robust.Create(noise.robust(), plain)
    if not isinstance(noise, gtsam.noiseModel.Gaussian) or not np.diag(noise.R()).all():
        return None
    root = np.linalg.inv(noise.R())
    return gtsam.noiseModel.Gaussian.Covariance(root @ root.T + sigma**2 * np.eye(3))


def _can_fall(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, share: float) -> bool:
    """Whether a Gauss-Newton step would decrease the error by more than a share of it."""
    linear = graph.linearize(values)
    ordering = gtsam.Ordering.ColamdGaussianFactorGraph(linear)
    step = linear.eliminateSequential(ordering, gtsam.EliminateQR).optimize()
    now = graph.error(values)
    return bool(now - linear.error(step) > max(share, CONVERGED_ERROR_ROBUST) * now)


def marginals_of(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    pairs: Collection[tuple[int, ...]] = (),
    apart: Collection[tuple[int, ...]] = (),
    *,
    keep_rows: bool = False,
    use_qr: bool = False,
) -> CovarianceBlocks:
    """Covariances of all variables and of some together: by Cholesky, or by QR where that fails.

    Errors are in body frames. ``pairs``, ``apart``, ``keep_rows``: see `covariance_blocks`;
    ``use_qr``: by QR at once.

    Raises:
        RuntimeError: one is indeterminate.
    """
    error = RuntimeError("")
    if not use_qr:
        try:
            return covariance_blocks(graph.linearize(values), pairs, apart, keep_rows=keep_rows)
        except RuntimeError as failed:
            error = failed
    linear = graph.linearize(values)
    blocks = covariance_blocks(linear, pairs, apart, use_qr=True, keep_rows=keep_rows)
    # QR does not fail on an indeterminate graph, its covariances are not finite
    if not all(np.isfinite(cov).all() for cov in blocks.marginals.values()):
        raise error
    return blocks


def root_of(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> tuple[CliqueRows, ...]:
    """The root of the information: by Cholesky, or by QR where that fails.

    Raises:
        RuntimeError: the graph is indeterminate.
    """
    linear = graph.linearize(values)
    try:
        return root_rows(linear)
    except RuntimeError as error:
        rows = root_rows(linear, use_qr=True)
        # QR does not fail on an indeterminate graph, its root is not finite
        if not all(np.isfinite(clique.block).all() for clique in rows):
            raise error
        return rows


def joint_marginal(tree: gtsam.ISAM2 | gtsam.GaussianBayesTree, keys: list[int]) -> Array:
    """Joint marginal covariance (D, D) of variables in this order.

    Raises:
        RuntimeError: it is indeterminate.
    """
    if len(keys) == 1:
        return np.asarray(tree.marginalCovariance(keys[0]))
    return np.asarray(tree.jointMarginalCovariance(keys).fullMatrix())


class JointMarginals:
    """Joint covariances of a few variables of a graph: by Cholesky, or by QR where that fails."""

    def __init__(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> None:
        """At ``values``."""
        self._graph, self._values = graph, values
        self._by_cholesky: gtsam.Marginals | None = None

    def of(self, keys: Sequence[int]) -> Array:
        """The joint covariance (D, D) of variables in this order, in their own axes.

        Raises:
            RuntimeError: it is indeterminate.
        """
        try:
            found = self._by_cholesky or gtsam.Marginals(self._graph, self._values)
            self._by_cholesky = found
            return np.asarray(found.jointMarginalCovariance(list(keys)).fullMatrix())
        except RuntimeError as failed:
            error = failed  # it names the variable
        R = self._root(keys)
        # QR does not fail on an indeterminate graph, its root is singular or not finite
        if not (np.isfinite(R).all() and np.diagonal(R).all()):
            raise error
        inverse = np.linalg.inv(R)
        return np.asarray(inverse @ inverse.T)

    def _root(self, keys: Sequence[int]) -> Array:
        """Root (D, D) of the information of variables, which are eliminated last, by QR."""
        linear = self._graph.linearize(self._values)
        last = gtsam.Ordering.ColamdConstrainedLastGaussianFactorGraph(linear, list(keys), True)
        every = linear.eliminateSequential(last, gtsam.EliminateQR)
        own = gtsam.GaussianBayesNet()
        for n in range(every.size() - len(keys), every.size()):
            own.push_back(every.at(n))
        return np.asarray(own.matrix()[0])
