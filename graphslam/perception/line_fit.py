"""Weighted total least squares of lines, many at once; shared by all front ends with lines.

Symbols: n the line's unit normal, d its offset (n·p = d), eta the signed distance along the line
from the line's position, w a point's weight, V the covariance of (normal offset, direction).
"""

from dataclasses import dataclass

import numpy as np

from graphslam.core.config import FrontEndConfig
from graphslam.core.errors import EstimationError
from graphslam.core.geometry import Array, rotation3, wrap
from graphslam.core.observation_arrays import LINE, SEGMENT, ObservationArrays
from graphslam.core.records import Observation
from graphslam.perception.beam_noise import range_variance
from graphslam.perception.ordered_scan import Indices, Mask

SMALLEST_SIGMA_M = 1e-4
"""Floor of one point's normal noise where the settings have none: weights stay finite."""


@dataclass(frozen=True, slots=True, eq=False)
class LineFits:
    """Lines (m) fitted to points, laser frame.

    ``z`` (m, 3): middle of the part seen (m) and direction (rad), the sensor on the left.
    ``length`` (m,) m of that part. ``V`` (m, 2, 2): covariance of (normal offset m, direction
    rad) in the line's own frame at z, without floors. ``end_var`` (m,) m²: along the line if both
    ends are real (eq. 4.38). ``rms`` (m,) m: deviation of the points from the line.
    """

    z: Array
    length: Array
    V: Array
    end_var: Array
    rms: Array

    def __getitem__(self, rows: Indices | Mask) -> "LineFits":
        return LineFits(
            self.z[rows], self.length[rows], self.V[rows], self.end_var[rows], self.rms[rows]
        )


def fit_lines(points: Array, starts: Indices, config: FrontEndConfig) -> LineFits:
    """Weighted total least squares of m lines, thesis 4.7.6 and eq. 4.32, 4.36-4.38.

    With ``config.covariance == "incidence"`` a point weighs 1/sigma_n², its own noise along the
    normal: range noise acts along the beam, so sigma_n = sigma_r |cos(incidence)|, and not less
    than floor_normal_m, as the material's bias does not vanish at grazing incidence. The cosine is
    computed from the beam's direction, which has no noise: one from the measured range would
    correlate weight and error. With ``"thesis"`` every point weighs 1/sigma_r², as in eq. 4.32.

    ``points`` (k, 2), m, laser frame, are those of one line after the other, each line's in the
    order of the beams (either way round) and from its row in ``starts`` (m,) on.

    Raises:
        EstimationError: the points of a line do not define a direction.
    """
    counts = np.diff(starts, append=len(points))
    line = np.repeat(np.arange(len(starts)), counts)
    x, y = points.T
    sigma_r = np.sqrt(range_variance(config, x * x + y * y))
    weight = np.broadcast_to(np.maximum(sigma_r, SMALLEST_SIGMA_M) ** -2, len(points))
    cx, cy, direction = _total_least_squares(x, y, weight, starts, line)
    if config.covariance == "incidence":
        from_normal = np.cos(direction)[line] * y - np.sin(direction)[line] * x
        floor = max(config.floor_normal_m, SMALLEST_SIGMA_M)
        sigma = np.maximum(sigma_r * np.abs(from_normal) / np.hypot(x, y), floor)
        weight = sigma**-2
        cx, cy, direction = _total_least_squares(x, y, weight, starts, line)
    # the line's left is (-sin, cos): the sensor is there if the line's own offset is negative
    offset = np.cos(direction) * cy - np.sin(direction) * cx
    direction = wrap(np.where(offset > 0, direction + np.pi, direction))
    c, s = np.cos(direction), np.sin(direction)

    dx, dy = x - cx[line], y - cy[line]
    c_each, s_each = c[line], s[line]
    eta = c_each * dx + s_each * dy
    deviation = c_each * dy - s_each * dx
    last = starts + counts - 1
    middle = (eta[starts] + eta[last]) / 2
    spacing_sq = (eta[starts] - eta[starts + 1]) ** 2 + (eta[last] - eta[last - 1]) ** 2
    return LineFits(
        z=np.array((cx + c * middle, cy + s * middle, direction)).T,
        length=np.abs(eta[last] - eta[starts]),
        V=_normal_block(eta - middle[line], weight, starts),
        end_var=spacing_sq / 24,  # mean (4.38) of two uniform distributions (4.36, 4.37)
        rms=np.sqrt(np.add.reduceat(deviation**2, starts) / counts),
    )


def _total_least_squares(
    x: Array, y: Array, weight: Array, starts: Indices, line: Indices
) -> tuple[Array, Array, Array]:
    """Weighted centroids x, y (m,) and directions (m,) of the principal axes, modulo pi."""
    w, wx, wy = np.add.reduceat(np.array((weight, weight * x, weight * y)), starts, axis=1)
    cx, cy = wx / w, wy / w
    dx, dy = x - cx[line], y - cy[line]  # centred first: no cancellation far from the sensor
    moments = weight * np.array((dx * dx, dx * dy, dy * dy))
    xx, xy, yy = np.add.reduceat(moments, starts, axis=1)
    if not np.all(xx + yy > 0):
        raise EstimationError("line fit: all points of a line coincide; it needs two distinct ones")
    return cx, cy, np.asarray(0.5 * np.arctan2(2 * xy, xx - yy))


def _normal_block(eta: Array, weight: Array, starts: Indices) -> Array:
    """V (m, 2, 2) of (normal offset, direction): eq. 4.32 with a weight for each point."""
    powers = weight * np.array((np.ones(len(eta)), eta, eta * eta))
    w0, w1, w2 = np.add.reduceat(powers, starts, axis=1)
    V = np.array(((w2, -w1), (-w1, w0))) / (w0 * w2 - w1 * w1)
    return np.moveaxis(V, -1, 0)


def observations(
    fits: LineFits, fully_visible: Mask, config: FrontEndConfig
) -> tuple[Observation, ...]:
    """Lines as observations, eq. 4.34: ``segment`` where ``fully_visible`` (m,), else ``line``.

    Their ``cov`` (3, 3) is of additive errors (x, y, phi) along the axes of the laser frame. The
    floors are added to V in the line's frame: they do not shrink with the number of points. The
    variance along a ``line`` carries no meaning; it is finite (length²/12) so that the matrix is
    regular.
    """
    seen = observation_arrays(fits, fully_visible, config)
    return tuple(seen.one(k) for k in range(len(seen)))


def observation_arrays(
    fits: LineFits, fully_visible: Mask, config: FrontEndConfig
) -> ObservationArrays:
    """`observations` as arrays."""
    own = np.zeros((len(fits.z), 3, 3))
    own[:, 0, 0] = np.where(
        fully_visible, fits.end_var + config.end_sigma_m**2, fits.length**2 / 12
    )
    own[:, 1:, 1:] = fits.V
    own[:, 1, 1] += config.floor_normal_m**2
    own[:, 2, 2] += config.floor_angle_rad**2
    turn = rotation3(fits.z[:, 2])
    cov = turn @ own @ turn.mT
    extent = fits.length[:, None] * np.array((-0.5, 0.5))
    kind = np.where(fully_visible, SEGMENT, LINE)
    return ObservationArrays(kind, fits.z, cov, extent)
