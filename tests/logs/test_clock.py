"""Clocks of robots: messages on one time line, and how far each is ahead, from mutual sightings."""

import numpy as np
import pytest
from common import simulated_log
from robots_in_scans import SCENARIO, both, outcome, true_offset_s

from graphslam.core.config_io import load_config
from graphslam.core.geometry import between, compose, exp
from graphslam.core.records import OdometryIncrement, OdometryPose
from graphslam.logs import LogWriter, open_logs
from graphslam.logs.clock import Clock, to_common_clock
from graphslam.slam.smooth import smooth

S, T0 = 1_000_000_000, 10_000_000_000
STARTS = {"a": (0.0, 0.0, 0.0), "b": (4.0, 1.0, 2.0)}
LANDMARKS = {"6": (3.0, 2.0), "7": (-1.0, 4.0), "8": (6.0, 5.0)}
SIGMAS = np.array([0.01, 0.03])


# ------------------------------------------------------------ one time line


@pytest.mark.parametrize("clock", [Clock(0.4, 3e-5, T0), Clock(-2.5, -1e-4, T0), Clock()])
def test_own_and_common_time_are_each_others_inverse(clock):
    for time_ns in (T0, T0 + 100 * S, T0 + 10_000 * S):
        own = int(clock.to_local(np.array([time_ns]))[0])
        assert abs(clock.to_common(own) - time_ns) <= 1
        ahead = clock.offset_s + clock.drift * 1e-9 * (time_ns - clock.epoch_ns)
        assert own - time_ns == pytest.approx(1e9 * ahead, abs=2)


@pytest.mark.parametrize("offset_s", [0.4, -0.4, 7.0])
def test_messages_come_in_the_order_of_the_common_clock(offset_s):
    """For both signs of the offset, also beyond the window of reordering. Stamps do not change."""
    clock = Clock(offset_s, 1e-4, T0)
    true = [(T0 + k * S // 10, "ab"[k % 2]) for k in range(200)]
    made = []
    for time_ns, robot in true:
        own = int(clock.to_local(np.array([time_ns]))[0]) if robot == "b" else time_ns
        made.append(OdometryPose(robot, own, own, np.zeros(3)))
    made.sort(key=lambda message: message.time_ns)
    found = list(to_common_clock(made, {"b": clock}))
    assert [m.robot for m in found] == [robot for _, robot in true]
    np.testing.assert_allclose([m.time_ns for m in found], [t for t, _ in true], atol=1)
    assert sorted(m.stamp_ns for m in found) == sorted(m.stamp_ns for m in made)


def test_both_ends_of_an_increment_move():
    clock = Clock(0.5, 0.0, T0)
    message = OdometryIncrement("b", T0 + S, T0 + S, T0, np.zeros(3), np.eye(3))
    (found,) = to_common_clock([message], {"b": clock})
    assert (found.start_ns, found.time_ns) == (T0 - S // 2, T0 + S // 2)


# ------------------------------------------------------------ offsets found


def pose(robot, seconds):
    """Both drive on circles with varying speed, so that a delay is not equal to a displacement."""
    phase = {"a": 0.0, "b": 1.0}[robot]
    way = 0.3 * seconds + 0.8 * (np.cos(phase) - np.cos(0.5 * seconds + phase))
    return compose(np.array(STARTS[robot]), exp(way * np.array([1.0, 0.0, 0.5])))


def write(folder, offset_s, drift=0.0, seed=0, mutual=True, seconds=60):
    """Two files, one per robot; the clock of b is ahead, and its truth has its clock."""
    rng = np.random.default_rng(seed)
    clock = Clock(offset_s, drift, T0)
    paths = [folder / f"{robot}.mcap" for robot in STARTS]
    for robot, path in zip(STARTS, paths, strict=True):
        with LogWriter(path) as log:
            for k in range(10 * seconds):
                time_ns = T0 + k * S // 10
                own = int(clock.to_local(np.array([time_ns]))[0]) if robot == "b" else time_ns
                x = pose(robot, k / 10)
                log.odometry(robot, own, between(pose(robot, 0.0), x))
                if k % 10 == 0:
                    log.truth(robot, own, x)
                if k % 5 != 0:
                    continue
                seen = {name: np.array([*at, 0.0]) for name, at in LANDMARKS.items()}
                if mutual:
                    seen |= {other: pose(other, k / 10) for other in STARTS if other != robot}
                for name, at in seen.items():
                    there = between(x, at)
                    z = np.array([np.arctan2(there[1], there[0]), np.hypot(*there[:2])])
                    subject = {"seen_robot" if name in STARTS else "identity": name}
                    noise = SIGMAS * rng.normal(size=2)
                    log.sighting(robot, own, z + noise, np.diag(SIGMAS**2), **subject)
    return paths


def run(paths, *settings):
    config = load_config(overrides=["start.from_truth=true", *settings])
    return smooth(open_logs(paths, config), config)


def ate(result, offset_s):
    """RMS position error of b, m, at the true times of its stamps."""
    found = result.robots["b"].final
    true = [pose("b", 1e-9 * (t - T0) - offset_s) for t in found.stamps_ns]
    return float(np.sqrt(np.mean(np.sum((found.poses - true)[:, :2] ** 2, axis=1))))


@pytest.mark.parametrize("offset_s", [0.4, -0.15, 2.0])
def test_the_offset_of_two_files_is_found_and_made_up_for(tmp_path, offset_s):
    """Within 20 ms and four of its own deviations; poses are as good as with right clocks."""
    result = run(write(tmp_path, offset_s))
    clock = result.summary["clocks"]["b"]
    assert clock["observable"] and clock["applied"]
    error_s = abs(clock["offset_s"] - offset_s)
    assert error_s < min(0.02, 4 * clock["offset_sigma_s"])
    assert ate(result, offset_s) < 0.03


@pytest.mark.parametrize("backend", ["ekf", "isam2"])
def test_a_clock_is_found_with_any_other_back_end(tmp_path, backend):
    result = run(write(tmp_path, 0.3), f"backend.name={backend}")
    assert abs(result.summary["clocks"]["b"]["offset_s"] - 0.3) < 0.02


def test_clocks_that_agree_are_left_alone(tmp_path):
    result = run(write(tmp_path, 0.0))
    clock = result.summary["clocks"]["b"]
    assert clock["observable"] and not clock["applied"]
    assert abs(clock["offset_s"]) < 4 * clock["offset_sigma_s"] < 0.1


def test_a_drift_is_found_where_the_log_is_long_enough(tmp_path):
    """A drift of 1e-3 is beyond any quartz, so the prior shrinks it; the sign is correct."""
    drifts = [
        run(write(tmp_path, 0.1, drift, seconds=120)).summary["clocks"]["b"]["drift_ppm"]
        for drift in (-5e-4, 5e-4)
    ]
    assert drifts[0] < -30 < 30 < drifts[1]


def test_robots_that_never_meet_have_no_observable_offset(tmp_path):
    result = run(write(tmp_path, 0.4, mutual=False))
    assert result.summary["clocks"]["b"] == {
        "offset_s": 0.0,
        "offset_sigma_s": pytest.approx(10.0),
        "drift_ppm": 0.0,
        "drift_sigma_ppm": pytest.approx(100.0),
        "observable": False,
        "applied": False,
    }


def test_one_robot_has_no_clock_to_compare(tmp_path):
    paths = write(tmp_path, 0.0, mutual=False)[:1]
    assert run(paths).summary["clocks"] == {}


# ------------------------------------------------------------ the thesis' experiment


def test_robots_in_scans_find_how_far_their_clocks_are_apart(tmp_path):
    """To 20 ms, and no worse than stated, though no sighting has a name."""
    found = outcome(simulated_log(SCENARIO, 0, tmp_path))
    assert found.clock["applied"]
    assert abs(found.clock["offset_s"] - true_offset_s(0.0)) < 0.02
    assert found.error_m < 4 * found.sigma_m


@pytest.mark.slow
def test_robots_in_scans_cooperate_although_their_clocks_disagree(tmp_path):
    """benchmarks/robots_in_scans.py has more seeds. The bars: a third off the error, and the offset
    to 20 ms."""
    runs = [both(seed, tmp_path) for seed in range(3)]  # alone, errors of seeds differ threefold
    joint, alone = (np.array([run[k].error_m for run in runs]) for k in (0, 1))
    assert np.sqrt(np.mean(joint**2)) <= 2 / 3 * np.sqrt(np.mean(alone**2))
    for together, single in runs:
        assert together.clock["applied"]
        assert abs(together.clock["offset_s"] - true_offset_s(0.0)) < 0.02
        assert not single.clock["observable"]
        assert together.error_m < 4 * together.sigma_m
