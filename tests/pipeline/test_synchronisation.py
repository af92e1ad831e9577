"""Messages in time order, each released once its robots' odometry reaches it."""

from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from graphslam.core.config import OdometryConfig, RobotConfig
from graphslam.core.record import replace
from graphslam.core.records import OdometryPose, Scan, Sighting, TrueLandmark, Truth
from graphslam.odometry.preintegration import Track
from graphslam.pipeline.sighting_batches import SightingBatch, batch_sightings
from graphslam.pipeline.synchronisation import synchronise

SECOND = 1_000_000_000
GAP_S = 5.0


def odometry(robot, t):
    return OdometryPose(robot, round(t * SECOND), round(t * SECOND), np.array([t, 0.0, 0.0]))


def scan(robot, t):
    ns = round(t * SECOND)
    return Scan(robot, ns, ns, np.ones(3), 0.0, 0.1, np.zeros(3))


def sighting(robot, t, seen_robot=None):
    ns = round(t * SECOND)
    return Sighting(robot, ns, ns, np.ones(2), np.eye(2), None, seen_robot, np.zeros(3))


def truth(robot, t):
    return Truth(robot, round(t * SECOND), round(t * SECOND), np.zeros(3))


class Run:
    """`synchronise` over messages; notes at each release how far the log had been read."""

    def __init__(self, messages, robots=("a", "b"), gap_s=GAP_S):
        self.tracks = {r: Track(OdometryConfig(), RobotConfig()) for r in robots}
        self.dropped = Counter()
        self.read_ns = 0
        self.released, self.read_at_release, self.covered = [], [], []
        for message in synchronise(self._count(messages), self.tracks, gap_s, self.dropped):
            self.released.append(message)
            self.read_at_release.append(self.read_ns)
            self.covered.append(self.tracks[message.robot].reaches(message.time_ns))

    def _count(self, messages):
        for message in messages:
            self.read_ns = message.time_ns
            yield message

    def times(self, kind):
        return [m.time_ns / SECOND for m in self.released if isinstance(m, kind)]


def test_scan_waits_for_the_odometry_reading_after_it():
    """A scan between two readings needs the later one; released at once, it would be placed by a
    robot that stands."""
    run = Run(
        [odometry("a", 0), scan("a", 0.5), odometry("a", 1), scan("a", 1.5), odometry("a", 2)]
    )
    assert [type(m).__name__ for m in run.released] == [
        "OdometryPose", "Scan", "OdometryPose", "Scan", "OdometryPose",
    ]  # fmt: skip
    assert all(run.covered)
    assert run.read_at_release[1] == 1 * SECOND  # not before the reading that covers it


@pytest.mark.parametrize("may_be", ["robot", "either", "landmark"])
def test_what_may_be_any_robot_waits_for_all_of_them(may_be):
    """Robot c is the last to be read: what may be c needs to know where it was; a landmark does
    not. The same holds for batches."""
    seen = replace(sighting("a", 0.5), may_be=may_be)
    later = [odometry("a", 1), odometry("b", 1.1), odometry("b", 1.2), odometry("c", 1.3)]
    first = [odometry(robot, 0.1 * k) for k, robot in enumerate("abc")]
    run = Run([*first, seen, *later, odometry("a", 2)], "abc")
    released = [t for m, t in zip(run.released, run.read_at_release, strict=True) if m is seen]
    until = 1.0 if may_be == "landmark" else 1.3
    assert released == [round(until * SECOND)]
    tracks = {r: Track(OdometryConfig(), RobotConfig()) for r in "abc"}

    def messages():
        for message in [*first, seen, replace(seen, time_ns=2 * seen.time_ns), *later]:
            if isinstance(message, OdometryPose):
                tracks[message.robot].add(message)
            read.append(message.time_ns)
            yield [message]

    read = []
    made = batch_sightings(messages(), tracks, SECOND // 10, round(GAP_S * SECOND))
    batch = next(event for event in made if isinstance(event, SightingBatch))
    assert batch.images == [[seen]] and read[-1] == round(until * SECOND)


def test_scan_at_the_stamp_of_a_reading_needs_no_later_one():
    run = Run([odometry("a", 0), odometry("a", 1), scan("a", 1), odometry("a", 2)])
    assert run.read_at_release[2] == 1 * SECOND


def test_order_of_time_is_kept_over_robots():
    """Robot b's scan may not overtake robot a's earlier one that still waits."""
    messages = [
        odometry("a", 0),
        odometry("b", 0),
        scan("a", 0.5),
        scan("b", 0.6),
        odometry("b", 1),
    ]
    run = Run([*messages, odometry("a", 2), odometry("b", 2)])
    times = [m.time_ns for m in run.released]
    assert times == sorted(times)
    b_scan = [m.robot for m in run.released if isinstance(m, Scan)].index("b")
    assert run.times(Scan) == [0.5, 0.6] and b_scan == 1
    assert min(run.read_at_release[2:]) == 2 * SECOND


def test_one_robots_silence_delays_the_others_by_the_gap_at_most():
    """Robot b's odometry ends at 0 s, its scan of 3 s can never be covered: what robot a does is
    held until 5 s have passed, not until the end of the log."""
    messages = [odometry("b", 0)]
    for k in range(200):
        t = 0.1 * k
        messages += [odometry("a", t), scan("a", t)]
        if k == 30:
            messages.append(scan("b", t))
    run = Run(messages)
    delays = [
        (read - m.time_ns) / SECOND
        for m, read in zip(run.released, run.read_at_release, strict=True)
    ]
    assert max(delays) <= GAP_S + 0.1 + 1e-9  # noticed at the next message, 0.1 s later
    late = [d for m, d in zip(run.released, delays, strict=True) if m.time_ns > 9 * SECOND]
    assert max(late) <= 0.1  # the delay does not stay


def test_what_is_near_odometry_at_the_end_of_the_log_is_released_and_the_rest_counted():
    """After its last reading a robot that stands is taken to stand on, for half a second and no
    longer. One that moves, by readings every 0.1 s, is elsewhere: its scans would be laid where it
    was."""
    scans = [scan("a", 2.2), scan("a", 2.5), scan("a", 2.6)]
    stands = replace(odometry("a", 1), stamp_ns=2 * SECOND, time_ns=2 * SECOND)
    run = Run([odometry("a", 0), odometry("a", 1), stands, *scans])
    assert run.times(Scan) == [2.2, 2.5]
    assert run.dropped == {"scan: no odometry near it": 1}
    moves = [odometry("a", 0.1 * k) for k in range(21)]
    run = Run([*moves, scan("a", 2.09), *scans])
    assert run.times(Scan) == [2.09, 2.2]
    assert run.dropped == {"scan: no odometry near it": 2}


def test_scans_before_the_first_odometry_are_counted():
    """Where a robot starts is told of where its odometry begins; it may have moved until then."""
    messages = [scan("a", 0), scan("a", 6.9), scan("a", 7), odometry("a", 7), odometry("a", 8)]
    run = Run(messages)
    assert run.times(Scan) == [7]
    assert run.dropped == {"scan: no odometry near it": 2}


def test_scans_in_a_hole_of_the_odometry_are_counted():
    """Longer than the gap, nobody knows where the robot was in it."""
    messages = [
        odometry("a", 0),
        scan("a", 1),
        odometry("a", 4.9),
        scan("a", 7),
        odometry("a", 10.0),
    ]
    run = Run(messages)
    assert run.times(Scan) == [1.0]
    assert run.dropped == {"scan: no odometry near it": 1}


def test_robot_without_any_odometry_has_all_its_scans_counted():
    """A scan without odometry is unusable, and the log may not be held up by it."""
    messages = [odometry("a", 0)]
    for k in range(1, 100):
        messages += [scan("b", k), odometry("a", k), scan("a", k)]
    run = Run(messages)
    assert run.dropped == {"scan: no odometry near it": 99}
    assert len(run.times(Scan)) == 99
    assert {m.robot for m in run.released} == {"a"}


def test_sighting_of_a_robot_waits_for_both_robots():
    """It makes a state of either; b's reading comes last."""
    messages = [odometry("a", 0), odometry("b", 0), sighting("a", 0.5, "b"), odometry("a", 1)]
    run = Run([*messages, odometry("b", 1.5)])
    index = [type(m) for m in run.released].index(Sighting)
    assert run.read_at_release[index] == 1.5 * SECOND
    run = Run([*messages[:2], sighting("a", 0.5), odometry("a", 1), odometry("b", 1.5)])
    index = [type(m) for m in run.released].index(Sighting)
    assert run.read_at_release[index] == 1 * SECOND  # of a landmark: a alone


def test_sighting_of_a_robot_without_odometry_near_it_is_counted():
    messages = [odometry("a", 0), sighting("a", 0.5, "b"), odometry("a", 1)]
    run = Run(messages)
    assert run.times(Sighting) == []
    assert run.dropped == {"sighting: no odometry near it": 1}


def test_sighting_of_a_robot_that_is_not_in_the_log_is_counted_and_delays_nothing():
    """A name misspelt, or a robot whose log was not given: no odometry of it can ever come, so
    waiting for it would hold up everything else for the whole gap."""
    messages = [odometry("a", 0), sighting("a", 0.5, "nobody"), scan("a", 0.6), odometry("a", 1)]
    run = Run([*messages, odometry("a", 2)])
    assert run.times(Sighting) == [] and run.times(Scan) == [0.6]
    assert run.dropped == {"sighting: robot nobody is not in the log": 1}
    assert run.read_at_release[1] == 1 * SECOND


def test_truth_never_reaches_the_estimator():
    landmark = TrueLandmark("", 0, 0, "tree", "point", np.zeros(3), None)
    run = Run([landmark, odometry("a", 0), truth("a", 0), odometry("a", 1), truth("a", 1)])
    assert [type(m) for m in run.released] == [OdometryPose] * 2


def test_odometry_is_in_the_track_before_it_comes_out():
    """A keyframe at an odometry stamp asks the track for the motion up to it."""
    run = Run([odometry("a", t) for t in range(5)])
    assert all(run.covered)
    assert len(run.tracks["a"]) == 5


@st.composite
def logs(draw):
    """Messages in time order of two robots; odometry may pause for long."""
    makers = [odometry, scan, sighting, lambda robot, t: sighting(robot, t, "ba"[robot == "b"])]
    n = draw(st.integers(0, 40))
    t, messages = 0.0, []
    for _ in range(n):
        t += draw(st.sampled_from([0.0, 0.1, 1.0, 4.0, 20.0]))
        messages.append(draw(st.sampled_from(makers))(draw(st.sampled_from("ab")), t))
    return messages


@given(logs())
def test_nothing_is_lost_unseen_and_nothing_changes_places(messages):
    """Whatever the gaps: what comes out is what went in, in that order, less what is counted."""
    run = Run(messages)
    position = {id(m): k for k, m in enumerate(messages)}
    order = [position[id(m)] for m in run.released]
    assert order == sorted(set(order))
    assert len(run.released) + run.dropped.total() == len(messages)
    assert sum(isinstance(m, OdometryPose) for m in messages) == len(run.times(OdometryPose))
    for m, read in zip(run.released, run.read_at_release, strict=True):
        waited = read - m.time_ns
        # a message may come long after: it is then the first that shows how late it is
        assert waited <= GAP_S * SECOND + 20 * SECOND
