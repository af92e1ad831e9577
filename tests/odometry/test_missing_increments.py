"""Increments that a log lacks, or that overlap."""

import numpy as np
import pytest

import graphslam
from graphslam.core.config import OdometryConfig, RobotConfig
from graphslam.core.geometry import between, compose, exp
from graphslam.core.records import OdometryIncrement
from graphslam.logs import LogWriter
from graphslam.odometry.missing_increments import bridge
from graphslam.odometry.preintegration import Track

S = 1_000_000_000
STEP = S // 10
TWIST = np.array([0.05, 0.0, 0.02])
COV = np.diag([1e-6, 1e-6, 1e-6])


def increment(start_ns, end_ns):
    share = (end_ns - start_ns) / STEP
    return OdometryIncrement("r", end_ns, end_ns, start_ns, exp(share * TWIST), share * COV)


def read(spans):
    track = Track(OdometryConfig(), RobotConfig())
    for start, end in spans:
        track.add(increment(start * STEP, end * STEP))
    return track


def test_a_lost_increment_does_not_mean_that_the_robot_stood():
    """It did before: a gap of 5 s at half a metre per second put the path 0.6 m off."""
    whole = read((k, k + 1) for k in range(20))
    lost = read((k, k + 1) for k in range(20) if not 8 <= k < 12)
    end = 20 * STEP
    np.testing.assert_allclose(lost.pose(end), whole.pose(end), atol=1e-9)
    assert (lost.missing.gaps, lost.missing.total_ns) == (1, 4 * STEP)
    told, bridged = (one.motion(0, end).cov for one in (whole, lost))
    assert (np.diag(bridged) > 10 * np.diag(told)).all()
    assert whole.missing.to_text(0) == ""


def test_the_variance_of_a_bridge_grows_with_the_third_power_of_its_time():
    """As that of a velocity that walks; white noise of the velocity would grow by 2 only."""
    v = np.array([0.5, 0.0, 0.0])
    (_, one), (_, two) = bridge(v, v, 0.5), bridge(v, v, 1.0)
    np.testing.assert_allclose(np.diag(two)[[0, 2]] / np.diag(one)[[0, 2]], 8.0)
    np.testing.assert_allclose(bridge(v, 3 * v, 1.0)[0], 2 * v)


def test_what_two_increments_have_in_common_counts_once():
    whole = read((k, k + 1) for k in range(20))
    overlapping = read((max(0.0, k - 0.4), k + 1) for k in range(20))
    end = 20 * STEP
    np.testing.assert_allclose(overlapping.pose(end), whole.pose(end), atol=1e-9)
    assert overlapping.missing.overlaps == 19


@pytest.mark.parametrize(("gap", "level"), [((0, 0), "good"), ((200, 260), "doubtful")])
def test_a_gap_is_named_and_does_not_bend_the_path(tmp_path, gap, level):
    """Without the bridge the path was 0.4 m off, and the verdict good."""
    path = tmp_path / "log.mcap"
    true = [np.zeros(3)]
    rng = np.random.default_rng(3)
    points = {f"p{k}": np.array([4 * np.cos(k), 4 * np.sin(k) + 2.5]) for k in range(6)}
    with LogWriter(path) as log:
        for k in range(600):
            pose = compose(true[-1], exp(TWIST))
            noise = rng.normal(0, [2e-3, 5e-4, 2e-3])
            if k not in range(*gap):
                delta = between(true[-1], pose) + noise
                span = k * STEP, (k + 1) * STEP
                log.increment("r", *span, delta=delta, cov=np.diag([4e-6, 2.5e-7, 4e-6]))
            true.append(pose)
            log.truth("r", (k + 1) * STEP, pose)
            for name, at in points.items() if k % 5 == 0 else ():
                seen = between(pose, np.append(at, 0.0))[:2]
                z = np.arctan2(seen[1], seen[0]), np.hypot(*seen)
                z += rng.normal(0, [0.02, 0.03])
                cov = np.diag([4e-4, 9e-4])
                log.sighting("r", (k + 1) * STEP, z, cov, identity=name)
    result = graphslam.smooth([path])
    found = graphslam.evaluate(result)["joint"]["final"]
    assert found["ate_aligned_rmse_m"] < 0.06  # 0.02 m; a gap of 3 m that is not bridged: 0.3 m
    assert result.summary["verdict"]["verdict"] == level
    named = [w for w in result.summary["warnings"] if "leaves out 1 stretch, 6.0 s" in w]
    assert bool(named) == (gap[1] > 0)
