"""Noise laws of simulated logs, from the logs: what is read back, against the truth beside it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from graphslam.core.config_io import load_config
from graphslam.core.geometry import between, compose, wrap
from graphslam.core.records import OdometryPose, Scan, Sighting, WheelAngles
from graphslam.logs import open_logs, read_true_associations, read_truth
from graphslam.simulation import simulate
from graphslam.simulation.scenario import (
    Body,
    Box,
    Cylinder,
    Encoders,
    Laser,
    Leg,
    Robot,
    RobotClock,
    Scenario,
    SightingSensor,
    StaticObjects,
    Wall,
)
from graphslam.simulation.sensor_clock import START_NS

WIDTH, DEPTH = 9.0, 6.0
ROOM = Wall("room", ((0.0, 0.0), (WIDTH, 0.0), (WIDTH, DEPTH), (0.0, DEPTH)), closed=True)
QUIET = Laser(range_sigma_m=0.0, bias_sigma_m=0.0, resolution_m=0.0, range_max_m=32.0, step_deg=1.0)
ROUND_TRIP = (
    Leg(through_m=((7.0, 1.5), (7.0, 4.5), (2.0, 4.5))),
    Leg(through_m=((6.0, 4.0),), reverse=True),
)
FLOAT32 = 1e-5  # m: ranges and beam angles are kept as float32


def robot(*, laser=None, encoders=None, drive=ROUND_TRIP, start=(1.5, 1.5), **more):
    body = more.pop("body", Body(radius_m=0.2))
    return Robot(start, body, drive=drive, laser=laser, encoders=encoders or Encoders(), **more)


class Log:
    """A scenario simulated and read back, by kind of message and robot."""

    def __init__(self, path, robots, things=None, seed=1, materials_seed=None, **more):
        world = StaticObjects(walls=(ROOM,)) if things is None else things
        scenario = Scenario(robots, world, name="test", truth_period_s=0.05, **more)
        self.simulation = simulate(scenario, path / "log.mcap", seed, materials_seed=materials_seed)
        config = load_config()
        self.messages = list(open_logs([path / "log.mcap"], config).messages())
        self.true = read_truth([path / "log.mcap"], config)

    def of(self, kind, name="robot"):
        return [m for m in self.messages if isinstance(m, kind) and m.robot == name]

    def poses(self, messages, name="robot"):
        """True poses at the messages' stamps: every one of them is in the log."""
        track = self.true.trajectories[name]
        stamps = [m.stamp_ns for m in messages]
        rows = np.searchsorted(track.stamps_ns, stamps)
        assert (track.stamps_ns[rows] == stamps).all()
        return track.poses[rows]


def room_ranges(poses, angles, bias=(0, 0, 0, 0)):
    """Ranges in the room in closed form, biases of the walls south, east, north, west added."""
    direction = poses[:, 2:] + angles
    c, s = np.cos(direction), np.sin(direction)
    x, y = poses[:, :1], poses[:, 1:2]
    with np.errstate(divide="ignore"):
        to_x, to_y = (
            np.where(c > 0, (WIDTH - x) / c, -x / c),
            np.where(s > 0, (DEPTH - y) / s, -y / s),
        )
    south, east, north, west = bias
    wall = np.where(to_x < to_y, np.where(c > 0, east, west), np.where(s > 0, north, south))
    return np.minimum(to_x, to_y) + wall


def scan_residuals(log, name="robot"):
    scans = log.of(Scan, name)
    at = compose(log.poses(scans, name), scans[0].mount)
    return np.array([m.ranges for m in scans]) - room_ranges(at, scans[0].angles), scans


def correlation(a, b):
    return float(np.corrcoef(a.ravel(), b.ravel())[0, 1])


def assert_white(z, axis_names=("time", "beam")):
    """Mean 0, variance 1, no correlation from one to the next: each at about 4 sigma."""
    n = z.size
    assert abs(z.mean()) < 4 / np.sqrt(n)
    low, high = chi2.ppf([3e-5, 1 - 3e-5], n) / n
    assert low < (z**2).mean() < high
    for axis, name in zip(range(z.ndim), axis_names, strict=False):
        lag = np.moveaxis(z, axis, 0)
        assert abs(correlation(lag[:-1], lag[1:])) < 4 / np.sqrt(n), name


# ------------------------------------------------------------ laser


def test_a_noise_free_laser_measures_the_room(tmp_path):
    """Mount, beam angles and poses fit together: nothing else is needed to explain a scan."""
    laser = replace(QUIET, mount_m=(0.15, -0.05), mount_deg=20.0, field_deg=270.0)
    log = Log(tmp_path, {"robot": robot(laser=laser)})
    residuals, scans = scan_residuals(log)
    assert np.abs(residuals).max() < FLOAT32
    assert scans[0].mount == pytest.approx([0.15, -0.05, np.radians(20)])
    assert len(scans[0].ranges) == 271


def test_range_noise_is_white_with_its_sigma(tmp_path):
    log = Log(tmp_path, {"robot": robot(laser=replace(QUIET, range_sigma_m=0.02))})
    residuals, _ = scan_residuals(log)
    assert residuals.size > 20_000
    assert_white(residuals / 0.02)


def test_every_wall_has_its_bias_for_all_lasers_and_scans(tmp_path):
    """The material's part is one constant per wall; the laser scales it."""
    robots = {
        "a": robot(laser=replace(QUIET, bias_sigma_m=0.01), body=Body(radius_m=0.01)),
        "b": robot(
            laser=replace(QUIET, bias_sigma_m=0.03),
            body=Body(radius_m=0.01),
            start=(3.0, 3.0),
            drive=(Leg(turn_deg=170.0),),
        ),
    }
    log = Log(tmp_path, robots)
    found = {}
    for name in robots:
        residuals, scans = scan_residuals(log, name)
        at = log.poses(scans, name)
        marked = room_ranges(at, scans[0].angles, (1000, 2000, 3000, 4000))
        wall = np.round(marked, -3).astype(int) // 1000
        found[name] = [np.median(residuals[wall == k]) for k in (1, 2, 3, 4)]
        same = np.abs(residuals - np.append(0, found[name])[wall]) < FLOAT32
        assert same.mean() > 0.98  # the rest met the other robot
    np.testing.assert_allclose(3 * np.array(found["a"]), found["b"], atol=1e-5)
    assert len(set(np.round(found["a"], 6))) == 4


def test_walls_keep_their_biases_in_logs_of_one_building(tmp_path):
    """On every day each surface had another one, and walls that nobody moved were elsewhere."""
    laser = replace(QUIET, bias_sigma_m=0.01, range_sigma_m=0.002)
    days = {}
    for seed, building in ((1, 7), (2, 7), (2, None)):
        folder = tmp_path / f"{seed}-{building}"
        folder.mkdir()
        log = Log(folder, {"robot": robot(laser=laser)}, seed=seed, materials_seed=building)
        residuals, scans = scan_residuals(log)
        marked = room_ranges(log.poses(scans), scans[0].angles, (1000, 2000, 3000, 4000))
        wall = np.round(marked, -3).astype(int) // 1000
        days[seed, building] = np.array([np.median(residuals[wall == k]) for k in (1, 2, 3, 4)])
    # medians of thousands of beams of 2 mm white noise
    assert np.abs(days[1, 7] - days[2, 7]).max() < 2e-4
    assert np.abs(days[2, None] - days[2, 7]).max() > 2e-3


def test_biases_of_many_walls_have_their_sigma(tmp_path):
    angles = 2 * np.pi * np.arange(120) / 120
    ring = tuple(zip(10 * np.cos(angles), 10 * np.sin(angles), strict=True))
    laser = replace(QUIET, bias_sigma_m=0.05, field_deg=360.0, step_deg=3.0)
    stands = robot(laser=laser, start=(0.0, 0.0), drive=(), start_deg=1.5)
    log = Log(
        tmp_path,
        {"robot": stands},
        StaticObjects(walls=(Wall("ring", ring, closed=True),)),
        duration_s=1,
    )
    ranges = log.of(Scan)[0].ranges[:-1]
    biases = ranges - 10 * np.cos(np.pi / 120)
    low, high = chi2.ppf([1e-4, 1 - 1e-4], 120) * 0.05**2
    assert low < (biases**2).sum() < high
    assert abs(biases.mean()) < 4 * 0.05 / np.sqrt(120)


def test_drop_outs_and_spurious_returns_have_their_shares(tmp_path):
    laser = replace(QUIET, dropout_share=0.03, spurious_share=0.02)
    residuals, _ = scan_residuals(Log(tmp_path, {"robot": robot(laser=laser)}))
    n = residuals.size
    dropped = np.isnan(residuals)
    assert abs(dropped.mean() - 0.03) < 4 * np.sqrt(0.03 / n)
    wrong = residuals[~dropped] < -FLOAT32
    assert (residuals[~dropped] < FLOAT32).all()  # never behind the wall
    assert abs(wrong.mean() - 0.02) < 4 * np.sqrt(0.02 / n)
    assert abs(correlation(dropped[:-1], dropped[1:])) < 4 / np.sqrt(n)


def ranges(folder, laser, things):
    """Ranges (scans, beams) of a drive past ``things``."""
    drive = (Leg(through_m=((7.5, 1.5),)),)
    log = Log(folder, {"robot": robot(laser=laser, drive=drive)}, things)
    return np.array([scan.ranges for scan in log.of(Scan)])


def test_mixed_pixels_lie_between_the_two_sides_of_an_edge(tmp_path):
    """And on either side of it equally often."""
    laser = replace(QUIET, mixed_share=0.6, range_sigma_m=0.0)
    box = StaticObjects(walls=(ROOM,), boxes=(Box("box", (4.5, 3.0), (0.6, 0.6)),))
    bare = ranges(tmp_path, QUIET, StaticObjects(walls=(ROOM,)))
    a, b = ranges(tmp_path, QUIET, box), ranges(tmp_path, laser, box)
    changed = np.abs(b - a) > FLOAT32
    around = np.stack(
        [np.pad(a, ((0, 0), (1, 1)), mode="edge")[:, k : k + a.shape[1]] for k in range(3)]
    )
    assert (b >= around.min(axis=0) - FLOAT32).all() and (b <= around.max(axis=0) + FLOAT32).all()
    on_box = np.abs(a - bare) > FLOAT32
    edge = (on_box[:, :-1] != on_box[:, 1:]) & (np.abs(np.diff(a, axis=1)) > 0.1)
    assert edge.sum() > 50
    for beside, other in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:, 1:], np.s_[:, :-1])):
        mixed = changed[beside][edge]
        assert abs(mixed.mean() - 0.3) < 4 * np.sqrt(0.21 / edge.sum())
        share = ((b - a)[beside] / np.where(edge, a[other] - a[beside], 1.0))[edge][mixed]
        assert 0 < share.min() < share.max() < 1
        assert abs(share.mean() - 0.5) < 4 / np.sqrt(12 * len(share))


def test_a_beam_along_a_wall_is_not_mixed_with_its_neighbour(tmp_path):
    """Neighbours hit the wall far from each other, but there is no edge: mixed with the neighbour
    of one side they turned walls by 3 mrad."""
    laser = replace(QUIET, mixed_share=1.0, range_sigma_m=0.0)
    wall = StaticObjects(walls=(Wall("wall", ((-20.0, 0.5), (20.0, 0.5))),))
    a, b = ranges(tmp_path, QUIET, wall), ranges(tmp_path, laser, wall)
    seen = np.isfinite(a)
    along = np.abs(np.diff(a, axis=1)) > 0.1
    assert along[seen[:, :-1] & seen[:, 1:]].sum() > 20
    np.testing.assert_allclose(b[seen], a[seen], atol=FLOAT32)


def test_what_is_out_of_range_is_not_reported_and_ranges_are_rounded(tmp_path):
    laser = replace(QUIET, range_max_m=4.0, resolution_m=0.01)
    log = Log(tmp_path, {"robot": robot(laser=laser)})
    residuals, scans = scan_residuals(log)
    ranges = np.array([m.ranges for m in scans])
    at = compose(log.poses(scans), scans[0].mount)
    expected = room_ranges(at, scans[0].angles)
    assert (np.isnan(ranges) == (np.round(expected, 2) > 4.0)).all()
    seen = ranges[~np.isnan(ranges)]
    np.testing.assert_allclose(seen * 100, np.round(seen * 100), atol=1e-4)
    assert np.nanmax(np.abs(residuals)) < 0.005 + FLOAT32


def test_robots_see_each_other_as_shapes(tmp_path):
    """A disc that drives across is met where it is at the time of the scan."""
    watcher = robot(laser=QUIET, start=(1.0, 3.0), drive=())
    disc = robot(body=Body(radius_m=0.3), start=(4.0, 1.0), drive=(Leg(through_m=((4.0, 5.0),)),))
    log = Log(tmp_path, {"watcher": watcher, "disc": disc})
    residuals, scans = scan_residuals(log, "watcher")
    where = log.poses(scans, "disc")[:, :2] - [1.0, 3.0]
    ranges = np.array([m.ranges for m in scans])
    angles = scans[0].angles
    along = where @ np.array([np.cos(angles), np.sin(angles)])
    across2 = (where**2).sum(axis=1)[:, None] - along**2
    hit = across2 < 0.3**2
    np.testing.assert_allclose(
        ranges[hit], (along - np.sqrt(np.maximum(0.09 - across2, 0)))[hit], atol=FLOAT32
    )
    assert np.abs(residuals[~hit]).max() < FLOAT32
    assert hit.any(axis=1).all()


# ------------------------------------------------------------ encoders


def wheel_residuals(log, encoders):
    """Read minus true angle increments (n, 2) rad, and true wheel travel (n, 2) m."""
    read = log.of(WheelAngles)
    poses = log.poses(read)
    turn = wrap(np.diff(poses[:, 2]))
    # the chord of the circle segment that the base drives on, signed by its x axis
    step = between(poses[:-1], poses[1:])
    path = np.hypot(step[:, 0], step[:, 1]) * np.sign(step[:, 0]) / np.sinc(turn / (2 * np.pi))
    half = encoders.axle_m * (1 + encoders.axle_error) / 2
    travel = np.column_stack([path - half * turn, path + half * turn])
    errors = np.array([encoders.radius_error_left, encoders.radius_error_right])
    true = travel / (encoders.wheel_radius_m * (1 + errors))
    angles = np.array([(m.left_rad, m.right_rad) for m in read])
    return np.diff(angles, axis=0) - true, travel, angles


STRAIGHT_AND_TURN = (
    Leg(through_m=((7.5, 3.0),)),
    Leg(turn_deg=180.0),
    Leg(through_m=((1.5, 3.0),)),
    Leg(turn_deg=-170.0),
)


def test_encoders_count_whole_pulses(tmp_path):
    """Without slip a reading is within one count of the truth, uniformly."""
    encoders = Encoders(joint_states=True, odometry=False, axle_error=0.02, radius_error_left=0.01)
    log = Log(
        tmp_path, {"robot": robot(encoders=encoders, drive=STRAIGHT_AND_TURN, start=(1.5, 3.0))}
    )
    residuals, _, angles = wheel_residuals(log, encoders)
    count = 2 * np.pi / 2000
    np.testing.assert_allclose(angles / count, np.round(angles / count), atol=1e-6)
    error = np.cumsum(residuals, axis=0) / count
    assert (error.max(axis=0) - error.min(axis=0) < 1 + 1e-6).all()
    moving = np.abs(np.diff(angles, axis=0)).min(axis=1) > 3 * count
    assert error[moving].std(axis=0) == pytest.approx([1 / np.sqrt(12)] * 2, rel=0.15)


def test_slip_is_white_and_grows_with_the_root_of_the_travel(tmp_path):
    encoders = Encoders(
        joint_states=True, odometry=False, slip_m=0.004, counts_per_turn=10**8, period_s=0.05
    )
    drive = STRAIGHT_AND_TURN * 4
    log = Log(tmp_path, {"robot": robot(encoders=encoders, drive=drive, start=(1.5, 3.0))})
    residuals, travel, _ = wheel_residuals(log, encoders)
    moved = np.abs(travel).min(axis=1) > 1e-4
    z = residuals[moved] * encoders.wheel_radius_m / (0.004 * np.sqrt(np.abs(travel[moved])))
    assert len(z) > 1500
    assert_white(z)


def test_odometry_is_what_the_wrong_geometry_makes_of_true_wheels(tmp_path):
    """A right wheel 2 % larger than nominal: the odometry turns right by the uncounted path."""
    encoders = Encoders(radius_error_right=0.02, counts_per_turn=10**8)
    drive = (Leg(through_m=((7.5, 3.0),)),)
    log = Log(tmp_path, {"robot": robot(encoders=encoders, drive=drive, start=(1.5, 3.0))})
    last = log.of(OdometryPose)[-1].pose
    right = 6.0 / 1.02
    assert last[2] == pytest.approx((right - 6.0) / encoders.axle_m, abs=1e-4)
    assert not log.of(WheelAngles)


# ------------------------------------------------------------ sightings


def test_sightings_have_the_noise_that_they_state(tmp_path):
    things = StaticObjects(
        walls=(ROOM, Wall("screen", ((4.5, 2.2), (4.5, 3.6)))),
        cylinders=(Cylinder("post", (8.0, 3.0), 0.1), Cylinder("pole", (4.0, 5.5), 0.05)),
    )
    seers = (
        SightingSensor(
            "landmarks", period_s=0.05, range_sigma_m=0.03, bearing_sigma_deg=0.7, field_deg=200
        ),
        SightingSensor("robots", period_s=0.05, direction_sigma_deg=2.0, identified=True),
    )
    robots = {
        "robot": robot(sightings=seers),
        "other": robot(start=(2.0, 3.0), drive=(Leg(turn_deg=90.0),)),
    }
    log = Log(tmp_path, robots, things)
    sightings = log.of(Sighting)
    places = {"post": np.array([8.0, 3.0, 0.0]), "pole": np.array([4.0, 5.5, 0.0])}
    screen = np.array([[4.5, 2.2], [4.5, 3.6]])
    poses = log.poses(sightings)
    for name in ("post", "pole", "other"):
        rows = [i for i, m in enumerate(sightings) if name in (m.identity, m.seen_robot)]
        seen, at = [sightings[i] for i in rows], poses[rows]
        target = places[name] if name in places else log.poses(seen, "other")
        relative = between(at, np.broadcast_to(target, at.shape))
        expected = np.column_stack(
            [
                np.arctan2(relative[:, 1], relative[:, 0]),
                np.hypot(*relative[:, :2].T),
                relative[:, 2],
            ]
        )
        z = np.array([m.z for m in seen])
        error = z - expected[:, : z.shape[1]]
        error[:, [0, *range(2, z.shape[1])]] = wrap(error[:, [0, *range(2, z.shape[1])]])
        sigma = np.sqrt(np.diag(seen[0].cov))
        assert len(seen) > 200
        assert_white(error / sigma)
        if name in places:
            assert np.abs(expected[:, 0]).max() <= np.radians(100)
        assert not crosses(at[:, :2], np.broadcast_to(target, at.shape)[:, :2], screen).any()


def test_sensors_take_names_for_one_another_and_see_what_is_not_there(tmp_path):
    """In the shares asked for, under the names of others; the truth says so, and what the sensor
    measures besides stays the same number for number. Without names the message says what it may
    be of."""
    drive = {f"r{k}": robot(start=(2.0 + k, 2.0), drive=(Leg(wait_s=40.0),)) for k in range(3)}

    def log(folder, **settings):
        (tmp_path / folder).mkdir()
        seers = (SightingSensor("robots", period_s=0.05, field_deg=200.0, **settings),)
        own = {"robot": robot(drive=(Leg(wait_s=40.0),), sightings=seers)}
        return Log(tmp_path / folder, {**own, **drive}, StaticObjects(walls=(ROOM,)))

    right, wrong = log("right"), log("wrong", exchanged_share=0.2, false_share=0.1)
    topics = read_true_associations([tmp_path / "wrong/log.mcap"], load_config())
    images = topics["/true_associations/sightings"]
    true = [m.names[t] if t >= 0 else "" for m in images for t in m.targets]
    seen = wrong.of(Sighting)
    assert len(true) == len(seen)
    there = [m for m, name in zip(seen, true, strict=True) if name]
    for a, b in zip(right.of(Sighting), there, strict=True):
        np.testing.assert_array_equal(a.z, b.z)
    n = len(there)
    exchanged = sum(m.seen_robot != name for m, name in zip(seen, true, strict=True) if name)
    for count, share in ((exchanged, 0.2), (len(seen) - n, 0.1)):
        assert abs(count - share * n) < 4 * np.sqrt(share * (1 - share) * n)
    assert {m.seen_robot for m in seen} == set(drive)
    assert all(0 < m.z[1] <= 8.0 and abs(m.z[0]) <= np.radians(100.0) for m in seen)
    for settings, may_be in (({}, "robot"), ({"told_apart": False}, "either")):
        unnamed = log(f"unnamed {may_be}", identified=False, **settings).of(Sighting)
        assert {(m.seen_robot, m.identity, m.may_be) for m in unnamed} == {(None, None, may_be)}
        assert len(unnamed) == n


def crosses(a, b, wall):
    """Whether the straight lines a-b (n, 2) cut the vertical wall; in closed form."""
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (wall[0, 0] - a[:, 0]) / (b[:, 0] - a[:, 0])
    y = a[:, 1] + share * (b[:, 1] - a[:, 1])
    return (share > 0) & (share < 1) & (y > wall[0, 1]) & (y < wall[1, 1])


# ------------------------------------------------------------ clocks


def test_clocks_have_their_offset_and_drift_and_sensors_their_latency(tmp_path):
    clock = RobotClock(offset_s=0.5, drift_ppm=1000.0)
    laser = replace(QUIET, period_s=0.25, phase_s=0.1, latency_s=0.03)
    encoders = Encoders(period_s=0.2, latency_s=0.01)
    robots = {
        "right": robot(laser=laser, encoders=encoders),
        "wrong": robot(laser=laser, encoders=encoders, clock=clock, start=(1.5, 2.5), drive=()),
    }
    log = Log(tmp_path, robots, duration_s=12.0)
    for kind, first, period in ((Scan, 0.13, 0.25), (OdometryPose, 0.01, 0.2)):
        right = [m.stamp_ns - START_NS for m in log.of(kind, "right")]
        wrong = [m.stamp_ns - START_NS for m in log.of(kind, "wrong")]
        true_ns = np.round((first + period * np.arange(len(right))) * 1e9)
        np.testing.assert_allclose(right, true_ns, atol=1)
        np.testing.assert_allclose(wrong, true_ns * 1.001 + 0.5e9, atol=2)
