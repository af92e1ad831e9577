"""What two neighbouring scans say about the motion between them, beside odometry.

Wheels slip, counters are unsigned, clocks jump: then odometry is wrong by far more than its
covariance says, and the lines of the next scan are looked for in the wrong places. So every scan is
laid on the one before by the motion that odometry tells. Where that does not fit and another motion
does, odometry is contradicted: its covariance grows by the disagreement, and the scans' motion
with its own covariance is fused with it. Directions that the scans do not show (along a corridor)
stay odometry's.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from graphslam.core.config import ScanMatchingConfig
from graphslam.core.gaussian import chi2_quantile, mahalanobis_squared, symmetric, update
from graphslam.core.geometry import Array, rotation, wrap
from graphslam.core.records import Closure, Motion, Observation
from graphslam.perception.scan_matching import Submap, align, fit, make_submap, match

#: points of a scan at least, to say anything
FEWEST = 30
#: squared Mahalanobis distance, 3 dof: worth a closer look; a contradiction
LOOK, CONTRADICTED = chi2_quantile([0.9, 0.999], 3)
#: m, rad: smaller disagreements are left to the landmarks
SMALLEST_M, SMALLEST_RAD = 0.05, 0.03
#: m, rad: directions in which scans are less sure are left to odometry
SURE = 0.08
#: share of points that lie on the scan before: fewer are worth a closer look; at least at another
#: motion, and so many more than at odometry's
USUAL, FITS, BETTER = 0.6, 0.5, 0.05
#: m, rad: window searched beside twice the motion (an unsigned counter reports it reversed)
MARGIN = np.array([0.5, 0.5, 0.2])
#: m: no nearer to a line than this is what lies on no line
BESIDE_M = 0.1


def scan_submap(points: Array, config: ScanMatchingConfig | None = None) -> Submap | None:
    """The points (n, 2) of one scan, in the frame of its state; None where there are few."""
    if len(points) < FEWEST:
        return None
    return make_submap(np.zeros((1, 3)), [np.asarray(points, dtype=float)], config)


def checked_against_scans(motion: Motion, before: Submap, now: Submap) -> Motion:
    """The motion, or what scans make of it if they contradict it (``matched``).

    Args:
        motion: according to odometry.
        before: scan of the state where it starts, in that state's frame.
        now: scan of the state where it ends.
    """
    here, step, cov = fit(now, before, motion.delta)
    if here >= USUAL and mahalanobis_squared(step, motion.cov + cov) < LOOK:
        return motion
    guesses = [align(now, before, motion.delta)]
    if fit(now, before, guesses[0][0])[0] < max(FITS, here + BETTER):
        window = MARGIN + 2 * np.abs(motion.delta)
        found = match(now, before, motion.delta, window)
        guesses += [(m.pose, m.cov) for m in found]
    there, (pose, cov) = max(
        ((fit(now, before, pose)[0], (pose, cov)) for pose, cov in guesses), key=lambda g: g[0]
    )
    axes, variances = _measured_directions(cov)
    measured_off = axes.T @ _difference(pose, motion.delta)
    off = axes @ measured_off
    if (
        there < max(FITS, here + BETTER)
        or (np.hypot(off[0], off[1]) < SMALLEST_M and abs(off[2]) < SMALLEST_RAD)
        or mahalanobis_squared(off, motion.cov + cov) < CONTRADICTED
    ):
        return motion
    inflated = replace(motion, cov=motion.cov + np.outer(off, off))
    return fused(inflated, axes.T, np.diag(variances), measured_off)


def fused(motion: Motion, H: Array, R: Array, innovation: Array) -> Motion:
    """A motion after a measurement of it; calibration errors no longer explain what is left.

    Args:
        motion: the motion.
        H: (k, 3) the measured combinations of its components.
        R: (k, k) their covariance.
        innovation: (k,) measured minus the motion's.
    """
    delta, cov, _, _ = update(motion.delta, motion.cov, H, R, innovation)
    delta[2] = wrap(delta[2])
    D = np.zeros_like(motion.d_delta_d_calibration)
    return replace(motion, delta=delta, cov=symmetric(cov), d_delta_d_calibration=D, matched=True)


def _difference(a: Array, b: Array) -> Array:
    off = a - b
    off[2] = wrap(off[2])
    return np.asarray(off)


def _measured_directions(cov: Array) -> tuple[Array, Array]:
    """Axes (3, k) along which a sigma is below `SURE`, and the variances (k,) along them.

    The noise of points looks like a little structure, also along a corridor.
    """
    variances, axes = np.linalg.eigh(cov)
    match_off_lines = variances < SURE**2
    return axes[:, match_off_lines], variances[match_off_lines]


def match_off_lines(motion: Motion, before: Submap, robot: str, points: Array) -> Closure | None:
    """A second source of a motion: from points that lie on no line, so nothing counts twice.

    Args:
        motion: according to odometry, where the search begins.
        before: scan of the state where it starts, in that state's frame.
        robot: whose.
        points: (n, 2) of the scan where it ends, in that state's frame, see `points_off_lines`.
    """
    source = scan_submap(points, before.config)
    if source is None:
        return None
    pose, cov = align(source, before, motion.delta)
    if mahalanobis_squared(_difference(pose, motion.delta), motion.cov + cov) > CONTRADICTED:
        return None
    return Closure(robot, motion.end_ns, robot, motion.start_ns, pose, cov)


def points_off_lines(points: Array, seen: Sequence[Observation]) -> Array:
    """Those of the points (n, 2) that lie on none of the observed lines; both in one frame."""
    free = np.ones(len(points), dtype=np.bool_)
    for o in seen:
        if o.extent is None:
            continue
        back = rotation(-float(o.z[2]))
        x, y = back @ (points - o.z[:2]).T
        near = (x > o.extent[0] - BESIDE_M) & (x < o.extent[1] + BESIDE_M)
        free &= ~(near & (np.abs(y) < BESIDE_M))
    return points[free]
