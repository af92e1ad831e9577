"""Search for places in the whole map of another robot, at all headings and positions.

Points of a place are correlated with occupied and free space, by Fourier transform (E. Olson, ICRA
2009, DOI 10.1109/ROBOT.2009.5152375, for this kind of search).
"""

from collections.abc import Sequence

import numpy as np

from graphslam.core.config import MultiRobotConfig
from graphslam.core.geometry import Array, between, compose, inverse, transform, unit_vectors
from graphslam.mapping.loop_closure import NEAR_M
from graphslam.mapping.submaps import SubmapPose
from graphslam.perception.correlation import GridSpectrum, grid_spectrum, occupancy_grid

#: rad: heading steps of the search; they move points 7 m from the laser by one cell
STEP_RAD = np.radians(2.5)
#: value of free cells; an occupied cell has 1
FREE = -0.5
#: poses that a search finds at most
MAX_POSES = 6
#: m, rad: poses nearer to each other are not distinct
DISTINCT_M, DISTINCT_RAD = 1.0, np.radians(15.0)
#: passes of a place with which another one is compared
MAX_PASSES = 3
#: another pose at which all places together reach this share of the score may be the right one
ALTERNATIVE_SHARE = 0.8


def nearest_of_each_pass(positions: Array, pose: Array) -> list[int]:
    """Index of the nearest of places (n, 2) in each pass by a pose (3,); `MAX_PASSES` at most.

    A pass is a run of consecutive places close to the pose.
    """
    distance = np.hypot(*(positions - pose[:2]).T)
    near = np.flatnonzero(distance <= NEAR_M)
    passes = np.split(near, np.flatnonzero(np.diff(near) > 1) + 1)
    nearest = [int(s[distance[s].argmin()]) for s in passes if len(s)]
    return sorted(nearest, key=lambda j: float(distance[j]))[:MAX_PASSES]


def map_spectrum(
    places: Sequence[SubmapPose], margin_m: float, config: MultiRobotConfig
) -> GridSpectrum:
    """The map of all places, with a margin as wide as what is searched for extends."""
    occupied = np.concatenate([transform(p.pose, p.submap.points) for p in places])
    free = np.concatenate([_free_points(p, config) for p in places])
    margin = int(np.ceil(margin_m / config.place_cell_m)) + 1
    return grid_spectrum(occupancy_grid(occupied, config.place_cell_m, margin, free, FREE))


def _free_points(place: SubmapPose, config: MultiRobotConfig) -> Array:
    """Points (n, 2) m, in the robot's frame, in the free space of a place's scans."""
    submap = place.submap
    free = submap.free[:, ::2]
    along = np.arange(0.0, config.place_range_m, config.place_cell_m)
    angle = 2 * np.pi * np.arange(free.shape[1]) / free.shape[1]
    scan, beam, step = np.nonzero(along < free[:, :, None])
    sensors = compose(place.pose, submap.poses)
    ray = unit_vectors(sensors[scan, 2] + angle[beam])
    return np.asarray(sensors[scan, :2] + along[step][:, None] * ray)


def search_poses(spectrum: GridSpectrum, points: Array, range_m: float) -> list[Array]:
    """Poses (3,), best first, at which points (n, 2) of a submap fit a map well.

    Points farther than ``range_m`` are left out.
    """
    near = points[np.hypot(points[:, 0], points[:, 1]) < range_m]
    if not len(near):
        return []
    cell_m = spectrum.cell_m
    near = np.unique(np.round(near / cell_m), axis=0) * cell_m
    best = np.full(spectrum.shape, -np.inf, dtype=np.float32)
    best_turn = np.zeros(spectrum.shape)
    for turn in np.arange(-np.pi, np.pi, STEP_RAD):
        scores = spectrum.correlate(transform(np.array([0.0, 0.0, turn]), near))
        better = scores > best
        best[better], best_turn[better] = scores[better], turn
    found: list[Array] = []
    x, y = (np.arange(n) for n in spectrum.shape)
    while len(found) < MAX_POSES and best.max() > 0:
        i, j = np.unravel_index(int(best.argmax()), best.shape)
        found.append(np.array([*(spectrum.low + cell_m * np.array([i, j])), best_turn[i, j]]))
        best[(x[:, None] - i) ** 2 + (y - j) ** 2 < (DISTINCT_M / cell_m) ** 2] = -np.inf
    return found


def alternative_alignments(
    start: Array,
    places_a: Sequence[SubmapPose],
    places_b: Sequence[SubmapPose],
    config: MultiRobotConfig,
    apart_m: float = DISTINCT_M,
) -> list[Array]:
    """Distinct starts (3,) at which all places together fit the map nearly as well as at ``start``.

    A hall looks the same turned by half a turn, and few of its places may show otherwise.

    Args:
        start: (3,) of robot b in the frame of robot a.
        places_a: places of a, in its frame.
        places_b: places of b, in its frame; those where a was not, by ``start``, are left out.
        config: settings.
        apart_m: m, between starts that are distinct though they are turned alike.
    """
    positions = np.array([p.pose[:2] for p in places_a])
    shared = [p for p in places_b if nearest_of_each_pass(positions, compose(start, p.pose))]
    points = np.concatenate([transform(p.pose, p.submap.points) for p in shared])
    middle = np.array([*points.mean(axis=0), 0.0])
    cell_m = config.place_cell_m
    points = np.unique(np.round((points - middle[:2]) / cell_m), axis=0) * cell_m
    spectrum = map_spectrum(places_a, float(np.hypot(*points.T).max()), config)
    own = compose(start, middle)
    x, y = (spectrum.low[k] + cell_m * np.arange(spectrum.shape[k]) for k in (0, 1))
    close = (x[:, None] - own[0]) ** 2 + (y - own[1]) ** 2 < apart_m**2
    at_start, best_of_turn = 0.0, []
    for turn in np.arange(0.0, 2 * np.pi, STEP_RAD):
        heading = own[2] + turn
        scores = spectrum.correlate(transform(np.array([0.0, 0.0, heading]), points))
        if min(turn, 2 * np.pi - turn) < DISTINCT_RAD:
            at_start = max(at_start, float(scores[close].max()))
            scores = np.where(close, 0.0, scores)
        i, j = np.unravel_index(int(scores.argmax()), scores.shape)
        best_of_turn.append((float(scores[i, j]), np.array([x[i], y[j], heading])))
    found: list[Array] = []
    for score, pose in sorted(best_of_turn, key=lambda one: -one[0]):
        if score <= ALTERNATIVE_SHARE * at_start or len(found) == MAX_POSES:
            break
        off = [between(other, pose) for other in found]
        if all(np.hypot(d[0], d[1]) > apart_m or abs(d[2]) > DISTINCT_RAD for d in off):
            found.append(pose)
    return [compose(pose, inverse(middle)) for pose in found]
