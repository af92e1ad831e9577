"""Landmarks of different visits that lie on each other are one, where that is certain."""

import numpy as np
import pytest

from graphslam.mapping.duplicate_landmarks import near_pairs
from graphslam.mapping.landmark_map import Entry, LandmarkMap
from graphslam.mapping.visits import tie_visits


def landmarks(*means, kind="line"):
    found = LandmarkMap()
    for n, mean in enumerate(means):
        found.entries[n] = Entry(
            n, kind, np.array(mean, dtype=float), np.eye(3), np.array([-2.0, 2.0]), n, n, None,
            in_graph=True,
        )  # fmt: skip
    return found


def sigmas(across_m, heading_rad):
    return lambda a, _b, _at, _normals: np.tile([across_m, heading_rad], (len(a), 1))


WALLS = [[0, 0, 0], [0.5, 0.03, 0.01], [0, 0.3, 0], [0.2, -0.02, 0.0]]


def test_walls_that_lie_on_each_other_are_tied_into_the_oldest():
    found = landmarks(*WALLS)
    assert tie_visits(found, sigmas(0.01, 0.005), ()) == {1: 0, 3: 0}


@pytest.mark.parametrize("unknown", [(0.1, 0.005), (0.01, 0.05)])
def test_nothing_is_tied_where_the_relative_pose_is_not_known(unknown):
    """Then a wall cannot be told from its neighbour, however near it seems."""
    assert tie_visits(landmarks(*WALLS), sigmas(*unknown), ()) == {}


def test_what_one_image_showed_as_two_things_stays_two():
    """Not even by way of a third that lies on both."""
    assert tie_visits(landmarks(*WALLS), sigmas(0.01, 0.005), [frozenset({0, 1})]) == {3: 0}


def test_a_wall_seen_whole_and_in_part_is_a_line():
    found = landmarks(*WALLS[:2])
    found.entries[0].kind = "segment"
    assert tie_visits(found, sigmas(0.01, 0.005), ()) == {1: 0}
    assert found.entries[0].kind == "line"


def test_points_are_tied_by_their_distance():
    found = landmarks([0, 0, 0], [0.05, 0.0, 0], [0.3, 0, 0], kind="point")
    assert tie_visits(found, sigmas(0.01, 0.005), ()) == {1: 0}


def test_pairs_near_each_other_grow_with_the_map_not_with_its_square():
    """A row of walls 10 m apart, each seen twice: one pair per wall, however many there are."""
    for n in (10, 100):
        x = np.zeros((2 * n, 3))
        x[:, 0] = 10.0 * np.repeat(np.arange(n), 2)
        i, j = near_pairs(x, np.tile([-2.0, 2.0], (2 * n, 1)), np.zeros(2 * n, dtype=bool), 1.0)
        np.testing.assert_array_equal(j - i, 1)
        assert len(i) == n
