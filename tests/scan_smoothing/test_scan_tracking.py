"""Logs of scans: the tracked path after its odometry was calibrated, and the noise of that."""

from dataclasses import replace

import numpy as np
import pytest
from paths import ROOT
from pose_checks import assert_same_pose

from graphslam.core.config import OdometryConfig, RobotConfig
from graphslam.core.config_io import load_config
from graphslam.core.geometry import between, compose, compose_cov, exp
from graphslam.core.records import OdometryPose
from graphslam.logs import open_logs
from graphslam.odometry.online_calibration import Learnt
from graphslam.odometry.preintegration import Track
from graphslam.scan_smoothing.scan_keyframes import KeyframeBlock, read_keyframes
from graphslam.scan_smoothing.scan_tracking import TrackedPath, recalibrate_path
from graphslam.slam.smooth import smooth

SECOND = 1_000_000_000
STATES, ANCHORS = 9, [0, 4, 6]
#: this motion was taken from the scans
FROM_SCANS = 6


def winding():
    """Odometry of a robot that winds its way, for ten seconds."""
    track, pose = Track(OdometryConfig(), RobotConfig()), np.zeros(3)
    for k in range(101):
        track.add(OdometryPose("r", k * SECOND // 10, k * SECOND // 10, pose))
        pose = compose(pose, exp(np.array([0.06, 0.0, 0.09 * np.sin(0.1 * k)])))
    return track


def calibrated(track):
    """The same odometry, with 4 % more path and 6 % less turning."""
    mean = np.zeros(len(track.calibration.mean))
    mean[:2] = 0.04, -0.06
    track.calibration = replace(track.calibration, mean=mean)
    return track


def tracked(motions, noise, landmark_cov):
    """A path over ``motions``, in which landmarks show the pose of each state seen from its anchor.

    What they show is independent of odometry, of covariance ``landmark_cov`` (in units of that of
    odometry) and at a fixed offset from the truth; ``noise`` are covariances of motions by which
    odometry is weighted.
    """
    real = winding()
    path = TrackedPath(poses=[np.array([1.0, 2.0, 3.0])], motions=list(motions), anchors=ANCHORS)
    path.times = [0] + [m.end_ns for m in motions]
    path.from_anchor = [(np.zeros(3), np.zeros((3, 3)))]
    for k in range(1, STATES):
        anchor = max(a for a in ANCHORS if a < k)
        odometry, Q = np.zeros(3), np.zeros((3, 3))
        for m, cov in zip(motions[anchor:k], noise[anchor:k], strict=True):
            Q = compose_cov(odometry, Q, m.delta, cov)
            odometry = compose(odometry, m.delta)
        shown = between(*real.pose(np.array([path.times[anchor], path.times[k]])))
        shown += [0.01, -0.02, 0.03]
        P = np.linalg.inv(np.linalg.inv(Q) * (1 + 1 / landmark_cov))
        seen = P @ np.linalg.solve(Q, odometry + shown / landmark_cov)
        path.from_anchor.append((seen, P))
        path.poses.append(compose(path.poses[anchor], seen))
    return path


@pytest.mark.parametrize("landmark_cov", [1e9, 1.0, 1e-9])
def test_a_recalibrated_path_is_the_one_that_was_tracked_with_that_calibration(landmark_cov):
    """Whether there is odometry alone, landmarks and odometry, or landmarks alone. Odometry counts
    since the last anchor, and what was taken from scans stays. A path that was left as it was would
    be centimetres off with the first two."""

    def motions_by(track):
        made = [track.motion(k * SECOND, (k + 1) * SECOND) for k in range(STATES - 1)]
        made[FROM_SCANS] = replace(
            made[FROM_SCANS], delta=np.array([0.6, 0.01, 0.3]), from_scans=True
        )
        return made

    before, after = motions_by(winding()), motions_by(calibrated(winding()))
    noise = [m.cov for m in before]
    path, expected = (tracked(motions, noise, landmark_cov) for motions in (before, after))
    apart = np.abs(np.array(path.poses) - np.array(expected.poses))[:, :2].max()
    assert (apart > 0.02) == (landmark_cov > 1e-6)
    covs = [cov for _, cov in path.from_anchor]
    recalibrate_path(path, calibrated(winding()))
    assert_same_pose(np.array(path.poses), np.array(expected.poses), atol=1e-9)
    found, same = (np.array([pose for pose, _ in p.from_anchor]) for p in (path, expected))
    assert_same_pose(found, same, atol=1e-9)
    assert all(cov is c for (_, cov), c in zip(path.from_anchor, covs, strict=True))


def test_the_noise_of_odometry_is_found_in_a_log_of_scans():
    """In the simulated lab each wheel slips by 6 mm per root of a metre, with 0.54 m between them.
    Without the fit variances are the default's, 4 times too large along x; by the median of the
    residuals alone they are never less than that. A factor of two is what 34 m of drive tell."""
    config = load_config(overrides=("start.from_truth=true",))
    result = smooth(open_logs([ROOT / "logs" / "lab.mcap"], config), config)
    (robot,) = result.robots
    rates, speed = result.summary["noise"][f"{robot} odometry"], 0.262
    along, turning = (rates[f"k_{axis}_m"] + rates[f"k_{axis}_s"] / speed for axis in ("x", "phi"))
    slip = 0.006**2
    assert slip / 2 / 2 < along < 2 * slip / 2
    assert 2 * slip / 0.54**2 / 2 < turning < 2 * 2 * slip / 0.54**2


def test_loose_returns_are_in_the_last_solution():
    """Breaks if the batch no longer asks for them. In the lab nearly every scan has a wall of which
    it sees some returns only; half of the scans is what a wider segment would leave."""
    config = load_config()
    result = smooth(open_logs([ROOT / "logs" / "lab.mcap"], config), config)
    (states,) = result.estimate.states.values()
    seen = [a for step in result.steps for a in step.associations]
    assert result.summary["consolidated"]["observations_by_loose_returns"] > len(states) / 2
    assert {a.target for a in seen} == {landmark.id for landmark in result.landmarks}


def white_noise_of_motions(noise_scale, *settings):
    """Variances (n, 3) of the motions of the sample log, without what the calibration leaves open,
    where the reader is told this factor after the first block."""
    config = load_config(overrides=settings)
    reading = read_keyframes(open_logs([ROOT / "logs" / "lab.mcap"], config), config, 1 << 30)
    item, found = next(reading), []
    while isinstance(item, KeyframeBlock):
        for motion in (k.motion for k in item.keyframes if k.motion is not None):
            D = motion.d_delta_d_calibration
            found.append(np.diag(motion.cov - D @ item.source.calibration.cov @ D.T))
        item = reading.send(Learnt(item.source.calibration, noise_scale, item.prior))
    return np.array(found)


def test_learnt_noise_is_in_later_motions_unless_noise_is_stated():
    """Tracking would follow odometry that is noisier than the default too far. What somebody states
    is used as stated."""
    factor = np.array([1.0, 4.0, 9.0])
    ratio = white_noise_of_motions(factor) / white_noise_of_motions(np.ones(3))
    np.testing.assert_array_equal(ratio[0], np.ones(3))  # of the first block
    np.testing.assert_allclose(ratio[-1], factor, rtol=1e-6)
    stated = "odometry.k_phi_m=2e-4"
    np.testing.assert_array_equal(
        white_noise_of_motions(factor, stated), white_noise_of_motions(np.ones(3), stated)
    )
