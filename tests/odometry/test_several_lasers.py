"""Motions between states of different lasers of one robot."""

from dataclasses import replace

import numpy as np
import pytest
from finite_differences import jacobian

from graphslam.core.config import OdometryConfig, RobotConfig
from graphslam.core.geometry import between, compose, compose_cov, exp
from graphslam.core.records import OdometryPose, Trajectory
from graphslam.odometry.several_lasers import SeveralLasersTrack, last_part

S = 1_000_000_000
TWIST = np.array([0.5, 0.02, 0.3])  # per second
#: by their errors, and latencies in s
FRONT, FRONT_LATE = np.array([0.03, -0.02, 0.02]), 0.04
REAR, REAR_LATE = np.array([-0.05, 0.04, -0.03]), 0.15
MEAN = np.array([0.0, 0.0, 0.0, *FRONT, FRONT_LATE, *REAR, REAR_LATE])
LATENCIES = np.isin(np.arange(len(MEAN)), [6, 10])


def base(t):
    return exp(TWIST * np.asarray(t, float)[..., None])


def driven(mean=MEAN):
    """Fifty readings a second of a steady turn; the scans of `rear` are in odd half seconds."""
    track = SeveralLasersTrack(OdometryConfig(), RobotConfig(), ["rear"])
    for t in np.arange(0, 10.01, 0.02):
        ns = round(t * S)
        track.add(OdometryPose("r", ns, ns, base(t)))
    track.add_states("rear", REAR_NS)
    track.calibration = replace(track.calibration, mean=mean)
    return track


REAR_NS = np.arange(3, 18, 2) * S // 2
FRONT_NS = np.arange(2, 18, 2) * S // 2


def true_state(ns):
    """The frame of the laser that has a state there."""
    rear = np.isin(ns, REAR_NS)
    t = ns / S - np.where(rear, REAR_LATE, FRONT_LATE)
    return compose(base(t), np.where(rear[:, None], REAR, FRONT))


@pytest.mark.parametrize(
    ("start", "end"),
    [(FRONT_NS, REAR_NS), (REAR_NS[:-1], FRONT_NS[1:]), (REAR_NS[:-1], REAR_NS[1:])],
    ids=["front to rear", "rear to front", "rear to rear"],
)
def test_motions_lead_from_one_lasers_frame_at_its_time_to_the_others(start, end):
    """Not if a mount or a latency of the wrong laser were taken at either end."""
    found = driven().motions(start, end)
    np.testing.assert_allclose(found.delta, between(true_state(start), true_state(end)), atol=1e-6)


def test_motions_change_with_every_parameter_as_their_derivative_says():
    """Also where one laser is so late that its later stamp is of an earlier time."""
    track = driven()
    start = np.array([FRONT_NS[0], REAR_NS[0], REAR_NS[1] - S // 20])
    end = np.array([REAR_NS[0], FRONT_NS[1], REAR_NS[1]])  # the last ends 0.06 s earlier

    def moved(mean):
        track.calibration = replace(track.calibration, mean=mean)
        return track.motions(start, end).delta.ravel()

    D = track.motions(start, end).d_cal.reshape(9, -1)
    expected = jacobian(moved, MEAN)
    track.calibration = replace(track.calibration, mean=MEAN)
    np.testing.assert_allclose(D[:, ~LATENCIES], expected[:, ~LATENCIES], atol=1e-6)
    # a difference quotient over 50 ms of a curve
    np.testing.assert_allclose(D[:, LATENCIES], expected[:, LATENCIES], atol=0.05 * 0.3 * 0.5)
    assert np.linalg.eigvalsh(track.motions(start, end).cov).min() > 0


def test_states_of_all_lasers_are_given_as_those_of_the_first():
    """At the same times, where its own clock says that it is."""
    track, ns = driven(), np.sort(np.concatenate([FRONT_NS, REAR_NS]))
    covs = np.tile(np.diag([1e-4, 1e-4, 1e-6]), (len(ns), 1, 1))
    found = track.at_first_laser(Trajectory(ns, true_state(ns), covs))
    np.testing.assert_allclose(found.poses, compose(base(ns / S - FRONT_LATE), FRONT), atol=1e-6)
    own = ~np.isin(ns, REAR_NS)
    np.testing.assert_array_equal(found.covs[own], covs[own])


def test_the_last_part_of_a_corrected_motion_completes_it():
    track = driven()
    first, last = track.motion(FRONT_NS[0], REAR_NS[0]), track.motion(REAR_NS[0], FRONT_NS[1])
    whole = replace(track.motion(FRONT_NS[0], FRONT_NS[1]), from_scans=True)
    whole = replace(whole, delta=whole.delta + np.array([0.1, -0.05, 0.02]))
    part = last_part(whole, first, last)
    np.testing.assert_allclose(compose(first.delta, part.delta), whole.delta, atol=1e-12)
    assert part.from_scans and not part.d_delta_d_calibration.any()
    least = compose_cov(first.delta, 0 * first.cov, part.delta, part.cov) - whole.cov
    assert np.linalg.eigvalsh(least).min() > -1e-12


def test_what_holds_a_mount_holds_that_of_every_laser():
    held = OdometryConfig(fixed_calibration=("laser_x_m",))
    track = SeveralLasersTrack(held, RobotConfig(), ["rear"])
    track.add(OdometryPose("r", 0, 0, np.zeros(3)))
    sigmas = dict(zip(track.prior.names, np.sqrt(np.diag(track.prior.cov)), strict=True))
    assert sigmas["laser_x_m"] < 1e-6 and sigmas["rear.laser_x_m"] < 1e-6
    assert sigmas["rear.laser_y_m"] == sigmas["laser_y_m"] == held.laser_sigma_m
