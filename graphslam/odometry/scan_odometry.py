"""Scan matching between consecutive keyframes: detects odometry errors and corrects them.

Wheels slip, counters are unsigned, clocks jump: then the odometry error is far larger than its
covariance, and the lines of the next scan are searched in the wrong places. So every scan is
compared with the previous one at the motion of the odometry. If they do not overlap there but do at
another motion, the covariance of the odometry is inflated by the disagreement, and the motion from
the scans is fused with it. Along directions that the scans do not determine (a corridor) the
motion remains that of the odometry.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from graphslam.core.arrays import BoolArray, IntArray
from graphslam.core.config import ScanMatchingConfig
from graphslam.core.gaussian import chi2_quantile, mahalanobis_squared, symmetric, update
from graphslam.core.geometry import Array, rotation, wrap
from graphslam.core.records import Closure, Contradiction, Motion, Observation
from graphslam.perception.scan_matching import (
    Submap,
    agreement,
    align,
    align_pairs,
    fits,
    make_submap,
    match_pairs,
    shares_on_others,
)
from graphslam.perception.scan_pairs import fit_pairs

#: scans with fewer points are not matched
MIN_POINTS = 30
#: squared Mahalanobis distance (90 and 99.9 %, 3 dof) between odometry and scans from which a
#: motion is searched for, and from which the scans contradict the odometry
SUSPECT_D2, CONTRADICTION_D2 = chi2_quantile([0.9, 0.999], 3)
#: largest sigma, m or rad, of a scan match along a direction in which it is used, in ``floor_m``
MAX_SIGMA_FLOORS = 4.0
#: share of points that lie on the previous scan: below the first a motion is searched for; one
#: that is found needs at least the second, and the third more than at the odometry's motion
USUAL_OVERLAP, MIN_OVERLAP, MIN_OVERLAP_GAIN = 0.6, 0.5, 0.05
#: share of the points of two scans that lie where the other one saw through, if a motion is wrong:
#: of Intel's corrected motions all but one have 0.02 and more, right ones of a laser of 60° have
#: none. And the share that is the same, if another one is right
DENIED, THE_SAME = 0.01, 0.85
#: points within so many cells of matched points of an observed line belong to it
LINE_CELLS = 2.0


def scan_submap(points: Array, config: ScanMatchingConfig | None = None) -> Submap | None:
    """The points (n, 2) of one scan, in the frame of its state; None where there are few."""
    if len(points) < MIN_POINTS:
        return None
    return make_submap(np.zeros((1, 3)), [np.asarray(points, dtype=float)], config)


def checked_against_scans(
    motion: Motion, before: Submap, now: Submap, *, has_paused: bool = False
) -> Motion:
    """The motion, corrected by scan matching if the scans contradict it; see `check_motions`."""
    return check_motions([motion], [before], [now], [has_paused])[0]


def check_motions(
    motions: Sequence[Motion],
    before: Sequence[Submap],
    now: Sequence[Submap],
    have_paused: Sequence[bool] = (),
) -> list[Motion]:
    """Motions, corrected by scan matching where the scans contradict them (``from_scans``).

    Scans of few points (`MIN_POINTS`) contradict nothing: half of them lie on another scan at some
    motion.

    Args:
        motions: according to odometry.
        before: scans of the states where they start, in these states' frames.
        now: scans of the states where they end.
        have_paused: whether the laser has, between the two; without, it never has.
    """
    have_paused = have_paused or [False] * len(motions)
    here, steps, covs = fits(now, before, [m.delta for m in motions])
    checked = list(motions)
    left = [
        k
        for k, motion in enumerate(motions)
        if is_suspect(float(here[k]), steps[k], motion.cov + covs[k])
        and min(len(before[k].points), len(now[k].points)) >= MIN_POINTS
    ]
    some = [motions[k] for k in left], [before[k] for k in left], [now[k] for k in left]
    for k, match in zip(left, match_motions(*some, here[left]), strict=True):
        if match is not None:
            motion = _corrected(motions[k], match.pose, match.cov, before[0].config)
            ends = now[k], before[k], motions[k].delta, match.pose
            if not match.searched or is_denied(*ends, has_paused=have_paused[k]):
                checked[k] = motion
    return checked


class ScanMatch(NamedTuple):
    """Pose (3,) of a scan seen from the one before, and its cov (3, 3).

    ``searched``: it was found in a wide window, not near the motion of the odometry.
    """

    pose: Array
    cov: Array
    searched: bool


def is_denied(
    now: Submap, before: Submap, delta: Array, other: Array, *, has_paused: bool = False
) -> bool:
    """Whether scans deny a motion (3,) where they lie better on each other at one far off (3,).

    They do if each sees through what the other saw, or if nearly all of them is the same at the
    other motion. Where a laser sees a narrow part and turns, much of a scan is out of sight of the
    other, and a wrong motion may lay more of it onto that than the right one.

    If the laser ``has_paused``, the robot may have driven to where nothing is as before, or through
    a corridor that looks like itself at any motion, none at all included. So the other motion is
    right only if the scans do not see through each other there.
    """
    _, through = agreement(now, before, delta)
    same, elsewhere = agreement(now, before, other)
    if has_paused and elsewhere >= DENIED:
        return False
    return through >= DENIED or same >= THE_SAME


def match_motions(
    motions: Sequence[Motion], before: Sequence[Submap], now: Sequence[Submap], overlap: Array
) -> list[ScanMatch | None]:
    """What scans say of motions; None where they do not match.

    Arguments are those of `check_motions`; ``overlap`` (n,) is the share of points of ``now`` on
    ``before`` at the motion: a match has more.
    """
    if not motions:
        return []
    config = before[0].config
    poses, covs, _ = align_pairs(now, before, [motion.delta for motion in motions])
    shares = shares_on_others(now, before, poses)
    needed = np.maximum(MIN_OVERLAP, overlap + MIN_OVERLAP_GAIN)
    found = [[(s, ScanMatch(p, c, False))] for s, p, c in zip(shares, poses, covs, strict=True)]
    lost = np.flatnonzero(shares < needed).tolist()
    window = np.array([config.search_m, config.search_m, config.search_rad])
    matches = match_pairs(
        [now[k] for k in lost],
        [before[k] for k in lost],
        [motions[k].delta for k in lost],
        # an unsigned counter reports the reverse of a motion
        [window + 2 * np.abs(motions[k].delta) for k in lost],
    )
    for k, own in zip(lost, matches, strict=True):
        at = np.array([m.pose for m in own]).reshape(-1, 3)
        again = shares_on_others([now[k]] * len(own), [before[k]] * len(own), at)
        found[k] += [
            (share, ScanMatch(m.pose, m.cov, True)) for share, m in zip(again, own, strict=True)
        ]
    best = [max(candidates, key=lambda one: one[0]) for candidates in found]
    return [
        match if share >= least else None
        for (share, match), least in zip(best, needed, strict=True)
    ]


def _corrected(motion: Motion, pose: Array, cov: Array, config: ScanMatchingConfig) -> Motion:
    """The motion, fused with the pose (3,) from scans and its cov (3, 3) if that contradicts it."""
    axes, variances = _measured_directions(cov, MAX_SIGMA_FLOORS * config.floor_m)
    measured_off = axes.T @ _difference(pose, motion.delta)
    off = axes @ measured_off
    is_small = (
        np.hypot(off[0], off[1]) < config.contradiction_m and abs(off[2]) < config.contradiction_rad
    )
    if is_small or mahalanobis_squared(off, motion.cov + cov) < CONTRADICTION_D2:
        return motion
    inflated = replace(motion, cov=motion.cov + np.outer(off, off))
    corrected = fused(inflated, axes.T, np.diag(variances), measured_off)
    information = (axes / variances) @ axes.T
    return replace(corrected, contradiction=Contradiction(motion, pose, information))


def is_suspect(share: float, step: Array, cov: Array) -> bool:
    """Whether a motion has to be searched for, by how the scans at its ends lie on each other.

    ``share`` of points on others; the step (3,) to where they lie best, with covariance (3, 3).
    """
    return share < USUAL_OVERLAP or bool(mahalanobis_squared(step, cov) >= SUSPECT_D2)


def suspect_motions(
    motions: Sequence[Motion],
    clouds: Sequence[Array],
    before: IntArray,
    now: IntArray,
    config: ScanMatchingConfig,
) -> tuple[BoolArray, Array]:
    """Which motions (n,) between consecutive scans `check_motions` has to look at.

    Also the share (n,) of the points of each later scan that lie on the earlier one.

    Args:
        motions: according to odometry.
        clouds: points (k, 2) of scans in the frames of their states, in the order of the beams.
        before: (n,) numbers of the scans where the motions start.
        now: (n,) and where they end.
        config: noise and reach.
    """
    if not motions:
        return np.zeros(0, dtype=np.bool_), np.zeros(0)
    delta = np.array([m.delta for m in motions])
    found = fit_pairs(clouds, before, now, delta, config)
    cov = np.array([m.cov for m in motions]) + found.cov
    off = mahalanobis_squared(found.step, cov) >= SUSPECT_D2
    return np.asarray((found.share < USUAL_OVERLAP) | off), found.share


def fused(motion: Motion, H: Array, R: Array, innovation: Array) -> Motion:
    """A motion updated by a measurement; its error no longer depends on the calibration.

    Args:
        motion: the motion.
        H: (k, 3) the measured combinations of its components.
        R: (k, k) their covariance.
        innovation: (k,) measured minus the motion's.
    """
    delta, cov, _, _ = update(motion.delta, motion.cov, H, R, innovation)
    delta[2] = wrap(delta[2])
    D = np.zeros_like(motion.d_delta_d_calibration)
    return replace(
        motion, delta=delta, cov=symmetric(cov), d_delta_d_calibration=D, from_scans=True
    )


def _difference(a: Array, b: Array) -> Array:
    off = a - b
    off[2] = wrap(off[2])
    return np.asarray(off)


def _measured_directions(cov: Array, max_sigma: float) -> tuple[Array, Array]:
    """Axes (3, k) along which the sigma is below ``max_sigma``, and the variances (k,) along them.

    Without the limit the noise of points would count as structure, even along a corridor.
    """
    variances, axes = np.linalg.eigh(cov)
    measured = variances < max_sigma**2
    return axes[:, measured], variances[measured]


def match_off_lines(motion: Motion, before: Submap, robot: str, points: Array) -> Closure | None:
    """A second measurement of a motion, from points on no line, so no information counts twice.

    Args:
        motion: according to odometry, where the search begins.
        before: scan of the state where it starts, in that state's frame.
        robot: its name.
        points: (n, 2) of the scan where it ends, in that state's frame, see `points_off_lines`.
    """
    source = scan_submap(points, before.config)
    if source is None:
        return None
    pose, cov = align(source, before, motion.delta)
    if mahalanobis_squared(_difference(pose, motion.delta), motion.cov + cov) > CONTRADICTION_D2:
        return None
    return Closure(robot, motion.end_ns, robot, motion.start_ns, pose, cov)


def points_off_lines(
    points: Array, seen: Sequence[Observation], config: ScanMatchingConfig
) -> Array:
    """Those of the points (n, 2) that lie on none of the observed lines; both in one frame."""
    margin_m = LINE_CELLS * config.cell_m
    free = np.ones(len(points), dtype=np.bool_)
    for o in seen:
        if o.extent is None:
            continue
        back = rotation(-float(o.z[2]))
        x, y = back @ (points - o.z[:2]).T
        near = (x > o.extent[0] - margin_m) & (x < o.extent[1] + margin_m)
        free &= ~(near & (np.abs(y) < margin_m))
    return points[free]
