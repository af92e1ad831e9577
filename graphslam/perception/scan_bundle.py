"""All scans of a robot aligned at once: bundle adjustment of their poses and of what they see.

What is seen is cut into short pieces of surfaces, each a line with two unknowns. A piece has the
returns of many scans, of all visits, so that it may be as small as the side of a door niche, of
which a single scan has one return or two. The lines are eliminated, and the poses that are left are
solved by conjugate gradients, from poses that must be near the truth already.

Source: Z. Liu, F. Zhang, BALM: bundle adjustment for lidar mapping, RA-L 2021,
DOI 10.1109/LRA.2021.3062815, where the lines are eliminated in the same way.
"""

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, cg
from scipy.spatial import cKDTree

from graphslam.core.arrays import BoolArray, IntArray
from graphslam.core.config import ScanMatchingConfig
from graphslam.core.geometry import Array, transform_each, wrap
from graphslam.perception.point_to_line import offset_jacobian, step_poses

#: rounds in which surfaces are found and poses solved
ROUNDS = 3
#: m: points in a cell of this size have one surface: that of the points nearer than `NEAR_M`, which
#: is far more than they scatter, and of the nearest until they are `ENOUGH`, up to `AROUND_M`
CELL_M, NEAR_M, ENOUGH, AROUND_M = 0.03, 0.08, 30, 0.2
#: cells within that, at most; cells whose neighbours are in memory at once
CELLS, BLOCK = 32, 1 << 14
#: of a surface: variance across over that along at most, and points at least
FLAT, LEAST_AROUND = 0.5, 5
#: m: pieces of surfaces are as long as this; of one piece are normals in the same of so many
#: sectors; shift of the pieces from round to round, as a share of their length
PIECE_M, SECTORS, SHIFT = 0.3, 12, 0.37
#: points of a piece, and scans, at least
LEAST_POINTS, LEAST_SCANS = 6, 3
#: times that a line is fitted, with weights by the residuals before
FITS = 3
#: information (1/m², 1/rad²) that holds the first pose; steps of conjugate gradients at most, and
#: residual, as a share, at which they end
HELD, GRADIENTS, SOLVED = 1e8, 200, 1e-5
#: information (1/m², 1/rad²) about what nothing tells of, added so that it can be inverted
NOTHING = 1e-2


@dataclass(frozen=True, slots=True, eq=False)
class Bundle:
    """Poses (n, 3) after all scans were aligned.

    ``information`` (n, 3, 3): of each scan about its pose if all else was known, along the axes of
    the world, by the noise that the residuals show.
    """

    poses: Array
    information: Array


@dataclass(frozen=True, slots=True, eq=False)
class _Points:
    """Points (m, 2) in the world, each of a scan (m,).

    ``arms`` (m, 2) lead there from the scan's pose, ``beams`` (m, 2) from the laser.
    """

    placed: Array
    arms: Array
    beams: Array
    scan: IntArray


def align_all(
    points: Array, lasers: Array, scan: IntArray, poses: Array, motion: Array,
    config: ScanMatchingConfig,
) -> Bundle:  # fmt: skip
    """Align the scans of one robot with each other.

    Args:
        points: (m, 2) m of n scans, each seen from its pose.
        lasers: (m, 2) m where the laser was that saw it, seen from there too.
        scan: (m,) the scan of each.
        poses: (n, 3) to begin with.
        motion: (n - 1, 3, 3) information of the motions between those, along the axes of the world:
            where scans tell nothing, poses keep it.
        config: noise of points.
    """
    found, information = poses.copy(), np.zeros((len(poses), 3, 3))
    for k in range(ROUNDS):
        seen = _seen(points, lasers, scan, found)
        normals, flat = _normals(seen)
        piece = _pieces(seen, normals, flat, k * SHIFT * PIECE_M)
        if piece.max(initial=-1) < 0:
            break
        equations, variance = _equations(seen, normals, piece, len(poses), config.point_sigma_m)
        moved = found - poses
        moved[:, 2] = wrap(moved[:, 2])
        found = step_poses(found, equations.step(motion, moved))
        information = equations.diagonal / variance
    return Bundle(found, information)


def _seen(points: Array, lasers: Array, scan: IntArray, poses: Array) -> _Points:
    at = poses[scan]
    placed = transform_each(at, points)
    return _Points(placed, placed - at[:, :2], placed - transform_each(at, lasers), scan)


def _cells(points: Array, size_m: float) -> IntArray:
    """Numbers (m,) of the cells of a grid that points (m, 2) are in."""
    cell = np.floor(points / size_m).astype(np.int64)
    cell -= cell.min(axis=0)
    return np.asarray(cell[:, 0] * (cell[:, 1].max() + 1) + cell[:, 1])


def _normals(seen: _Points) -> tuple[Array, BoolArray]:
    """Normals (m, 2) of the surfaces at points, towards the laser, and whether there are any."""
    _, own = np.unique(_cells(seen.placed, CELL_M), return_inverse=True)
    count = np.bincount(own).astype(float)
    mean = np.column_stack([np.bincount(own, v) / count for v in seen.placed.T])
    dx, dy = (seen.placed - mean[own]).T
    moments = np.array([np.bincount(own, v) for v in (dx * dx, dx * dy, dy * dy)])
    tree = cKDTree(mean)
    sums = np.concatenate([
        _sums_around(np.arange(k, min(k + BLOCK, len(mean))), tree, mean, count, moments)
        for k in range(0, len(mean), BLOCK)
    ], axis=1)  # fmt: skip
    total = sums[0]
    x, y, xx, xy, yy = sums[1:] / total
    xx, xy, yy = xx - x * x, xy - x * y, yy - y * y
    along = 0.5 * np.arctan2(2 * xy, xx - yy)
    spread, middle = np.sqrt(0.25 * (xx - yy) ** 2 + xy**2), 0.5 * (xx + yy)
    is_flat = (middle - spread < FLAT * (middle + spread)) & (total >= LEAST_AROUND)
    normals = np.column_stack([-np.sin(along), np.cos(along)])[own]
    normals[(normals * seen.beams).sum(axis=1) > 0] *= -1.0
    return normals, np.asarray(is_flat[own])


def _sums_around(
    cells: IntArray, tree: cKDTree, mean: Array, count: Array, moments: Array
) -> Array:
    """Sums (6, k) of the points around some of all cells: number, x, y, x², xy, y², from its mean.

    ``mean`` (n, 2), ``count`` (n,) and second central ``moments`` (3, n) are of all.
    """
    most = min(CELLS, len(mean))
    distance, near = tree.query(mean[cells], k=most, distance_upper_bound=AROUND_M)
    distance, near = distance.reshape(-1, most), near.reshape(-1, most)
    sums = np.zeros((6, len(cells)))
    for column in range(most):
        used = np.isfinite(distance[:, column])
        used &= (sums[0] < ENOUGH) | (distance[:, column] < NEAR_M)
        if not used.any():
            break
        other = near[used, column]
        n = count[other]
        x, y = (mean[other] - mean[cells[used]]).T
        xx, xy, yy = moments[:, other]
        sums[:, used] += [n, n * x, n * y, xx + n * x * x, xy + n * x * y, yy + n * y * y]
    return sums


def _pieces(seen: _Points, normals: Array, flat: BoolArray, shift_m: float) -> IntArray:
    """Number (m,) of the piece of a surface that each point is on; -1 on none."""
    sector = np.round(np.arctan2(normals[:, 1], normals[:, 0]) * (SECTORS / (2 * np.pi)))
    key = _cells(seen.placed + shift_m, PIECE_M) * SECTORS + sector.astype(np.int64) % SECTORS
    use = np.flatnonzero(flat)
    _, piece = np.unique(key[use], return_inverse=True)
    count = np.bincount(piece)
    scans = int(seen.scan.max()) + 1
    pairs = np.unique(piece * scans + seen.scan[use])
    seen_by = np.bincount(pairs // scans, minlength=len(count))
    enough = (count >= LEAST_POINTS) & (seen_by >= LEAST_SCANS)
    number = np.where(enough, np.cumsum(enough) - 1, -1)
    out = np.full(len(flat), -1, dtype=np.intp)
    out[use] = number[piece]
    return out


@dataclass(frozen=True, slots=True, eq=False)
class _Equations:
    """Normal equations of n poses and m lines, of which only products are needed.

    ``diagonal`` (n, 3, 3) and ``gradient`` (n, 3) are of the poses; ``coupling`` (3n, 2m) sparse;
    ``lines`` (2m, 2m) sparse: the inverse of the lines' own; ``line_gradient`` (2m,).
    """

    diagonal: Array
    gradient: Array
    coupling: sparse.csr_matrix
    lines: sparse.csr_matrix
    line_gradient: Array

    def step(self, motion: Array, moved: Array) -> Array:
        """Steps (n, 3) of the poses, which moved by (n, 3) since the motions were known."""
        n = len(self.diagonal)
        own = self.diagonal.copy()
        own[0] += HELD * np.eye(3)
        pull = np.einsum("nij,nj->ni", motion, np.diff(moved, axis=0))
        gradient = self.gradient - (self.coupling @ (self.lines @ self.line_gradient)).reshape(n, 3)
        gradient[:-1] -= pull
        gradient[1:] += pull
        back = self.coupling.T.tocsr()

        def product(x: Array) -> Array:
            x = x.reshape(n, 3)
            out = np.einsum("nij,nj->ni", own, x)
            bent = np.einsum("nij,nj->ni", motion, np.diff(x, axis=0))
            out[:-1] -= bent
            out[1:] += bent
            out -= (self.coupling @ (self.lines @ (back @ x.ravel()))).reshape(n, 3)
            return np.asarray(out.ravel())

        blocks = own + NOTHING * np.eye(3)
        blocks[:-1] += motion
        blocks[1:] += motion
        inverse = np.linalg.inv(blocks)

        def precondition(x: Array) -> Array:
            return np.asarray(np.einsum("nij,nj->ni", inverse, x.reshape(n, 3)).ravel())

        shape = (3 * n, 3 * n)
        step, _ = cg(
            LinearOperator(shape, product),
            -gradient.ravel(),
            rtol=SOLVED,
            maxiter=GRADIENTS,
            M=LinearOperator(shape, precondition),
        )
        return np.asarray(step.reshape(n, 3))


def _equations(
    seen: _Points, normals: Array, piece: IntArray, n: int, sigma_m: float
) -> tuple[_Equations, float]:
    """Normal equations at ``n`` poses with points of noise ``sigma_m``.

    Returns:
        Those, and the variance of the points that the residuals show, in their noise.
    """
    use = np.flatnonzero(piece >= 0)
    line, scan = piece[use], seen.scan[use]
    placed, arms, facing = seen.placed[use], seen.arms[use], normals[use]
    lines = int(line.max(initial=-1)) + 1
    w = np.ones(len(use))
    for _ in range(FITS):
        normal, r, t = _fitted(placed, facing, line, w, lines)
        w = 1.0 / (1.0 + (r / sigma_m) ** 2 / 4.0)
    # the lines are as fitted with the weights before, which hardly differ
    variance = float((w * r * r).sum() / max(w.sum(), 1.0)) / sigma_m**2
    J = offset_jacobian(normal[line], arms) / sigma_m
    F = np.column_stack([np.ones(len(t)), t]) / sigma_m
    r = r / sigma_m
    diagonal, gradient = np.zeros((n, 3, 3)), np.zeros((n, 3))
    for i in range(3):
        gradient[:, i] = np.bincount(scan, w * J[:, i] * r, n)
        for j in range(3):
            diagonal[:, i, j] = np.bincount(scan, w * J[:, i] * J[:, j], n)
    pairs, pair = np.unique(scan * lines + line, return_inverse=True)
    blocks = np.array([
        [np.bincount(pair, w * J[:, i] * F[:, j], len(pairs)) for j in range(2)] for i in range(3)
    ])  # fmt: skip
    of_scan, of_line = pairs // max(lines, 1), pairs % max(lines, 1)
    rows = 3 * of_scan + np.arange(3)[:, None, None] + np.zeros((1, 2, 1), dtype=np.intp)
    columns = 2 * of_line + np.arange(2)[None, :, None] + np.zeros((3, 1, 1), dtype=np.intp)
    coupling = sparse.csr_matrix(
        (blocks.ravel(), (rows.ravel(), columns.ravel())), shape=(3 * n, 2 * lines)
    )
    own = np.array([
        [np.bincount(line, w * F[:, i] * F[:, j], lines) for j in range(2)] for i in range(2)
    ])  # fmt: skip
    inverse = np.linalg.inv(np.moveaxis(own, 2, 0) + NOTHING * np.eye(2))
    number = np.arange(lines)
    eliminated = sparse.bsr_matrix(
        (inverse, number, np.arange(lines + 1)), shape=(2 * lines, 2 * lines)
    )
    pull: Array = np.array([np.bincount(line, w * F[:, i] * r, lines) for i in range(2)])
    found = _Equations(diagonal, gradient, coupling, eliminated.tocsr(), pull.T.ravel())
    return found, variance


def _fitted(
    placed: Array, facing: Array, line: IntArray, w: Array, lines: int
) -> tuple[Array, Array, Array]:
    """Lines through weighted points: normals (lines, 2), offsets of points (m,), places along."""
    total = np.bincount(line, w, lines)
    mean = np.column_stack([np.bincount(line, w * v, lines) / total for v in placed.T])
    d = placed - mean[line]
    xx, xy, yy = (
        np.bincount(line, w * v, lines) / total
        for v in (d[:, 0] ** 2, d[:, 0] * d[:, 1], d[:, 1] ** 2)
    )
    along = 0.5 * np.arctan2(2 * xy, xx - yy)
    normal = np.column_stack([-np.sin(along), np.cos(along)])
    usual = np.column_stack([np.bincount(line, v, lines) for v in facing.T])
    usual = usual / np.hypot(*usual.T)[:, None]
    # points of a short piece scatter less along it than across: it faces as those around do
    short = np.abs((normal * usual).sum(axis=1)) < np.cos(2 * np.pi / SECTORS)
    normal = np.where(short[:, None], usual, normal)
    at = normal[line]
    return normal, (d * at).sum(axis=1), d[:, 1] * at[:, 0] - d[:, 0] * at[:, 1]
