"""Estimates of messages as they come."""

from collections import deque
from dataclasses import replace

import numpy as np
import pytest
from room_log import MOUNT, SCAN, START_NS, drive, true_pose

import graphslam
from graphslam.core.geometry import between, compose
from graphslam.core.records import Closure, OdometryPose, Scan, Sighting, Truth, WheelAngles
from graphslam.live import live_pass
from graphslam.logs import LogWriter
from graphslam.pipeline import step_recorder

HORIZON_S = 8.0
S = 1_000_000_000
ROBOT = {"robot": [OdometryPose, Scan]}


def messages_of(path):
    """The messages of a log, sorted."""
    return [m for m in graphslam.open_logs(path).messages() if isinstance(m, (OdometryPose, Scan))]


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """Twice round the box, and its messages."""
    path = drive(tmp_path_factory.mktemp("room") / "room.mcap", seconds=60)
    return path, messages_of(path)


@pytest.fixture(scope="module")
def live(room):
    """The estimates of that drive, and their session."""
    session = graphslam.Session(live={"horizon_s": HORIZON_S})
    return session, list(session.process(room[1]))


@pytest.fixture(scope="module")
def filtered(room):
    """The same without a beginning that is solved as a batch."""
    session = graphslam.Session(live={"horizon_s": HORIZON_S})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(live_pass.LivePass, "restarts", lambda _self: False)
        return session, list(session.process(room[1]))


def test_estimates_are_the_causal_poses_of_a_fixed_lag_smoother(room, filtered):
    """Poses and covariances, where nothing is solved as a batch; forgetting changes nothing.

    1e-7: sums of a path begin elsewhere, and places that are kept are variables of the window too,
    so that its Gauss-Newton steps end a little elsewhere.
    """
    _, found = filtered
    same = {"name": "isam2", "horizon_s": HORIZON_S}
    causal = graphslam.smooth(room[0], backend=same).robots["robot"].causal
    assert [e.stamp_ns for e in found] == causal.stamps_ns.tolist()
    np.testing.assert_allclose([e.pose for e in found], causal.poses, rtol=0, atol=1e-7)
    np.testing.assert_allclose([e.cov for e in found], causal.covs, rtol=0, atol=1e-7)


def test_a_beginning_is_solved_as_a_batch(room, live, filtered):
    """What follows is by the map and the calibration of all that was seen until then.

    From 103 s / 2 on, when there are 100 states, poses are 6 mm off the final ones in the mean. A
    smoother that only goes on with what it believed at first stays 17 mm off.
    """
    final = graphslam.smooth(room[0]).robots["robot"].final
    wrong = [
        [np.hypot(*(e.pose - final.at(e.stamp_ns))[:2]) for e in found]
        for _, found in (live, filtered)
    ]
    solved = next(k for k, (a, b) in enumerate(zip(*wrong, strict=True)) if a != b)
    assert solved in range(100, 110)
    assert np.mean(wrong[0][solved:]) < 0.5 * np.mean(wrong[1][solved:])
    # the estimate says by how much that moved it
    assert np.hypot(*live[1][solved].jump[:2]) > 5 * np.hypot(*filtered[1][solved].jump[:2])


def test_steps_are_kept_until_the_last_batch(room, live):
    """The next one needs them. They are forgotten when the window is built again after the last."""
    assert len(live[0]._pass.steps) > 100
    session = graphslam.Session(live={"horizon_s": HORIZON_S})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(step_recorder, "FIRST_BATCH_STEP", 60)
        patch.setattr(live_pass, "LAST_BATCH_STEP", 60)
        for _ in session.process(room[1]):
            pass
    assert not session._pass.steps


def test_a_robot_that_stands_for_longer_than_the_horizon_keeps_what_it_saw(room, tmp_path):
    """Walls of the first scan that are not sure yet were forgotten, and their observations lost."""
    path, stands_s = tmp_path / "stands.mcap", 30
    first = {kind: next(m for m in room[1] if isinstance(m, kind)) for kind in (OdometryPose, Scan)}
    with LogWriter(path) as log:
        log.mount("robot", START_NS, MOUNT)
        for k in range(10 * stands_s):
            log.odometry("robot", START_NS + k * S // 10, first[OdometryPose].pose)
            if k % 5 == 0:
                log.scan("robot", START_NS + k * S // 10, first[Scan].ranges, **SCAN)
        for m in room[1][:300]:
            if isinstance(m, Scan):
                log.scan("robot", m.stamp_ns + stands_s * S, m.ranges, **SCAN)
            else:
                log.odometry("robot", m.stamp_ns + stands_s * S, m.pose)
    session = graphslam.Session(live={"horizon_s": HORIZON_S})
    found = list(session.process(messages_of(path)))
    same = {"name": "isam2", "horizon_s": HORIZON_S}
    causal = graphslam.smooth(path, backend=same).robots["robot"].causal
    # as above; without those observations they differ by 5 mm
    np.testing.assert_allclose([e.pose for e in found], causal.poses, rtol=0, atol=1e-7)


def test_an_estimate_is_of_what_came_until_then(room, live):
    """The first half of the messages gives the first half of the estimates, to the bit."""
    half = room[1][: len(room[1]) // 2]
    found = list(graphslam.Session(live={"horizon_s": HORIZON_S}).process(half))
    # what is last waited for what did not come any more
    for early, late in zip(found[:-2], live[1], strict=False):
        assert early.stamp_ns == late.stamp_ns
        assert np.array_equal(early.pose, late.pose)
        assert np.array_equal(early.cov, late.cov)


def test_what_is_behind_the_horizon_is_forgotten(filtered):
    """Of 60 s at 10 readings and 2 scans a second some ten seconds are kept, twice at most."""
    session, _ = filtered
    assert not session._pass.steps
    assert not session._pass.keyframe_scans
    (run,) = session._pass.runs.values()
    seconds = 1e-9 * (session._pass.last_ns - run.times[0])
    assert seconds < 2.5 * 10.0
    assert len(run.times) == len(run.causal_poses) == len(run.causal_covs) == len(run.calibrations)
    # no reading is forgotten here: they are few
    assert len(session._pass.backend._past) < len(run.times) + 20


def test_the_map_can_be_read_at_any_time(live):
    """The walls of the room and of the box, with covariances."""
    session, _ = live
    walls = [m for m in session.landmarks if m.kind in ("line", "segment")]
    assert len(walls) >= 6
    assert all(np.linalg.eigvalsh(m.cov)[0] > 0 for m in walls)


def test_a_second_round_adds_no_walls(room, live):
    """The room has four walls and the box four, of which one may be in the map in two parts. Breaks
    if a wall that comes into view alone, 10 m after it was last seen, is always a new one: 10 and
    14 of them after one round and two."""
    half = graphslam.Session(live={"horizon_s": HORIZON_S})
    for _ in half.process(room[1][: len(room[1]) // 2]):
        pass
    assert len(live[0].landmarks) <= len(half.landmarks) <= 9


def test_a_jump_is_said(live):
    """An estimate is what the one before and the odometry give, and its jump."""
    for before, after in zip(live[1], live[1][1:], strict=False):
        moved = between(before.odometry, after.odometry)
        expected = compose(compose(before.pose, moved), after.jump)
        np.testing.assert_allclose(between(after.pose, expected), 0.0, atol=1e-9)
    assert not live[1][0].jump.any()


class OneClosure:
    """Closes a loop once: the robot is 0.5 m ahead of where its last motion took it."""

    def __init__(self, *_settings):
        self.states, self.is_done = [], False

    def add(self, scans):
        self.states += [(scan.robot, scan.time_ns) for scan in scans]

    def closures(self, _time_ns):
        if self.is_done or len(self.states) < 20:
            return ()
        self.is_done = True
        ends, far = (*self.states[-1], *self.states[-2]), np.array([0.5, 0.0, 0.0])
        return (Closure(*ends, far, 1e-8 * np.eye(3), verified=True),)


def test_a_loop_that_a_place_closes_moves_the_estimate_and_says_so(room, monkeypatch):
    """By no more than it says. This one is wrong, so landmarks take some of it back."""
    monkeypatch.setattr(live_pass, "LoopCloser", OneClosure)
    found = list(graphslam.Session().process(room[1]))
    assert sum(e.loop_closed for e in found) == 1
    said = next(e for e in found if np.hypot(*e.jump[:2]) > 0.1)
    assert said.loop_closed
    assert np.hypot(*said.jump[:2]) < 0.6
    assert not any(e.loop_closed for e in found[: found.index(said)])


class OneClosureOfTwo(OneClosure):
    """Closes a loop between the robots a and b once: b is 0.3 m beside where it was thought."""

    def closures(self, _time_ns):
        own = {robot: [s for s in self.states if s[0] == robot] for robot in "ab"}
        if self.is_done or min(map(len, own.values())) < 20:
            return ()
        self.is_done = True
        ends, cov = (*own["b"][-1], *own["a"][-1]), 1e-6 * np.eye(3)
        return (Closure(*ends, np.array([0.3, 0.0, 0.0]), cov, verified=True),)


def test_a_closed_loop_is_said_of_every_robot_that_it_moves(room, monkeypatch):
    """Breaks if only the robot says so whose scan comes next."""
    monkeypatch.setattr(live_pass, "LoopCloser", OneClosureOfTwo)
    late_ns = S // 20
    both = [
        replace(m, robot=robot, stamp_ns=m.stamp_ns + ns, time_ns=m.time_ns + ns)
        for m in room[1]
        for robot, ns in (("a", 0), ("b", late_ns))
    ]
    session = graphslam.Session(start={"poses": {"a": [0, 0, 0], "b": [0, 0, 0]}})
    found = list(session.process(sorted(both, key=lambda m: m.time_ns)))
    said = [e for e in found if e.loop_closed]
    assert sorted(e.robot for e in said) == ["a", "b"]
    assert all(np.hypot(*e.jump[:2]) > 0.2 for e in said)  # then landmarks take some of it back


def test_estimates_are_where_the_robot_is(live):
    """8 cm: odometry that is 3 % too long counts until it is calibrated, then 1 cm of range noise.

    Dead reckoning is off by metres at the end.
    """
    start = true_pose(0.0)
    for e in live[1]:
        true = between(start, true_pose(1e-9 * (e.stamp_ns - START_NS)))
        assert np.hypot(*(e.pose - true)[:2]) < 0.08


def test_messages_that_are_late_are_sorted_in(room, live):
    """Scans that come 0.9 s late give the same; those beyond live.reorder_s are left out."""
    late = sorted(room[1], key=lambda m: m.time_ns + 900_000_000 * isinstance(m, Scan))
    session = graphslam.Session(live={"horizon_s": HORIZON_S, "reorder_s": 1.0})
    found = list(session.process(late))
    assert len(found) == len(live[1])
    np.testing.assert_array_equal([e.pose for e in found], [e.pose for e in live[1]])
    session = graphslam.Session(live={"horizon_s": HORIZON_S, "reorder_s": 0.2})
    assert len(list(session.process(late))) < 0.2 * len(found)
    assert session.dropped["stamp: older than live.reorder_s allows"] > 0.8 * len(found)


def test_what_is_left_out_is_counted_while_it_happens(room):
    """A clock that is set back by an hour: the drive has not ended, and the count tells."""
    back = [replace(m, stamp_ns=m.stamp_ns - 3600 * S, time_ns=m.time_ns - 3600 * S)
            for m in room[1][-100:]]  # fmt: skip
    session, counted = graphslam.Session(), []

    def queue():
        yield from room[1][:600]
        for message in back:
            yield message
            counted.append(sum(session.dropped.values()))

    list(session.process(queue()))
    assert counted == list(range(1, 101))


def test_a_drive_begins_once(room):
    session = graphslam.Session()
    assert list(session.process(room[1][:300]))
    with pytest.raises(graphslam.ConfigError, match="was called before"):
        next(session.process(room[1][300:600]))


def sightings(seconds=20):
    """A robot that drives round four posts without names and looks at them five times a second."""
    rng = np.random.default_rng(3)
    posts = np.array([[0.0, 0.0], [3.0, 0.5], [2.5, 3.0], [-0.5, 3.5]])
    mount, cov = np.zeros(3), np.diag([0.01**2, 0.02**2])
    odometry = np.zeros(3)
    before = circle(0.0)
    for k in range(seconds * 10 + 1):
        stamp, pose = S * 100 + k * S // 10, circle(k / 10)
        odometry = compose(odometry, between(before, pose) + rng.normal(0, 5e-4, 3))
        before = pose
        yield OdometryPose("robot", stamp, stamp, odometry)
        if k % 2 == 0:
            for post in posts:
                seen = between(pose, np.append(post, 0.0))
                z = np.array([np.arctan2(seen[1], seen[0]), np.hypot(*seen[:2])])
                z += rng.normal(0, [0.01, 0.02])
                yield Sighting("robot", stamp, stamp, z, cov, None, None, mount)


def circle(seconds):
    """Round the posts in 20 s."""
    a = 0.1 * np.pi * seconds
    return np.array([1.5 + 4 * np.cos(a), 1.5 + 4 * np.sin(a), a + np.pi / 2])


def test_sightings_have_estimates_too():
    """Within 5 of their sigmas, which 30 is the square of with three dimensions and 100 poses."""
    session = graphslam.Session()
    found = list(session.process(sightings()))
    assert len(found) > 90
    for e in found:
        true = between(circle(0.0), circle(1e-9 * e.stamp_ns - 100))
        off = e.pose - true
        assert off @ np.linalg.solve(e.cov, off) < 30.0
        assert e.scan_pose is None
    assert len(session.landmarks) == 4


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"z": np.full(2, np.nan)}, "sighting: not finite"),
        ({"cov": np.zeros((2, 2))}, "sighting: covariance is not positive definite"),
        ({"time_ns": 9 * 10**18, "stamp_ns": 9 * 10**18}, "stamp: far later than those before"),
        ({"z": np.zeros(4), "cov": np.eye(4)}, "Sighting: z must be bearing, range and perhaps"),
        ({"cov": np.eye(3)}, "Sighting: cov must be an array (k, k) of numbers"),
        ({"mount": [0.0, "left", 0.0]}, "Sighting: mount must be an array (3) of numbers"),
        ({"stamp_ns": 1e18}, "Sighting: stamp_ns and time_ns must be whole numbers"),
    ],
)
def test_a_message_that_cannot_be_used_is_left_out_and_counted(changes, reason):
    """The rest is estimated to the bit as if it had not come."""
    messages = list(sightings())
    bad = max(k for k in range(400) if isinstance(messages[k], Sighting))
    left = list(graphslam.Session().process(messages[:bad] + messages[bad + 1 :]))
    session = graphslam.Session()
    wrong = [*messages[:bad], replace(messages[bad], **changes), *messages[bad + 1 :]]
    found = list(session.process(wrong))
    assert [(key.startswith(reason), n) for key, n in session.dropped.items() if n] == [(True, 1)]
    np.testing.assert_array_equal([e.pose for e in found], [e.pose for e in left])


def test_scans_that_smooth_drops_are_left_out_and_counted(room):
    """No estimates come of those without directions or beams, and the others are as without."""
    few = room[1][:300]
    scans = [k for k, m in enumerate(few) if isinstance(m, Scan)]
    bad = {scans[3]: {"angle_step_rad": 0.0}, scans[7]: {"ranges": np.empty(0)}}
    left = list(graphslam.Session().process(m for k, m in enumerate(few) if k not in bad))
    session = graphslam.Session()
    found = list(session.process(replace(m, **bad.get(k, {})) for k, m in enumerate(few)))
    reasons = "angle increment is zero or angles are not finite", "no beams"
    assert session.dropped == {f"scan: {reason}": 1 for reason in reasons}
    np.testing.assert_array_equal([e.pose for e in found], [e.pose for e in left])


def test_lists_are_arrays_and_what_is_no_message_is_counted():
    """A program that has its numbers as lists gets the same estimates; None is no end of all."""
    messages = list(sightings())
    as_lists = [
        replace(m, z=m.z.tolist(), cov=m.cov.tolist()) if isinstance(m, Sighting)
        else replace(m, pose=m.pose.tolist())
        for m in messages
    ]  # fmt: skip
    session = graphslam.Session()
    found = list(session.process([*as_lists[:50], None, *as_lists[50:]]))
    assert session.dropped == {"NoneType: is no record of graphslam": 1}
    expected = [e.pose for e in graphslam.Session().process(messages)]
    np.testing.assert_array_equal([e.pose for e in found], expected)


@pytest.mark.parametrize("robots", [["robot"], {"robot": ["scan"]}, {"robot": OdometryPose}])
def test_robots_that_are_no_records_are_refused(robots):
    """Not with an error from inside."""
    with pytest.raises(graphslam.ConfigError, match="needs a dict of what each sends"):
        graphslam.Session(robots=robots)


@pytest.mark.parametrize("off_ns", [3600 * S, -3600 * S, None], ids=["ahead", "behind", "zero"])
@pytest.mark.parametrize("place", [0, 1, 3])
def test_a_wrong_stamp_at_the_beginning_is_left_out_and_counted(room, off_ns, place):
    """Breaks if robots and sensors are found out before it is: an hour ahead, the introduction
    never ended; at 0, it ended at once, with nothing to estimate from. The rest is as without."""
    few = room[1][:200]
    wrong_ns = 0 if off_ns is None else few[place].time_ns + off_ns
    bad = replace(few[place], stamp_ns=wrong_ns, time_ns=wrong_ns)
    taken = []

    def queue():
        for message in [*few[:place], bad, *few[place + 1 :]]:
            taken.append(message)
            yield message

    session, at_first = graphslam.Session(), []
    found = []
    for estimate in session.process(queue()):
        at_first = at_first or [len(taken)]
        found.append(estimate)
    without = graphslam.Session()
    left = list(without.process(few[:place] + few[place + 1 :]))
    assert at_first[0] < 60  # it does not wait for the end: 20 readings and 4 scans in 2 s
    (reason,) = +(session.dropped - without.dropped)
    assert reason.startswith("stamp: far") and session.dropped[reason] == 1
    np.testing.assert_array_equal([e.pose for e in found], [e.pose for e in left])


def test_a_clock_that_is_set_in_the_beginning_does_not_end_it(room):
    """Eight messages since 1970: time did go on, and the two seconds begin anew."""
    few = room[1][:300]
    early = [replace(m, stamp_ns=m.stamp_ns - few[0].stamp_ns, time_ns=m.time_ns - few[0].time_ns)
             for m in few if isinstance(m, OdometryPose)][:8]  # fmt: skip
    found = list(graphslam.Session().process([*early, *few[8:]]))
    assert len(found) > 40


def test_the_truth_may_have_a_clock_of_its_own(room):
    """It is not used, so that its stamps say nothing of those of the others."""
    few = room[1][:200]
    true = [Truth("robot", k, k, np.zeros(3)) for k in range(len(few))]
    mixed = [m for pair in zip(true, few, strict=True) for m in pair]
    session = graphslam.Session()
    found = list(session.process(mixed))
    assert not +session.dropped
    left = list(graphslam.Session().process(few))
    np.testing.assert_array_equal([e.pose for e in found], [e.pose for e in left])


def test_time_may_go_on_after_a_pause():
    """Nothing for a minute, and then everything as before: no stamp is taken for wrong."""
    messages = list(sightings())
    half = next(k for k in range(300, 400) if isinstance(messages[k], OdometryPose))
    later = [replace(m, stamp_ns=m.stamp_ns + 60 * S, time_ns=m.time_ns + 60 * S)
             for m in messages[half:]]  # fmt: skip
    session = graphslam.Session()
    found = list(session.process(messages[:half] + later))
    assert not any(n for key, n in session.dropped.items() if key.startswith("stamp"))
    assert len(found) > 90


def test_what_is_late_says_nothing_of_the_stamps_of_the_others():
    """Of odometry, too, what is beyond live.reorder_s is left out; nothing else is moved in time.

    Estimates are those without it, to the bit.
    """
    messages = list(sightings())
    late = [m for m in messages if isinstance(m, OdometryPose)][20:-20:20]
    rest = [m for m in messages if not any(m is one for one in late)]
    left = list(graphslam.Session().process(rest))
    mixed = sorted([*rest, *late], key=lambda m: m.time_ns + 2 * S * any(m is x for x in late))
    session = graphslam.Session(live={"reorder_s": 0.3})
    found = list(session.process(mixed))
    assert sum(session.dropped.values()) == len(late)
    assert [e.stamp_ns for e in found] == [e.stamp_ns for e in left]
    np.testing.assert_array_equal([e.pose for e in found], [e.pose for e in left])


def test_two_robots_have_frames_of_their_own_until_their_starts_are_told(room):
    """Nothing is assumed of where a second robot starts; its map is its own."""
    both = [m for one in room[1] for m in (one, replace(one, robot="other"))]
    frames = {e.robot: e.frame for e in graphslam.Session().process(both[:1500])}
    assert frames == {"robot": "robot", "other": "other"}
    told = {"robot": [0.0, 0.0, 0.0], "other": [0.0, 0.0, 0.0]}
    session = graphslam.Session(start={"poses": told})
    frames = {e.robot: e.frame for e in session.process(both[:1500])}
    assert len(set(frames.values())) == 1


def test_what_nobody_announced_is_left_out(room):
    """A robot that comes later is counted, and named in `robots` it is not."""
    stranger = [replace(m, robot="late") for m in room[1][-50:]]
    session = graphslam.Session()
    assert {e.robot for e in session.process([*room[1][:300], *stranger])} == {"robot"}
    assert sum(session.dropped.values()) == 50
    whose = "late did not send any in the first 2 s"
    assert set(session.dropped) == {f"{what}: {whose}" for what in ("odometrypose", "scan")}
    session = graphslam.Session(robots={"robot": (OdometryPose, Scan)})
    found = session.process([*room[1][:300], *stranger])
    assert {e.robot for e in found} == {"robot"}
    assert session.robots == ("robot",)
    whose = "late was not to send any, by Session(robots=...)"
    assert set(session.dropped) == {f"{what}: {whose}" for what in ("odometrypose", "scan")}


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        ({"backend": "ekf"}, "live estimates are those of isam2"),
        ({"backend": {"name": "isam2", "horizon_s": 0.0}}, "with a horizon above 0 s"),
        ({"start": {"from_truth": True}}, "needs a whole log"),
    ],
)
def test_settings_that_need_the_whole_log_are_refused(settings, text):
    """Before anything is read."""
    with pytest.raises(graphslam.ConfigError, match=text):
        graphslam.Session(**settings)


def test_messages_of_which_nothing_can_be_estimated_are_refused(room):
    """Odometry alone, or no message at all."""
    odometry = [m for m in room[1] if isinstance(m, OdometryPose)]
    for messages in (odometry, []):
        with pytest.raises(graphslam.LogError, match="needs odometry and scans or sightings"):
            list(graphslam.Session().process(messages))


@pytest.fixture(scope="module")
def known(tmp_path_factory):
    """The map of the first day, in whose world the robot starts at the origin."""
    folder = tmp_path_factory.mktemp("known")
    graphslam.smooth(drive(folder / "monday.mcap", seconds=32), output=folder / "monday")
    return str(folder / "monday")


def off(estimate):
    """Distance, m, of the laser from its true position relative to the start of the base."""
    true = between(true_pose(0.0), true_pose(1e-9 * (estimate.stamp_ns - START_NS)))
    return float(np.hypot(*(estimate.scan_pose - compose(true, MOUNT))[:2]))


def test_a_robot_that_comes_back_is_localised_in_the_known_map(room, known):
    """A start that is told 6 cm and 0.03 rad wrong is put right by the walls, and only by them.

    2 cm once it moves: the error of that map is 1 cm. Without it the error of the start remains.
    Of the laser, since that of the base is also that of the mount, which is calibrated meanwhile.
    """
    start = {"poses": {"robot": [0.05, -0.04, 0.03]}}
    later = slice(10, 60)
    with_map = graphslam.Session(start=start, known_map={"directory": known})
    found = list(with_map.process(room[1][:800]))[later]
    assert max(map(off, found)) < 0.02
    assert all(e.frame == "robot" for e in found)
    alone = list(graphslam.Session(start=start).process(room[1][:800]))[later]
    assert np.median(list(map(off, alone))) > 0.04
    before = {m.id for m in graphslam.load_result(known).landmarks}
    assert before <= {m.id for m in with_map.landmarks}


def test_a_known_map_needs_a_start_and_is_not_continued(room, known):
    """Both take the whole log."""
    with pytest.raises(graphslam.EstimationError, match=r"need its start; give --start robot="):
        list(graphslam.Session(known_map={"directory": known}).process(room[1]))
    with pytest.raises(graphslam.ConfigError, match="smooth the recording with --update"):
        graphslam.Session(known_map={"directory": known, "update": True})
    with pytest.raises(graphslam.OutputError, match="not a result folder"):
        start = {"poses": {"robot": [0.0, 0.0, 0.0]}}
        list(graphslam.Session(start=start, known_map={"directory": "none"}).process(room[1]))


def test_robots_are_told_with_what_they_send():
    """Names alone do not say whether scans or sightings come."""
    with pytest.raises(graphslam.ConfigError, match="needs a dict of what each sends"):
        graphslam.Session(robots=["anna", "ben"])


def together(messages, number):
    """Estimates of messages that come ``number`` at once, and how many there are after each lot."""
    session = graphslam.Session(live={"horizon_s": HORIZON_S}, robots=ROBOT)
    ready, found, reported = deque(), [], []

    def lots():
        for begin in range(0, len(messages), number):
            reported.append(len(found))
            ready.extend(messages[begin : begin + number])
            while ready:
                yield ready.popleft()

    for estimate in session.process_sorted(lots(), ready):
        found.append(estimate)  # at once: `lots` counts them meanwhile
    return found, reported


def test_scans_that_come_at_once_are_reported_together_and_no_later(room):
    """A recorder that fell behind writes two seconds at once. Breaks if an estimate waits for the
    next lot where it need not, or is lost.

    1e-6: scans without a state are matched together, and places are compared after the last one.
    """
    found, reported = together(room[1], 23)
    one_by_one, in_time = together(room[1], 1)
    assert reported == in_time[::23]
    assert [e.stamp_ns for e in found] == [e.stamp_ns for e in one_by_one]
    for a, b in zip(found, one_by_one, strict=True):
        np.testing.assert_allclose(a.pose, b.pose, rtol=0, atol=1e-6)
        np.testing.assert_allclose(a.cov, b.cov, rtol=0, atol=1e-6)


@pytest.mark.parametrize("horizon_s", [1.0, HORIZON_S])
def test_more_may_come_at_once_than_the_horizon_holds(room, horizon_s):
    """Half a minute. Breaks if places are kept only once their states are forgotten."""
    session = graphslam.Session(live={"horizon_s": horizon_s, "reorder_s": 30.0})
    found = list(session.process(room[1]))
    assert len(found) == sum(isinstance(m, Scan) for m in room[1])


def test_of_two_kinds_of_odometry_one_is_used_and_the_other_is_counted(room):
    """As of a robot with /odom and /joint_states."""
    wheels = [
        WheelAngles(m.robot, m.stamp_ns, m.time_ns, 10.0 * k, 10.0 * k)
        for k, m in enumerate(room[1])
        if isinstance(m, OdometryPose)
    ]
    session = graphslam.Session()
    found = list(session.process(sorted([*room[1], *wheels], key=lambda m: m.time_ns)))
    alone = list(graphslam.Session().process(room[1]))
    assert np.array_equal([e.pose for e in found], [e.pose for e in alone])
    (said,) = session.dropped
    assert said == "wheelangles: not used, as robot has another kind of odometry"
    assert session.dropped[said] == len(wheels)


def test_a_horizon_of_nothing_is_refused():
    with pytest.raises(graphslam.ConfigError, match=r"live.horizon_s: .* above 0 s"):
        graphslam.Session(live={"horizon_s": 0.0})
