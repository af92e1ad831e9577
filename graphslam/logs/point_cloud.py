"""sensor_msgs/PointCloud2 of a planar laser, as scans.

A cloud is planar if its points lie at one height of its frame (one level ring, or what
laser_geometry makes of a LaserScan). Clouds of lasers with several rings and of depth cameras are
not, and are refused: which of their points are walls at the height of a planar map, they do not
say.
"""

from typing import Any

import numpy as np

from graphslam.core.geometry import Array

#: points of a plane lie this close to their median height, m, or see it under this angle, rad
_FLAT_M, _FLAT_RAD = 0.03, np.deg2rad(1.0)
#: share of the points that must lie in the plane
_MOST = 0.98
#: points closer in bearing than this share of a step are echoes of one beam
_SAME_BEAM = 0.2
#: numpy's codes of PointField.datatype
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
#: beams of a full circle at most; a cloud with points more finely spaced is none of a laser
_MAX_BEAMS = 36_000


def cloud_points(message: Any) -> Array:
    """The points (n, 3), m, of a PointCloud2 that are finite and not the origin.

    Raises:
        ValueError: it has no x, y and z of a known type, or its data are shorter than it says.
    """
    places = {field.name: field for field in message.fields if field.datatype in _TYPES}
    if not {"x", "y", "z"} <= places.keys():
        raise ValueError("no x, y and z")
    order = ">" if message.is_bigendian else "<"
    kind: Any = {
        "names": ["x", "y", "z"],
        "formats": [order + _TYPES[places[n].datatype] for n in "xyz"],
        "offsets": [places[n].offset for n in "xyz"],
        "itemsize": message.point_step,
    }
    width, height = message.width, message.height
    data = np.ascontiguousarray(message.data).view(np.uint8)
    # rows may end with bytes that belong to no point
    step = message.row_step or width * message.point_step  # not always set
    rows = data[: height * step].reshape(height, step)
    cells = np.ascontiguousarray(rows[:, : width * message.point_step])
    table = cells.reshape(-1).view(np.dtype(kind))
    points = np.stack([table[n].astype(float) for n in "xyz"], axis=1)
    return np.asarray(points[np.isfinite(points).all(axis=1) & points[:, :2].any(axis=1)])


def is_planar(points: Array) -> bool:
    """Whether points (n, 3) are those of a level planar laser; none are not."""
    if not len(points):
        return False
    off = np.abs(points[:, 2] - np.median(points[:, 2]))
    distance = np.hypot(points[:, 0], points[:, 1])
    flat = off <= np.maximum(_FLAT_M, _FLAT_RAD * distance)
    return bool(np.mean(flat) >= _MOST)


def sweep_of(points: Array) -> tuple[Array, Array]:
    """Bearings (b,) rad, ascending, and ranges (b,) m of points (n, 3), NaN where there are none.

    Of points in one direction the nearest is taken. Beams without a return are not in a cloud;
    where neighbours are farther apart than usual, they are put in again.
    """
    ranges = np.hypot(points[:, 0], points[:, 1])
    bearings = np.arctan2(points[:, 1], points[:, 0])
    order = np.argsort(bearings, kind="stable")
    bearings, ranges = bearings[order], ranges[order]
    step = beam_step(bearings)
    group = np.concatenate([[0], np.cumsum(np.diff(bearings) > _SAME_BEAM * step)])
    nearest = np.lexsort((ranges, group))
    nearest = nearest[np.concatenate([[True], np.diff(group[nearest]) > 0])]
    bearings, ranges = bearings[nearest], ranges[nearest]
    beams = np.maximum(np.rint(np.diff(bearings) / step), 1).astype(np.int64)
    place = np.concatenate([[0], np.cumsum(beams)])
    filled = np.full(int(place[-1]) + 1, np.nan)
    filled[place] = ranges
    return np.interp(np.arange(len(filled)), place, bearings), filled


def beam_step(bearings: Array) -> float:
    """The usual angle between neighbours among bearings (n,), ascending; rad."""
    apart = np.diff(bearings)
    apart = apart[apart > 2 * np.pi / _MAX_BEAMS]
    return float(np.median(apart)) if len(apart) else np.deg2rad(1.0)
