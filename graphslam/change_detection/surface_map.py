"""The surfaces that a visit observed: in every occupied cell a line fit with its uncertainty.

Where both faces of a thin wall lie in one window, the returns of one face alone are fitted: those
of the beams that come from its side.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

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
from graphslam.core.geometry import Array, unit_vectors
from graphslam.perception.point_to_line import offset_jacobian

#: half width, in cells, of the window over which a piece is fitted and evidence is summed
WINDOW = 2
#: a piece is straight if its variance along the line exceeds that across it by the first factor,
#: and that across it is below the second factor times what the noise explains (plus 3 sigmas)
_STRAIGHT, _SLACK = 4.0, 1.3
#: directions of beams are told apart in so many sectors; half of them come from one side
_SECTORS = 16
#: a piece is of one side if its normal is within this cosine of the middle of that side's beams,
#: and if what the other side's beams hit lies behind it by so many cells, on average
_FACING_COSINE, _BEHIND_CELLS = 0.7, 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """Pieces of surface: line fits, one per cell with returns.

    Attributes:
        cells: (n,) flat indices on the grid, sorted.
        windows: per offset the rows of the neighbours, see `neighbour_rows`.
        points: (n, 2) m, on the fitted line, next to the cell's centre.
        normals: (n, 2) unit vectors; the sign is arbitrary.
        one_sided: (n,) whether it is fitted to the beams from one side only.
        facing: (n, 2) of those the normal that points along the beams; zero for others.
        noise: (n,) m², variance of the window's returns about the line.
        offset_cov: (n,) m², variance of the piece's position along its normal, due to white noise
            and to the curvature of the surface within the window.
        pose_var: (n,) m², the same due to the poses of its scans.
        incidence: (n,) mean cosine between beam and normal.
        returns: (n,) number in the window.
        first_ns: (n,) stamp of the first return in the cell.
        good: (n,) whether it is straight and observed often enough to be compared.
        nearest: distance map of the good pieces.
        beams: (b,) for every beam of the visit the row of its piece, -1 for none: also for one that
            came from the other side of its cell's piece.
    """

    cells: Ints
    windows: list[Ints]
    points: Array
    normals: Array
    one_sided: Bools
    facing: Array
    noise: Array
    offset_cov: Array
    pose_var: Array
    incidence: Array
    returns: Array
    first_ns: Ints
    good: Bools
    nearest: DistanceMap
    beams: Ints


@dataclass(frozen=True, slots=True, eq=False)
class _Returns:
    """Returns of a visit, by cell.

    ``beams`` (k,) indices; ``ends`` (k, 2) m; ``directions`` (k, 2) unit vectors; ``row`` (k,) of
    the cell that each is in; ``cells`` (n,) those cells, on ``grid``; ``windows``: see `Surface`.
    """

    visit: Visit
    beams: Ints
    ends: Array
    directions: Array
    row: Ints
    cells: Ints
    grid: Grid
    windows: list[Ints]


@dataclass(frozen=True, slots=True, eq=False)
class _Lines:
    """Lines through the returns of windows, with how well they fit; see `Surface`.

    ``m`` (n,): number of returns; ``mean`` (n, 2) m, of the returns, from the cell's centre;
    ``spread`` (n,) m², variance along the line; ``expected`` (n,) m², what noise explains across.
    """

    m: Array
    mean: Array
    normals: Array
    noise: Array
    spread: Array
    expected: Array
    straight: Bools
    pose_var: Array
    incidence: Array
    good: Bools


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
    returns = _Returns(visit, used, ends, visit.directions[used], row, cells, grid, windows)
    lines = _fit_all(returns, sigma_m, config)
    one_sided, facing = np.zeros(n, dtype=bool), np.zeros((n, 2))
    rows, along = _seen_from_two_sides(returns, lines, config)
    if len(rows):
        lines, rows, along = _fit_one_side(returns, lines, rows, along, sigma_m, config)
        turn = np.sign(np.einsum("ni,ni->n", lines.normals[rows], along))
        facing[rows] = turn[:, None] * lines.normals[rows]
        windows = _windows_of_one_side(windows, rows, facing, lines.good)
        one_sided[rows] = True
        one = np.nonzero(one_sided[row])[0]
        ahead = np.einsum("ni,ni->n", facing[row[one]], returns.directions[one])
        used, row = (np.delete(each, one[ahead < 0]) for each in (used, row))
    # the cell's centre, projected onto the line through the window's mean
    m, normals = lines.m, lines.normals
    tangents = np.column_stack([-normals[:, 1], normals[:, 0]])
    t = -np.einsum("ni,ni->n", lines.mean, tangents)
    points = grid.centers(cells) + lines.mean + t[:, None] * tangents
    leverage = 1 / m + t**2 / np.maximum(m * lines.spread, 1e-12)
    bend = 0.25 * ((WINDOW + 0.5) * grid.cell_m) ** 2 * _direction_variance(normals, m, windows)
    first = np.full(n, np.iinfo(np.int64).max)
    np.minimum.at(first, row, visit.stamps_ns[visit.scan[used]])
    beams = np.full(len(visit.range_m), -1, dtype=np.int64)
    beams[used] = row
    return Surface(
        cells, windows, points, normals, one_sided, facing, lines.noise,
        lines.noise * leverage + bend, lines.pose_var, lines.incidence, m, first, lines.good,
        distance_map(grid, cells, lines.good), beams,
    )  # fmt: skip


def _fit_all(returns: _Returns, sigma_m: float, config: ChangesConfig) -> _Lines:
    """The lines (n,) through all returns of each cell's window."""
    row, grid, n = returns.row, returns.grid, len(returns.cells)
    windows, scan = returns.windows, returns.visit.scan[returns.beams]
    local = returns.ends - grid.centers(returns.cells)[row]  # small numbers: no cancellation
    moments = np.column_stack([row_sums(row, w, n) for w in _moments(local)])
    m, mean, cov = _mean_and_cov(_window_moments(moments, windows, grid.cell_m))
    values, vectors = np.linalg.eigh(cov)
    normals = vectors[:, :, 0]
    terms = _noise_terms(returns, slice(None), normals[row])
    sums = window_sums(np.column_stack([row_sums(row, w, n) for w in terms]), windows)
    scans = scans_per_cell(row, scan, len(returns.visit.poses), n)
    of_scans = window_sums(scans.astype(float), windows), window_max(scans, windows)
    return _judged((m, mean, normals, values), sums, of_scans, grid, sigma_m, config)


def _judged(
    line: tuple[Array, Array, Array, Array],
    sums: Array,
    scans: tuple[Array, Array],
    grid: Grid,
    sigma_m: float,
    config: ChangesConfig,
) -> _Lines:
    """Lines with their noise, and whether they are good.

    ``line``: count (n,), mean (n, 2), normals (n, 2), variances (n, 2), that across first;
    ``sums`` (n, 3): of `_noise_terms`; ``scans``: sum and largest (n,) of the scans per cell.
    """
    m, mean, normals, values = line
    cosine, own, common = (sums / np.maximum(m, 1)[:, None]).T
    noise = np.maximum(values[:, 0], 0.0) * m / np.maximum(m - 2, 1)
    expected = (sigma_m * cosine) ** 2 + config.flatness_m**2 + own + common
    # The line must pass through the cell. Returns that noise moved into other cells belong to the
    # piece next to them: a piece of their own would be made of outliers only.
    aside = np.einsum("ni,ni->n", mean, normals)
    straight = _is_straight(values[:, 0], values[:, 1], m, expected)
    good = (
        straight
        & (np.abs(aside) <= 0.5 * grid.cell_m * np.abs(normals).sum(axis=1))
        & (m >= config.min_returns)
        & (scans[0] >= config.min_scans)
    )
    pose_var = common + own / np.maximum(scans[1], 1)
    return _Lines(m, mean, normals, noise, values[:, 1], expected, straight, pose_var, cosine, good)


def _is_straight(across: Array, along: Array, m: Array, expected: Array) -> Bools:
    """Whether ``m`` returns with variances, m², across and along their line are on a line."""
    noise = np.maximum(across, 0.0) * m / np.maximum(m - 2, 1)
    within = noise < expected * (_SLACK + 3 * np.sqrt(2 / np.maximum(m, 1)))
    return np.asarray((along > _STRAIGHT * across) & within)


def _noise_terms(returns: _Returns, chosen: Ints | slice, normals: Array) -> tuple[Array, ...]:
    """Of some returns (k,): cosine of incidence, and both variances of `pose_variance`."""
    cosine = np.abs(np.einsum("ni,ni->n", returns.directions[chosen], normals))
    beams, ends = returns.beams[chosen], returns.ends[chosen]
    return cosine, *pose_variance(returns.visit, beams, ends, normals)


def _seen_from_two_sides(
    returns: _Returns, lines: _Lines, config: ChangesConfig
) -> tuple[Ints, Array]:
    """Cells in whose windows the returns from one side are straight, and those from both are not.

    Of the halves into which directions can be divided that with the most returns is taken.

    Returns:
        Their rows (k,), and unit vectors (k, 2) along the beams from that side, about.
    """
    cells, windows, row = returns.cells, returns.windows, returns.row
    n, half = len(cells), _SECTORS // 2
    # a cell that is less dense than its window holds what noise moved there
    dense = np.bincount(row, minlength=n) * len(windows) >= lines.m
    rows = np.nonzero(~lines.straight & dense & (lines.m >= config.min_returns))[0]
    some, near = _returns_near(returns, rows)
    turn = np.arctan2(returns.directions[some, 1], returns.directions[some, 0]) / (2 * np.pi)
    sector = np.floor(turn * _SECTORS).astype(np.int64) % _SECTORS
    centers = returns.grid.centers(cells[rows])
    local = returns.ends[some] - centers.mean(axis=0)  # one point for all: sums need no shifts
    key, size = row[some] * _SECTORS + sector, n * _SECTORS
    moments = np.column_stack([row_sums(key, w, size) for w in _moments(local)])
    inside, begin = near >= 0, np.zeros(len(rows) + 1, dtype=np.int64)
    np.cumsum(inside.sum(axis=1), out=begin[1:])
    member = csr_array((np.ones(begin[-1]), near[inside], begin), shape=(len(rows), n))
    total = (member @ moments.reshape(n, -1)).reshape(-1, _SECTORS, 6)
    in_half = (np.arange(_SECTORS) - np.arange(_SECTORS)[:, None]) % _SECTORS < half
    of_half = in_half.astype(float) @ total  # (k, halves, 6)
    of_half = _about(of_half, *(centers.mean(axis=0) - centers).T[..., None])
    m, mean, cov = _mean_and_cov(of_half)
    middle, radius = (0.5 * (cov[..., 0, 0] + sign * cov[..., 1, 1]) for sign in (1, -1))
    length = np.hypot(radius, cov[..., 0, 1])
    across = 0.5 * np.arctan2(cov[..., 0, 1], radius) + np.pi / 2
    axis = (np.arange(_SECTORS) + half / 2) * 2 * np.pi / _SECTORS
    cosine = np.cos(across - axis)
    normals = np.sign(cosine)[..., None] * unit_vectors(across)
    other = np.roll(of_half, half, axis=1)
    behind = np.einsum("nhi,nhi->nh", other[..., 1:3], normals) / np.maximum(other[..., 0], 1)
    at = np.einsum("nhi,nhi->nh", mean, normals)
    fits = (
        (m >= config.min_returns)
        & (other[..., 0] > 0)
        & (np.abs(cosine) > _FACING_COSINE)
        & (np.abs(at) <= 0.5 * returns.grid.cell_m * np.abs(normals).sum(axis=2))
        & (behind - at > _BEHIND_CELLS * returns.grid.cell_m)
        & _is_straight(middle - length, middle + length, m, lines.expected[rows, None])
    )
    best = np.argmax(np.where(fits, m, 0.0), axis=1)
    found = fits[np.arange(len(rows)), best]
    return rows[found], normals[found, best[found]]


def _returns_near(returns: _Returns, rows: Ints) -> tuple[Ints, Ints]:
    """Returns (m,) in the windows of cells ``rows`` (k,), and those windows (k, w): rows, or -1."""
    near = np.column_stack([window[rows] for window in returns.windows])
    touched = np.zeros(len(returns.cells) + 1, dtype=bool)
    touched[near] = True
    return np.nonzero(touched[returns.row])[0], near


def _fit_one_side(
    returns: _Returns,
    lines: _Lines,
    rows: Ints,
    along: Array,
    sigma_m: float,
    config: ChangesConfig,
) -> tuple[_Lines, Ints, Array]:
    """The lines with those of ``rows`` (k,) fitted to the beams that go ``along`` (k, 2), if good.

    Returns:
        The lines, and of ``rows`` and ``along`` those that were good.
    """
    k, grid = len(rows), returns.grid
    some, windows = _returns_near(returns, rows)
    order = some[np.argsort(returns.row[some], kind="stable")]
    begin = np.searchsorted(returns.row[order], np.arange(len(returns.cells) + 1))
    near = windows.reshape(-1)
    count = np.where(near >= 0, begin[near + 1] - begin[near], 0)
    pair = np.repeat(np.arange(len(near)), count)  # (row, cell of its window) of each return
    within = np.arange(len(pair)) - np.repeat(np.cumsum(count) - count, count)
    chosen = order[begin[near[pair]] + within]
    piece = pair // len(returns.windows)
    own = np.einsum("ni,ni->n", returns.directions[chosen], along[piece]) > 0
    pair, piece, chosen = pair[own], piece[own], chosen[own]
    local = returns.ends[chosen] - grid.centers(returns.cells[rows])[piece]
    sums = np.column_stack([row_sums(piece, w, k) for w in _moments(local)])
    m, mean, cov = _mean_and_cov(sums)
    values, vectors = np.linalg.eigh(cov)
    normals = vectors[:, :, 0]
    terms = _noise_terms(returns, chosen, normals[piece])
    sums = np.column_stack([row_sums(piece, w, k) for w in terms])
    scan, size = returns.visit.scan[returns.beams[chosen]], len(returns.visit.poses)
    scans = scans_per_cell(pair, scan, size, len(near)).reshape(k, -1)
    of_scans = scans.sum(axis=1).astype(float), scans.max(axis=1).astype(float)
    fitted = _judged((m, mean, normals, values), sums, of_scans, grid, sigma_m, config)
    good = np.nonzero(fitted.good)[0]
    rows = rows[good]
    merged = []
    for name in _Lines.__slots__:
        part = getattr(lines, name).copy()
        part[rows] = getattr(fitted, name)[good]
        merged.append(part)
    return _Lines(*merged), rows, along[good]


def _windows_of_one_side(windows: list[Ints], rows: Ints, facing: Array, good: Bools) -> list[Ints]:
    """The windows, in those of pieces of one side, ``rows`` (k,), only pieces of the same side.

    Among them count good ones of no side. ``facing``: see `Surface`.
    """
    cut = []
    for window in windows:
        near = window[rows]
        alike = np.einsum("ni,ni->n", facing[near], facing[rows])
        keep = (near >= 0) & np.where(facing[near].any(axis=1), alike > 0, good[near])
        cut.append(window.copy())
        cut[-1][rows] = np.where(keep, near, -1)
    return cut


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


def _moments(points: Array) -> tuple[Array, ...]:
    """Of points (k, 2) m the terms (k,) of which count, mean and covariance are made."""
    x, y = points.T
    return np.ones(len(x)), x, y, x * x, x * y, y * y


def _window_moments(moments: Array, windows: list[Ints], cell_m: float) -> Array:
    """Sums (n, 6) over ``windows`` of ``moments`` (n, 6), all about the cells' centres."""
    padded = np.concatenate([moments, np.zeros((1, 6))])
    total = np.zeros_like(moments)
    offsets = range(-WINDOW, WINDOW + 1)
    shifts = [(i * cell_m, j * cell_m) for i in offsets for j in offsets]
    for (dx, dy), rows in zip(shifts, windows, strict=True):
        total += _about(padded[rows], dx, dy)
    return total


def _about(moments: Array, dx: Array | float, dy: Array | float) -> Array:
    """Sums (..., 6) of `_moments` of points that are moved by dx, dy (...) m."""
    c, x, y, xx, xy, yy = np.moveaxis(moments, -1, 0)
    moved = np.empty_like(moments)
    moved[..., 0] = c
    moved[..., 1] = x + dx * c
    moved[..., 2] = y + dy * c
    moved[..., 3] = xx + 2 * dx * x + dx * dx * c
    moved[..., 4] = xy + dx * y + dy * x + dx * dy * c
    moved[..., 5] = yy + 2 * dy * y + dy * dy * c
    return moved


def _mean_and_cov(sums: Array) -> tuple[Array, Array, Array]:
    """Count (...), mean (..., 2) and covariance (..., 2, 2) from sums (..., 6) of `_moments`."""
    m = sums[..., 0]
    x, y, xx, xy, yy = np.moveaxis(sums[..., 1:] / np.maximum(m, 1)[..., None], -1, 0)
    cov = np.array([[xx - x * x, xy - x * y], [xy - x * y, yy - y * y]])
    return m, np.stack([x, y], axis=-1), np.moveaxis(cov, (0, 1), (-2, -1))


def scans_per_cell(row: Ints, scan: Ints, scans: int, rows: int) -> Ints:
    """Number (rows,) of distinct scans with a return in each cell."""
    pairs = sorted_unique(row * scans + scan)
    return np.asarray(np.bincount(pairs // scans, minlength=rows))
