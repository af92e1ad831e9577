"""Which points images should show: they see others behind and beside them."""

import numpy as np
from scipy.spatial import cKDTree

from graphslam.core.arrays import IntArray
from graphslam.core.geometry import Array, between, wrap

#: share of the largest range in an image, and rad from its outermost bearings: what is within is in
#: sight, since what is behind it or beside it is seen
NEARER, MARGIN_RAD = 0.9, 0.05


def points_in_sight(places: Array, poses: Array, image: IntArray, z: Array) -> IntArray:
    """Pairs (k, 2) of image and point such that the image shows others behind and beside it.

    ``places`` (n, 2) m are the points, ``poses`` (m, 3) those of the images; ``image`` (s,) and
    ``z`` (s, 2), bearing rad and range m, are the sightings.
    """
    m = len(poses)
    reach = np.zeros(m)
    np.maximum.at(reach, image, NEARER * z[:, 1])
    middle = np.arctan2(*(np.bincount(image, f(z[:, 0]), m) for f in (np.sin, np.cos)))
    low, high = np.full(m, np.inf), np.full(m, -np.inf)
    beside = wrap(z[:, 0] - middle[image])
    np.minimum.at(low, image, beside + MARGIN_RAD)
    np.maximum.at(high, image, beside - MARGIN_RAD)
    near = cKDTree(places).query_ball_point(poses[:, :2], reach)
    size = np.array([len(found) for found in near])
    pairs = np.column_stack([
        np.repeat(np.arange(m), size), np.concatenate([np.array(f, dtype=np.int64) for f in near])
    ])  # fmt: skip
    k = pairs[:, 0]
    x, y = between(poses[k], np.column_stack([places[pairs[:, 1]], np.zeros(len(k))]))[:, :2].T
    bearing = wrap(np.arctan2(y, x) - middle[k])
    return np.asarray(pairs[(bearing > low[k]) & (bearing < high[k])])
