"""A log of named sightings is localised in the map of an earlier one."""

from dataclasses import replace

import numpy as np
import pytest

import graphslam
from graphslam.core.errors import ConfigError, EstimationError, LogError
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
]
[robots.robot]
start_m = [3, 2]
body = { length_m = 0.5, width_m = 0.4, rear_m = 0.15 }
drive = [{ through_m = [[14, 4], [16.5, 8.5], [12, 10], [4, 7]], speed_m_s = 0.8 }]
encoders = { period_s = 0.1, wheel_radius_m = 0.1, axle_m = 0.5, slip_m = 0.003 }
sightings = [{ of = "landmarks", range_sigma_m = 0.03, identified = true }]
"""
#: where the second drive begins, m, m, rad
BEGIN = (6.0, 6.0, 0.0)


def recorded(folder, name, seed, *, begin=(3.0, 2.0, 0.1799), moved=None, text=SCENARIO):
    """A drive in the hall, in which some posts are ``moved``: name -> by how much, m."""
    path = folder / "hall.toml"
    path.write_text(text)
    scenario = load_scenario(path)
    posts = tuple(
        replace(c, center_m=tuple(np.add(c.center_m, (moved or {}).get(c.name, (0.0, 0.0)))))
        for c in scenario.world.cylinders
    )
    (robot,) = scenario.robots.values()
    robot = replace(robot, start_m=begin[:2], start_deg=float(np.degrees(begin[2])))
    scenario = replace(
        scenario, world=replace(scenario.world, cylinders=posts), robots={"robot": robot}
    )
    simulate(scenario, folder / f"{name}.mcap", seed)
    return folder / f"{name}.mcap"


@pytest.fixture(scope="module")
def earlier(tmp_path_factory):
    """The result of the first drive, whose start is told to 2 mm and 0.2 mrad."""
    folder = tmp_path_factory.mktemp("map")
    start = {"poses": {"robot": [3.0, 2.0, 0.1799]}, "given_sigma_m": 0.002}
    start["given_sigma_rad"] = 0.0002
    graphslam.smooth(recorded(folder, "first", 3), output=folder / "map", start=start)
    return folder / "map"


def localised(log, earlier, **settings):
    return graphslam.smooth(log, known_map={"directory": str(earlier)}, **settings)


def errors(result):
    return graphslam.evaluate(result)["robots"]["robot"]["final"]


def in_map(result, earlier):
    """How far posts that did not move, seen on both drives, are off those of the map, m."""
    before = {m.id: m.position for m in graphslam.load_result(earlier).landmarks}
    off = [m.position[:2] - before[m.id][:2] for m in result.landmarks if m.id in before]
    return float(np.hypot(*np.array(off).T).max())


def names(result):
    return sorted(mark.identity for mark in result.landmarks)


def test_the_start_is_found_by_names_and_the_map_says_where_the_path_is(earlier, tmp_path):
    """By itself the path would begin at the origin, 8 m off."""
    result = localised(recorded(tmp_path, "second", 4, begin=BEGIN), earlier)
    assert result.summary["verdict"]["verdict"] == "good"
    assert result.summary["known_map"]["seen"] == 7
    assert result.summary["known_map"]["new"] == 0
    found = result.summary["starts_found"]["robot"]
    assert np.hypot(found["x"] - BEGIN[0], found["y"] - BEGIN[1]) < 0.1
    # the first drive tells the direction of the map to some mrad, at 15 m
    assert errors(result)["ate_rmse_m"] < 0.12
    assert errors(result)["nees_per_dof"] < 3.0
    assert in_map(result, earlier) < 0.03


def test_a_start_that_was_told_elsewhere_is_doubted_and_not_used(earlier, tmp_path):
    log = recorded(tmp_path, "second", 4, begin=BEGIN)
    right = localised(log, earlier, start={"poses": {"robot": list(BEGIN)}})
    assert right.summary["verdict"]["verdict"] == "good"
    wrong = localised(log, earlier, start={"poses": {"robot": [7.0, 6.0, 0.0]}})
    assert wrong.summary["verdict"]["verdict"] == "doubtful"
    assert "1.0" in wrong.summary["known_map"]["doubt"]
    assert errors(wrong)["ate_rmse_m"] == pytest.approx(errors(right)["ate_rmse_m"], abs=1e-3)


def test_posts_that_were_moved_are_new_and_leave_a_map_that_goes_on(earlier, tmp_path):
    """Taken for what they were they would pull the path by a decimetre."""
    moves = {"p3": (0.3, -0.2), "p5": (-0.2, 0.3)}
    log = recorded(tmp_path, "second", 4, begin=BEGIN, moved=moves)
    only = localised(log, earlier)
    assert in_map(only, earlier) < 0.03
    assert names(only) == [*(f"p{k}" for k in range(1, 8)), "robot.p3", "robot.p5"]
    continued = graphslam.smooth(
        log, known_map={"directory": str(earlier), "update": True}, output=tmp_path / "on"
    )
    assert names(continued) == [f"p{k}" for k in range(1, 8)]
    found = {one["name"]: one["moved_m"] for one in continued.summary["moved_points"]}
    assert found == pytest.approx({"p3": np.hypot(0.3, 0.2), "p5": np.hypot(0.2, 0.3)}, abs=0.05)
    (fact,) = (one for one in continued.summary["verdict"]["facts"] if one["check"] == "moved")
    assert fact["text"].startswith("moved since it was seen before: p3 by 0.3")
    retired = continued.summary["known_map"]["retired"]
    before = {m.id: m.identity for m in graphslam.load_result(earlier).landmarks}
    assert sorted(before[one["id"]] for one in retired) == ["p3", "p5"]
    # a third day finds all of them where the second one put them
    third = localised(recorded(tmp_path, "third", 5, begin=BEGIN, moved=moves), tmp_path / "on")
    assert third.summary["known_map"]["new"] == 0
    assert in_map(third, tmp_path / "on") < 0.03


def test_a_map_of_another_place_is_refused_though_its_points_have_the_same_names(earlier, tmp_path):
    rng = np.random.default_rng(2)
    moved = {f"p{k}": tuple(rng.uniform(-1.5, 1.5, 2)) for k in range(1, 8)}
    log = recorded(tmp_path, "other", 4, begin=BEGIN, moved=moved)
    with pytest.raises(EstimationError, match="where it begins in the map map is not known"):
        localised(log, earlier)
    with pytest.raises(
        EstimationError, match=r"of 7 points [01] are where the start that was told"
    ):
        localised(log, earlier, start={"poses": {"robot": list(BEGIN)}})


def test_points_of_other_names_tell_no_start(earlier, tmp_path):
    text = SCENARIO.replace('name = "p', 'name = "q')
    log = recorded(tmp_path, "other", 4, begin=BEGIN, text=text)
    with pytest.raises(EstimationError, match="shares 0 names"):
        localised(log, earlier)
    told = localised(log, earlier, start={"poses": {"robot": list(BEGIN)}})
    assert told.summary["verdict"]["verdict"] == "doubtful"
    assert "nothing in it is recognised" in told.summary["known_map"]["doubt"]


def test_what_is_not_localised_in_such_a_map_is_refused(earlier, tmp_path):
    text = SCENARIO.replace("identified = true", "identified = false")
    log = recorded(tmp_path, "unnamed", 4, begin=BEGIN, text=text)
    with pytest.raises(LogError, match="sightings without names"):
        localised(log, earlier)
    with pytest.raises(ConfigError, match="only scans of one robot, or sightings with names"):
        localised(log, earlier, backend={"name": "ekf"})


def test_live_points_are_known_by_their_names(earlier, tmp_path):
    """Without names some of the first, from a start told 0.3 m off, would be new points."""
    log = recorded(tmp_path, "second", 4, begin=BEGIN)
    told = [BEGIN[0] + 0.2, BEGIN[1] - 0.2, BEGIN[2]]
    session = graphslam.Session(
        known_map={"directory": str(earlier)},
        start={"poses": {"robot": told}, "given_sigma_m": 0.3, "given_sigma_rad": 0.05},
    )
    for _ in session.process(graphslam.open_logs(log).messages()):
        pass
    assert session.known_map["observations_of_others"] == 0
    assert session.known_map["seen"] == 7


def test_a_map_that_goes_on_for_days_stays_as_well_known_as_it_is(earlier, tmp_path):
    """By covariances in which the map is held where it is, sigmas shrink until they are none."""
    moved, day = {}, earlier
    for k, post in enumerate(("p3", "p5", "p2", "p6")):
        moved = moved | {post: (0.2, -0.25)}
        log = recorded(tmp_path, f"day{k}", 20 + k, begin=BEGIN if k % 2 else (3.0, 2.0, 0.1799),
                       moved=moved)  # fmt: skip
        result = graphslam.smooth(
            log, known_map={"directory": str(day), "update": True}, output=tmp_path / f"map{k}"
        )
        assert [one["name"] for one in result.summary["moved_points"]] == [post]
        day = tmp_path / f"map{k}"
    found = graphslam.evaluate(result)
    assert found["landmarks"]["rmse_m"] < 0.15
    # of seven points, whose errors are mostly those of the first day: beyond 3.5 in one of 1000
    assert found["landmarks"]["nees_per_dof"] < 3.5
