"""The thesis' change detection (chapter 5): one scan against a map of dents, for comparison.

Corrections of the printed equations are stated where they are made; docs/change-detection.md has
the method's detection and false-alarm rates. Applications use `detect_changes`.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import label

from graphslam.change_detection.grid import Grid
from graphslam.change_detection.visit import Bools, Ints
from graphslam.core.geometry import Array, unit_vectors, wrap

#: V_0 of 5.10, m³; it cancels out of every comparison
VOLUME = 1.0
#: steps per cell along a beam when looking for the first dent
_STEPS_PER_CELL = 2


@dataclass(frozen=True, slots=True)
class LaserNoise:
    """Standard deviations of a beam: of its range, m; across it ``phi1`` m + ``phi2`` rad (5.3)."""

    range_m: float = 0.015
    phi1_m: float = 0.001
    phi2_rad: float = 0.0044


@dataclass(frozen=True, slots=True, eq=False)
class DentMap:
    """The reference map: per cell of a grid the deepest dent that covers it.

    Attributes:
        grid: cells.
        depth: (cells,) of the winning dent in that cell, 0 where there is none.
        winner: (cells,) index of the point whose dent it is, -1 for none.
        bottom: (n,) depth of every point's dent at its centre.
        threshold: d²_thres of 5.7.
    """

    grid: Grid
    depth: Array
    winner: Ints
    bottom: Array
    threshold: float


def scan_points(pose: Array, angles: Array, ranges: Array) -> Array:
    """World points (n, 2) m of a scan from ``pose`` (3,); NaN where there is no return."""
    return np.asarray(pose[:2] + ranges[:, None] * unit_vectors(pose[2] + angles))


def point_covariances(
    pose: Array, cov: Array, angles: Array, ranges: Array, noise: LaserNoise
) -> Array:
    """Covariances (n, 2, 2) m² of the points of a scan, world axes (5.1-5.6).

    The laser's ``pose`` (3,) has ``cov`` (3, 3); ``angles`` (n,) rad are in its frame.
    """
    across = noise.phi1_m + (noise.phi2_rad + np.sqrt(cov[2, 2])) * ranges
    c, s = np.cos(pose[2] + angles), np.sin(pose[2] + angles)
    R = np.moveaxis(np.array([[c, -s], [s, c]]), 2, 0)
    local = np.zeros((len(ranges), 2, 2))
    local[:, 0, 0], local[:, 1, 1] = noise.range_m**2, across**2
    return np.asarray(R @ local @ R.mT + cov[:2, :2])


def make_dents(grid: Grid, points: Array, covs: Array, threshold: float = 9.0) -> DentMap:
    """The reference map of dents (5.7-5.12): of equal volume; where they overlap the deeper wins.

    A dent is the paraboloid c (1 - d²/d²_thres) with d² = (z - m)' cov⁻¹ (z - m); its depth at
    the bottom is c = 2 V_0 / (π a b), a and b being the semi-axes *at the rim*, √(λ d²_thres).

    Args:
        grid: cells of the map.
        points: (n, 2) m; rows with NaN make no dent.
        covs: (n, 2, 2) m².
        threshold: d²_thres.
    """
    usable = np.nonzero(np.isfinite(points).all(axis=1))[0]
    determinant = np.full(len(points), np.inf)
    determinant[usable] = np.linalg.det(covs[usable])
    bottom = 2 * VOLUME / (np.pi * threshold * np.sqrt(determinant))
    information = np.linalg.inv(covs[usable])
    size = grid.shape[0] * grid.shape[1]
    depth, winner = np.zeros(size), np.full(size, -1, dtype=np.int64)
    home = grid.cells(points[usable])
    # a loop over the cells of the largest dent, vectorised over the points
    widest = np.sqrt(threshold * max(float(np.linalg.eigvalsh(covs[usable]).max()), 0.0))
    radius = int(np.ceil(widest / grid.cell_m)) + 1
    for offset in grid.neighbours(np.zeros(1, dtype=np.int64), radius):
        cell = home + offset[0]
        inside = (home >= 0) & (cell >= 0) & (cell < size)
        away = grid.centers(np.where(inside, cell, 0)) - points[usable]
        d2 = np.einsum("ni,nij,nj->n", away, information, away)
        # the cell that holds the point belongs to its dent however narrow it is
        share = 1 - d2 / threshold
        share = np.maximum(share, 1e-3) if offset[0] == 0 else share
        value = bottom[usable] * share
        chosen = np.nonzero(inside & (value > 0))[0]
        np.maximum.at(depth, cell[chosen], value[chosen])
        won = chosen[depth[cell[chosen]] == value[chosen]]
        winner[cell[won]] = usable[won]
    return DentMap(grid, depth, winner, bottom, threshold)


def dent_covariance(depth: Array, threshold: float) -> Array:
    """Covariance (n, 2, 2) m² of a dent with ``depth`` (n,) at its centre (5.13).

    The printed a² = 2 V_0/(π c) is the semi-axis at the rim; the covariance is that over d²_thres.
    An isotropic covariance is recovered exactly.
    """
    variance = 2 * VOLUME / (np.pi * depth * threshold)
    return np.asarray(variance[:, None, None] * np.eye(2))


def expected_measurements(
    dents: DentMap, pose: Array, angles: Array, reach_m: float
) -> tuple[Array, Array]:
    """Range along each beam to the deepest cell of the first dent, and its covariance (5.2).

    The covariance is that of the winning dent at its centre, not at the cell that the beam crosses.

    Args:
        dents: the reference map.
        pose: (3,) of the laser.
        angles: (n,) rad in its frame.
        reach_m: largest range.

    Returns:
        Ranges (n,) m, NaN where there is no dent, and covariances (n, 2, 2) m².
    """
    step = dents.grid.cell_m / _STEPS_PER_CELL
    r = np.arange(1, int(reach_m / step) + 1) * step
    d = unit_vectors(pose[2] + angles)
    along = pose[:2] + r[None, :, None] * d[:, None, :]
    cell = dents.grid.cells(along.reshape(-1, 2)).reshape(len(angles), len(r))
    depth = np.where(cell >= 0, dents.depth[cell], 0.0)
    # the first minimum: the last step before the map gets shallower again
    ahead = np.column_stack([depth[:, 1:], np.zeros(len(angles))])
    minimum = (depth > 0) & (ahead < depth)
    first = minimum.argmax(axis=1)
    beam = np.arange(len(angles))
    found = minimum[beam, first]
    # a plateau of one cell: its middle
    level = depth[beam, first]
    begin = (depth == level[:, None]) & (np.arange(len(r)) <= first[:, None])
    width = np.minimum(begin.sum(axis=1), 2 * _STEPS_PER_CELL)
    ranges = np.where(found, r[first] - step * (width - 1) / 2, np.nan)
    point = dents.winner[cell[beam, first]]
    bottom = np.where(found, dents.bottom[point], np.nan)
    return ranges, dent_covariance(bottom, dents.threshold)


def squared_mahalanobis(points: Array, covs: Array, expected: Array, expected_covs: Array) -> Array:
    """Squared Mahalanobis distances (n,) of measured from expected points (5.14); NaN if none."""
    r = points - expected
    S = covs + expected_covs
    usable = np.isfinite(r).all(axis=1) & np.isfinite(S).all(axis=(1, 2))
    d2 = np.full(len(points), np.nan)
    d2[usable] = np.einsum("ni,nij,nj->n", r[usable], np.linalg.inv(S[usable]), r[usable])
    return d2


def occlusion_map(grid: Grid, pose: Array, angles: Array, ranges: Array, margin_m: float) -> Bools:
    """Which cells (cells,) the reference scan observed, free or hit; others are occluded (5.4).

    Args:
        grid: cells.
        pose: (3,) of the laser.
        angles: (n,) rad, evenly spaced and ascending.
        ranges: (n,) m, NaN without a return (then nothing is known to have been observed).
        margin_m: depth of the surface behind a return.
    """
    centers = grid.centers(np.arange(grid.shape[0] * grid.shape[1]))
    away = centers - pose[:2]
    # bearings relative to the middle of the fan: relative to its first beam they would have to go
    # from 0 to the field of view, of which an angle that is wrapped to (-pi, pi] has the first half
    step, middle = angles[1] - angles[0], (angles[0] + angles[-1]) / 2
    bearing = wrap(np.arctan2(away[:, 1], away[:, 0]) - pose[2] - middle)
    beam = np.floor((bearing + middle - angles[0]) / step + 0.5).astype(int)
    n = len(angles)
    if n * step > 2 * np.pi - 0.5 * step:  # the circle is closed: behind the last comes the first
        beam %= n
    inside = (beam >= 0) & (beam < n)
    seen = ranges[np.clip(beam, 0, n - 1)] + margin_m
    return np.asarray(inside & (np.hypot(*away.T) <= np.nan_to_num(seen, nan=-1.0)))


@dataclass(frozen=True, slots=True, eq=False)
class BeamComparison:
    """Beams (n,) against what is expected of them.

    Attributes:
        ranges: expected, m; NaN where there is no dent.
        sigmas: standard deviation of that, m.
        d2: squared distance of measured and expected point (5.14); NaN where not compared.
        dismissed: nearer than expected, where the reference was occluded (5.4).
    """

    ranges: Array
    sigmas: Array
    d2: Array
    dismissed: Bools

    @property
    def compared(self) -> Bools:
        """(n,) beams that have both a return and an expected one."""
        return np.isfinite(self.d2)

    def differs(self, gate: float) -> Bools:
        """(n,) beams whose squared distance exceeds a gate, and that are not dismissed."""
        return np.asarray((np.nan_to_num(self.d2) > gate) & ~self.dismissed)

    @classmethod
    def joined(cls, parts: "Sequence[BeamComparison]") -> "BeamComparison":
        """Several scans one after another."""
        return cls(
            np.concatenate([part.ranges for part in parts]),
            np.concatenate([part.sigmas for part in parts]),
            np.concatenate([part.d2 for part in parts]),
            np.concatenate([part.dismissed for part in parts]),
        )


def compare_scan(
    dents: DentMap,
    visible: Bools,
    pose: Array,
    cov: Array,
    angles: Array,
    ranges: Array,
    noise: LaserNoise,
) -> BeamComparison:
    """One scan against the reference map (5.13, 5.14) and the occlusion map (5.4).

    Args:
        dents: reference map.
        visible: (cells,) see `occlusion_map`.
        pose: (3,) of the laser.
        cov: (3, 3) of it.
        angles: (n,) rad.
        ranges: (n,) m, NaN without a return.
        noise: of a beam.
    """
    reach = float(np.nanmax(ranges, initial=0.0)) + 1.0
    expected, expected_covs = expected_measurements(dents, pose, angles, reach)
    points = scan_points(pose, angles, ranges)
    covs = point_covariances(pose, cov, angles, np.nan_to_num(ranges, nan=1.0), noise)
    d2 = squared_mahalanobis(points, covs, scan_points(pose, angles, expected), expected_covs)
    cell = dents.grid.cells(points)
    hidden = (cell < 0) | ~visible[cell]
    # what stands where the reference was occluded may have been there all along
    dismissed = hidden & (ranges < np.nan_to_num(expected))
    return BeamComparison(expected, np.sqrt(expected_covs[:, 0, 0]), d2, np.asarray(dismissed))


def changed_beams(
    dents: DentMap,
    visible: Bools,
    pose: Array,
    cov: Array,
    angles: Array,
    ranges: Array,
    noise: LaserNoise,
    gate: float,
    consecutive: int = 1,
) -> tuple[Bools, Bools]:
    """The thesis' detector for one scan: which beams (n,) are compared, and which show a change.

    ``gate`` is on the squared distance of 5.14; ``consecutive`` the least number of flagged
    neighbours in a row, 1 = the rule is off. The others: see `compare_scan`.
    """
    found = compare_scan(dents, visible, pose, cov, angles, ranges, noise)
    marked = found.differs(gate)
    return found.compared, marked & consecutive_runs(marked, consecutive)


def consecutive_runs(marked: Bools, least: int) -> Bools:
    """Which of ``marked`` (n,) are in a run of at least ``least`` marked ones (5.3)."""
    run, _ = label(marked)
    return np.asarray(marked & (np.bincount(run)[run] >= least))
