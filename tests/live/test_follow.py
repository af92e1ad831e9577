"""A recording that is estimated while it is written, and the folder of it."""

import os
import signal
from dataclasses import replace

import numpy as np
import pytest
from command_line import call
from paths import LOGS
from room_log import SCAN, S, drive

import graphslam
from graphslam.core.geometry import wrap
from graphslam.core.records import OdometryPose, Scan
from graphslam.core.worker import allow_fork, can_fork
from graphslam.live import follow as follow_module
from graphslam.logs import LogWriter, growing_mcap
from graphslam.logs.mcap_file import MAGIC, records_from


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """Once round the box."""
    return drive(tmp_path_factory.mktemp("room") / "room.mcap")


class Recorder:
    """Writes a file piece by piece whenever who reads it waits."""

    def __init__(self, source, path, monkeypatch, pieces=30, stop=None):
        self.bytes, self.path, self.stop = source.read_bytes(), path, stop
        self.ends = np.linspace(0, len(self.bytes), pieces + 1).astype(int).tolist()
        self.piece, self.clock = 0, 0.0
        self.then = lambda: None
        for module in (growing_mcap, follow_module):
            monkeypatch.setattr(module.time, "sleep", self.sleep)
        monkeypatch.setattr(growing_mcap.time, "monotonic", lambda: self.clock)
        path.write_bytes(b"")

    def sleep(self, seconds):
        self.clock += max(seconds, 0.5)
        if self.piece == self.stop:
            self.then()
        elif self.piece + 1 < len(self.ends):
            with self.path.open("ab") as stream:
                stream.write(self.bytes[self.ends[self.piece] : self.ends[self.piece + 1]])
            self.piece += 1


def test_a_recording_is_followed_to_its_end(room, tmp_path, monkeypatch):
    """The estimates are those of a session; the folder was kept current and is a result folder."""
    recorder = Recorder(room, tmp_path / "now.mcap", monkeypatch)
    seen, current = [], []

    def look(estimate):
        seen.append(estimate)
        if (tmp_path / "out").exists():
            current.append(len(graphslam.load_result(tmp_path / "out").robots["robot"].final))

    told = graphslam.follow(recorder.path, tmp_path / "out", each=look)
    assert told["live"]["state"] == "ended"
    assert told["live"]["estimates"] == len(seen) == 61
    assert current == sorted(current)
    assert 0 < current[0] < 61
    saved = graphslam.load_result(tmp_path / "out")
    robot = saved.robots["robot"]
    messages = graphslam.open_logs(room).messages()
    for e, pose, cov in zip(
        graphslam.Session().process(messages), robot.causal.poses, robot.causal.covs, strict=True
    ):
        np.testing.assert_allclose(pose, e.pose, atol=1e-9)  # the digits of the files
        np.testing.assert_allclose(cov, e.cov, atol=1e-9)
    assert len(saved.landmarks) == told["counts"]["landmarks"] >= 6
    for name in ("map.pgm", "map.yaml", "map.svg", "report.html", "scans.npz", "config.toml"):
        assert (tmp_path / "out" / name).stat().st_size
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert 'http-equiv="refresh"' not in page  # it is over
    assert str(tmp_path) not in page
    # 5 cm: causal, and the odometry is 3 % too long until that is found
    errors = graphslam.evaluate(tmp_path / "out", truth=room)
    assert errors["robots"]["robot"]["final"]["ate_aligned_rmse_m"] < 0.05
    assert sorted(path.name for path in tmp_path.iterdir()) == ["now.mcap", "out"]


def test_a_recording_that_stops_growing_has_ended(room, tmp_path, monkeypatch):
    """What came is estimated, and the summary says so."""
    recorder = Recorder(room, tmp_path / "now.mcap", monkeypatch, stop=20)
    told = graphslam.follow(recorder.path, tmp_path / "out", live={"wait_s": 4.0})
    assert told["live"]["state"] == "has not grown for 4 s"
    assert 20 < told["live"]["estimates"] < 61


def test_a_recording_that_is_cut_keeps_what_was_estimated(room, tmp_path, monkeypatch):
    """One line says what happened; the folder has the estimates until then."""
    recorder = Recorder(room, tmp_path / "now.mcap", monkeypatch, stop=20)
    recorder.then = lambda: os.truncate(recorder.path, 1000)
    with pytest.raises(graphslam.LogError, match="was cut or overwritten while it was followed"):
        graphslam.follow(recorder.path, tmp_path / "out")
    saved = graphslam.load_result(tmp_path / "out")
    assert saved.summary["live"]["state"] == "stopped"
    assert any("was cut" in warning for warning in saved.summary["warnings"])
    assert len(saved.robots["robot"].final) > 20


def test_a_recording_that_grows_by_what_cannot_be_read_is_damaged(room, tmp_path, monkeypatch):
    """It is not said to have stopped; the folder has the estimates until then."""
    recorder = Recorder(room, tmp_path / "now.mcap", monkeypatch, stop=20)

    def add_garbage():
        with recorder.path.open("ab") as stream:
            stream.write(b"\x99" * 1000)

    recorder.then = add_garbage
    with pytest.raises(graphslam.LogError, match="grows, but is damaged: nothing can be read from"):
        graphslam.follow(recorder.path, tmp_path / "out", live={"wait_s": 4.0})
    assert len(graphslam.load_result(tmp_path / "out").robots["robot"].final) > 20


def test_a_finished_recording_that_is_damaged_is_read_until_there_and_said_so(room, tmp_path):
    """And not that it stopped growing: half of it would be lost without a word."""
    path = tmp_path / "now.mcap"
    with room.open("rb") as stream:
        begins = [begin for begin, *_ in records_from(stream, len(MAGIC))]
    whole = bytearray(room.read_bytes())
    middle = next(begin for begin in begins if begin > len(whole) // 2)
    whole[middle : middle + 400] = b"\x99" * 400
    path.write_bytes(whole)
    told = graphslam.follow(path, tmp_path / "out", live={"wait_s": 0.5})
    assert told["live"]["state"] == "has not grown for 0.5 s"
    assert 20 < told["live"]["estimates"] < 61
    (warning,) = [warning for warning in told["warnings"] if "damaged" in warning]
    assert "are no whole record" in warning


def test_ctrl_c_does_not_end_the_writing_of_the_folder(room, tmp_path, monkeypatch):
    """It would be begun anew, and take what it has just written for another program's."""
    allow_fork()
    if not can_fork():
        pytest.skip("no second process here")
    here, real, sent = os.getpid(), follow_module.identity, tmp_path / "sent"

    def interrupted(folder):
        if os.getpid() != here:
            sent.touch()
            os.kill(os.getpid(), signal.SIGINT)
        return real(folder)

    monkeypatch.setattr(follow_module, "identity", interrupted)
    told = graphslam.follow(room, tmp_path / "out")
    assert sent.exists() and told["live"]["state"] == "ended"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "sent"]


def test_ctrl_c_ends_the_following(room, tmp_path):
    """The folder has what was estimated until then."""

    seen = []

    def interrupt(estimate):
        seen.append(estimate)
        if len(seen) == 20:
            raise KeyboardInterrupt

    told = graphslam.follow(room, tmp_path / "out", each=interrupt)
    assert told["live"]["state"] == "interrupted"
    assert len(graphslam.load_result(tmp_path / "out").robots["robot"].final) == 20


def test_a_robot_that_still_stands_has_a_folder_without_a_grid_map(tmp_path):
    """It has one keyframe, of which nothing is mapped yet: that is no reason to end."""
    path = tmp_path / "stands.mcap"
    with graphslam.LogWriter(path) as log:
        log.mount("robot", 10**9, (0, 0, 0))
        for k in range(60):
            stamp = 10**9 + k * 10**8
            log.odometry("robot", stamp, (0, 0, 0))
            shape = {"angle_min_rad": -1.0, "angle_step_rad": 0.02, "range_max_m": 10.0}
            log.scan("robot", stamp, np.full(101, 3.0), **shape)
    told = graphslam.follow(path, tmp_path / "out")
    assert told["counts"]["keyframes"] == 1
    assert (tmp_path / "out/map.svg").exists() and not (tmp_path / "out/map.pgm").exists()


def test_an_error_of_writing_is_told_as_it_is(room, tmp_path, monkeypatch):
    """And not what fails when it is tried once more."""

    def full(*_):
        raise graphslam.OutputError("the disk is full")

    monkeypatch.setattr(follow_module, "write_live_folder", full)
    with pytest.raises(graphslam.OutputError, match="the disk is full"):
        graphslam.follow(room, tmp_path / "out")


def test_what_stands_there_is_not_overwritten(room, tmp_path):
    """Neither another folder, nor a result without force."""
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("do not touch")
    with pytest.raises(graphslam.OutputError, match="is not a result folder"):
        graphslam.follow(room, tmp_path / "mine", force=True)
    graphslam.follow(room, tmp_path / "out")
    with pytest.raises(graphslam.OutputError, match="already exists"):
        graphslam.follow(room, tmp_path / "out")
    assert graphslam.follow(room, tmp_path / "out", force=True)["live"]["state"] == "ended"


def test_a_recording_of_which_nothing_can_be_used_is_refused(tmp_path):
    """With the reason that `smooth` would give; no folder is made."""
    path = tmp_path / "odometry.mcap"
    with graphslam.LogWriter(path) as log:
        for k in range(100):
            log.sighting("robot", 10**9 + k * 10**8, [0.0, 1.0], np.eye(2), identity="post")
    with pytest.raises(graphslam.LogError, match="without odometry"):
        graphslam.follow(path, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_turns_of_wheels_are_counted_from_the_first_messages_on(tmp_path):
    """Their angles begin again after each turn; taken as they are the robot would go back."""
    path = tmp_path / "wheels.mcap"
    with LogWriter(path) as log:
        log.mount("robot", S, (0, 0, 0))
        for k in range(100):
            angle = float(wrap(0.4 * k))
            log.wheel_angles("robot", S + k * S // 10, angle, angle)
            log.scan("robot", S + k * S // 10, np.full(101, np.inf), **SCAN)
    told = graphslam.follow(path, tmp_path / "out", live={"wait_s": 1.0})
    assert told["repaired"] == {"joints: angle begins again after a turn": 6}
    (said,) = (line for line in told["warnings"] if "begin again after each turn, 12 times" in line)
    assert said.startswith("/joint_states: ")
    x_m = [float(line.split()[1]) for line in
           (tmp_path / "out/trajectories/robot.causal.tum").read_text().splitlines()]  # fmt: skip
    assert np.all(np.diff(x_m) > 0)


def test_robots_of_unknown_start_are_said(tmp_path):
    """Each has a frame of its own, and the line that places it."""
    told = graphslam.follow(LOGS / "two-robots.mcap", tmp_path / "out")
    frames = told["frames"]
    (alone,) = set(frames) - {told["world"]}
    assert any(w.startswith(f"{alone}: its start is not known") for w in told["warnings"])
    assert f"--start {alone}=x,y,phi" in (tmp_path / "out" / "report.html").read_text("utf-8")


def test_a_clock_that_is_set_back_is_said(room, tmp_path):
    """What comes then is stamped an hour before what is estimated already."""
    messages = list(graphslam.open_logs(room).messages())
    half, hour = len(messages) // 2, 3600 * S
    middle = messages[half].time_ns
    rewritten(
        tmp_path / "back.mcap", messages, stamps=lambda m: m.stamp_ns - hour * (m.time_ns > middle)
    )
    summary = graphslam.follow(tmp_path / "back.mcap", tmp_path / "now")
    (said,) = (line for line in summary["warnings"] if "a clock was set back" in line)
    assert int(said.split()[0]) > 0.4 * half
    (reason,) = (key for key in summary["dropped"] if key.startswith("stamp: older"))
    assert "live.reorder_s" in reason  # logs.reorder_s is not used
    assert 0.4 < summary["live"]["estimates"] / summary["counts"]["scans"] <= 1.0


def rewritten(path, messages, *, stamps=lambda m: m.stamp_ns, times=1):
    """A log of messages, each recorded ``times``, when it was; ``stamps``: what is stamped."""
    with LogWriter(path) as log:
        for m in messages:
            for _ in range(times):
                if isinstance(m, OdometryPose):
                    log.odometry(m.robot, stamps(m), m.pose, log_time_ns=m.time_ns)
                elif isinstance(m, Scan):
                    log.scan(m.robot, stamps(m), m.ranges, log_time_ns=m.time_ns, **SCAN)
    return path


def two_robots(room, path, late_s):
    """The room, and another robot in it that begins ``late_s`` later."""
    messages = list(graphslam.open_logs(room).messages())
    begin = messages[0].time_ns
    other = [replace(m, robot="other") for m in messages if m.time_ns > begin + late_s * S]
    return rewritten(path, sorted([*messages, *other], key=lambda m: m.time_ns))


def test_what_begins_too_late_to_be_followed_is_said_at_once_and_counted(
    room, tmp_path, monkeypatch
):
    """A robot was ignored without a word. What is followed is estimated as without it."""
    both = two_robots(room, tmp_path / "both.mcap", 15)
    recorder = Recorder(both, tmp_path / "now.mcap", monkeypatch)
    said, seen = [], []
    told = graphslam.follow(
        recorder.path,
        tmp_path / "out",
        each=seen.append,
        warn=lambda text: said.append((len(seen), text)),
    )
    assert {e.robot for e in seen} == {"robot"} and len(seen) == 61
    ((when, first),) = said
    assert 20 < when < 45  # when it begins, not at the end
    assert "/other/odom, /other/scan: began later than what is followed" in first
    assert "`graphslam smooth` of the recording uses them" in first
    counts = {key: n for key, n in told["dropped"].items() if "began later" in key}
    assert {key.partition(":")[0] for key in counts} == {"/other/odom", "/other/scan"}
    assert sum(counts.values()) == 150 + 31
    (last,) = (line for line in told["warnings"] if "began later" in line)
    assert "181 messages so far are left out" in last


def test_the_command_says_at_once_what_it_does_not_follow(room, tmp_path, monkeypatch):
    """On stderr, without --verbose; and again in the end, with what was dropped."""
    both = two_robots(room, tmp_path / "both.mcap", 15)
    recorder = Recorder(both, tmp_path / "now.mcap", monkeypatch)
    done = call("follow", recorder.path, "-o", tmp_path / "out")
    assert done.code == 0
    assert done.err.startswith("graphslam: warning: /other/odom, /other/scan: began later than")
    assert done.err.count("\n") == 1
    assert "warning: /other/odom, /other/scan: began later than what is followed" in done.out
    assert "dropped: 31 x /other/scan: began later than what is followed" in done.out


def test_a_robot_whose_start_is_given_is_waited_for(room, tmp_path, monkeypatch):
    """Up to live.wait_s; it was refused unless it came in the first two seconds."""
    both = two_robots(room, tmp_path / "both.mcap", 8)
    recorder = Recorder(both, tmp_path / "now.mcap", monkeypatch, pieces=60)
    starts = {"start.poses.robot": [0.0, 0.0, 0.0], "start.poses.other": [1.0, 0.0, 0.0]}
    told = graphslam.follow(recorder.path, tmp_path / "out", **{"live.wait_s": 30.0}, **starts)
    assert told["frames"] == {"other": "other", "robot": "other"}  # one frame for both
    assert not any("began later" in text for text in (*told["dropped"], *told["warnings"]))
    robots = graphslam.load_result(tmp_path / "out").robots
    assert {name: len(robot.final) > 40 for name, robot in robots.items()} == {
        "other": True,
        "robot": True,
    }


def test_a_robot_that_never_comes_is_not_waited_for_without_end(room, tmp_path, monkeypatch):
    """The line names it, and those that are there."""
    recorder = Recorder(room, tmp_path / "now.mcap", monkeypatch, pieces=300)
    with pytest.raises(graphslam.LogError, match=r"nothing usable of ben .*30 s, only of robot;"):
        graphslam.follow(
            recorder.path,
            tmp_path / "out",
            **{"live.wait_s": 30.0, "start.poses.ben": [0.0, 0.0, 0.0]},
        )
    assert 60 < recorder.piece < 120  # of half a second each


def test_messages_that_were_recorded_twice_give_one_pose(room, tmp_path):
    """Two poses of one stamp were written. Poses are those of the recording without them."""
    messages = list(graphslam.open_logs(room).messages())
    once = graphslam.follow(rewritten(tmp_path / "once.mcap", messages), tmp_path / "a")
    told = graphslam.follow(rewritten(tmp_path / "twice.mcap", messages, times=2), tmp_path / "b")
    assert told["live"]["estimates"] == once["live"]["estimates"] == 61
    repeated = {"scan: stamp repeated": 61, "odometrypose: recorded twice": 301}
    assert told["dropped"] == once["dropped"] | repeated
    a, b = (graphslam.load_result(tmp_path / name).robots["robot"].final for name in "ab")
    assert np.all(np.diff(b.stamps_ns) > 0)
    np.testing.assert_array_equal(a.poses, b.poses)


def test_a_clock_that_is_set_back_by_a_second_is_said(room, tmp_path):
    """The motion of some of that second is lost: four readings of ten a second, too few to be said
    for their number. Breaks also if the stamps that come again give a second pose each."""
    messages = list(graphslam.open_logs(room).messages())
    middle = messages[len(messages) // 2].time_ns
    path = rewritten(
        tmp_path / "back.mcap", messages, stamps=lambda m: m.stamp_ns - S * (m.time_ns > middle)
    )
    told = graphslam.follow(path, tmp_path / "out")
    (said,) = (line for line in told["warnings"] if "a clock was set back" in line)
    assert said.startswith("4 messages were left out")
    final = graphslam.load_result(tmp_path / "out").robots["robot"].final
    assert np.all(np.diff(final.stamps_ns) > 0)


def test_single_late_messages_are_counted_and_are_no_warning(room, tmp_path):
    """Of a bus under load; a pose of odometry that is missing does no harm."""
    messages = list(graphslam.open_logs(room).messages())
    late = {id(m) for m in [m for m in messages if isinstance(m, OdometryPose)][20:-20:40]}
    moved = [replace(m, time_ns=m.time_ns + S) if id(m) in late else m for m in messages]
    path = rewritten(tmp_path / "late.mcap", sorted(moved, key=lambda m: m.time_ns))
    told = graphslam.follow(path, tmp_path / "out")
    assert told["dropped"]["stamp: older than live.reorder_s allows"] == len(late)
    assert not any("a clock was set back" in line for line in told["warnings"])


def test_what_is_lost_is_said(room, tmp_path):
    """As `smooth` says it: a flipped bit in a chunk loses the chunk, and neither is silent."""
    content = bytearray(room.read_bytes())
    content[len(content) // 2] ^= 1
    path = tmp_path / "flipped.mcap"
    path.write_bytes(content)
    known = graphslam.open_logs(path)
    told = graphslam.follow(path, tmp_path / "out")
    (file,) = told["logs"]
    assert file["lost"] == known.files[0].lost > 0
    assert (file["messages"], file["sha256"]) == (known.files[0].messages, known.files[0].sha256)
    assert any("messages are lost" in warning for warning in told["warnings"])


def test_a_followed_recording_is_no_map_yet_and_says_so(room, tmp_path):
    """It has no joint covariance of its landmarks; it is not of another version."""
    graphslam.follow(room, tmp_path / "live")
    with pytest.raises(graphslam.OutputError, match=r"live: is of `graphslam follow`.* smooth "):
        graphslam.smooth(room, **{"known_map.directory": str(tmp_path / "live")})


@pytest.mark.parametrize(("start", "astray"), [([0.0, 0.0, 0.0], False), ([3.0, 2.5, 2.0], True)])
def test_a_start_that_is_wrong_in_the_known_map_is_said(room, tmp_path, start, astray):
    """Hardly anything that is seen is in the map then: the room is mapped again beside itself."""
    graphslam.smooth(room, output=tmp_path / "known")
    told = graphslam.follow(
        room,
        tmp_path / "out",
        **{"known_map.directory": str(tmp_path / "known"), "start.poses.robot": start},
    )
    found = told["known_map"]
    share = found["observations_of_it"] / (
        found["observations_of_it"] + found["observations_of_others"]
    )
    # on either side of the 0.4 of the warning: walls of a turned room meet by chance, new parts
    # of known ones are landmarks of their own
    assert share < 0.3 if astray else share > 0.8
    said = [w for w in told["warnings"] if "are of landmarks of the map known" in w]
    assert len(said) == astray
