"""Motions that scans contradict: slips, or a calibration that is far from its prior."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from graphslam.core.config import OdometryConfig
from graphslam.core.geometry import compose
from graphslam.core.motion_models import nominal_calibration
from graphslam.core.records import Contradiction, Motion, Step
from graphslam.odometry.calibration_jacobian import CalibratedSource
from graphslam.odometry.contradicted_motions import (
    ContradictedMotions,
    without_explained,
)
from graphslam.odometry.far_calibration import FAR_SIGMAS, T_DOF, explain, far_from_prior, widened
from graphslam.odometry.preintegration import Track
from graphslam.odometry.scan_odometry import CONTRADICTION_D2
from tests.odometry.test_online_calibration import CENTRED, NOTHING, Drive, weaving

PRIOR = nominal_calibration("odometry", OdometryConfig(), mounted=True)
#: what scans tell of a motion: 1 cm and 0.01 rad
SCAN = np.diag(np.square([0.01, 0.01, 0.01]))


def contradicted(drive, rng, noise=(0.0, 0.0, 0.0), slips=0.0):
    """Steps of a drive whose odometry has noise, sigmas along each axis, and a share of slips.

    Those that scans contradict by the stated noise have what these say.
    """
    steps = []
    for start, end in zip(drive.states[:-1], drive.states[1:], strict=True):
        motion = drive.track.motion(int(start), int(end))
        off = rng.normal(0.0, noise) + (rng.random() < slips) * rng.uniform(-0.5, 0.5, 3)
        motion = replace(motion, delta=compose(motion.delta, off))
        pose = drive.moved(start, end) + rng.normal(0.0, np.sqrt(np.diag(SCAN)))
        miss = pose - motion.delta
        if miss @ np.linalg.solve(motion.cov + SCAN, miss) > CONTRADICTION_D2:
            against = Contradiction(motion, pose, np.linalg.inv(SCAN))
            motion = replace(motion, delta=pose, from_scans=True, contradiction=against)
        steps.append(Step(motion.end_ns, motions={"r": motion}))
    return steps


def explanation(drive, steps):
    found = [s.motions["r"].contradiction for s in steps if s.motions["r"].contradiction]
    source = CalibratedSource.of(drive.track)
    known = ContradictedMotions.none().with_motions(found, source, np.ones(3))
    return known, explain(known, np.linalg.inv(PRIOR.cov), PRIOR.mean, PRIOR)


def value(found):
    """The calibration by all, with a prior as wide as it has to be."""
    mean = PRIOR.mean
    for _ in range(4):
        before = np.linalg.inv(widened(PRIOR, replace(PRIOR, mean=mean)).cov)
        cov = np.linalg.inv(before + found.information)
        mean = cov @ found.vector
    return mean, np.sqrt(np.diag(cov))


@pytest.mark.parametrize("turning", [-0.5, -0.33, 0.25, 0.43, 0.8])
@pytest.mark.parametrize("slips", [0.0, 0.03])
def test_a_robot_that_skids_is_calibrated_though_scans_contradict_its_turns(turning, slips):
    """To 4 sigmas: scales are products of noisy numbers. If each contradiction were a slip nothing
    would be learnt; if slips counted, the scale would be off by more."""
    rng = np.random.default_rng(3)
    drive = Drive(weaving(2000, rng), {**NOTHING, "rotation_scale": turning}, CENTRED)
    steps = contradicted(drive, rng, slips=slips)
    _, found = explanation(drive, steps)
    mean, sigma = value(found)
    at = PRIOR.names.index("rotation_scale")
    assert abs(mean[at] - turning) < 4.0 * sigma[at] + 0.01
    assert sigma[at] < 0.04
    assert found.used.mean() > (0.6 if slips else 0.95)


@pytest.mark.parametrize("seed", range(5))
def test_odometry_much_noisier_than_stated_is_no_scale(seed):
    """With the motion as measured, noise would be explained best by odometry that counts nothing: a
    scale of -1."""
    rng = np.random.default_rng(seed)
    drive = Drive(weaving(2000, rng), NOTHING, CENTRED)
    known, found = explanation(drive, contradicted(drive, rng, noise=(0.1, 0.05, 0.2)))
    assert len(known.miss) > 100
    assert found is None


def test_a_few_slips_are_no_calibration():
    rng = np.random.default_rng(5)
    drive = Drive(weaving(2000, rng), NOTHING, CENTRED)
    known, found = explanation(drive, contradicted(drive, rng, slips=0.1))
    assert 0 < len(known.miss) < 30
    assert found is None


def test_a_laser_that_is_late_by_far_is_no_calibration_of_the_odometry():
    """Stamps that are wrong are named: a latency of 14 sigmas is none."""
    rng = np.random.default_rng(6)
    drive = Drive(weaving(2000, rng), NOTHING, {**CENTRED, "laser_latency_s": 0.7})
    known, found = explanation(drive, contradicted(drive, rng))
    assert len(known.miss) > 20
    assert found is None


def test_contradictions_that_the_calibration_explains_are_odometry_again_and_slips_are_not():
    rng = np.random.default_rng(7)
    drive = Drive(weaving(1000, rng), {**NOTHING, "rotation_scale": 0.4}, CENTRED)
    steps = contradicted(drive, rng)
    slipped = next(k for k, s in enumerate(steps) if s.motions["r"].from_scans)
    motion: Motion = steps[slipped].motions["r"]
    against = replace(motion.contradiction, pose=motion.contradiction.pose + np.array([0.4, 0, 0]))
    motion = replace(motion, contradiction=against)
    steps[slipped] = replace(steps[slipped], motions={"r": motion})
    before = [s.motions["r"].from_scans for s in steps]
    mean = np.where(np.array(PRIOR.names) == "rotation_scale", 0.4, 0.0)
    track: Track = drive.track
    track.calibration = replace(PRIOR, mean=mean, cov=1e-4 * PRIOR.cov)
    taken = without_explained(steps, "r", track, np.ones(3))
    after = [k for k, s in enumerate(taken) if s.motions["r"].from_scans]
    assert sum(before) > 20
    assert after == [slipped]
    assert [s.time_ns for s in taken] == [s.time_ns for s in steps]


def test_a_prior_is_wider_only_for_the_odometry_and_only_beyond_its_tails():
    """A mount or a latency that seems far off is a fault in the log."""
    for name, sigmas, wider in (
        ("rotation_scale", FAR_SIGMAS - 0.1, False),
        ("rotation_scale", FAR_SIGMAS + 0.1, True),
        ("laser_latency_s", 10.0, False),
    ):
        at = PRIOR.names.index(name)
        mean = np.zeros(len(PRIOR.names))
        mean[at] = sigmas * np.sqrt(PRIOR.cov[at, at])
        found = widened(PRIOR, replace(PRIOR, mean=mean))
        assert (found.cov[at, at] > PRIOR.cov[at, at]) == wider
        others = np.arange(len(mean)) != at
        np.testing.assert_array_equal(np.diag(found.cov)[others], np.diag(PRIOR.cov)[others])


def test_the_pull_of_a_wider_prior_is_that_of_a_student_distribution():
    """The slope of the negative logarithm of its density, by differences, at the value found."""
    at, sigma = PRIOR.names.index("rotation_scale"), 5.0
    spread = float(np.sqrt(PRIOR.cov[at, at]))
    mean = np.zeros(len(PRIOR.names))
    mean[at] = sigma * spread
    found = widened(PRIOR, replace(PRIOR, mean=mean))
    cost = -stats.t.logpdf(sigma + np.array([-1e-4, 1e-4]), T_DOF)
    assert mean[at] / found.cov[at, at] * spread == pytest.approx(np.diff(cost)[0] / 2e-4, rel=1e-6)


def test_a_log_is_read_again_only_for_odometry_far_off_and_with_doubt_in_what_was_found():
    """Breaks if a latency, or two sigmas of the prior, cost another pass, or if a calibration that
    was found among false associations is taken for certain."""
    prior = nominal_calibration("odometry", OdometryConfig(), mounted=True)
    sigma = np.sqrt(np.diag(prior.cov))
    cov = np.diag((sigma / 10) ** 2)
    near = replace(prior, mean=2.0 * sigma * (np.arange(7) != 6), cov=cov)
    late = replace(prior, mean=10.0 * sigma * (np.arange(7) == 6), cov=cov)
    assert far_from_prior(prior, prior, near) is None
    assert far_from_prior(prior, prior, late) is None
    far = replace(prior, mean=10.0 * sigma * (np.arange(7) == 1), cov=cov)
    for before, doubt in ((prior, far.mean[1] / 3), (far, 0.0)):
        begun = far_from_prior(prior, before, far)
        np.testing.assert_array_equal(begun.mean, far.mean)
        expected = sigma / 10
        expected[1] = np.hypot(sigma[1] / 10, doubt)
        np.testing.assert_allclose(np.sqrt(np.diag(begun.cov)), expected, rtol=1e-12)
