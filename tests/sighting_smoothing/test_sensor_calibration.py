"""Sensors of sightings that are turned, or whose ranges are too long."""

import numpy as np
import pytest

import graphslam
from graphslam.core.config import Config, OdometryConfig
from graphslam.core.geometry import compose, exp, wrap
from graphslam.core.information_root import InformationRoot
from graphslam.core.records import Sighting
from graphslam.estimation.sensor_errors import ShownErrors, without_errors
from graphslam.logs import LogWriter
from graphslam.sighting_smoothing.sensor_calibration import Sensors, find_errors

S, N = 1_000_000_000, 900
ODOMETRY, SIGHTING = np.array([0.004, 1e-4, 0.006]), np.array([0.02, 0.02])
MOUNT = np.array([0.2, -0.1, 0.5])
POINTS = np.random.default_rng(7).uniform([-4, -3], [4, 3], (14, 2))


def drive(path, *, turned=0.0, scaled=0.0, stated=True, mount=None):
    """A log of 90 s: odometry of noise ODOMETRY, and the true poses (n, 3)."""
    rng, mount = np.random.default_rng(3), np.zeros(3) if mount is None else mount
    true, odometry, poses = np.zeros(3), np.zeros(3), []
    with LogWriter(path) as out:
        for k in range(N):
            t = S + k * S // 10
            if k:
                twist = np.array([0.05, 0.0, 0.03 + 0.06 * np.sin(k / 40)])
                true = compose(true, exp(twist))
                noisy = exp(twist + ODOMETRY * rng.normal(size=3))
                odometry = compose(odometry, noisy)
                if stated:
                    cov = np.diag(ODOMETRY**2)
                    out.increment("r", t - S // 10, t, delta=noisy, cov=cov)
            if not stated:
                out.odometry("r", t, odometry)
            poses.append(true)
            sensor = compose(true, mount)
            apart = POINTS - sensor[:2]
            nearest = np.argsort(np.hypot(*apart.T))[:4]
            for i in nearest if k else ():
                bearing = np.arctan2(*apart[i][::-1]) - sensor[2]
                e = SIGHTING * rng.normal(size=2)
                z = [
                    wrap(bearing + turned + e[0]),
                    (1 + scaled) * float(np.hypot(*apart[i])) + e[1],
                ]
                mounted = {} if not mount.any() else {"mount": mount}
                cov = np.diag(SIGHTING**2)
                out.sighting("r", t, np.array(z), cov, identity=f"p{i}", **mounted)
    return np.array(poses)


def judged(result, true):
    """Root mean square error, m, in the best frame, and NEES per degree of freedom as it is."""
    final = result.robots["r"].final
    off = final.poses - true[-len(final) :]
    off[:, 2] = wrap(off[:, 2])
    nees = np.einsum("ni,nij,nj->n", off, np.linalg.pinv(final.covs), off)[1:].mean() / 3
    a, b = (
        (p[:, :2] - p[:, :2].mean(axis=0)) @ [1, 1j] for p in (final.poses, true[-len(final) :])
    )
    turn = np.vdot(a, b)
    return np.sqrt(np.mean(np.abs(a * turn / abs(turn) - b) ** 2)), nees


@pytest.mark.slow
@pytest.mark.parametrize("stated", [True, False])
def test_a_turned_sensor_is_as_good_as_a_straight_one(tmp_path, stated):
    """Taken as mounted as told, 2 degrees doubled the error and more."""
    true = drive(tmp_path / "a.mcap", stated=stated)
    straight, _ = judged(graphslam.smooth(tmp_path / "a.mcap"), true)
    drive(tmp_path / "b.mcap", turned=np.radians(2.0), stated=stated)
    found = graphslam.smooth(tmp_path / "b.mcap")
    error, nees = judged(found, true)
    # the angle is told to a tenth of a degree
    assert error < 1.2 * straight
    assert nees < 1.5
    yaw = found.summary["calibration"]["r.sighting_yaw_rad"]
    assert yaw["observable"]
    assert abs(yaw["value"] - np.radians(2.0)) < 4 * yaw["sigma"]
    assert yaw["sigma"] < 0.002


@pytest.mark.slow
def test_ranges_that_are_too_long_are_scaled_by_odometry_of_known_scale(tmp_path):
    """Taken as told, 6 % made a map that is as much too large."""
    true = drive(tmp_path / "a.mcap", scaled=0.06)
    found = graphslam.smooth(tmp_path / "a.mcap")
    scale = found.summary["calibration"]["r.sighting_range_scale"]
    assert scale["observable"]
    assert abs(scale["value"] - 0.06) < 4 * scale["sigma"]
    assert judged(found, true)[1] < 2.0


@pytest.mark.slow
def test_odometry_of_unknown_scale_does_not_tell_that_of_ranges(tmp_path):
    """Ranges were right then, and covariances as if that was known: NEES above 10."""
    true = drive(tmp_path / "a.mcap", scaled=0.06, stated=False)
    found = graphslam.smooth(tmp_path / "a.mcap")
    scale = found.summary["calibration"]["r.sighting_range_scale"]
    assert scale["value"] == 0.0
    assert not scale["observable"]
    assert any("different scales" in warning for warning in found.summary["warnings"])
    assert judged(found, true)[1] < 4.0  # 6 % is two sigmas of what ranges may have


@pytest.mark.slow
def test_nothing_changes_where_nothing_is_wrong(tmp_path):
    """An error that is not clearly there would cost accuracy."""
    drive(tmp_path / "a.mcap")
    held = OdometryConfig(fixed_calibration=("sighting_yaw_rad", "sighting_range_scale"))
    found = graphslam.smooth(tmp_path / "a.mcap")
    without = graphslam.smooth(tmp_path / "a.mcap", config=Config(odometry=held))
    assert found.summary["calibration"]["r.sighting_yaw_rad"]["value"] == 0.0
    assert np.array_equal(found.robots["r"].final.poses, without.robots["r"].final.poses)
    assert np.allclose(found.robots["r"].final.covs, without.robots["r"].final.covs)
    assert not any(name.startswith("r.sighting") for name in without.summary["calibration"])


@pytest.mark.parametrize("errors", [(0.1, 0.0), (0.0, 0.2), (-0.05, 0.1)])
def test_corrected_sightings_and_the_errors_of_the_graph_are_the_same(errors):
    """Breaks if one turns about the base and the other about the sensor."""
    z = np.array([0.4, 3.0])
    cov = np.diag([1e-4, 4e-4])
    seen = Sighting(
        robot="r", stamp_ns=0, time_ns=0, z=z, cov=cov, identity="p", seen_robot=None, mount=MOUNT
    )
    sensors = Sensors.behind([seen])
    (corrected,) = sensors.corrected([seen], np.array(errors))

    def from_base(z):
        x, y, _ = compose(MOUNT, np.array([z[1] * np.cos(z[0]), z[1] * np.sin(z[0]), 0.0]))
        return np.array([[np.arctan2(y, x), np.hypot(x, y)]])

    found = without_errors(from_base(z), MOUNT[None], np.array(errors))
    assert np.allclose(found, from_base(corrected.z))


def shown(gradient, information):
    """What a log shows of two errors, of which a calibration takes up nothing."""
    nothing = np.zeros((0, 0))
    empty = np.zeros(0, dtype=np.int64)
    root = InformationRoot(empty, empty, empty, empty, np.zeros(0), {})
    information = np.diag(np.array(information, dtype=float))
    return ShownErrors(
        np.array(gradient, dtype=float),
        information,
        information,
        np.zeros(2),
        np.zeros((2, 2)),
        nothing,
        root,
    )


def test_only_what_is_clear_and_told_is_applied():
    """Breaks if noise, or the prior, is taken for an error."""
    prior = np.array([0.05, 0.03])
    # sigmas of 1e-3 by the data: 10 and 2 of them
    found = find_errors(shown([1e4, 2e3], [1e6, 1e6]), np.zeros(2), prior)
    assert found.applied.tolist() == [0]
    assert found.errors[1] == 0.0
    # what is corrected already counts
    found = find_errors(shown([0.0, 0.0], [1e6, 1e6]), np.array([0.01, 0.0]), prior)
    assert found.errors[0] == pytest.approx(0.01, rel=1e-2)
    # however much it pulls: the data tell less than is known before
    found = find_errors(shown([0.0, 1e3], [1e6, 500.0]), np.zeros(2), prior)
    assert not len(found.applied)
    held = find_errors(shown([1e4, 1e4], [1e6, 1e6]), np.zeros(2), np.array([0.05, 0.0]))
    assert held.applied.tolist() == [0]
