"""The surfaces that a single scan shows: points on them, also between its returns.

Far away the returns of a wall are as far apart as the beams, half a metre at 25 m. The end of a
corridor is two to five such returns, and all that tells where along it the robot is. So neighbours
are looked for as far as beams that follow each other are apart, three returns in a line are a
surface, and where two in a row are on one surface it is taken as seen in between: there are then
points of it near whatever the next scan sees. Returns on a flat surface are moved onto the line
through their neighbours, which have less noise.
"""

import numpy as np

from graphslam.core.config import ScanMatchingConfig
from graphslam.core.geometry import Array
from graphslam.perception.scan_matching import information_from_scatter
from graphslam.perception.scan_pairs import surface_scatter

#: returns on either side of one, and their distance at most in cells or in beams on a surface that
#: faces the laser, that show the surface there: with few, noise turns the surface, and walls seem
#: to tell where along them the robot is
BESIDE, NEIGHBOURHOOD_CELLS, NEIGHBOURHOOD_BEAMS = 12, 12, 2.5
#: returns, itself included, that show the surface at a point
FEWEST = 3
#: standard deviation of returns across a flat surface at most, and offset of a return across that
#: of its neighbour, in ``point_sigma_m``
FLAT_SIGMAS, SAME_SIGMAS = 0.6, 2.0
#: m: surfaces have a point as often as this
SPACING_M = 0.1
#: determinant over squared trace of information: less is that across a line, 1/4 that of clutter
LINE = 1e-6


def scan_surfaces(
    points: Array, laser: Array, step_rad: float, config: ScanMatchingConfig
) -> tuple[Array, Array]:
    """Points (m, 2) m on the surfaces of a scan and their information (m, 2, 2), see `Submap`.

    Args:
        points: (n, 2) m of the scan in the order of its beams.
        laser: (2,) m, where it was.
        step_rad: angle between two beams.
        config: noise, size of cells.
    """
    apart_m = abs(step_rad) * np.hypot(*(points - laser).T)
    near_m = np.maximum(NEIGHBOURHOOD_CELLS * config.cell_m, NEIGHBOURHOOD_BEAMS * apart_m)
    scan = np.zeros(len(points), dtype=np.intp)
    count, mean, (xx, xy, yy) = surface_scatter(points, scan, near_m, BESIDE)
    information = information_from_scatter(count, xx, xy, yy, config, FEWEST)
    trace = information[:, 0, 0] + information[:, 1, 1]
    is_line = (trace > 0.0) & (np.linalg.det(information) < LINE * trace**2)
    variance = config.point_sigma_m**2
    across = np.einsum("nij,nj->ni", information, mean) * variance
    spread = 0.5 * (xx + yy) - np.sqrt(0.25 * (xx - yy) ** 2 + xy**2)
    flat = is_line & (spread < FLAT_SIGMAS**2 * variance)
    points = points + across * flat[:, None]
    step = np.diff(points, axis=0)
    gap_m = np.hypot(*step.T)
    off = [
        np.einsum("ni,nij,nj->n", step, one, step) for one in (information[:-1], information[1:])
    ]
    on_one = is_line[:-1] & is_line[1:] & (gap_m < np.minimum(near_m[:-1], near_m[1:]))
    on_one &= np.maximum(*off) < SAME_SIGMAS**2
    between = np.where(on_one, np.ceil(gap_m / SPACING_M) - 1, 0).astype(np.intp)
    first = np.repeat(np.arange(len(step)), between)
    number = 1 + np.arange(len(first)) - np.repeat(np.cumsum(between) - between, between)
    share = number / (between[first] + 1)
    added = points[first] + share[:, None] * step[first]
    nearer = first + (share > 0.5)
    return np.concatenate([points, added]), np.concatenate([information, information[nearer]])
