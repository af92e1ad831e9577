"""Nonrigid registration: the later scans in the reference's map where no rigid motion fits.

Two runs through the same place have maps that are bent differently where little constrains them:
odometry along a corridor, few loop closures. Each scan still fits the reference's surfaces. Both
paths are refined by their own scans (`path_refinement`); rigid motions that make the maps overlap
are found by correlation; from each of them one path is fitted to the other's surfaces as an elastic
whole (`elastic_path`), each of the two to the other, and the fit with the highest agreement is
kept. From there the scans of both visits can be aligned at once (`aligned_at_once`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from graphslam.change_detection.elastic_path import fit_elastic_path
from graphslam.change_detection.grid import grid_over
from graphslam.change_detection.path_refinement import refine_path, refine_together
from graphslam.change_detection.rigid_registration import Registration
from graphslam.change_detection.surface_map import Surface, fit_surfaces
from graphslam.change_detection.visit import Bools, Visit
from graphslam.core.config import ChangesConfig
from graphslam.core.errors import OutputError
from graphslam.core.geometry import Array, compose, inverse, rotation, wrap
from graphslam.core.worker import parallel_map
from graphslam.perception.correlation import grid_spectrum, occupancy_grid

#: stated covariance of a registered scan, (2 cm, 2 cm, 0.5 deg)²: a bound, as the map is bent
_SCAN_COV = np.diag([0.02, 0.02, np.radians(0.5)]) ** 2
#: gates of the elastic fit over `max_pose_error_m`: refined maps differ by twice that at most
_GATES = np.repeat([2.0, 1.4, 1.0, 0.8, 0.6, 0.4, 0.3, 0.2], 3)
#: the fit is repeated while it raises the agreement by this share, this many times at most
_MAX_ROUNDS, _MIN_GAIN = 6, 0.01
#: times `resolution_m`: largest distance of a return that agrees with a surface; cell of the
#: correlation
_COARSE = 4
#: least share of a scan's returns that agree (legs and clutter are no surfaces); of a run's scans
_SCAN_SHARE, _RUN_SHARE = 0.3, 0.5
_MIN_RETURNS = 20  # of a scan: fewer may agree by chance
#: correlation: most cells of a side, step of the rotation, rad, and number of candidates; points
#: outside of these quantiles are left out
_MAX_CELLS, _TURN_RAD, _CANDIDATES = 600, np.radians(2.0), 6
_QUANTILES = (0.005, 0.995)


@dataclass(frozen=True, slots=True, eq=False)
class BentVisits:
    """Two visits in one frame, each scan at a pose of its own.

    ``started`` (s, 3) are the poses of the ``later`` scans before. ``shapes``: the poses of both
    paths as their own scans refine them, each in any frame.
    """

    reference: Visit
    later: Visit
    started: Array
    shapes: Sequence[Array]

    def registered(
        self, config: ChangesConfig, *, whole_reference: bool
    ) -> tuple[Visit, Visit, Registration]:
        """Both visits without scans that do not fit the other's surfaces, and the registration.

        That is the mean motion of the later scans that are left, with their scatter as covariance.
        Of the ``whole_reference`` none are left out.

        Raises:
            OutputError: too few of the later scans fit.
        """
        near_m = _COARSE * config.resolution_m
        share = agreement(_surfaces(self.reference, config), self.later, near_m)
        kept: Bools = share > _SCAN_SHARE
        if kept.mean() < _RUN_SHARE:
            raise OutputError(
                "the two runs cannot be registered: no motion brings their landmarks together, and "
                f"only {100 * kept.mean():.0f} % of the later scans fit the reference's surfaces, "
                "however the path is bent; did both drive through the same place?"
            )
        motions = compose(self.later.poses[kept], inverse(self.started[kept]))
        mean = motions.mean(axis=0)
        mean[2] = np.arctan2(np.sin(motions[:, 2]).mean(), np.cos(motions[:, 2]).mean())
        away = motions - mean
        away[:, 2] = wrap(away[:, 2])
        cov = away.T @ away / len(away) + _SCAN_COV
        registration = Registration(mean, cov, np.zeros((0, 2), dtype=np.int64))
        later = self.later.select(kept)
        reference = self.reference
        if not whole_reference:
            seen = agreement(_surfaces(later, config), reference, near_m) > _SCAN_SHARE
            reference = reference.select(seen)
        return _with_stated_cov(reference), _with_stated_cov(later), registration


def register_nonrigid(
    reference: Visit, later: Visit, config: ChangesConfig
) -> tuple[BentVisits, BentVisits]:
    """Both visits in one frame, in which the reference's first scan stays, in two ways.

    In the first the later path is fitted to the reference's surfaces. The second is that or the
    reference's path fitted to the later surfaces, whichever agrees better: which of two bent maps
    is the reference is arbitrary, and it is the one bent less in which the other one is found.
    """
    started = later.poses
    reference, later = parallel_map(refine_path, [reference, later])
    shapes = reference.poses, later.poses
    (fitted, share), (turned, share_turned) = parallel_map(
        lambda pair: _fit(*pair, config), [(reference, later), (later, reference)]
    )
    first = BentVisits(reference, fitted, started, shapes)
    if share_turned.mean() <= share.mean():
        return first, first
    back = compose(reference.poses[0], inverse(turned.poses[0]))
    visits = turned.transformed(back, _SCAN_COV), later.transformed(back, _SCAN_COV)
    return first, BentVisits(*visits, started, shapes)


def aligned_at_once(visits: BentVisits) -> BentVisits:
    """The visits where all scans of both agree best."""
    reference, later = refine_together((visits.reference, visits.later), visits.shapes)
    return replace(visits, reference=reference, later=later)


def _surfaces(visit: Visit, config: ChangesConfig) -> Surface:
    grid = grid_over(visit.ends_of(visit.surface), config.resolution_m, config.max_side_cells**2)
    return fit_surfaces(visit, grid, config.range_sigma_m, config)


def _fit(reference: Visit, later: Visit, config: ChangesConfig) -> tuple[Visit, Array]:
    """The later visit fitted to the reference's surfaces, and the agreement (s,) of its scans.

    The best fit from any rigid motion is fitted again: scans that lie on the surfaces pull in
    their neighbours.
    """
    surface, near_m = _surfaces(reference, config), _COARSE * config.resolution_m
    gates = tuple((config.max_pose_error_m * _GATES).tolist())
    candidates = correlate_maps(
        reference.ends_of(reference.surface), later.ends_of(later.surface), near_m
    )
    fits = []
    for motion in candidates:
        start = later.transformed(motion, _SCAN_COV)
        fit = fit_elastic_path(start, later.poses, surface, gates)
        fits.append((fit, agreement(surface, fit, near_m)))
    # the mean over all scans decides: a single scan may agree by chance
    best, share = max(fits, key=lambda one: float(one[1].mean()))
    for _ in range(_MAX_ROUNDS):
        fit = fit_elastic_path(best, later.poses, surface, gates)
        now = agreement(surface, fit, near_m)
        if now.mean() < share.mean() + _MIN_GAIN:
            break
        best, share = fit, now
    return best, share


def _with_stated_cov(visit: Visit) -> Visit:
    covs = np.tile(_SCAN_COV, (len(visit.poses), 1, 1))
    return replace(visit, covs=covs, shared=covs)


def agreement(surface: Surface, visit: Visit, near_m: float) -> Array:
    """Share (s,) of each scan's returns within ``near_m`` of a surface; 0 if it has too few."""
    beams = np.nonzero(visit.surface)[0]
    cell = surface.nearest.grid.cells(visit.ends_of(beams))
    near = (cell >= 0) & (surface.nearest.distance_m[cell] < near_m)
    scan, size = visit.scan[beams], len(visit.poses)
    returns = np.bincount(scan, minlength=size)
    share = np.bincount(scan, near, size) / np.maximum(returns, 1)
    return np.asarray(np.where(returns >= _MIN_RETURNS, share, 0.0))


def correlate_maps(reference: Array, later: Array, cell_m: float) -> list[Array]:
    """Motions (3,), best first, with which the maps' points (n, 2), (m, 2) m overlap most.

    Exhaustive over rotations and shifts, in cells of ``cell_m`` or larger ones.
    """
    low, high = np.quantile(reference, _QUANTILES, axis=0)
    middle = np.median(later, axis=0)
    distance = np.hypot(*(later - middle).T)
    radius = float(np.quantile(distance, _QUANTILES[1]))
    cell = max(cell_m, (float((high - low).max()) + 2 * radius) / _MAX_CELLS)
    inside = ((reference >= low) & (reference <= high)).all(axis=1)
    grid = occupancy_grid(reference[inside], cell, int(np.ceil(radius / cell)) + 1)
    spectrum = grid_spectrum(grid)
    # every cell counts once, however many returns ended in it
    later = np.unique(np.round((later - middle)[distance <= radius] / cell), axis=0) * cell
    found = []
    for turn in np.arange(0, 2 * np.pi, _TURN_RAD):
        scores = spectrum.correlate(later @ rotation(turn).T)
        best = np.array(np.unravel_index(int(scores.argmax()), scores.shape))
        shift = grid.low + best * cell - rotation(turn) @ middle
        found.append((float(scores.max()), np.array([*shift, wrap(turn)])))
    found.sort(key=lambda one: -one[0])
    return [motion for _, motion in found[:_CANDIDATES]]
