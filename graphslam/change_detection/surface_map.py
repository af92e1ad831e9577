"""The surfaces that a visit observed: in every occupied cell a line fit with its uncertainty."""

from dataclasses import dataclass

import numpy as np

from graphslam.change_detection.grid import (
    DistanceMap,
    Grid,
    distance_map,
    neighbour_rows,
    row_sums,
    sorted_unique,
    window_sums,
)
from graphslam.change_detection.visit import Bools, Ints, Visit
from graphslam.core.config import ChangesConfig
from graphslam.core.geometry import Array
from graphslam.perception.point_to_line import offset_jacobian

#: half width, in cells, of the window over which a piece is fitted and evidence is summed
WINDOW = 2
#: a piece is straight if its variance along the line exceeds that across it by the first factor,
#: and that across it is below the second factor times what the noise explains (plus 3 sigmas)
_STRAIGHT, _SLACK = 4.0, 1.3


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """Pieces of surface: line fits, one per cell with returns.

    Attributes:
        cells: (n,) flat indices on the grid, sorted.
        windows: per offset the rows of the neighbours, see `neighbour_rows`.
        points: (n, 2) m, on the fitted line, next to the cell's centre.
        normals: (n, 2) unit vectors; the sign is arbitrary.
        noise: (n,) m², variance of the window's returns about the line.
        offset_cov: (n,) m², variance of the piece's position along its normal, due to white noise
            and to the curvature of the surface within the window.
        pose_var: (n,) m², the same due to the poses of its scans.
        incidence: (n,) mean cosine between beam and normal.
        returns: (n,) number in the window.
        first_ns: (n,) stamp of the first return in the cell.
        good: (n,) whether it is straight and observed often enough to be compared.
        nearest: distance map of the good pieces.
        beams: (b,) for every beam of the visit the row of its piece, -1 for none.
    """

    cells: Ints
    windows: list[Ints]
    points: Array
    normals: Array
    noise: Array
    offset_cov: Array
    pose_var: Array
    incidence: Array
    returns: Array
    first_ns: Ints
    good: Bools
    nearest: DistanceMap
    beams: Ints


def fit_surfaces(visit: Visit, grid: Grid, sigma_m: float, config: ChangesConfig) -> Surface:
    """The surfaces of a visit on a grid in its frame; only cells with returns take memory.

    A piece with more scatter than range noise of ``sigma_m`` explains is not straight.
    """
    used = np.nonzero(visit.surface & (visit.range_m <= config.max_range_m))[0]
    ends = visit.ends_of(used)
    cell = grid.cells(ends)
    used, ends, cell = used[cell >= 0], ends[cell >= 0], cell[cell >= 0]
    cells, row = grid.occupied(cell)
    n = len(cells)
    windows = neighbour_rows(grid, cells, WINDOW)
    local = ends - grid.centers(cells)[row]  # small numbers: no cancellation in the moments
    x, y = local.T
    sums: list[Array] = [row_sums(row, w, n) for w in (np.ones(len(x)), x, y, x * x, x * y, y * y)]
    moments = np.column_stack(sums)
    m, mean, cov = _window_moments(moments, windows, grid.cell_m)
    values, vectors = np.linalg.eigh(cov)
    normals = vectors[:, :, 0]
    # the cell's centre, projected onto the line through the window's mean
    t = np.einsum("ni,ni->n", -mean, vectors[:, :, 1])
    points = grid.centers(cells) + mean + t[:, None] * vectors[:, :, 1]
    noise = np.maximum(values[:, 0], 0.0) * m / np.maximum(m - 2, 1)
    leverage = 1 / m + t**2 / np.maximum(m * values[:, 1], 1e-12)
    bend = 0.25 * ((WINDOW + 0.5) * grid.cell_m) ** 2 * _direction_variance(normals, m, windows)
    scans = scans_per_cell(row, visit.scan[used], len(visit.poses), n)
    scans_in_window = window_sums(scans.astype(float), windows)
    directions = visit.directions[used]
    cosine = np.abs(np.einsum("ni,ni->n", directions, normals[row]))
    own, common = pose_variance(visit, used, ends, normals[row])
    sums = [row_sums(row, w, n) for w in (cosine, own, common)]
    cosine_sum, own_sum, common_sum = window_sums(np.column_stack(sums), windows).T
    pose_var = common_sum / m + own_sum / m / np.maximum(window_max(scans, windows), 1)
    first = np.full(n, np.iinfo(np.int64).max)
    np.minimum.at(first, row, visit.stamps_ns[visit.scan[used]])
    expected = (sigma_m * cosine_sum / m) ** 2 + config.flatness_m**2
    expected += (own_sum + common_sum) / m
    # The line must pass through the cell. Returns that noise moved into other cells belong to the
    # piece next to them: a piece of their own would be made of outliers only.
    aside = np.einsum("ni,ni->n", mean, normals)
    crossed = np.abs(aside) <= 0.5 * grid.cell_m * np.abs(normals).sum(axis=1)
    good = (
        crossed
        & (m >= config.min_returns)
        & (scans_in_window >= config.min_scans)
        & (values[:, 1] > _STRAIGHT * values[:, 0])
        & (noise < expected * (_SLACK + 3 * np.sqrt(2 / m)))
    )
    beams = np.full(len(visit.range_m), -1, dtype=np.int64)
    beams[used] = row
    offset_cov, incidence = noise * leverage + bend, cosine_sum / m
    return Surface(
        cells, windows, points, normals, noise, offset_cov, pose_var, incidence, m, first, good,
        distance_map(grid, cells, good), beams,
    )  # fmt: skip


def window_max(values: Ints, windows: list[Ints]) -> Array:
    """Maxima (n,) of ``values`` (n,) in each window."""
    padded = np.concatenate([values, [0]])
    return np.asarray(np.max([padded[rows] for rows in windows], axis=0), dtype=float)


def _direction_variance(normals: Array, weight: Array, windows: list[Ints]) -> Array:
    """Variance (n,) rad² of the directions of the pieces in each window."""
    double = 2 * np.arctan2(normals[:, 1], normals[:, 0])
    parts = np.column_stack([weight * np.cos(double), weight * np.sin(double), weight])
    x, y, total = window_sums(parts, windows).T
    # 1 - R of doubled angles is half of their variance, which is four times that of the angles
    return np.asarray(np.maximum(1 - np.hypot(x, y) / total, 0.0) / 2)


def pose_variance(visit: Visit, beams: Ints, ends: Array, normals: Array) -> tuple[Array, Array]:
    """Variances (k,) m² of ``ends`` (k, 2) along ``normals`` (k, 2) due to their scans' poses.

    The end of a beam moves with the laser and turns about it: J = [n, n · perp(end - laser)].

    Returns:
        The part that is independent between scans, and the part that may be common to all.
    """
    scan = visit.scan[beams]
    J = offset_jacobian(normals, ends - visit.poses[scan, :2])
    total, common = (
        np.einsum("ni,nij,nj->n", J, covs[scan], J) for covs in (visit.covs, visit.shared)
    )
    return np.maximum(total - common, 0.0), common


def _window_moments(moments: Array, windows: list[Ints], cell_m: float) -> tuple[Array, ...]:
    """Count (n,), mean (n, 2) and covariance (n, 2, 2) over windows, about the cell's centre."""
    padded = np.concatenate([moments, np.zeros((1, 6))])
    total = np.zeros_like(moments)
    offsets = range(-WINDOW, WINDOW + 1)
    shifts = [(i * cell_m, j * cell_m) for i in offsets for j in offsets]
    for (dx, dy), rows in zip(shifts, windows, strict=True):
        c, x, y, xx, xy, yy = padded[rows].T
        total[:, 0] += c
        total[:, 1] += x + dx * c
        total[:, 2] += y + dy * c
        total[:, 3] += xx + 2 * dx * x + dx * dx * c
        total[:, 4] += xy + dx * y + dy * x + dx * dy * c
        total[:, 5] += yy + 2 * dy * y + dy * dy * c
    m = total[:, 0]
    x, y, xx, xy, yy = (total[:, 1:] / m[:, None]).T
    cov = np.array([[xx - x * x, xy - x * y], [xy - x * y, yy - y * y]])
    return m, np.column_stack([x, y]), np.moveaxis(cov, 2, 0)


def scans_per_cell(row: Ints, scan: Ints, scans: int, rows: int) -> Ints:
    """Number (rows,) of distinct scans with a return in each cell."""
    pairs = sorted_unique(row * scans + scan)
    return np.asarray(np.bincount(pairs // scans, minlength=rows))
