"""Recordings of one place at different times: a trajectory each, one map."""

import struct
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from recordings import messages_of
from room_log import BEAMS, SCAN, drive

import graphslam
from graphslam.core import records
from graphslam.core.errors import LogError
from graphslam.core.records import Trajectory
from graphslam.evaluation.metrics import evaluate
from graphslam.evaluation.relation_metrics import Relations
from graphslam.logs import LogWriter, open_logs, read_truth
from graphslam.logs.sessions import session_names
from graphslam.simulation import load_scenario, simulate
from graphslam.simulation.scenario import Leg

SAME_PLACE = graphslam.load_config(**{"logs.same_place": True})
DAY_S = 86_400


def test_sessions_are_named_like_their_files(tmp_path):
    """Without the endings of containers; what is no letter, number or dash is replaced."""
    files = ("monday.mcap", "a/monday.mcap.zstd", "my robot.bag", "tuesday", "2026-11-23.db3")
    names = session_names([tmp_path / name for name in files])
    assert names == ["monday", "monday-2", "my_robot", "tuesday", "2026-11-23"]
    assert session_names([tmp_path / "火曜日.mcap", tmp_path / "!.mcap"]) == ["火曜日", "session"]


def test_the_robot_of_each_recording_is_a_session(tmp_path):
    """Its topics, mount and truth are in the session's namespace; without the setting it is one."""
    paths = [drive(tmp_path / "monday.mcap"), drive(tmp_path / "tuesday.mcap", seconds=20)]
    log = open_logs(paths, SAME_PLACE)
    assert log.robots == ("monday", "tuesday")
    assert {topic.name for topic in log.topics} >= {"/monday/scan", "/tuesday/odom"}
    for name in log.robots:
        np.testing.assert_allclose(log.mount(f"/{name}/scan"), [0.2, 0, 0], atol=1e-9)
    assert {message.robot for message in log.messages()} == {"monday", "tuesday"}
    truth = read_truth(paths, SAME_PLACE).trajectories
    assert {name: len(own) for name, own in truth.items()} == {"monday": 301, "tuesday": 201}
    assert open_logs(paths, graphslam.load_config()).robots == ("robot",)


@pytest.mark.parametrize("space", ["", "fleet/"])
def test_several_robots_of_a_recording_are_each_in_each_session(tmp_path, space):
    """A fleet that comes again has two trajectories of every robot, also in ``/fleet/a``: its
    topics are not shared by all sessions."""
    paths = []
    for day, name in enumerate(("monday", "tuesday")):
        paths.append(tmp_path / f"{name}.mcap")
        with LogWriter(paths[-1]) as log:
            for robot in ("a", "b"):
                for k in range(20):
                    stamp = (DAY_S * day + k) * 1_000_000_000
                    log.odometry(space + robot, stamp, [0.1 * k, 0, 0])
                    log.sighting(
                        space + robot, stamp, [0.1, 2.0], np.eye(2) * 1e-3, identity="post"
                    )
    log = open_logs(paths, SAME_PLACE)
    assert log.robots == ("monday.a", "monday.b", "tuesday.a", "tuesday.b")
    assert {topic.count for topic in log.topics} == {20}


def test_robots_see_those_of_their_own_session(tmp_path):
    """A message names a robot as its recording does; the log has one of that name in each session.
    What is measured between them was dropped as of a robot that is not in the log."""
    paths = [tmp_path / "monday.mcap", tmp_path / "tuesday.mcap"]
    for day, path in enumerate(paths):
        with LogWriter(path) as log:
            for robot, other in (("a", "b"), ("b", "a")):
                for k in range(1, 20):
                    stamp = (DAY_S * day + k) * 1_000_000_000
                    log.odometry(robot, stamp, [0.1 * k, 0, 0])
                    log.sighting(robot, stamp, [0.1, 2.0], np.eye(2) * 1e-3, seen_robot=other)
                    log.relative_pose(
                        robot, stamp, stamp, delta=np.ones(3), cov=np.eye(3), other=other
                    )
    seen = [(m.robot, m.seen_robot) for m in messages(paths) if isinstance(m, records.Sighting)]
    given = [(m.robot, m.other) for m in messages(paths) if isinstance(m, records.RelativePose)]
    pairs = {(f"{day}.{a}", f"{day}.{b}") for day in ("monday", "tuesday") for a, b in ("ab", "ba")}
    assert set(seen) == set(given) == pairs


def messages(paths):
    """Of all sessions."""
    return open_logs(paths, SAME_PLACE).messages()


@pytest.mark.parametrize("first", ["angles", "nothing", "poses"])
def test_what_tells_how_a_session_moved_says_nothing_of_another_one(tmp_path, first):
    """One robot may count wheel angles, or nothing, where another one states poses."""
    paths = [tmp_path / "monday.mcap", tmp_path / "tuesday.mcap"]
    for day, (path, kind) in enumerate(zip(paths, (first, "poses"), strict=True)):
        robot = ("robot", "vehicle")[day]
        with LogWriter(path) as log:
            for k in range(20):
                stamp = (DAY_S * day + k) * 1_000_000_000
                if kind == "angles":
                    log.wheel_angles(robot, stamp, 2.0 * k, 2.0 * k)
                elif kind == "poses":
                    log.odometry(robot, stamp, [0.1 * k, 0, 0])
                log.scan(robot, stamp, np.full(len(BEAMS), 2.0), **SCAN)
    log = open_logs(paths, SAME_PLACE)
    assert log.robots == ("monday", "tuesday")
    numbers = [sum(topic.robot == name for topic in log.topics) for name in log.robots]
    assert numbers == [1 if first == "nothing" else 2, 2]


def test_topics_that_are_chosen_have_the_names_of_the_recordings(tmp_path):
    """What `logs.topics` says holds in every session."""
    paths = [drive(tmp_path / "monday.mcap"), drive(tmp_path / "tuesday.mcap", seconds=20)]
    chosen = {"/scan": "robot", "/odom": "robot"}
    config = replace(SAME_PLACE, logs=replace(SAME_PLACE.logs, topics=chosen))
    log = open_logs(paths, config)
    assert log.robots == ("monday", "tuesday")
    assert len(log.topics) == 4


def test_topics_may_be_named_as_in_the_log_of_all_sessions(tmp_path):
    """So remedies name them. A recording need not have all of them, but some; each is in one."""
    paths = [drive(tmp_path / "monday.mcap"), drive(tmp_path / "tuesday.mcap", seconds=20)]

    def opened(chosen):
        return open_logs(paths, replace(SAME_PLACE, logs=replace(SAME_PLACE.logs, topics=chosen)))

    monday = {"/monday/scan": "monday", "/monday/odom": "monday"}
    log = opened(monday | {"/tuesday/scan": "tuesday"})
    assert [topic.name for topic in log.topics] == [*sorted(monday), "/tuesday/scan"]
    assert log.robots == ("monday", "tuesday")
    with pytest.raises(LogError, match=r"tuesday.mcap: has none of the topics that logs.topics"):
        opened(monday)
    with pytest.raises(LogError, match=r"names /scam, which is a topic of none of the recordings"):
        opened({"/scan": "robot", "/scam": "robot"})


def test_one_session_is_refused(tmp_path):
    """There is nothing to join."""
    with pytest.raises(LogError, match=r"is one session; --same-place joins two or more"):
        open_logs([drive(tmp_path / "monday.mcap", seconds=5)], SAME_PLACE)


def later(log, target, seconds):
    """The recording as if it had been made so much later: its stamps follow their headers."""
    with LogWriter(target) as made:
        for topic, schema, log_time, data in messages_of(log):
            (stamp,) = struct.unpack_from("<i", data, 4)
            moved = data[:4] + struct.pack("<i", stamp + seconds) + data[8:]
            kept = data if schema.endswith("TFMessage") else moved
            made.encoded(topic, schema, kept, log_time + seconds * 1_000_000_000)
    return target


def office(path, seed, *drive, **start):
    """One robot that drives through the simulated office."""
    scenario = load_scenario("office-loop")
    (robot,) = scenario.robots.values()
    laser = replace(robot.laser, period_s=0.5)
    robot = replace(robot, laser=laser, drive=(Leg(through_m=drive),), **start)
    simulate(replace(scenario, robots={"robot": robot}), path, seed)
    return path


def test_a_second_day_that_starts_elsewhere_is_in_the_map_of_the_first(tmp_path):
    """Where it started is found; both days have one frame, and no warning tells of the clocks.

    5 cm: where two parts of a path see little in common the pose between them is that good;
    a session that is joined at a wrong place is off by metres.
    """
    path = (20.0, 6.1), (20.0, 17.9), (17.0, 17.9)
    monday = office(tmp_path / "monday.mcap", 0, *path, start_m=(9.0, 6.1))
    path = (20.0, 6.1), (20.0, 16.0)
    same = office(tmp_path / "same.mcap", 10, *path, start_m=(30.0, 6.1), start_deg=180.0)
    tuesday = later(same, tmp_path / "tuesday.mcap", DAY_S)
    result = graphslam.smooth([monday, tuesday], config=SAME_PLACE)
    assert result.summary["frames"] == {"monday": "monday", "tuesday": "monday"}
    assert not any("clock" in warning for warning in result.summary["warnings"])
    truth = read_truth([monday, tuesday], SAME_PLACE)
    errors = evaluate(result, truth.trajectories, truth.landmarks)
    assert errors["joint"]["final"]["ate_aligned_rmse_m"] < 0.05


def straight(first_s, offset_m):
    """A trajectory of three scans a second apart, 1 m each, from ``offset_m`` on."""
    stamps = (first_s + np.arange(3)) * 1_000_000_000
    poses = np.column_stack([offset_m + np.arange(3.0), np.zeros(3), np.zeros(3)])
    return Trajectory(stamps, poses, np.zeros((3, 3, 3)))


@pytest.mark.parametrize("same_place", [True, False])
def test_relations_tie_scans_of_different_sessions(same_place):
    """Robots of one recording have equal stamps, so theirs are never taken for one trajectory."""
    first, second = straight(0, 0.0), straight(10, 5.0)
    robots = {
        name: SimpleNamespace(scan_final=own, scan_causal=own, scan_ties=None)
        for name, own in (("a", first), ("b", second))
    }
    result = SimpleNamespace(
        robots=robots,
        config=SAME_PLACE if same_place else graphslam.load_config(),
        summary={"frames": {"a": "a", "b": "a"}},
        estimate=SimpleNamespace(root=None),
        landmarks=(),
    )
    stamps = np.concatenate([first.stamps_ns, second.stamps_ns])
    relations = Relations(stamps[[0, 2]], stamps[[1, 4]], np.array([[1.0, 0, 0], [4.0, 0, 0]]))
    found = evaluate(result, relations=relations)["relations"]
    for one in (found, found["causal"]):
        assert one["all"]["n"] == (2 if same_place else 1)
        assert one["all"]["trans_mean_m"] < 1e-9
