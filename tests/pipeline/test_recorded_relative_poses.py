"""Relative poses that a log states, beside sightings."""

import numpy as np

import graphslam
from graphslam.core.geometry import between, compose, exp
from graphslam.logs import LogWriter

S = 1_000_000_000
STEP = S // 10
SECOND = np.array([1.0, 1.0, 0.5])


def test_relative_poses_of_robots_that_see_landmarks_are_used(tmp_path):
    """They were lost where the solution has a state at every sighting: the two paths were as far
    apart as without them, and the result named 25 closures that no estimate had."""
    rng = np.random.default_rng(5)
    points = {"a": np.array([5.0, 1.0]), "b": np.array([-4.0, 3.0])}
    errors = {}
    for related in (False, True):
        path = tmp_path / f"{related}.mcap"
        poses = {"r": np.zeros(3), "s": SECOND.copy()}
        twists = {"r": np.array([0.05, 0.0, 0.02]), "s": np.array([0.05, 0.0, -0.015])}
        rng = np.random.default_rng(5)
        with LogWriter(path) as log:
            for k in range(600):
                span = k * STEP, (k + 1) * STEP
                for robot, pose in poses.items():
                    after = compose(pose, exp(twists[robot]))
                    delta = between(pose, after) + rng.normal(0, [5e-3, 1e-3, 1e-2])
                    log.increment(robot, *span, delta=delta, cov=np.diag([2.5e-5, 1e-6, 1e-4]))
                    log.truth(robot, span[1], after)
                    poses[robot] = after
                    for name, at in points.items() if k % 40 == 0 else ():
                        seen = between(after, np.append(at, 0.0))[:2]
                        z = np.array([np.arctan2(seen[1], seen[0]), np.hypot(*seen)])
                        z += rng.normal(0, [0.05, 0.2])
                        log.sighting(robot, span[1], z, np.diag([0.0025, 0.04]), identity=name)
                if related and k % 25 == 0:
                    apart = between(poses["r"], poses["s"])
                    cov = np.eye(3) * 1e-4
                    log.relative_pose("s", span[1], span[1], delta=apart, other="r", cov=cov)
        result = graphslam.smooth(path, **{"start.from_truth": True})
        met = np.arange(26, 600, 25)  # where the last of the related ones end
        states = [one.final for one in result.robots.values()]
        found = between(*(own.poses[own.stamps_ns.searchsorted(met * STEP)] for own in states))
        true = [between(exp(n * twists["r"]), compose(SECOND, exp(n * twists["s"]))) for n in met]
        errors[related] = np.sqrt(np.mean(np.sum((found - true)[:, :2] ** 2, axis=1)))
        assert result.summary["counts"]["loop_closures"] == 24 * related
    # odometry carries them to the states before, so it is not the stated centimetre
    assert errors[True] < 0.8 * errors[False]
