"""Logs of several robots in which one is missing for part of the time: handled, with a warning."""

import numpy as np
import pytest
from three_robots import LANDMARKS, SIGMAS, STARTS, T0, TWISTS, S, pose

from graphslam.core.config import Config, StartConfig
from graphslam.core.geometry import between, exp
from graphslam.logs import LogWriter, open_logs
from graphslam.slam.smooth import smooth

SECONDS = 60
UNPLACED = "sighting: no odometry near it"
#: m: sightings of 0.05 m and more than 100 of them per robot; without any the error is metres
NEAR_M = 0.1


def write(path, robots, *, odometry=None, sees=None, shift_s=0):
    """Robots on circles that see landmarks and each other twice a second.

    ``odometry`` and ``sees``: robot -> (begin, end) s between which it reports, else all the time.
    """
    rng = np.random.default_rng(3)

    def reports(spans, robot, t):
        begin, end = (spans or {}).get(robot, (0, SECONDS))
        return begin <= t < end

    with LogWriter(path) as log:
        for k in range(10 * SECONDS):
            t, stamp = k / 10, T0 + shift_s * S + k * S // 10
            for robot in robots:
                if reports(odometry, robot, t):
                    log.odometry(robot, stamp, exp(np.array(TWISTS[robot]) * t))
            for robot in robots if k % 5 == 0 else ():
                if not reports(sees, robot, t):
                    continue
                others = {name: pose(name, t)[:2] for name in robots if name != robot}
                for name, at in {**LANDMARKS, **others}.items():
                    x, y, _ = between(pose(robot, t), np.array([*at, 0.0]))
                    z = np.array([np.arctan2(y, x), np.hypot(x, y)]) + SIGMAS * rng.normal(size=2)
                    seen = name if name in robots else None
                    identity = None if seen else name
                    cov = np.diag(SIGMAS**2)
                    log.sighting(robot, stamp, z, cov, identity=identity, seen_robot=seen)
    return path


def smoothed(paths, starts):
    config = Config(start=StartConfig(poses={name: tuple(x) for name, x in starts.items()}))
    return smooth(open_logs(paths, config), config)


def error(result, robot, shift_s=0):
    """Largest error of a robot's final path, m, and the s that it covers."""
    final = result.robots[robot].final
    seconds = (final.stamps_ns - T0) / S - shift_s
    true = np.array([pose(robot, t) for t in seconds])
    assert np.isfinite(final.covs).all()
    return np.hypot(*(final.poses - true)[:, :2].T).max(), (seconds[0], seconds[-1])


def named(result, robot):
    """The one warning about a robot."""
    (line,) = (w for w in result.summary["warnings"] if w.startswith(f"{robot}: "))
    return line


def test_a_robot_whose_odometry_stops_is_estimated_until_then(tmp_path):
    """Its camera goes on, and the others still see it: these sightings are dropped."""
    log = write(tmp_path / "log.mcap", STARTS, odometry={"b": (0, 30)})
    result = smoothed([log], STARTS)
    for robot, end in (("a", 59.9), ("b", 29.9), ("c", 59.9)):
        off, span = error(result, robot)
        assert off < NEAR_M and span == pytest.approx((0, end))
    # half a second after its end it is still known where it is
    images, seen, per_image = 59, 2 * 59, len(LANDMARKS) + 2
    assert result.summary["dropped"][UNPLACED] == images * per_image + seen
    assert "0.0 to 29.9 s of 59.9 s" in named(result, "b")


def test_a_robot_seen_before_its_log_begins_is_estimated_from_then(tmp_path):
    spans = {"b": (30, SECONDS)}
    log = write(tmp_path / "log.mcap", STARTS, odometry=spans, sees=spans)
    result = smoothed([log], STARTS | {"b": pose("b", 30)})
    for robot, begin in (("a", 0), ("b", 30), ("c", 0)):
        off, span = error(result, robot)
        assert off < NEAR_M and span == pytest.approx((begin, 59.9))
    assert result.summary["dropped"][UNPLACED] > 100
    assert "30.0 to 59.9 s of 59.9 s" in named(result, "b")


def test_logs_without_common_time_share_the_map_with_a_warning(tmp_path):
    logs = [
        write(tmp_path / "a.mcap", ["a"]),
        write(tmp_path / "b.mcap", ["b"], shift_s=1000),
    ]
    result = smoothed(logs, {name: STARTS[name] for name in "ab"})
    assert error(result, "a")[0] < NEAR_M and error(result, "b", 1000)[0] < NEAR_M
    assert len(result.landmarks) == len(LANDMARKS)
    for robot in "ab":
        assert "does not overlap any other robot's" in named(result, robot)


def test_robots_present_all_the_time_cause_no_warning(tmp_path):
    result = smoothed([write(tmp_path / "log.mcap", STARTS)], STARTS)
    assert result.summary["warnings"] == []
