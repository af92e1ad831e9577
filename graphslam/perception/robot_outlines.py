"""Robots of known outline in a scan: their returns, their poses and covariances.

A robot stands free: a few consecutive returns, nearer than what is beside them. Its outline at a
pose predicts the range of every beam that hits it, and the directions of its two edges. The pose is
fitted to both by weighted least squares, as `cylinders` does with circles, so the covariance
depends on what is seen: one face gives the range, the two edges the bearing, two faces the heading.
Thesis 4.5 and 6.1.3 treat robots as objects like others.

Symbols: p = (x, y, phi) pose of the robot in the laser's frame, r range, a direction of a beam.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from graphslam.core.config import FrontEndConfig
from graphslam.core.geometry import Array, polar_points, rotation, unit_vectors, wrap
from graphslam.perception.beam_noise import range_variance
from graphslam.perception.ordered_scan import Indices, Mask, Sweep

#: m, beams, m: returns farther apart are not of one free-standing object: a distance, as many times
#: the distance between beams if that is more (a side at grazing incidence), and an upper limit
MIN_GAP_M, GAP_BEAMS, MAX_GAP_M = 0.25, 6.0, 0.5
#: fewest returns that a pose, and also a heading, is fitted to
MIN_RETURNS, MIN_RETURNS_FOR_HEADING = 3, 6
#: beams: sigma of an edge between two beams, as the last one may be a mixed pixel, and of the error
#: that both edges share; m: sigma of the first and the last range, which may be mixed pixels too
EDGE_BEAMS, COMMON_EDGE_BEAMS, MIXED_M = 1.0, 0.25, 0.15
#: significance of the chi-square test: clusters that fit worse than this share of robots are none
FIT_PROBABILITY = 0.001
#: least visible share of an outline's width
MIN_VISIBLE_SHARE = 0.5
#: rad: with a larger sigma the fit of a heading is not linear enough
MAX_HEADING_SIGMA_RAD = 0.1
#: Levenberg-Marquardt: iterations at most, decrease of chi-square below which it ends, step of the
#: difference quotients and largest step of an iteration (m, rad)
ITERATIONS, CONVERGED, DIFFERENCE_STEP, MAX_STEP = 8, 1e-3, 1e-4, 0.3
#: sides of the polygon that approximates a circle
ROUND_SIDES = 24


@dataclass(frozen=True, slots=True, eq=False)
class Clusters:
    """Free-standing objects in a scan: (m,) each, in the order of the beams.

    ``first`` and ``last`` row of `Sweep.points`, both included. ``unoccluded`` (m, 2): whether
    nothing nearer hides the right and the left end.
    """

    first: Indices
    last: Indices
    unoccluded: Mask

    def __len__(self) -> int:
        return len(self.first)


@dataclass(frozen=True, slots=True, eq=False)
class OutlineFit:
    """An outline fitted to a cluster.

    ``pose`` (3,) in the laser's frame, ``cov`` (3, 3) of it; ``heading_found``: whether the heading
    was fitted, else it is the expected one and ``cov`` includes its uncertainty. ``chi2`` of
    ranges and edges with ``dof``; ``share`` of the outline's width that is visible.
    """

    pose: Array
    cov: Array
    heading_found: bool
    chi2: float
    dof: int
    share: float

    @property
    def is_plausible(self) -> bool:
        """Whether the cluster can be the outline; a small part of one may be of anything."""
        limit = float(chdtri(max(self.dof, 1), FIT_PROBABILITY))
        return self.share > MIN_VISIBLE_SHARE and self.chi2 <= limit


@dataclass(frozen=True, slots=True, eq=False)
class _ClusterView:
    """A cluster: ranges ``r`` (n,) in directions ``a`` (n,), directions of its ``edges`` (2,).

    ``w`` (n + 2,): weights of ranges and edges, 0 for an occluded edge.
    """

    outline: Array
    a: Array
    r: Array
    edges: Array
    w: Array


def outline_of(corners: Sequence[Sequence[float]]) -> Array:
    """Corners (k, 2), m, base frame, of an outline as the configuration has it.

    One number alone is the radius of a circle about the base's origin.
    """
    if len(corners) == 1 and len(corners[0]) == 1:
        a = np.linspace(0.0, 2 * np.pi, ROUND_SIDES, endpoint=False)
        # the polygon has the circle's area: half of it lies outside
        radius = corners[0][0] * np.sqrt(2 * np.pi / ROUND_SIDES / np.sin(2 * np.pi / ROUND_SIDES))
        return np.asarray(radius * unit_vectors(a))
    return np.array(corners, dtype=float)


def outline_radius(outline: Array) -> float:
    """Largest distance of the outline (k, 2) from the base's origin, m."""
    return float(np.hypot(*outline.T).max())


def is_round(outline: Array) -> bool:
    """Whether an outline (k, 2) looks the same from all sides of the base's origin."""
    r = np.hypot(*outline.T)
    return bool(len(outline) >= ROUND_SIDES and r.max() - r.min() < 1e-6)


def free_standing_clusters(sweep: Sweep, widest_m: float) -> Clusters:
    """Free-standing objects no wider than ``widest_m``.

    On either side the next return is farther away, or nearer (it may then occlude a part), or there
    is none. At least one end is not occluded.
    """
    k = len(sweep.beam)
    if not k:
        none = np.zeros(0, dtype=np.intp)
        return Clusters(none, none, np.zeros((0, 2), dtype=np.bool_))
    x, y = sweep.points.T
    r = sweep.ranges[sweep.beam]
    step = np.hypot(x[1:] - x[:-1], y[1:] - y[:-1])
    near = np.minimum(r[1:], r[:-1])
    apart = np.clip(GAP_BEAMS * sweep.step_rad * near, MIN_GAP_M, MAX_GAP_M)
    new_scan = sweep.scan[1:] != sweep.scan[:-1]
    border = np.concatenate(([0], np.flatnonzero((step > apart) | new_scan) + 1, [k]))
    first, last = border[:-1], border[1:] - 1
    rise = np.concatenate(([np.inf], r[1:] - r[:-1], [-np.inf]))
    before, after = -rise[first], rise[last + 1]
    # what lies beyond the ends of a scan is unknown, unless beams there have no return
    begins, ends = np.append(True, new_scan)[first], np.append(new_scan, True)[last]
    stops = np.append(sweep.starts[1:], len(sweep.ranges)) - 1
    inside = sweep.beam[first] > sweep.starts[sweep.scan[first]]
    before[begins] = np.where(inside, np.inf, -np.inf)[begins]
    inside = sweep.beam[last] < stops[sweep.scan[last]]
    after[ends] = np.where(inside, np.inf, -np.inf)[ends]
    visible = np.array((before > 0, after > 0)).T
    width = np.hypot(x[last] - x[first], y[last] - y[first])
    keep = (width <= widest_m) & visible.any(axis=1)
    return Clusters(first[keep], last[keep], visible[keep])


def cluster_centres(sweep: Sweep, found: Clusters) -> Array:
    """Mean points (m, 2) of clusters, m, laser frame."""
    sums = np.concatenate([np.zeros((1, 2)), np.cumsum(sweep.points, axis=0)])
    count = (found.last - found.first + 1)[:, None]
    return np.asarray((sums[found.last + 1] - sums[found.first]) / count)


def expected_ranges(outline: Array, poses: Array, angles: Array) -> tuple[Array, Array]:
    """What a laser at the origin measures of an outline (k, 2), base frame, at m poses of the base.

    Returns:
        Ranges (m, n) of beams in directions ``angles`` (n,), for those that miss at the nearer
        edge, and the directions (m, 2) of both edges, right then left.
    """
    c, s = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
    X = poses[:, :1] + c * outline[:, 0] - s * outline[:, 1]
    Y = poses[:, 1:2] + s * outline[:, 0] + c * outline[:, 1]
    middle = np.arctan2(poses[:, 1:2], poses[:, :1])
    bearing = middle + wrap(np.arctan2(Y, X) - middle)
    edges = np.stack([bearing.min(axis=1), bearing.max(axis=1)], axis=1)
    inset = 1e-3 * (edges[:, 1] - edges[:, 0])
    a = edges[:, :1] + wrap(angles - edges[:, :1])
    a = np.clip(a, (edges[:, 0] + inset)[:, None], (edges[:, 1] - inset)[:, None])
    ca, sa = np.cos(a)[:, :, None], np.sin(a)[:, :, None]
    # coordinates of each corner across and along a beam; a side is hit where `across` changes sign
    across = ca * Y[:, None] - sa * X[:, None]
    along = ca * X[:, None] + sa * Y[:, None]
    across2, along2 = np.roll(across, -1, axis=2), np.roll(along, -1, axis=2)
    met = (across > 0) != (across2 > 0)
    gap = np.where(met, across - across2, 1.0)
    r = np.where(met, along + (along2 - along) * across / gap, np.inf)
    return r.min(axis=2), edges


def fit_outline(
    sweep: Sweep,
    first: int,
    last: int,
    unoccluded: Mask,
    outline: Array,
    expected: Array,
    heading_sigma: float,
    config: FrontEndConfig,
) -> OutlineFit:
    """The pose at which an outline (k, 2), base frame, fits a cluster best.

    The cluster reaches from row ``first`` of `Sweep.points` to row ``last``, inclusive;
    ``unoccluded`` (2,) tells whether its right and its left edge are visible. The ``expected`` pose
    (3,), laser frame, is only the initial value, except for a heading that the returns do not show;
    that one has ``heading_sigma``, rad.
    """
    beam = sweep.beam[first : last + 1]
    edges, sigma = _edges_seen(sweep, first, last)
    variance = range_variance(config, sweep.ranges[beam] ** 2)
    w = np.concatenate([np.broadcast_to(1 / variance, len(beam)), unoccluded * sigma**-2])
    w[[0, len(beam) - 1]] = MIXED_M**-2
    view = _ClusterView(outline, sweep.angles[beam], sweep.ranges[beam], edges, w)
    fixed = _levenberg_marquardt(_initial_pose(view, expected), 2, view)
    floor = _floor(fixed, outline, sweep.step_rad, config)
    dof = int(np.count_nonzero(view.w)) - 2
    if len(view.r) >= MIN_RETURNS_FOR_HEADING and not is_round(outline):
        turned = _levenberg_marquardt(fixed, 3, view)
        e, J = _linearise(turned, view)
        P = np.asarray(np.linalg.inv(J.T @ (view.w[:, None] * J) + np.eye(3)))
        # a heading far from the expected one may be that of another face
        off2 = float(wrap(turned[2] - expected[2])) ** 2
        if P[2, 2] < MAX_HEADING_SIGMA_RAD**2 and off2 < 9 * (heading_sigma**2 + P[2, 2]):
            chi2 = float(view.w @ e**2)
            return OutlineFit(turned, P + floor, True, chi2, dof - 1, _share(turned, view))
    e, J = _linearise(fixed, view)
    P = np.linalg.inv(J[:, :2].T @ (view.w[:, None] * J[:, :2]) + np.eye(2))
    # derivative of the position by the heading, which is the expected one
    lever = -P @ J[:, :2].T @ (view.w * J[:, 2])
    cov = np.diag([0.0, 0.0, heading_sigma**2])
    cov[:2, :2] = P + floor[:2, :2] + heading_sigma**2 * np.outer(lever, lever)
    return OutlineFit(fixed, cov, False, float(view.w @ e**2), dof, _share(fixed, view))


def _share(pose: Array, view: _ClusterView) -> float:
    """Share of the outline's width at a pose that the cluster covers."""
    _, sides = expected_ranges(view.outline, pose[None], view.a)
    return float(wrap(view.edges[1] - view.edges[0]) / (sides[0, 1] - sides[0, 0]))


def _floor(pose: Array, outline: Array, step_rad: float, config: FrontEndConfig) -> Array:
    """Covariance (3, 3) of errors that do not shrink with the number of returns.

    The outline is known, and its surface measured, to ``floor_normal_m``; its heading to that over
    its size. Mixed pixels shift both edges the same way, by a fraction of the beam spacing.
    """
    flat = config.floor_normal_m
    across = np.array([-pose[1], pose[0]]) * COMMON_EDGE_BEAMS * step_rad
    P = np.diag([flat, flat, 2 * flat / outline_radius(outline)]) ** 2
    P[:2, :2] += np.outer(across, across)
    return P


def _edges_seen(sweep: Sweep, first: int, last: int) -> tuple[Array, Array]:
    """Directions (2,) of a cluster's edges and their sigmas: between its last beam and the next.

    Where the next beam has no return, the edge may lie on either side of it.
    """
    out, sigma = np.zeros(2), np.zeros(2)
    known = np.isfinite(sweep.ranges)
    for k, (row, way) in enumerate(((first, -1), (last, 1))):
        beam = int(sweep.beam[row])
        beyond = beam + way
        while 0 <= beyond < len(known) and not known[beyond] and abs(beyond - beam) < 3:
            beyond += way
        apart = sweep.step_rad * max(abs(beyond - beam), 1)
        out[k] = sweep.angles[beam] + way * apart / 2
        sigma[k] = EDGE_BEAMS * apart
    return out, sigma


def _initial_pose(view: _ClusterView, expected: Array) -> Array:
    """The expected pose, translated so that the outline lies at the returns."""
    a, r, pose = view.a, view.r, expected.copy()
    seen = polar_points(r, a).mean(axis=0)
    pose[:2] = seen + outline_radius(view.outline) / 2 * seen / max(float(np.hypot(*seen)), 1e-6)
    for _ in range(2):
        _, edges = expected_ranges(view.outline, pose[None], a)
        turn = float(wrap((a[0] + a[-1]) / 2 - edges[0].mean()))
        pose[:2] = rotation(turn) @ pose[:2]
        miss = float(np.median(r - expected_ranges(view.outline, pose[None], a)[0][0]))
        pose[:2] += miss * unit_vectors(a[len(a) // 2])
    return pose


def _linearise(pose: Array, view: _ClusterView) -> tuple[Array, Array]:
    """Residuals (n + 2,), measured minus predicted; derivatives (n + 2, 3) of the prediction."""
    shifts = DIFFERENCE_STEP * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    h = np.concatenate(expected_ranges(view.outline, pose + shifts, view.a), axis=1)
    e = np.concatenate([view.r, view.edges]) - h[0]
    e[-2:] = wrap(e[-2:])
    return e, ((h[1:4] - h[4:7]) / (2 * DIFFERENCE_STEP)).T


def _levenberg_marquardt(pose: Array, free: int, view: _ClusterView) -> Array:
    """Levenberg-Marquardt over the first ``free`` parameters of the pose."""
    damping = 1e-3
    e, J = _linearise(pose, view)
    cost = float(view.w @ e**2)
    for _ in range(ITERATIONS):
        J = J[:, :free]
        N = J.T @ (view.w[:, None] * J)
        N += damping * np.diag(np.diag(N)) + 1e-6 * np.eye(free)
        trial = pose.copy()
        trial[:free] += np.clip(np.linalg.solve(N, J.T @ (view.w * e)), -MAX_STEP, MAX_STEP)
        new_e, new_J = _linearise(trial, view)
        less = cost - float(view.w @ new_e**2)
        if less < 0:
            damping = max(10 * damping, 1e-2)
            continue
        pose, e, J, cost, damping = trial, new_e, new_J, cost - less, damping / 10
        if less < CONVERGED:
            break
    return pose
