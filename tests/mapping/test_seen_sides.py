"""From which side walls of an earlier map were seen, by the scans of its places."""

import numpy as np
import pytest

from graphslam.core.config import ScanMatchingConfig
from graphslam.core.geometry import between, compose, transform
from graphslam.mapping.known_map import map_place
from graphslam.mapping.seen_sides import seen_sides

LENGTH_M = 3.0


def place(number, at, sensor, *walls):
    """A place whose one scan, from ``sensor`` in its frame, has 30 returns on each wall (3,)."""
    laser = compose(np.array(at, float), np.array(sensor, float))
    along = np.column_stack([np.linspace(-1.4, 1.4, 30), np.zeros(30)])
    world = np.concatenate([transform(np.array(wall, float), along) for wall in walls])
    own = between(laser, np.column_stack([world, np.zeros(len(world))]))[:, :2]
    return map_place(number, np.array(at, float), np.array([sensor], float), [own], MATCHING)


MATCHING = ScanMatchingConfig()


def sides(walls, *places):
    walls = np.array(walls, float).reshape(-1, 3)
    return seen_sides(walls, np.full(len(walls), LENGTH_M), places).tolist()


@pytest.mark.parametrize("turn", [0.0, 0.7, 2.0, -3.0])
def test_the_side_is_where_the_laser_was(turn):
    """To the left of the wall's direction it is 1, wherever the map lies and the laser looks, and
    wherever it is mounted: place and mount are on different sides of the wall here."""
    world = np.array([20.0, -5.0, turn])
    wall = compose(world, np.array([3.0, 1.0, 0.4]))
    back = compose(wall, np.array([0.0, 0.0, np.pi]))
    laser = compose(wall, np.array([0.3, 1.5, 2.0]))
    mount = np.array([2.0, 0.0, -1.0])
    at = compose(laser, between(mount, np.zeros(3)))
    seen = place(0, at, mount, wall)
    assert sides([wall, back], seen) == [1.0, -1.0]


def test_faces_of_a_partition_are_told_apart():
    """They are 10 cm apart: returns on the other face would tell the wrong side, or take the right
    one back."""
    front, behind = (0.0, 0.1, 0.0), (0.0, 0.0, 0.0)
    before = place(0, (0.0, 2.0, 0.0), (0.0, 0.0, 0.0), front)
    after = place(1, (0.0, -2.0, 0.0), (0.0, 0.0, 0.0), behind)
    assert sides([front, behind], before, after, after) == [1.0, -1.0]


def test_what_no_place_has_seen_is_not_known():
    """Nor is a wall that another one, in its plane, goes on as: beyond its ends nothing counts."""
    wall, next_one, far = (0.0, 0.0, 0.0), (LENGTH_M, 0.0, 0.0), (0.0, 30.0, 0.0)
    seen = place(0, (0.0, 2.0, 0.0), (0.0, 0.0, 0.0), wall)
    assert sides([wall, next_one, far], seen) == [1.0, 0.0, 0.0]
    assert sides([wall]) == [0.0]
    assert sides([], seen) == []
