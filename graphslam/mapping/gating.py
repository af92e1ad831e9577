"""Gating and assignment of observations to landmarks.

Thesis 3.21-3.25 (a variant of the nearest neighbour standard filter) and section 4.6 (new objects
between two thresholds). Pure functions on arrays: `candidate_pairs` applies the gates that need no
covariance, `compare` computes Mahalanobis distances, `assign` chooses pairs.
"""

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from graphslam.core.arrays import BoolArray, IntArray
from graphslam.core.assignment import cheapest_assignment
from graphslam.core.config import AssociationConfig
from graphslam.core.gaussian import chi2_quantile, mahalanobis_squared
from graphslam.core.geometry import Array, between, compose, rotate_cov, wrap
from graphslam.core.observation_models import MODELS
from graphslam.core.record import replace
from graphslam.core.records import Observation

#: rad: lines that differ more in direction are never compared, however uncertain the heading
MAX_ANGLE_RAD = 0.6
#: m, rad: typical distance of a correct pair, to rank pairs before covariances are read
TYPICAL_M, TYPICAL_RAD = 0.1, 0.05
#: m: two observations of a whole segment agree in length within this; else only the line is used
LENGTH_TOLERANCE_M = 0.15
#: m: sigma of a position that counts as determined; walls that differ by 5° just miss it
MAX_POSITION_SIGMA_M = 0.2
#: models of walls
WALLS = ("line", "segment")


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """Candidate pairs (k,) of observation and landmark that passed the cheap gates.

    ``model`` names the row of `MODELS` per pair; ``flipped``: the measured direction is
    turned by pi before it is compared (eq. 3.24). ``rough_distance`` is one without
    covariance, in units of `TYPICAL_M` and `TYPICAL_RAD`.
    """

    observation: IntArray
    landmark: IntArray
    model: tuple[str, ...]
    flipped: BoolArray
    rough_distance: Array

    def joined(self, more: "Pairs") -> "Pairs":
        """These pairs and then ``more``."""
        return Pairs(
            np.append(self.observation, more.observation),
            np.append(self.landmark, more.landmark),
            self.model + more.model,
            np.append(self.flipped, more.flipped),
            np.append(self.rough_distance, more.rough_distance),
        )

    def only(self, keep: BoolArray) -> "Pairs":
        """The pairs for which ``keep`` (k,) holds."""
        models = tuple(m for m, k in zip(self.model, keep, strict=True) if k)
        return Pairs(
            self.observation[keep],
            self.landmark[keep],
            models,
            self.flipped[keep],
            self.rough_distance[keep],
        )


@dataclass(frozen=True, slots=True, eq=False)
class PairDistances:
    """Squared Mahalanobis distances (k,) of pairs, with what a joint test needs.

    ``residuals``, their covariances ``cov``, ``H_x`` and ``H_t`` hold one array per pair;
    ``cov_without_floor`` is ``cov`` without the floor of the gates.
    """

    d2: Array
    dof: IntArray
    residuals: tuple[Array, ...]
    cov: tuple[Array, ...]
    H_x: tuple[Array, ...]
    H_t: tuple[Array, ...]
    noise: tuple[Array, ...]
    cov_without_floor: tuple[Array, ...]


def gate_distance(probability: float, dof: IntArray | int) -> Array:
    """Chi-square gates on d² (eq. 3.25), shaped like ``dof`` (0-d or (k,)), which is 1 to 9."""
    return np.asarray(_quantiles(probability)[np.asarray(dof) - 1])


def gate_floor(config: AssociationConfig) -> dict[str, Array]:
    """Model -> covariance (k, k) added to that of a measurement for gates; walls: `wall_floors`."""
    m2, rad2 = config.floor_m**2, config.floor_rad**2
    polar, pose = np.diag([rad2, m2]), np.diag([m2, m2, rad2])
    return {
        "line": np.diag([0.0, m2, rad2]),
        "point": polar,
        "segment": pose,
        "robot-point": polar,
        "robot-pose": pose,
    }


def wall_floors(floor: Array, z: Array) -> Array:
    """Covariances (n, 3, 3) added to those of walls ``z`` (n, 3), seen from the robot, for gates.

    ``floor`` (3, 3) is along each one's own axes, where it passes the robot: directions are off as
    the robot's is, so walls turn about it. At the origin of a landmark, which may be metres away
    along the wall, a door a decimetre behind it would hide in the error of its direction. Where the
    wall is seen, one that is seen metres ahead would be refused where the odometry turned too far.
    """
    c, s = np.cos(z[:, 2]), np.sin(z[:, 2])
    J = np.tile(np.eye(3), (len(z), 1, 1))
    J[:, 1, 2] = c * z[:, 0] + s * z[:, 1]  # along the wall, from where it passes the robot
    return rotate_cov(J @ floor @ J.mT, z[:, 2])


@functools.cache
def _quantiles(probability: float) -> Array:
    """Chi-square quantiles (9,) of 1 to 9 degrees of freedom."""
    return np.asarray(chi2_quantile(probability, range(1, 10)))


def flip(seen: Observation) -> Observation:
    """The same line described in the opposite direction."""
    assert seen.extent is not None
    z = np.array([seen.z[0], seen.z[1], wrap(seen.z[2] + np.pi)])
    return replace(seen, z=z, extent=-seen.extent[::-1])


def candidate_pairs(
    seen: Sequence[Observation],
    pose: Array,
    means: Array,
    extents: Array,
    is_point: BoolArray,
    whole: BoolArray,
    config: AssociationConfig,
) -> Pairs:
    """Pairs that pass the gates that need no covariance: distance, direction, overlap.

    They are sorted by observation.

    Args:
        seen: n observations in the robot's base frame.
        pose: predicted pose (3,) of the robot, world frame.
        means: landmarks (m, 3), world frame; the heading of points is ignored.
        extents: (m, 2) where each line begins and ends along its own x axis, m.
        is_point: (m,) points rather than lines.
        whole: (m,) segments whose both ends are known.
        config: gates.
    """
    if not len(seen) or not len(means):
        nothing = np.zeros(0, np.int64)
        return Pairs(nothing, nothing, (), np.zeros(0, bool), np.zeros(0))
    points = np.array([o.kind == "point" for o in seen])
    world = np.zeros((len(seen), 3))
    ends = np.zeros((len(seen), 2))
    for n, o in enumerate(seen):
        if points[n]:
            world[n, :2] = MODELS["point"].invert(o.z, pose)
        else:
            world[n] = compose(pose, o.z)
            ends[n] = o.extent if o.extent is not None else 0.0
    both_points = points[:, None] & is_point[None]
    both_lines = ~points[:, None] & ~is_point[None]
    # the landmark's origin and direction as seen from each observation
    relative = between(world[:, None], means[None])
    turned = wrap(relative[..., 2])
    flipped = np.zeros_like(turned, dtype=bool)
    if not config.directed:
        flipped = both_lines & (np.abs(turned) > np.pi / 2)
        turned = np.where(flipped, wrap(turned + np.pi), turned)
    # the observed middle in the landmark's frame: along the line, and its distance from it
    middle = between(means[None], world[:, None])
    begin = middle[..., 0] + np.cos(middle[..., 2]) * ends[:, None, 0]
    end = middle[..., 0] + np.cos(middle[..., 2]) * ends[:, None, 1]
    begin, end = np.minimum(begin, end), np.maximum(begin, end)
    gap = np.maximum(begin - extents[None, :, 1], extents[None, :, 0] - end)
    near = np.hypot(middle[..., 0], middle[..., 1]) < config.max_distance_m
    as_printed = config.nearness == "middle"
    line_ok = near & (np.abs(turned) < np.pi / 2)
    if not as_printed:
        line_ok = (
            (np.abs(middle[..., 1]) < config.max_distance_m)
            & (np.abs(turned) < MAX_ANGLE_RAD)
            & (gap < config.overlap_gap_m)
        )
    i, j = np.nonzero((both_points & near) | (both_lines & line_ok))
    length = ends[:, 1] - ends[:, 0]
    known = extents[:, 1] - extents[:, 0]
    models = tuple(
        "point"
        if points[a]
        else "segment"
        if seen[a].kind == "segment"
        and whole[b]
        and (as_printed or abs(length[a] - known[b]) < LENGTH_TOLERANCE_M)
        else "line"
        for a, b in zip(i.tolist(), j.tolist(), strict=True)
    )
    across, turn = middle[i, j, 1] / TYPICAL_M, turned[i, j] / TYPICAL_RAD
    apart = np.hypot(middle[i, j, 0], middle[i, j, 1]) / TYPICAL_M
    miss = np.where(is_point[j], apart, np.hypot(across, turn))
    return Pairs(i.astype(np.int64), j.astype(np.int64), models, flipped[i, j], miss)


def compare(
    seen: Sequence[Observation],
    pairs: Pairs,
    pose: Array,
    states: Array,
    P_xx: Array,
    P_xt: Array,
    P_tt: Array,
    floor: Mapping[str, Array],
) -> PairDistances:
    """Squared Mahalanobis distance of each pair, eq. 3.22, vectorised over pairs of one model.

    Args:
        seen: observations in the base frame.
        pairs: k candidate pairs.
        pose: predicted pose (3,).
        states: landmark estimate (k, 3) of each pair; the third entry of a point is not used.
        P_xx: covariance (k, 3, 3) of the pose; all three along world axes.
        P_xt: (k, 3, 3) cross covariance with the landmark, points padded with zeros.
        P_tt: (k, 3, 3) of the landmark, likewise.
        floor: model name -> covariance (k, k) added to that of every measurement for what the
            models leave out (walls that are not flat, inexact stamps), see `gate_floor`. It widens
            the gates and never enters the estimate.
    """
    k = len(pairs.observation)
    d2, dof = np.full(k, np.inf), np.zeros(k, dtype=np.int64)
    residuals: list[Array] = [np.zeros(0)] * k
    H_xs: list[Array] = [np.zeros((0, 3))] * k
    H_ts: list[Array] = [np.zeros((0, 3))] * k
    noises: list[Array] = [np.zeros((0, 0))] * k
    covs: list[Array] = [np.zeros((0, 0))] * k
    covs_without: list[Array] = [np.zeros((0, 0))] * k
    both = zip(pairs.observation, pairs.flipped, strict=True)
    oriented = [flip(seen[i]) if flipped else seen[i] for i, flipped in both]
    for name in sorted(set(pairs.model)):
        model = MODELS[name]
        which = np.array([n for n, m in enumerate(pairs.model) if m == name])
        z = np.array([oriented[n].z for n in which])
        cov = np.array([oriented[n].cov for n in which])
        t = states[which][:, : model.dim]
        x = np.broadcast_to(pose, (len(which), 3))
        r = model.residual(z, x, t)
        more = wall_floors(floor[name], z) if name in WALLS else floor[name]
        R, without = model.noise(z, cov + more, x, t), model.noise(z, cov, x, t)
        H_x, H_t = model.jacobians(z, x, t)
        tt, xt = P_tt[which][:, : model.dim, : model.dim], P_xt[which][:, :, : model.dim]
        cross = H_x @ xt @ H_t.mT
        P = H_x @ P_xx[which] @ H_x.mT + cross + cross.mT + H_t @ tt @ H_t.mT
        S, own = P + R, P + without
        d2[which] = mahalanobis_squared(r, S)
        dof[which] = model.rows
        for place, n in enumerate(which):
            residuals[n], covs[n], noises[n] = r[place], S[place], R[place]
            covs_without[n] = own[place]
            H_xs[n], H_ts[n] = H_x[place], H_t[place]
    return PairDistances(
        d2, dof, tuple(residuals), tuple(covs), tuple(H_xs), tuple(H_ts), tuple(noises),
        tuple(covs_without),
    )  # fmt: skip


def assign(cost: Array, gate: Array, method: str) -> list[tuple[int, int]]:
    """One-to-one assignment of observations (rows) to landmarks (columns).

    Args:
        cost: squared distances (n, m), inf where a pair is impossible.
        gate: largest acceptable cost per pair (n, m).
        method: `optimal` minimises the sum of costs, leaving a row alone costing its gate (the
            NNSF of thesis 3.21); `greedy` takes the smallest element, strikes its row and column,
            and repeats (the thesis' fast variant).

    Returns:
        Pairs (row, column), sorted by row.
    """
    allowed = np.where(cost < gate, cost, np.inf)
    m = allowed.shape[1]
    possible = np.flatnonzero(np.isfinite(allowed).any(axis=1))
    if not len(possible):
        return []
    best = allowed[possible].argmin(axis=1).tolist()
    if len(set(best)) == len(best):  # no two rows want the same column: both methods find this
        return list(zip(possible.tolist(), best, strict=True))
    if method == "greedy":
        found = []
        while np.isfinite(allowed).any():
            i, j = divmod(int(np.argmin(allowed)), m)
            found.append((i, j))
            allowed[i, :] = allowed[:, j] = np.inf
        return sorted(found)
    alone = np.where(np.isfinite(allowed), gate, 0.0).max(axis=1)
    rows, columns = cheapest_assignment(allowed, alone)
    return list(zip(rows.tolist(), columns.tolist(), strict=True))


def jointly_compatible(
    compared: PairDistances,
    chosen: Sequence[int],
    slices: Sequence[slice],
    P: Array,
    probability: float,
) -> bool:
    """Whether several pairs are jointly compatible, by the covariance of their stacked innovation.

    Individually compatible pairs may contradict each other; false closures usually do. (J. Neira,
    J. Tardós, joint compatibility, DOI 10.1109/70.976019.)

    ``slices`` are, for each chosen pair, where its landmark lies in the joint covariance ``P``
    (D, D), pose first; ``probability`` is that of the chi-square gate.
    """
    r = np.concatenate([compared.residuals[k] for k in chosen])
    R = block_diag(*(compared.noise[k] for k in chosen))
    H = np.zeros((len(r), len(P)))
    row = 0
    for k, where in zip(chosen, slices, strict=True):
        rows = slice(row, row + len(compared.residuals[k]))
        H[rows, :3], H[rows, where] = compared.H_x[k], compared.H_t[k]
        row = rows.stop
    d2 = float(mahalanobis_squared(r, H @ P @ H.T + R))
    return d2 < float(chi2_quantile(probability, len(r)))


def fixes_pose(compared: PairDistances, chosen: Sequence[int]) -> bool:
    """Whether the chosen pairs determine the robot's whole pose.

    Parallel walls, or a single point, leave a direction open. By the information of the pairs alone
    the position must be known to better than `MAX_POSITION_SIGMA_M` in its weakest direction.
    """
    info = np.zeros((3, 3))
    for k in chosen:
        H = compared.H_x[k]
        info += H.T @ np.linalg.solve(compared.noise[k], H)
    position = info[:2, :2] - np.outer(info[:2, 2], info[2, :2]) / max(info[2, 2], 1e-12)
    return bool(np.linalg.eigvalsh(position)[0] > MAX_POSITION_SIGMA_M**-2)
