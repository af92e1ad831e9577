"""Nearest neighbours by a grid."""

import numpy as np

from graphslam.perception.nearest_points import NearestPoints, nearest_of_each


def test_of_several_grids_each_is_asked_for_its_own_points():
    """Up to a cell, and outside of a grid none within its reach. Breaks if points are looked up in
    another one's grid, or wrapped around at its border."""
    rng = np.random.default_rng(0)
    known = rng.uniform(-3, 3, (200, 2))
    asked = rng.uniform(-4, 4, (500, 2))
    grids = [NearestPoints.of(known[:100], 0.05, 0.6), NearestPoints.of(known, 0.05, 0.6)]
    near = nearest_of_each(grids, np.stack([asked.T, asked.T], axis=1))
    for size, own in zip((100, 200), near, strict=True):
        distance = np.hypot(*(asked[:, None] - known[:size]).transpose(2, 0, 1))
        least = distance.min(axis=1)
        found = distance[np.arange(500), own]
        # a query and the nearest point are moved to their cells' middles, each by half a diagonal;
        # the mask of the distance transform errs by 2 % of 0.6 m
        near_enough = least < 0.5
        np.testing.assert_array_less(
            found[near_enough], least[near_enough] + 0.05 * np.sqrt(2) + 0.012
        )
        assert found[least > 0.6].min() > 0.6
