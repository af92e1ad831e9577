"""Sightings of robots against a solution without them."""

from dataclasses import replace

import numpy as np
import pytest
from backend_cases import PLAIN, motion, run, see, two_robots

from graphslam.core.config import RobustConfig
from graphslam.core.records import Start, Step
from graphslam.estimation.robot_distances import robot_distances

NO_FLOOR = {"robot-pose": np.zeros((3, 3)), "robot-point": np.zeros((2, 2))}


def meetings(steps):
    return [(s.time_ns, a) for s in steps for a in s.associations if isinstance(a.target, str)]


def without(steps, a):
    return [replace(s, associations=tuple(b for b in s.associations if b is not a)) for s in steps]


@pytest.mark.parametrize("kernel", ["none", "cauchy"])
@pytest.mark.parametrize("which", [0, 1])
@pytest.mark.parametrize("off", [0.0, 0.15])
def test_a_sighting_that_is_used_is_as_far_as_if_it_were_not(kernel, which, off):
    """Taken out of the solution by a formula, or by solving without it; a pose and a point, with
    noise or far off. Breaks if the estimate that it has pulled is compared with it: that distance
    is half as large."""
    config = replace(PLAIN, robust=RobustConfig(kernel=kernel))
    steps, _ = two_robots(np.random.default_rng(3))
    steps = [
        replace(
            s,
            associations=tuple(
                replace(a, z=a.z + off) if isinstance(a.target, str) else a for a in s.associations
            ),
        )
        for s in steps
    ]
    time_ns, a = meetings(steps)[which]
    rest = without(steps, meetings(steps)[1 - which][1])  # the other one would be far off, too
    used = run("batch", rest, config).finish()
    (with_it,) = robot_distances(rest, [(time_ns, a)], [True], used, config.robust, NO_FLOOR)
    left = without(rest, a)
    unused = run("batch", left, config).finish()
    (true,) = robot_distances(left, [(time_ns, a)], [False], unused, config.robust, NO_FLOOR)
    assert true > 0.01
    assert with_it == pytest.approx(true, rel=0.15, abs=0.02)


def test_all_offers_are_compared_each_by_its_own_model_and_floor():
    steps, _ = two_robots(np.random.default_rng(4))
    estimate = run("batch", steps, PLAIN).finish()
    both = meetings(steps)
    together = robot_distances(steps, both, [True, True], estimate, PLAIN.robust, NO_FLOOR)
    for n, one in enumerate(both):
        alone = robot_distances(steps, [one], [True], estimate, PLAIN.robust, NO_FLOOR)
        assert together[n] == pytest.approx(alone[0], rel=1e-9)
    wide = {name: floor + 1.0 * np.eye(len(floor)) for name, floor in NO_FLOOR.items()}
    assert np.all(
        robot_distances(steps, both, [True, True], estimate, PLAIN.robust, wide) < 0.1 * together
    )


def test_the_only_tie_between_two_robots_is_not_judged():
    """Nothing else says where b is, so nothing contradicts the sighting, however poor its start."""
    starts = {
        "a": Start(np.zeros(3), 1e-4 * np.eye(3)),
        "b": Start(np.array([3.0, 1.0, 0.0]), 1e8 * np.eye(3)),
    }
    x, t = np.array([0.5, 0.0, 0.0]), np.array([9.0, 7.0, 0.0])
    motions = {"a": motion(0, 1, [0.5, 0, 0], 1e-4 * np.eye(3))}
    motions["b"] = motion(0, 1, [0, 0, 0], 1e-4 * np.eye(3))
    steps = [Step(0, starts), Step(1, {}, motions, (see("a", 1, "b", "robot-pose", x, t),))]
    estimate = run("batch", steps, PLAIN).finish()
    found = robot_distances(steps, meetings(steps), [True], estimate, PLAIN.robust, NO_FLOOR)
    assert found[0] == 0.0
