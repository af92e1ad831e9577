"""Which points images should show: they see others behind and beside them."""

import numpy as np
from scipy.spatial import cKDTree

from graphslam.core.arrays import IntArray
from graphslam.core.geometry import Array, between, wrap

#: share of the largest range in an image, and rad from its outermost bearings: what is within is in
#: sight, since what is behind it or beside it is seen
NEARER, MARGIN_RAD = 0.9, 0.05
#: images that are compared with all points at once
BLOCK = 1000


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
    tree, found = cKDTree(places), [np.zeros((0, 2), dtype=np.int64)]
    for begin in range(0, m, BLOCK):
        end = min(begin + BLOCK, m)
        near = tree.query_ball_point(poses[begin:end, :2], reach[begin:end])
        k = np.repeat(np.arange(begin, end), [len(own) for own in near])
        point = np.concatenate([np.array(own, dtype=np.int64) for own in near])
        x, y = between(poses[k], np.column_stack([places[point], np.zeros(len(k))]))[:, :2].T
        bearing = wrap(np.arctan2(y, x) - middle[k])
        inside = (bearing > low[k]) & (bearing < high[k])
        found.append(np.column_stack([k[inside], point[inside]]))
    return np.concatenate(found)
