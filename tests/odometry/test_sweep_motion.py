"""Scans of a laser whose beams are measured one after the other, while the robot moves."""

import numpy as np
import pytest
from sweep_motion import scenario
from walls import AROUND, L_ROOM, cast

from graphslam.core.config import Config, LogsConfig, OdometryConfig, RobotConfig
from graphslam.core.geometry import compose, exp, inverse, transform
from graphslam.core.record import replace
from graphslam.core.records import OdometryPose, Scan
from graphslam.logs import LogWriter, open_logs
from graphslam.odometry.laser_odometry import with_laser_odometry
from graphslam.odometry.preintegration import Track
from graphslam.odometry.sweep_motion import sweep_end_ns, undistorted, undistorted_by_track
from graphslam.perception.ordered_scan import scan_points, thinned
from graphslam.simulation import simulate

S = 1_000_000_000
N, STEP = len(AROUND), AROUND[1] - AROUND[0]
PERIOD_S = 0.1 / N
MOUNT = np.array([0.3, -0.1, 0.2])
AT = np.array([-2.0, 1.0, 0.3])
#: of the base, per second: a car that turns quickly
TWIST = np.array([0.8, 0.0, 1.5])


def base(seconds):
    """Its pose."""
    return compose(AT, exp(seconds * TWIST))


def starting(seconds):
    """Its pose, if it reaches that velocity in half a second, after another at rest."""
    t = np.clip(seconds - 0.5, 0.0, None)
    return base(t * t if t < 0.5 else t - 0.25)


def swept(backwards=False, start_s=0.0, pose=base):
    """A scan of the room, beam by beam, the last one first if ``backwards``."""
    order = np.arange(N)[::-1] if backwards else np.arange(N)
    ranges = np.full(N, np.nan)
    for k, beam in enumerate(order):
        laser = compose(pose(start_s + k * PERIOD_S), MOUNT)
        ranges[beam] = cast(L_ROOM, AROUND[beam : beam + 1], laser)[0]
    ranges[7] = np.nan
    stamp = round(start_s * S)
    period = -PERIOD_S if backwards else PERIOD_S
    return Scan("r", stamp, stamp, ranges, AROUND[0], STEP, MOUNT, period)


def off_walls(scan, pose):
    """Largest distance (m) of the returns from the nearest wall, the base being at a pose (3,)."""
    points = transform(pose, scan_points(scan, 30.0))
    a, b = L_ROOM[:, 0], L_ROOM[:, 1]
    along = b - a
    share = np.einsum("nwk,wk->nw", points[:, None] - a, along) / (along**2).sum(axis=1)
    nearest = a + np.clip(share, 0, 1)[..., None] * along
    return np.hypot(*np.moveaxis(points[:, None] - nearest, 2, 0)).min(axis=1).max()


def driven(turning=1.0, path=1.0):
    """The odometry of that drive."""
    track = Track(OdometryConfig(), RobotConfig(), mounted=True)
    for k in range(60):
        t = k * S // 100
        track.add(OdometryPose("r", t, t, exp(k / 100 * TWIST * [path, 1.0, turning])))
    return track


@pytest.mark.parametrize("backwards", [False, True])
def test_returns_lie_where_they_were_measured(backwards):
    """On the walls to 0.1 mm, seen from where the robot was at the stamp; as they come they are up
    to 0.3 m off. One without a return stays without."""
    scan = swept(backwards, start_s=0.2)
    assert off_walls(scan, base(0.2)) > 0.2
    (mended,) = undistorted_by_track([scan], driven())
    assert off_walls(mended, base(0.2)) < 1e-4
    assert np.isnan(mended.ranges[7]) and np.isfinite(mended.bearings).all()
    assert mended.beam_period_s == 0.0 and mended.time_ns == scan.time_ns
    assert sweep_end_ns(scan) - scan.time_ns == pytest.approx(0.1 * S, rel=0.01)


def test_the_motion_during_a_sweep_is_that_of_calibrated_odometry():
    """A robot that skids turns less than its odometry says. As measured, its turning would leave
    returns 0.1 m off the walls; the derivative is exact but for the bend of the arc: 1 mm."""
    scan, track = swept(start_s=0.2), driven(turning=1.5, path=0.9)
    (as_measured,) = undistorted_by_track([scan], track)
    assert off_walls(as_measured, base(0.2)) > 0.1
    known = {"translation_scale": 1 / 0.9 - 1, "rotation_scale": 1 / 1.5 - 1}
    mean = np.array([known.get(name, 0.0) for name in track.calibration.names])
    track.calibration = replace(track.calibration, mean=mean)
    (mended,) = undistorted_by_track([scan], track)
    assert off_walls(mended, base(0.2)) < 1e-3


def test_the_motion_during_a_late_sweep_is_that_of_when_it_was_measured():
    """A scan that is stamped 0.15 s late, of a robot that speeds up. Its motion at the stamp would
    leave returns 0.2 m off the walls. Taken as constant, that during the sweep leaves 0.02 m."""
    scan, late_ns = swept(start_s=0.7, pose=starting), round(0.15 * S)
    scan = replace(scan, stamp_ns=scan.stamp_ns + late_ns, time_ns=scan.time_ns + late_ns)
    track = Track(OdometryConfig(), RobotConfig(), mounted=True)
    for k in range(150):
        t = k * S // 100
        track.add(OdometryPose("r", t, t, starting(k / 100)))
    (as_stamped,) = undistorted_by_track([scan], track)
    assert off_walls(as_stamped, starting(0.7)) > 0.15
    mean = np.array([0.15 * (name == "laser_latency_s") for name in track.calibration.names])
    track.calibration = replace(track.calibration, mean=mean)
    (mended,) = undistorted_by_track([scan], track)
    assert off_walls(mended, starting(0.7)) < 0.03


@pytest.mark.parametrize("backwards", [False, True])
def test_a_thinned_scan_has_some_of_the_returns(backwards):
    """Each where it was measured, also where the last beam is measured first: on the walls to
    0.1 mm once the robot's motion is taken out. Their number is no multiple of those that stay."""
    scan = swept(backwards, start_s=0.2)
    thin = thinned(scan, 50)
    assert len(thin.ranges) == 45 and (N - 1) % 8
    (mended,) = undistorted_by_track([thin], driven())
    assert off_walls(mended, base(0.2)) < 1e-4
    assert sweep_end_ns(thin) <= sweep_end_ns(scan)
    told = replace(scan, bearings=scan.angles, angle_min_rad=np.nan)
    np.testing.assert_allclose(thinned(told, 50).angles, thin.angles, atol=1e-12)
    assert thinned(scan, N) is scan


def test_a_scan_of_one_instant_is_left_alone():
    """The very object: every log whose messages state no time between beams is as before."""
    scan = Scan("r", 0, 0, np.ones(N), AROUND[0], STEP, MOUNT)
    assert undistorted(scan, TWIST) is scan and undistorted_by_track([scan], driven()) == [scan]
    assert sweep_end_ns(scan) == scan.time_ns and scan.bearings is None


def test_a_robot_that_stands_bends_no_scan():
    """Ranges and bearings as measured."""
    scan = swept()
    still = undistorted(scan, np.zeros(3))
    assert still.bearings == pytest.approx(scan.angles)
    assert still.ranges == pytest.approx(scan.ranges, nan_ok=True)
    assert still.angle_step_rad == scan.angle_step_rad


def test_without_odometry_the_velocity_of_the_scans_is_used():
    """From rest to half a turn at 1.5 rad/s by scan matching: to 3 cm and 0.02 rad."""
    scans = [swept(start_s=0.1 * k, pose=starting) for k in range(28)]
    true = compose(inverse(AT), starting(2.7))
    found = np.zeros(3)
    for m in with_laser_odometry(scans, {"r"}, Config()):
        if not isinstance(m, Scan):
            found = compose(found, m.delta)
    assert np.all(np.abs(found - true) < [0.03, 0.03, 0.02])


# ------------------------------------------------------------ messages


@pytest.mark.parametrize(
    ("period_s", "undistort", "read_s"),
    [
        (1e-3, True, 1e-3),
        (0.0, True, 0.0),
        (-1e-3, True, 0.0),
        (1.0, True, 0.0),
        (1e-3, False, 0.0),
    ],
    ids=["stated", "none", "negative", "absurd", "switched off"],
)
def test_the_time_between_beams_is_read_where_it_can_be_true(period_s, undistort, read_s, tmp_path):
    """No sweep takes a second; drivers that write nonsense leave their scans as they are."""
    with LogWriter(tmp_path / "log.mcap") as log:
        log.odometry("robot", 0, (0, 0, 0))
        log.scan(
            "robot", S, np.ones(10), angle_min_rad=0.0, angle_step_rad=0.1, range_max_m=8.0,
            beam_period_s=period_s,
        )  # fmt: skip
    config = Config(logs=LogsConfig(undistort=undistort))
    scans = [
        m for m in open_logs([tmp_path / "log.mcap"], config).messages() if isinstance(m, Scan)
    ]
    assert scans[0].beam_period_s == pytest.approx(read_s)


def test_simulated_sweeps_are_bent_by_the_motion(tmp_path):
    """The first beam sees what it sees without a sweep; later ones, while the robot turns, not."""
    found = []
    for sweep_s in (0.0, 0.1):
        path = tmp_path / f"{sweep_s}.mcap"
        simulate(scenario(sweep_s), path, 1)
        found.append([m for m in open_logs([path], Config()).messages() if isinstance(m, Scan)])
    once, bent = ([scan.ranges for scan in scans] for scans in found)
    assert found[1][0].beam_period_s == pytest.approx(0.1 / (len(bent[0]) - 1), rel=1e-6)
    apart = np.nan_to_num(np.abs(np.array(once) - np.array(bent)))
    assert np.median(apart[:, 0]) < 1e-3 < np.median(apart[:, -1]) or apart[:, -1].max() > 0.1
    assert apart[:, 0].max() < apart[:, -1].max()
