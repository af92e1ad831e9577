"""Steps along paths: to first order those of GTSAM, and right where a path turns as a whole."""

import gtsam
import numpy as np
import pytest

from graphslam.core.config import RobustConfig
from graphslam.core.geometry import between, compose, transform
from graphslam.estimation import factors
from graphslam.estimation.optimisation import CONVERGED_ERROR_ROBUST, reweighted
from graphslam.estimation.path_retraction import PathRetraction

CAUCHY = RobustConfig("cauchy", 2.0)
STEPS = 60


def graph_of(robots=1, turned_rad=0.0):
    """Paths with points beside them, a pose seen from each and a point in a landmark's place.

    Values are true, but for the first turn of each path. Everything fits, whatever that turn is,
    except for a prior that is weak on it.
    """
    rng = np.random.default_rng(0)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    sigmas = gtsam.noiseModel.Diagonal.Sigmas
    for robot in range(robots):
        pose = np.array([0.0, 5.0 * robot, turned_rad])
        keys = [factors.state_key(robot, n) for n in range(STEPS)]
        prior = gtsam.Pose2(0.0, 5.0 * robot, 0.0)
        graph.add(gtsam.PriorFactorPose2(keys[0], prior, sigmas([0.01, 0.01, 0.1])))
        for n, key in enumerate(keys):
            if n:
                step = np.array([1.0, 0.0, 0.1 * np.sin(0.3 * n)])
                pose = compose(pose, step)
                noise = sigmas([0.01, 0.01, 0.001])
                graph.add(gtsam.BetweenFactorPose2(keys[n - 1], key, factors.pose2(step), noise))
            factors.write(values, key, pose)
            point = transform(pose, rng.uniform(-3, 3, (1, 2)))[0]
            x, y, _ = between(pose, np.array([*point, 0.0]))
            landmark = factors.landmark_key(robot * STEPS + n)
            factors.write(values, landmark, point)
            seen = gtsam.Rot2(float(np.arctan2(y, x)))
            robust = gtsam.noiseModel.Robust.Create(
                gtsam.noiseModel.mEstimator.Cauchy.Create(2.0), sigmas([0.01, 0.02])
            )
            # from two states, so that the points hold the path as well
            graph.add(
                gtsam.BearingRangeFactor2D(key, landmark, seen, float(np.hypot(x, y)), robust)
            )
    line = factors.landmark_key(10 * STEPS)
    relative = gtsam.Pose2(1.0, 2.0, 0.5)
    graph.add(gtsam.BetweenFactorPose2(keys[-1], line, relative, sigmas([0.1, 0.1, 0.1])))
    factors.write(values, line, compose(pose, factors.array3(relative)))
    stand_in = int(gtsam.symbol("b", 0))
    graph.add(gtsam.BetweenFactorPoint2(landmark, stand_in, np.zeros(2), sigmas([0.1, 0.1])))
    factors.write(values, stand_in, point)
    return graph, values


@pytest.mark.parametrize("robots", [1, 2])
def test_small_steps_are_those_of_gtsam(robots):
    """The difference falls with the square of the step, for every kind of variable."""
    graph, values = graph_of(robots)
    along, rng = PathRetraction(graph), np.random.default_rng(1)
    step, zero = gtsam.VectorValues(), values.zeroVectors()
    for key in list(values.keys()):
        step.insert(key, rng.normal(0, 1e-4, len(zero.at(key))))
    apart = [
        values.retract(step.scale(f)).localCoordinates(along(values, step.scale(f))).norm()
        for f in (1.0, 0.5)
    ]
    assert 0 < apart[0] < 0.01 * step.norm()
    assert apart[1] == pytest.approx(apart[0] / 4, rel=0.05)


@pytest.mark.parametrize("robots", [1, 2])
def test_a_path_that_turns_as_a_whole_is_there_in_one_step(robots):
    """Far off is the first heading only: straight steps tear points and states from each other."""
    graph, values = graph_of(robots, turned_rad=0.3)
    linear = graph.linearize(values)
    step = linear.optimize()
    before = graph.error(values)
    assert graph.error(values.retract(step)) > 10 * before
    assert graph.error(PathRetraction(graph)(values, step)) < 1e-6 * before
    solved, _, is_done = reweighted(graph, values, CONVERGED_ERROR_ROBUST)
    assert is_done and graph.error(solved) < 1e-6 * before
