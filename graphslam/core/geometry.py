"""Planar rigid-body geometry on plain arrays.

A pose is an array ``(..., 3)`` of x in metres, y in metres and heading in radians
(counter-clockwise, x forward, y to the left). ``compose(a, b)`` is the pose ``b``, given in the
frame of ``a``, expressed in the frame that ``a`` is given in. Functions broadcast over leading
axes unless they say otherwise. GTSAM's objects never appear here.
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def wrap(angle_rad: ArrayLike) -> Array:
    """Angles (...,) in [-pi, pi), rad: the one place where angles are wrapped.

    An angle inside is returned unchanged: adding and subtracting pi would lose turns below 4e-16
    rad.
    """
    angle = np.asarray(angle_rad, dtype=float)
    return np.asarray(angle - 2 * np.pi * np.floor((angle + np.pi) / (2 * np.pi)))


def _wrap(angle_rad: float) -> float:
    """`wrap` of one angle."""
    if not math.isfinite(angle_rad):
        return math.nan
    return angle_rad - 2 * math.pi * math.floor((angle_rad + math.pi) / (2 * math.pi))


def _stacked(x: Array, y: Array, turn: Array) -> Array:
    """Poses (..., 3) of their entries (...,); NumPy's `stack` takes five times as long for few."""
    out = np.empty((*x.shape, 3))
    out[..., 0], out[..., 1], out[..., 2] = x, y, turn
    return out


def rotation(angle_rad: float) -> Array:
    """Rotation matrix ``(2, 2)`` that turns vectors counter-clockwise by ``angle_rad``."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s], [s, c]])


def rotation3(angle_rad: ArrayLike) -> Array:
    """``blockdiag(rotation(angle), 1)`` ``(..., 3, 3)``: the thesis' M(-angle), local to global."""
    angle = np.asarray(angle_rad, dtype=float)
    c, s = np.cos(angle), np.sin(angle)
    M = np.zeros((*angle.shape, 3, 3))
    M[..., 0, 0] = M[..., 1, 1] = c
    M[..., 0, 1], M[..., 1, 0] = -s, s
    M[..., 2, 2] = 1.0
    return M


def compose(a: Array, b: Array) -> Array:
    """``a`` followed by ``b`` given in the frame of ``a``: poses ``(..., 3)``, thesis eq. 4.4."""
    a, b = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    if a.ndim == b.ndim == 1:  # one pose: most calls, and operations on small arrays are slow
        (ax, ay, at), (bx, by, bt) = a.tolist(), b.tolist()
        cos, sin = math.cos(at), math.sin(at)
        return np.array([ax + cos * bx - sin * by, ay + sin * bx + cos * by, _wrap(at + bt)])
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    return _stacked(
        a[..., 0] + c * b[..., 0] - s * b[..., 1],
        a[..., 1] + s * b[..., 0] + c * b[..., 1],
        wrap(a[..., 2] + b[..., 2]),
    )


def inverse(a: Array) -> Array:
    """Inverse poses ``(..., 3)``: where the reference frame is, seen from ``a``."""
    a = np.asarray(a, dtype=float)
    if a.ndim == 1:  # as in `compose`
        x, y, turn = a.tolist()
        cos, sin = math.cos(turn), math.sin(turn)
        return np.array([-cos * x - sin * y, sin * x - cos * y, _wrap(-turn)])
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    return _stacked(-c * a[..., 0] - s * a[..., 1], s * a[..., 0] - c * a[..., 1], wrap(-a[..., 2]))


def between(a: Array, b: Array) -> Array:
    """Pose ``b`` seen from ``a``, both (..., 3): thesis eq. 4.18 without noise.

    ``compose(a, between(a, b))`` is ``b``.
    """
    # the difference first: two equal poses give exactly zero, wherever they are
    a, b = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    if a.ndim == b.ndim == 1:  # as in `compose`
        (ax, ay, at), (bx, by, bt) = a.tolist(), b.tolist()
        cos, sin = math.cos(at), math.sin(at)
        east, north = bx - ax, by - ay
        return np.array([cos * east + sin * north, -sin * east + cos * north, _wrap(bt - at)])
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    dx, dy = b[..., 0] - a[..., 0], b[..., 1] - a[..., 1]
    return _stacked(c * dx + s * dy, -s * dx + c * dy, wrap(b[..., 2] - a[..., 2]))


def transform(pose: Array, points: Array) -> Array:
    """Points ``(n, 2)`` in the frame of ``pose`` (3,), expressed in the pose's reference frame."""
    return np.asarray(points @ rotation(pose[2]).T + pose[:2])


def transform_each(poses: Array, points: Array) -> Array:
    """Points (n, 2), each in the frame of its own pose (n, 3), in the poses' reference frame."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    x, y = points[:, 0], points[:, 1]
    return np.column_stack([c * x - s * y + poses[:, 0], s * x + c * y + poses[:, 1]])


def unit_vectors(angle_rad: ArrayLike) -> Array:
    """Vectors (..., 2) of length 1 in directions (...,)."""
    return np.stack([np.cos(angle_rad), np.sin(angle_rad)], axis=-1)


def polar_points(range_m: Array, bearing_rad: Array) -> Array:
    """Points (..., 2), m, at ranges and bearings (...,) from the origin."""
    return np.asarray(range_m[..., None] * unit_vectors(bearing_rad))


def area_centroid(polygon: Array) -> Array:
    """Centroid (2,) of the area that a simple polygon (n, 2) encloses, in either sense of turning.

    Unlike the mean of the corners it does not move when an edge is divided, and unlike the middle
    of the bounding box it turns with the polygon. Of a polygon without area: the mean of its
    corners. Source: P. Bourke, Calculating the area and centroid of a polygon, 1988.
    """
    middle = polygon.mean(axis=0)
    a = polygon - middle  # far from the origin the differences would lose their digits
    b = np.roll(a, -1, axis=0)
    twice = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    area = twice.sum()
    if abs(area) <= 1e-12 * max(float((a * a).sum()), 1e-300):
        return np.asarray(middle)
    return np.asarray(middle + ((a + b) * twice[:, None]).sum(axis=0) / (3.0 * area))


def chained(moved: Array) -> Array:
    """Poses (n + 1, 3) along motions (n, 3), each in the frame of the pose before, from zero on."""
    headings = np.append(0.0, np.cumsum(moved[:, 2]))
    c, s = np.cos(headings[:-1]), np.sin(headings[:-1])
    steps = np.column_stack([c * moved[:, 0] - s * moved[:, 1], s * moved[:, 0] + c * moved[:, 1]])
    places = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    return np.column_stack([places, wrap(headings)])


def path_length(points: Array) -> Array:
    """Length (n,), m, of the path through points or poses (n, 2 or 3) up to each of them."""
    x, y = (points[1:] - points[:-1])[:, :2].T
    return np.concatenate([[0.0], np.cumsum(np.hypot(x, y))])


def _sinc(phi: float) -> float:
    """``sin(phi)/phi``, 1 at zero."""
    if not math.isfinite(phi):
        return math.nan
    return math.sin(phi) / phi if phi else 1.0


def _sinc_terms(phi: Array) -> tuple[Array, Array]:
    """``sin(phi)/phi`` and ``(1 - cos phi)/phi`` (...,) without cancellation near zero.

    sin phi = 2 sin(phi/2) cos(phi/2) and 1 - cos phi = 2 sin²(phi/2), so both are exact to
    rounding: sinc(phi/2) cos(phi/2) and phi/2 sinc²(phi/2).
    """
    half = _sincs(phi / 2)
    return np.asarray(half * np.cos(phi / 2)), np.asarray(0.5 * phi * half * half)


def _sincs(phi: Array) -> Array:
    """`_sinc` of many angles (...,); NumPy's own takes twice as long for few."""
    return np.divide(np.sin(phi), phi, out=np.ones_like(phi), where=phi != 0)


def exp(twist: Array) -> Array:
    """Exponential map of SE(2): twist ``(..., 3)`` (v_x, v_y, omega) over unit time to a pose."""
    twist = np.asarray(twist, dtype=float)
    if twist.ndim == 1:  # as in `compose`
        vx, vy, phi = twist.tolist()
        half = _sinc(phi / 2)
        sinc = half * math.cos(phi / 2) if math.isfinite(phi) else math.nan
        rise = 0.5 * phi * half * half
        return np.array([sinc * vx - rise * vy, rise * vx + sinc * vy, _wrap(phi)])
    a, b = _sinc_terms(twist[..., 2])
    x, y = twist[..., 0], twist[..., 1]
    return _stacked(a * x - b * y, b * x + a * y, wrap(twist[..., 2]))


def log(pose: Array) -> Array:
    """Inverse of `exp` for headings in (-pi, pi): pose ``(..., 3)`` to twist."""
    pose = np.asarray(pose, dtype=float)
    if pose.ndim == 1:  # as in `compose`
        east, north, angle = pose.tolist()
        turn = _wrap(angle)
        cot = math.cos(turn / 2) / _sinc(turn / 2)
        return np.array([cot * east + turn / 2 * north, -turn / 2 * east + cot * north, turn])
    phi = wrap(pose[..., 2])
    half = np.asarray(phi) / 2
    # (phi/2) cot(phi/2): cos(h)/sinc(h) is exact at zero as well
    c = np.cos(half) / _sincs(half)
    x, y = pose[..., 0], pose[..., 1]
    return _stacked(c * x + half * y, -half * x + c * y, phi)


def adjoint(pose: Array) -> Array:
    """Matrix (..., 3, 3) that takes errors (v, omega) at a pose (..., 3) to its parent's origin."""
    out = rotation3(pose[..., 2])
    out[..., 0, 2], out[..., 1, 2] = pose[..., 1], -pose[..., 0]
    return out


def moved_by_world(poses: Array) -> Array:
    """Derivative (..., 3, 3) of poses by the twist of their world."""
    J = np.zeros((*poses.shape, 3))
    J[..., range(3), range(3)] = 1.0
    J[..., 0, 2], J[..., 1, 2] = -poses[..., 1], poses[..., 0]
    return J


def compose_jacobians(a: Array, b: Array) -> tuple[Array, Array]:
    """Derivatives ``(..., 3, 3)`` of ``compose(a, b)`` by a and b, additive errors.

    Thesis eq. 4.7: F for the first pose; W = rotation3(heading of a) for the second.
    """
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    F = np.zeros((*np.broadcast_shapes(a.shape, b.shape), 3))
    F[..., 0, 0] = F[..., 1, 1] = F[..., 2, 2] = 1.0
    F[..., 0, 2] = -s * b[..., 0] - c * b[..., 1]
    F[..., 1, 2] = c * b[..., 0] - s * b[..., 1]
    return F, rotation3(a[..., 2])


def compose_cov(a: Array, cov_a: Array, b: Array, cov_b: Array) -> Array:
    """Covariance (..., 3, 3) of ``compose(a, b)`` for independent a and b, additive errors.

    ``cov_a`` is along the axes of a's reference frame, ``cov_b`` along the axes of frame a.
    """
    F, W = compose_jacobians(a, b)
    return np.asarray(F @ cov_a @ F.mT + W @ cov_b @ W.mT)


def inverse_cov(a: Array, cov_a: Array) -> Array:
    """Covariance (..., 3, 3) of ``inverse(a)``, along the axes of frame a."""
    K = inverse_jacobian(a)
    return np.asarray(K @ cov_a @ K.mT)


def inverse_jacobian(a: Array) -> Array:
    """Derivative (..., 3, 3) of ``inverse(a)`` by a, additive errors (x m, y m, phi rad).

    From ``compose(a, inverse(a)) = 0``: F da + W d(inverse) = 0, and W is a rotation.
    """
    F, W = compose_jacobians(a, inverse(a))
    return np.asarray(-W.mT @ F)


def rotate_cov(cov: Array, angle_rad: ArrayLike) -> Array:
    """Covariance (..., 3, 3) of (x, y, phi) turned by ``angle_rad``: to the parent's axes."""
    M = rotation3(angle_rad)
    return np.asarray(M @ cov @ M.mT)


def is_positive(cov: Array) -> bool:
    """Whether a symmetric matrix (n, n) is positive definite: whether it has a Cholesky factor.

    It is written out for small ones. Most are 2 x 2 or 3 x 3, of which there are 100 000, and
    LAPACK takes ten times as long. (Minors would be rounding where eigenvalues span ten decades.)
    """
    if len(cov) == 2:
        (a, b), (_, d) = cov.tolist()
        return bool(a > 0 and d - b / a * b > 0)
    if len(cov) == 3:
        (a, b, c), (_, d, e), (_, _, f) = cov.tolist()
        if not a > 0:
            return False
        d, e, f = d - b / a * b, e - b / a * c, f - c / a * c
        return bool(d > 0 and f - e / d * e > 0)
    try:
        factor = np.linalg.cholesky(cov)
    except np.linalg.LinAlgError:
        return False
    return bool(np.isfinite(factor).all())  # of NaN LAPACK makes NaN


def are_positive(covs: Array) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """`is_positive` of each of n symmetric matrices (n, 2, 2); False where one is not finite."""
    a, b, d = covs[:, 0, 0], covs[:, 0, 1], covs[:, 1, 1]
    with np.errstate(all="ignore"):
        return np.isfinite(a + b + d) & (a > 0) & (d - b / a * b > 0)


def interpolate(a: Array, b: Array, share: ArrayLike) -> Array:
    """Pose between a and b ``(..., 3)`` at share 0..1 along the constant twist from a to b."""
    return compose(a, exp(np.asarray(share)[..., None] * log(between(a, b))))


def exp_jacobian(twist: Array) -> Array:
    """Derivative ``(..., 3, 3)`` of `exp` (additive errors of the pose) for twists ``(..., 3)``.

    Thesis eq. 4.11-4.13 need its columns for v_x and omega; exact at omega = 0 as well.
    """
    twist = np.asarray(twist, dtype=float)
    w = twist[..., 2]
    a, b = _sinc_terms(w)
    small = np.abs(w) < 0.3
    # a' = (w cos w - sin w)/w², b' = (w sin w - 1 + cos w)/w²: both cancel near zero, where six
    # terms of their series leave less than 1e-16 for |w| < 0.3
    w2 = w * w
    da_series = (
        -w / 3 * (1 - w2 / 10 * (1 - w2 / 28 * (1 - w2 / 54 * (1 - w2 / 88 * (1 - w2 / 130)))))
    )
    db_series = 0.5 - w2 / 8 * (1 - w2 / 18 * (1 - w2 / 40 * (1 - w2 / 70 * (1 - w2 / 108))))
    da, db = da_series, db_series
    if not small.all():  # increments of odometry rarely turn so far
        safe = np.where(small, 1.0, w)
        cos, sin = np.cos(safe), np.sin(safe)
        da = np.where(small, da, (safe * cos - sin) / safe**2)
        db = np.where(small, db, (safe * sin - 1 + cos) / safe**2)
    out = np.zeros((*twist.shape, 3))
    out[..., 0, 0] = out[..., 1, 1] = a
    out[..., 0, 1], out[..., 1, 0] = -b, b
    out[..., 0, 2] = da * twist[..., 0] - db * twist[..., 1]
    out[..., 1, 2] = db * twist[..., 0] + da * twist[..., 1]
    out[..., 2, 2] = 1.0
    return out


def log_jacobian(pose: Array) -> Array:
    """Derivative ``(..., 3, 3)`` of `log` with respect to additive errors of the pose."""
    pose = np.asarray(pose, dtype=float)
    phi = wrap(pose[..., 2])
    half = phi / 2
    c = np.cos(half) / np.sinc(half / np.pi)
    small = np.abs(phi) < 0.1
    safe = np.where(small, 1.0, half)
    # derivative of (phi/2) cot(phi/2); its series near zero, next term 1e-13 at 0.1 rad
    series = -phi / 6 * (1 + phi**2 / 30 * (1 + phi**2 / 28 * (1 + phi**2 / 30)))
    dc = np.where(small, series, 0.5 / np.tan(safe) - 0.5 * safe / np.sin(safe) ** 2)
    x, y = pose[..., 0], pose[..., 1]
    out = np.zeros((*pose.shape, 3))
    out[..., 0, 0] = out[..., 1, 1] = c
    out[..., 0, 1], out[..., 1, 0] = half, -half
    out[..., 0, 2] = dc * x + y / 2
    out[..., 1, 2] = -x / 2 + dc * y
    out[..., 2, 2] = 1.0
    return out
