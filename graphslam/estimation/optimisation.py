"""Batch optimisation of a graph to convergence, whatever its noise.

Cholesky factorises the information matrix, whose condition is the square of that of the factors:
where information spans more than ten decades it loses the weakest, finds no step, or calls the
graph indeterminate. QR factorises the factors themselves, at about twice the cost.
"""

from collections.abc import Iterable, Sequence

import gtsam
import numpy as np

from graphslam.core.config import RobustConfig
from graphslam.core.records import Closure, Motion
from graphslam.estimation.selected_inverse import CovarianceBlocks, covariance_blocks

#: relative decrease of the error at which optimisation ends: without a kernel; with one
#: (reweighting converges linearly: beyond 1e-6 hundreds of iterations move nothing that shows); and
#: where another round follows anyway
CONVERGED_ERROR, CONVERGED_ERROR_ROBUST, CONVERGED_ERROR_ROUGH = 1e-10, 1e-6, 1e-3
#: information of motions and closures, of the strongest direction relative to the weakest, beyond
#: which QR is used: Cholesky then has less than six digits of the weakest left
WIDE_INFORMATION = 1e9
#: largest damping: GTSAM's own, and where information is as large as 1e12
MAX_DAMPING, MAX_DAMPING_QR = 1e5, 1e20
MAX_ITERATIONS = 200
#: error per factor from which a start is too far for stiff factors: Levenberg-Marquardt would
#: creep along the curved valley that they leave. All are then first taken as no stiffer than these
#: sigmas, m and rad
FAR, SOFT_SIGMAS = 2.0, (1e-2, 1e-4)


def is_wide(measured: Sequence[Motion | Closure]) -> bool:
    """Whether the information of relative poses spans more than `WIDE_INFORMATION`."""
    covs = np.array([one.cov for one in measured])
    if not len(covs) or not np.isfinite(covs).all():
        return False
    variances = np.linalg.eigvalsh(covs)
    return bool(variances.max() > WIDE_INFORMATION * variances.min())


def optimise(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    kernel: RobustConfig,
    converged: float | None = None,
    *,
    use_qr: bool = False,
) -> gtsam.Values:
    """Levenberg-Marquardt from ``values`` until the relative decrease of the error is small.

    ``converged`` is that limit: by default `CONVERGED_ERROR`, whose 1e-10 costs nothing where
    convergence is quadratic, or `CONVERGED_ERROR_ROBUST` with a kernel. ``use_qr``: see the module.

    Raises:
        RuntimeError: the graph is indeterminate.
    """
    if converged is None:
        converged = CONVERGED_ERROR if kernel.kernel == "none" else CONVERGED_ERROR_ROBUST
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(converged)
    parameters.setAbsoluteErrorTol(1e-9)
    parameters.setMaxIterations(MAX_ITERATIONS)
    if use_qr:
        if graph.error(values) > FAR * graph.size():
            for sigma in SOFT_SIGMAS:
                soft = softened(graph, sigma)
                values = optimise(soft, values, kernel, CONVERGED_ERROR_ROUGH)
        parameters.setLinearSolverType("MULTIFRONTAL_QR")
        parameters.setlambdaUpperBound(MAX_DAMPING_QR)
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)
    values = optimizer.optimize()
    # it gives up where no damping helps: at a minimum, or because Cholesky fails
    if not use_qr and optimizer.lambda_() >= MAX_DAMPING and _can_fall(graph, values, converged):
        return optimise(graph, values, kernel, converged, use_qr=True)
    return values


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
    pairs: Iterable[tuple[int, int]] = (),
    *,
    keep_rows: bool = False,
    use_qr: bool = False,
) -> CovarianceBlocks:
    """Covariances of all variables and of pairs of poses: by Cholesky, or by QR where that fails.

    Errors are in body frames. ``keep_rows``: see `covariance_blocks`; ``use_qr``: by QR at once.

    Raises:
        RuntimeError: one is indeterminate.
    """
    error = RuntimeError("")
    if not use_qr:
        try:
            return covariance_blocks(graph.linearize(values), pairs, keep_rows=keep_rows)
        except RuntimeError as failed:
            error = failed
    linear = graph.linearize(values)
    blocks = covariance_blocks(linear, pairs, use_qr=True, keep_rows=keep_rows)
    # QR does not fail on an indeterminate graph, its covariances are not finite
    if not all(np.isfinite(cov).all() for cov in blocks.marginals.values()):
        raise error
    return blocks
