"""Each later scan in the map of the reference, where no rigid motion brings the maps together.

Two runs through the same place bend their maps differently where little holds them: odometry over
a corridor, few loops. Each scan still fits the reference's surfaces somewhere. Where is found by
laying one map over the other in all ways, straightened; from the best of these the later path is
bent onto the reference's surfaces as a whole (`flexed`), and the one that agrees most is taken.
"""

from dataclasses import replace

import cv2
import numpy as np

from graphslam.change_detection.elastic_path import fit_elastic_path
from graphslam.change_detection.grid import grid_over
from graphslam.change_detection.path_refinement import refine_path
from graphslam.change_detection.rigid_registration import Registration
from graphslam.change_detection.surface_map import Surface, fit_surfaces
from graphslam.change_detection.visit import Bools, Visit
from graphslam.core.config import ChangesConfig
from graphslam.core.errors import OutputError
from graphslam.core.geometry import Array, compose, inverse, rotation, wrap

#: sigmas that are stated of a placed scan: of a map that bends they are no more than a bound
_PLACED_COV = np.diag([0.02, 0.02, np.radians(0.5)]) ** 2
#: farthest returns that pull, m, round by round; the widest is what straight maps differ by
_GATES = tuple(np.repeat([1.0, 0.7, 0.5, 0.4, 0.3, 0.2, 0.15, 0.1], 3).tolist())
#: a map is laid again as long as this share more of its returns agree
_MOST_ROUNDS, _LEAST_GAIN = 6, 0.01
_RANGE_SIGMA_M = 0.02
#: a return this near to a surface of the reference, m, agrees with it
_AGREES_M = 0.1
#: shares of a scan's returns that must agree (legs and clutter are no surfaces); of scans that must
_SCAN_SHARE, _RUN_SHARE = 0.3, 0.5
_FEWEST = 20  # returns of a scan that may agree by chance
#: pictures of the maps: cells, m, and how many a side; turns that are tried, rad; best of them kept
_CELL_M, _MOST_CELLS, _TURN_RAD, _OVERLAYS = 0.1, 600, np.radians(2.0), 6


def register_nonrigid(
    reference: Visit, later: Visit, config: ChangesConfig
) -> tuple[Visit, Visit, Registration]:
    """Both visits, straightened, in one frame: that in which the reference's first scan stays.

    Scans that fit nowhere are left out.

    Args:
        reference: in its world frame.
        later: in its own.
        config: settings.

    Returns:
        The reference, the later visit, and the mean of its scans' motions with their scatter.

    Raises:
        OutputError: too few of the scans fit.
    """
    started = later.poses
    reference, later = refine_path(reference), refine_path(later)
    ends = reference.ends[reference.surface]
    grid = grid_over(ends, config.resolution_m, config.max_side_cells**2)
    surface = fit_surfaces(reference, grid, _RANGE_SIGMA_M, config)
    placed, share = _laid(surface, later, correlate_maps(ends, later.ends[later.surface]))
    placed_share = float((share > _SCAN_SHARE).mean())
    if placed_share < _RUN_SHARE:
        raise OutputError(
            "the two runs cannot be registered: no motion brings their landmarks together, and "
            f"only {100 * placed_share:.0f} % of the later scans fit the reference's surfaces, "
            "however the path is bent; did both drive through the same place?"
        )
    kept: Bools = share > _SCAN_SHARE
    motions = compose(placed.poses[kept], inverse(started[kept]))
    mean = motions.mean(axis=0)
    mean[2] = np.arctan2(np.sin(motions[:, 2]).mean(), np.cos(motions[:, 2]).mean())
    away = motions - mean
    away[:, 2] = wrap(away[:, 2])
    cov = away.T @ away / len(away) + _PLACED_COV
    none = np.zeros((0, 2), dtype=np.int64)
    return (
        _as_placed(reference),
        _as_placed(placed.select(kept)),
        Registration(mean, cov, none, np.zeros(0, dtype=np.int64)),
    )


def _laid(surface: Surface, later: Visit, guesses: list[Array]) -> tuple[Visit, Array]:
    """The visit laid onto the surfaces from one of ``guesses`` (3,), and what agrees per scan.

    That from which most agrees is gone on with. What lies on the surfaces pulls in what comes
    before and after, again and again while that helps.
    """
    tried = []
    for guess in guesses:
        laid = fit_elastic_path(later.transformed(guess, _PLACED_COV), later.poses, surface, _GATES)
        tried.append((laid, agreement(surface, laid)))
    # how much agrees in all counts: a scan may agree by chance
    best, share = max(tried, key=lambda one: float(one[1].mean()))
    for _ in range(_MOST_ROUNDS):
        laid = fit_elastic_path(best, later.poses, surface, _GATES)
        now = agreement(surface, laid)
        if now.mean() < share.mean() + _LEAST_GAIN:
            break
        best, share = laid, now
    return best, share


def _as_placed(visit: Visit) -> Visit:
    covs = np.tile(_PLACED_COV, (len(visit.poses), 1, 1))
    return replace(visit, covs=covs, shared=covs)


def agreement(surface: Surface, visit: Visit) -> Array:
    """Share (s,) of each scan's returns that lie on a surface; 0 for scans with hardly any."""
    beams = np.nonzero(visit.surface)[0]
    cell = surface.nearest.grid.cells(visit.ends[beams])
    near = (cell >= 0) & (surface.nearest.distance_m[cell] < _AGREES_M)
    scan, size = visit.scan[beams], len(visit.poses)
    returns = np.bincount(scan, minlength=size)
    share = np.bincount(scan, near, size) / np.maximum(returns, 1)
    return np.asarray(np.where(returns >= _FEWEST, share, 0.0))


def correlate_maps(reference: Array, later: Array) -> list[Array]:
    """Motions (3,) with which the two maps' points (n, 2), (m, 2) m overlap most.

    All turns and shifts are tried: the correlation of two pictures is a product of their spectra.
    """
    low, high = np.quantile(reference, [0.005, 0.995], axis=0)
    middle = np.median(later, axis=0)
    later = later - middle
    radius = float(np.quantile(np.hypot(*later.T), 0.995))
    side = float((high - low).max()) + 2 * radius
    cell = max(_CELL_M, side / _MOST_CELLS)
    size = int(np.ceil(side / cell)) + 2
    spectrum = np.fft.rfft2(_picture(reference - (low + high) / 2, cell, size))
    found = []
    for turn in np.arange(0, 2 * np.pi, _TURN_RAD):
        other = np.fft.rfft2(_picture(later @ rotation(turn).T, cell, size))
        match = np.fft.irfft2(spectrum * np.conj(other), (size, size))
        steps = np.array(np.unravel_index(int(match.argmax()), match.shape))
        steps = np.where(steps > size // 2, steps - size, steps)
        to = (low + high) / 2 + steps * cell
        found.append((float(match.max()), np.array([*(to - rotation(turn) @ middle), wrap(turn)])))
    found.sort(key=lambda one: -one[0])
    return [motion for _, motion in found[:_OVERLAYS]]


def _picture(points: Array, cell_m: float, size: int) -> Array:
    """Where points (n, 2) m about the origin lie, (size, size), 0 to 1, a little blurred."""
    ij = np.floor(points / cell_m).astype(np.int64) + size // 2
    ij = ij[((ij >= 0) & (ij < size)).all(axis=1)]
    image = np.zeros((size, size), dtype=np.float32)
    image[ij[:, 0], ij[:, 1]] = 1.0
    return np.asarray(cv2.GaussianBlur(image, (3, 3), 0), dtype=float)
