"""Posts that are moved between two sessions neither drag the map nor pass for noise."""

from dataclasses import replace

import numpy as np
import pytest

import graphslam
from graphslam.simulation import load_scenario, simulate

SCENARIO = """
[world]
walls = [{ name = "hall", points_m = [[0, 0], [20, 0], [20, 14], [0, 14]], closed = true }]
cylinders = [
  { name = "p1", center_m = [2, 4], radius_m = 0.1 },
  { name = "p2", center_m = [5, 10.5], radius_m = 0.1 },
  { name = "p3", center_m = [9, 7], radius_m = 0.1 },
  { name = "p4", center_m = [12.5, 2], radius_m = 0.1 },
  { name = "p5", center_m = [17, 5], radius_m = 0.1 },
  { name = "p6", center_m = [15, 11], radius_m = 0.1 },
  { name = "p7", center_m = [10, 12.5], radius_m = 0.1 },
  { name = "p8", center_m = [6, 0.8], radius_m = 0.1 },
  { name = "p9", center_m = [1, 12], radius_m = 0.1 },
]
[robots.robot]
start_m = [3, 2]
body = { length_m = 0.5, width_m = 0.4, rear_m = 0.15 }
drive = [{ through_m = [[14, 4], [16.5, 8.5], [12, 10], [4, 7], [3, 2.5]], speed_m_s = 0.8 }]
encoders = { period_s = 0.1, wheel_radius_m = 0.1, axle_m = 0.5, radius_error_left = 0.01, slip_m = 0.003 }
sightings = [{ of = "landmarks", range_sigma_m = 0.03, identified = true }]
"""  # noqa: E501


def logs(folder, moved, *, named):
    """Two drives among the posts, between which some were ``moved``: name -> by how much, m."""
    path = folder / "posts.toml"
    path.write_text(
        SCENARIO if named else SCENARIO.replace("identified = true", "identified = false")
    )
    monday = load_scenario(path)
    world = monday.world
    cylinders = tuple(
        replace(c, center_m=tuple(np.add(c.center_m, moved.get(c.name, (0.0, 0.0)))))
        for c in world.cylinders
    )
    tuesday = replace(monday, world=replace(world, cylinders=cylinders))
    paths = [folder / "monday.mcap", folder / "tuesday.mcap"]
    simulate(monday, paths[0], 4)
    simulate(tuesday, paths[1], 5)
    return paths


def smoothed(paths, *, told=("monday",)):
    start = [3.0, 2.0, 0.1799]
    return graphslam.smooth(
        paths, logs={"same_place": True}, start={"poses": dict.fromkeys(told, start)}
    )


def names_of(result):
    return sorted(mark.identity or "" for mark in result.landmarks)


@pytest.mark.parametrize("named", [True, False])
def test_posts_that_were_moved_stand_in_the_map_twice_and_drag_nothing(tmp_path, named):
    """With all points shared the second session is 0.14 to 0.29 m off."""
    moves = {"p3": (0.3, -0.2), "p6": (0.3, -0.2)}
    # seven of nine points without names are too few to find the start by
    told = ("monday",) if named else ("monday", "tuesday")
    result = smoothed(logs(tmp_path, moves, named=named), told=told)
    assert result.summary["verdict"]["verdict"] == "good"
    assert len(result.landmarks) == 11
    assert result.summary["consolidated"]["landmarks_moved"] == 2
    if named:
        posts = [f"p{k}" for k in range(1, 10)]
        assert names_of(result) == sorted([*posts, "tuesday.p3", "tuesday.p6"])
        marks = {mark.identity: mark for mark in result.landmarks}
        for name, by in moves.items():
            now, before = marks[f"tuesday.{name}"], marks[name]
            off = now.position[:2] - before.position[:2] - by
            # chi-square limit of one in ten thousand, whose sigmas are far below the 0.36 m
            assert off @ np.linalg.solve(now.cov + before.cov, off) < 18.4
            assert np.hypot(*off) < 0.1


def test_points_that_three_sessions_see_are_compared_with_all_before(tmp_path):
    """The third has one post where the second put it, and another one where it was first."""
    paths = logs(tmp_path, {"p3": (0.3, -0.2), "p6": (-0.2, 0.4)}, named=True)
    wednesday = tmp_path / "more"
    wednesday.mkdir()
    third = logs(wednesday, {"p3": (0.3, -0.2)}, named=True)[1].rename(tmp_path / "wednesday.mcap")
    result = smoothed([*paths, third])
    posts = [f"p{k}" for k in range(1, 10)]
    assert names_of(result) == sorted([*posts, "tuesday.p3", "tuesday.p6"])
    seen = {mark.identity: mark.sightings for mark in result.landmarks}
    assert seen["tuesday.p3"] > 1.5 * seen["p3"]
    assert seen["p6"] > 1.5 * seen["tuesday.p6"]


def test_posts_that_nobody_moved_are_shared(tmp_path):
    result = smoothed(logs(tmp_path, {}, named=True))
    assert names_of(result) == [f"p{k}" for k in range(1, 10)]
    assert not result.summary["consolidated"].get("landmarks_moved")
