"""Paths that were told to begin somewhere in a map, and fit clearly better somewhere else."""

import numpy as np
import pytest
from walls import cloud, rectangles

from graphslam.core.config import MultiRobotConfig
from graphslam.core.geometry import compose, inverse
from graphslam.core.record import replace
from graphslam.mapping.submaps import SubmapPose
from graphslam.multi_robot import better_starts
from graphslam.multi_robot.better_starts import better_alignment
from graphslam.multi_robot.map_localisation import support
from graphslam.perception.scan_matching import make_submap

#: a hall that looks the same turned by half a turn, but for a cupboard in front of a wall
HALL = rectangles((-8.0, -4.0, 8.0, 4.0), (-5.0, -0.5, -4.0, 0.5), (4.0, -0.5, 5.0, 0.5))
CUPBOARD = rectangles((-7.0, 3.0, -5.5, 4.0))
TABLE = rectangles((0.5, -3.0, 1.5, -2.2))
BIN = rectangles((0.5, -2.8, 0.8, -2.5))
MAP_X, PATH_X = np.arange(-7.0, 7.5, 1.75), np.array([-3.0, -1.0, 1.0])
HALF_A_TURN = np.array([0.0, 0.0, np.pi])


def places(walls, along_x, reach_m=20.0):
    """Places along a line through the hall, a scan at each."""
    made = []
    for k, x in enumerate(along_x.tolist()):
        pose = np.array([x, -0.9, 0.1])
        submap = make_submap(np.zeros((1, 3)), [cloud(pose, walls, limit=reach_m)])
        made.append(SubmapPose(("r", k), pose, 2.0 * k, (k, k), submap))
    return made


def moved(path, motion):
    """The path as if its start had been told elsewhere."""
    return [replace(place, pose=compose(motion, place.pose)) for place in path]


def found(known, path):
    return better_alignment(known, path, support(known, path), MultiRobotConfig())


@pytest.mark.parametrize("more", [[], [BIN]])
def test_a_start_told_half_a_turn_wrong_is_better_where_it_was(more):
    """Though each place is confirmed by walls, and a bin was brought as well."""
    path = places(np.concatenate([HALL, CUPBOARD, *more]), PATH_X)
    known = places(np.concatenate([HALL, CUPBOARD]), MAP_X)
    told = moved(path, HALF_A_TURN)
    assert support(known, told).confirmed.all()
    motion = found(known, told)
    off = compose(inverse(path[0].pose), compose(motion, told[0].pose))
    assert np.hypot(off[0], off[1]) < 0.4
    assert abs(off[2]) < 0.06


def test_what_looks_the_same_is_where_it_was_told():
    """Of a hall without the cupboard, and one in which it is gone: both ways are contradicted."""
    without = places(HALL, PATH_X)
    assert found(places(HALL, MAP_X), moved(without, HALF_A_TURN)) is None
    assert found(places(np.concatenate([HALL, CUPBOARD]), MAP_X), without) is None


def test_what_was_moved_is_no_better_start():
    """The table that was brought contradicts the right start, and every other one too."""
    known = places(np.concatenate([HALL, CUPBOARD]), MAP_X)
    path = places(np.concatenate([HALL, CUPBOARD, TABLE]), PATH_X)
    assert support(known, path).absent.mean() > better_starts.LEAST_ABSENT
    assert found(known, path) is None


def test_where_nothing_is_mapped_nothing_speaks_for_another_start():
    """The map ends where the path begins: the other half, turned, would explain all of it."""
    known = places(HALL, MAP_X[MAP_X < -1.0], reach_m=5.0)
    path = places(HALL, np.array([1.0, 3.0, 5.0]), reach_m=5.0)
    assert found(known, path) is None
    assert found(known, moved(path, np.array([300.0, 0.0, 0.0]))) is None


def test_it_must_explain_the_whole_path():
    """Also what lies outside of the map where it was told."""
    known = places(np.concatenate([HALL, CUPBOARD]), MAP_X)
    path = places(np.concatenate([HALL, CUPBOARD]), PATH_X)
    elsewhere = places(rectangles((-3.0, -4.0, 3.0, 2.0)), np.array([0.0]))[0]
    far = replace(elsewhere, pose=np.array([100.0, 0.0, 0.0]))
    told = moved(path, HALF_A_TURN)
    assert found(known, told) is not None
    assert found(known, [*told, far]) is None


def test_far_parts_of_a_building_are_not_searched(monkeypatch):
    """Time must not grow with the building."""
    known = places(np.concatenate([HALL, CUPBOARD]), MAP_X)
    far = [replace(place, pose=place.pose + np.array([500.0, 0.0, 0.0])) for place in known]
    searched = []
    search = better_starts.alternative_alignments
    monkeypatch.setattr(
        better_starts,
        "alternative_alignments",
        lambda start, near, *more: searched.append(len(near)) or search(start, near, *more),
    )
    path = places(np.concatenate([HALL, CUPBOARD]), PATH_X)
    assert found([*known, *far], moved(path, HALF_A_TURN)) is not None
    assert searched == [len(known)]
