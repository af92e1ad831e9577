"""Pairs of observations and landmarks around a robot, in its frame, and how far apart they are.

What `core.observation_models` says of each kind, for a robot at the origin and for all pairs of an
image at once. Lines and segments share what they have in common, which takes a third of the time.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from graphslam.core.arrays import BoolArray, IntArray
from graphslam.core.config import AssociationConfig
from graphslam.core.gaussian import mahalanobis_squared
from graphslam.core.geometry import Array, log_jacobian, wrap
from graphslam.core.observation_arrays import LINE, POINT, SEGMENT, ObservationArrays
from graphslam.core.observation_models import MODELS
from graphslam.mapping.gating import LENGTH_TOLERANCE_M, MAX_ANGLE_RAD


@dataclass(slots=True, eq=False)
class LocalPairs:
    """Candidate pairs (k,) of observation and landmark, by index, and how far apart they are.

    ``model`` (k,) code in `core.observation_arrays.KINDS`; ``flipped``: the observed line is turned
    by pi, as ``z`` (k, 3) is; ``residual`` (k, 3), ``H`` (k, 3, 3) by the landmark and ``noise``
    (k, 3, 3) count in the first `core.observation_arrays.ROWS`; the others are zero. ``d2`` are
    squared Mahalanobis distances, thesis 3.22.
    """

    observation: IntArray
    landmark: IntArray
    model: IntArray
    flipped: BoolArray
    z: Array
    residual: Array
    H: Array
    noise: Array
    d2: Array


class LocalLandmarks(NamedTuple):
    """Landmarks in the robot's frame: means (n, 3), covariances (n, 3, 3) and codes of kinds (n,).

    ``extent`` (n, 2): where each line begins and ends along its own x axis, m.
    """

    means: Array
    covs: Array
    kind: IntArray
    extent: Array


def candidate_pairs(
    image: ObservationArrays, landmarks: LocalLandmarks, floor: Array, config: AssociationConfig
) -> LocalPairs:
    """Pairs that pass the gates of distance, direction and overlap, sorted by observation.

    ``floor`` (3, 3, 3) is added to the innovations' covariances by the code of the model; it is
    positive in the rows that a model does not have.
    """
    means, covs, kind, extent = landmarks
    at = image.poses()
    of_point, is_point = image.kind == POINT, kind == POINT
    # the observed middles in the landmarks' frames
    c, s = np.cos(means[:, 2]), np.sin(means[:, 2])
    east, north = at[:, :1] - means[:, 0], at[:, 1:2] - means[:, 1]
    along, across = c * east + s * north, c * north - s * east
    turn = wrap(at[:, 2:] - means[:, 2])
    turned, flipped = turn, np.zeros(turn.shape, dtype=bool)
    if not config.directed:
        flipped = (np.abs(turn) > np.pi / 2) & ~of_point[:, None] & ~is_point
        turned = np.where(flipped, wrap(turn + np.pi), turn)
    stretch = np.cos(turn)
    ends = along + stretch * image.extent[:, :1], along + stretch * image.extent[:, 1:]
    gap = np.maximum(np.minimum(*ends) - extent[:, 1], extent[:, 0] - np.maximum(*ends))
    near = np.abs(across) < config.max_distance_m
    near &= np.abs(turned) < MAX_ANGLE_RAD
    own, known = np.diff(image.extent), np.diff(extent)[:, 0]
    near &= overlapping(gap, np.minimum(own, known), config)
    near &= ~of_point[:, None] & ~is_point
    if of_point.any():
        close = np.hypot(along, across) < config.max_distance_m
        near |= of_point[:, None] & is_point & close
    i, j = np.nonzero(near)
    whole = (image.kind[i] == SEGMENT) & (kind[j] == SEGMENT)
    whole &= np.abs(own[i, 0] - known[j]) < LENGTH_TOLERANCE_M
    model = np.where(of_point[i], POINT, np.where(whole, SEGMENT, LINE))
    turned_over, z = flipped[i, j], image.z[i]
    z[turned_over, 2] += np.pi
    r, H, R = compare(model, z, image.cov[i], means[j])
    d2 = mahalanobis_squared(r, H @ covs[j] @ H.mT + R + floor[model])
    return LocalPairs(i, j, model, turned_over, z, r, H, R, d2)


def overlapping(gap: Array, shorter: Array, config: AssociationConfig) -> BoolArray:
    """Whether what is seen may be of a known wall, by where both lie along it; shapes as given.

    A door leaf or a cabinet beside a wall stands a few centimetres out of its line, which far away
    and in a turn is less than the uncertainty. What they do not have is a part in common. That can
    be asked for where the landmarks are those of the last metres of path: after a loop a short wall
    may lie beside itself.

    Args:
        gap: m, between the two along the line; negative where they overlap.
        shorter: length of the shorter one, m; 0 where the ends of one are not known.
        config: gates.
    """
    shared = -gap >= config.overlap_ratio * shorter
    return np.where(shorter > 0.0, shared, gap < config.overlap_gap_m)


def compare(model: IntArray, z: Array, cov: Array, t: Array) -> tuple[Array, Array, Array]:
    """Residuals (k, 3), their derivatives (k, 3, 3) by the landmarks, and noise (k, 3, 3).

    Args:
        model: codes (k,).
        z: measurements (k, 3).
        cov: their covariances (k, 3, 3).
        t: landmarks (k, 3) in the robot's frame.
    """
    c, s, heading = np.cos(z[:, 2]), np.sin(z[:, 2]), z[:, 2]
    # the landmark in the measurement's frame; a line's measurement slides along to face it
    east, north = t[:, 0] - z[:, 0], t[:, 1] - z[:, 1]
    ahead = c * east + s * north
    is_line = model == LINE
    lever = np.where(is_line, ahead, 0.0)
    off = np.empty((len(z), 3))
    off[:, 0], off[:, 1], off[:, 2] = ahead - lever, c * north - s * east, wrap(t[:, 2] - heading)
    D = log_jacobian(off)
    a, half = D[:, 0, 0], D[:, 0, 1]
    r = np.empty((len(z), 3))
    r[:, 0], r[:, 1] = a * off[:, 0] + half * off[:, 1], a * off[:, 1] - half * off[:, 0]
    r[:, 2] = off[:, 2]
    # derivative by the landmark's position: that of the logarithm after turning into z's frame
    H = D
    H[:, 0, 0], H[:, 0, 1] = a * c - half * s, a * s + half * c
    H[:, 1, 0], H[:, 1, 1] = -H[:, 0, 1], H[:, 0, 0]
    R = _turned_back(cov, c, s)
    # the error of the direction moves the normal by the distance that the measurement slid
    R[:, 1] += lever[:, None] * R[:, 2]
    R[:, :, 1] += lever[:, None] * R[:, :, 2]
    if is_line.any():
        r[is_line, :2], H[is_line, :2] = r[is_line, 1:], H[is_line, 1:]
        R[is_line, :2, :2] = R[is_line, 1:, 1:]
        r[is_line, 2] = H[is_line, 2] = R[is_line, 2] = R[is_line, :, 2] = 0.0
    points = np.flatnonzero(model == POINT)
    if len(points):
        compared, x, at = MODELS["point"], np.zeros((len(points), 3)), t[points, :2]
        own, own_cov = z[points, :2], cov[points, :2, :2]
        r[points] = H[points] = R[points] = 0.0
        r[points, :2] = compared.residual(own, x, at)
        H[points, :2, :2] = compared.jacobians(own, x, at)[1]
        R[points, :2, :2] = compared.noise(own, own_cov, x, at)
    return r, H, R


def _turned_back(cov: Array, c: Array, s: Array) -> Array:
    """Covariances (k, 3, 3) along axes of cosine c and sine s (k,): `rotate_cov` by the opposite.

    Entry by entry: products of many small matrices take three times as long.
    """
    x, xy, y = cov[:, 0, 0], cov[:, 0, 1], cov[:, 1, 1]
    out = np.empty_like(cov)
    cc, ss, cs = c * c, s * s, c * s
    both = 2 * cs * xy
    out[:, 0, 0], out[:, 1, 1] = cc * x + both + ss * y, ss * x - both + cc * y
    out[:, 0, 1] = out[:, 1, 0] = cs * (y - x) + (cc - ss) * xy
    out[:, 0, 2] = out[:, 2, 0] = c * cov[:, 0, 2] + s * cov[:, 1, 2]
    out[:, 1, 2] = out[:, 2, 1] = c * cov[:, 1, 2] - s * cov[:, 0, 2]
    out[:, 2, 2] = cov[:, 2, 2]
    return out
