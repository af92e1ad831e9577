"""Stamps later than their recording: placed between what was recorded around them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from graphslam.core.config import Config
from graphslam.core.records import OdometryIncrement, OdometryPose, Scan
from graphslam.logs import LogWriter, open_logs
from graphslam.logs.future_stamps import MAX_RUN, TOLERANCE_NS, repair_future_stamps
from graphslam.logs.time_order import SAMPLED

MS = 1_000_000


def odometry(stamp_ns):
    return OdometryPose("r", stamp_ns, stamp_ns, np.array([1e-9 * stamp_ns, 0.0, 0.0]))


def scan(stamp_ns):
    return Scan("r", stamp_ns, stamp_ns, np.ones(3), 0.0, 0.1, np.zeros(3))


def increment(stamp_ns):
    return OdometryIncrement("r", stamp_ns, stamp_ns, stamp_ns - MS, np.zeros(3), np.eye(3))


MAKERS = {"/odom": odometry, "/scan": scan, "/odom_increment": increment}


def record(*rows):
    """(topic, stamp ms) in the order of recording; recorded at the earliest stamp of a message and
    all behind it, as importers write it."""
    stamps = [round(stamp * MS) for _, stamp in rows]
    logged = np.minimum.accumulate(stamps[::-1])[::-1].tolist()
    return [
        (topic, MAKERS[topic](stamp), log_ns)
        for (topic, _), stamp, log_ns in zip(rows, stamps, logged, strict=True)
    ]


def sound(topic, n, end_ms):
    """n messages, one per ms, the last at end_ms: a topic's history of valid stamps."""
    return [(topic, end_ms - n + 1 + k) for k in range(n)]


def placed_ms(recorded):
    return [message.time_ns / MS for _, message, _ in repair_future_stamps(recorded, SAMPLED)]


HISTORY = [*sound("/odom", 10, -20), *sound("/scan", 10, 0)]


def test_a_run_is_spread_evenly_and_in_order_across_topics():
    """Five messages of two topics, stamped half a second late, recorded between 0 and 60 ms: one
    every 10 ms. Topic by topic, a scan would come before odometry recorded ahead of it."""
    late = [("/odom", 500), ("/scan", 501), ("/odom", 502), ("/scan", 503), ("/odom", 500)]
    found = placed_ms(record(*HISTORY, *late, ("/odom", 60), ("/scan", 70)))
    assert found[-8:] == [0, 10, 20, 30, 40, 50, 60, 70]


def test_stamps_are_kept_and_so_is_the_order_of_recording():
    """The time gives the order; outputs name a message by its unchanged stamp."""
    recorded = record(*HISTORY, ("/odom", 123.456789), ("/scan", 400), ("/odom", 60))
    placed = list(repair_future_stamps(recorded, SAMPLED))
    assert [(t, m.stamp_ns, log) for t, m, log in placed] == [
        (t, m.stamp_ns, log) for t, m, log in recorded
    ]
    assert [m.time_ns for _, m, _ in placed[-3:]] == [20 * MS, 40 * MS, 60 * MS]


def test_two_runs_do_not_run_into_each_other():
    """Each has its own time of recording; the second begins where the first ended."""
    runs = [("/odom", 500), ("/odom", 30), ("/odom", 900), ("/odom", 901), ("/odom", 90)]
    assert placed_ms(record(*HISTORY, *runs))[-5:] == [15, 30, 50, 70, 90]
    # without a sound message between them: the first was recorded at 30, the second at 90
    recorded = [
        *record(*HISTORY),
        ("/odom", odometry(500 * MS), 30 * MS),
        ("/odom", odometry(900 * MS), 90 * MS),
        ("/odom", odometry(90 * MS), 90 * MS),
    ]
    assert placed_ms(recorded)[-3:] == [15, 60, 90]


@pytest.mark.parametrize(("late_ns", "moved"), [(TOLERANCE_NS, False), (TOLERANCE_NS + 1, True)])
def test_clocks_are_read_twice(late_ns, moved):
    """Recorder and driver read the clock in turn; a millisecond between them is tolerated."""
    recorded = [*record(*HISTORY), ("/scan", scan(50 * MS + late_ns), 50 * MS)]
    (*_, (_, message, _)) = repair_future_stamps(recorded, SAMPLED)
    assert (message.time_ns != message.stamp_ns) == moved


@pytest.mark.parametrize("offset_ms", [5, 3600_000])
def test_a_constant_offset_between_clocks_is_left_alone(offset_ms):
    """A laser with a clock of its own that is ahead: all of its stamps are later than their
    recording, so they say nothing about the logger. The same objects come out."""
    recorded = []
    for k in range(200):
        recorded.append(("/odom", odometry(10 * k * MS), 10 * k * MS))
        recorded.append(("/scan", scan((10 * k + 5 + offset_ms) * MS), (10 * k + 5) * MS))
    placed = list(repair_future_stamps(recorded, SAMPLED))
    assert all(a[1] is b[1] for a, b in zip(placed, recorded, strict=True))


def test_increments_name_their_times_themselves():
    """Only samples of a process are placed by the order of recording."""
    recorded = record(*HISTORY, ("/odom_increment", 500), ("/odom", 60))
    assert placed_ms(recorded)[-2:] == [500, 60]


def test_nothing_sound_before_it_nothing_to_place_it_by():
    """The log begins with a late message: it stays where its stamp says, and does not drag those
    behind it along."""
    assert placed_ms(record(("/odom", 500), ("/odom", 10), ("/odom", 20))) == [500, 10, 20]


def test_a_run_of_any_length_stays_in_order():
    """Memory is bounded by MAX_RUN messages; what is behind them piles up at the time of the
    recording, in order."""
    late = [("/odom", 5000 + k) for k in range(MAX_RUN + 10)]
    rows = [*sound("/odom", 2 * len(late), 0), *late, ("/odom", 65)]
    found = placed_ms(record(*rows))
    assert found[-(len(late) + 1) :] == sorted(found[-(len(late) + 1) :])
    assert found[-len(late) - 1] == 1 and found[-11:] == [65] * 11
    assert max(found) == 65


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["/odom", "/scan"]),
            st.sampled_from([0, 0, 0, 0, 300, 450]),
            st.integers(1, 40),
        ),
        max_size=60,
    )
)
def test_good_stamps_are_never_touched_and_time_never_runs_backwards(rows):
    """Whatever is late by how much, on which topic: a stamp that its recording does not contradict
    stays, and messages come out in the order of recording in time as well, but for late ones that
    nothing sound of their topic vouches for (more than half of it late so far)."""
    now, spoken = 0, []
    for topic, late, step in rows:
        now += step
        spoken.append((topic, now + late))
    # enough good stamps beforehand that no topic is ever half late
    history = [*sound("/odom", 70, -100), *sound("/scan", 70, 0)]
    recorded = record(*history, *spoken, ("/odom", now + 1000))
    placed = list(repair_future_stamps(recorded, SAMPLED))
    assert len(placed) == len(recorded)
    times = [m.time_ns for _, m, _ in placed]
    assert times == sorted(times)
    for (_, message, log_ns), time_ns in zip(recorded, times, strict=True):
        if message.stamp_ns <= log_ns + TOLERANCE_NS:
            assert time_ns == message.stamp_ns
        else:
            assert time_ns <= log_ns


def test_a_log_with_a_hiccup_is_read_in_the_order_of_its_recording(tmp_path):
    """From the file to the pipeline: odometry and scan that alternate every 50 ms, five of them
    stamped late by 0.4 s. Placed within 10 ms of the truth: they were recorded evenly."""
    path = tmp_path / "log.mcap"
    late = {41, 42, 43, 44, 45}
    stamps = [50 * k + (400 if k in late else 0) for k in range(100)]
    logged = np.minimum.accumulate(stamps[::-1])[::-1]
    with LogWriter(path) as writer:
        for k, stamp in enumerate(stamps):
            log_ns = int(logged[k]) * MS
            if k % 2:
                fan = {"angle_min_rad": 0.0, "angle_step_rad": 0.1, "range_max_m": 30.0}
                writer.scan("robot", stamp * MS, np.ones(5), **fan, log_time_ns=log_ns)
            else:
                writer.odometry("robot", stamp * MS, [0.01 * k, 0, 0], log_time_ns=log_ns)
    log = open_logs([path], Config())
    messages = list(log.messages())
    assert [m.stamp_ns for m in messages] == [stamp * MS for stamp in stamps]
    assert [m.time_ns for m in messages] == pytest.approx(
        [50 * k * MS for k in range(100)], abs=10 * MS
    )
    assert log.repaired.total() == len(late) and not log.dropped
