"""The invariant filter: what cannot be observed stays unobserved; else it is the thesis' filter."""

from dataclasses import replace

import numpy as np
import pytest
from backend_cases import MODEL_OF, MOTION_COV, PLAIN, WORLD, drive, motion, run, see, without_lines

from graphslam.core.config import EkfConfig
from graphslam.core.errors import ConfigError
from graphslam.core.geometry import compose
from graphslam.core.records import Association, Start, Step

POSITION = 0.02  # variance of the start along each axis, m²


def standing(rng, sigma_rad):
    """A robot that never moves and does not know its heading sees a point 60 times."""
    pose = np.array([1.0, -2.0, 0.5])
    start = Start(pose, np.diag([POSITION, POSITION, sigma_rad**2]))
    seen = [see("r", 0, 0, "point", pose, WORLD[0], rng) for _ in range(60)]
    return [Step(0, {"r": start}), *(Step(0, associations=(s,)) for s in seen)]


@pytest.mark.parametrize(("name", "kept"), [("invariant-ekf", True), ("ekf", False)])
def test_a_robot_that_stands_still_learns_nothing_of_its_heading(name, kept, rng):
    """It sees the point from one place, so only where the point is relative to it. The filter with
    additive errors becomes sure of the heading nevertheless (S. Julier, J. Uhlmann, ICRA 2001,
    https://doi.org/10.1109/ROBOT.2001.933257): it looks at the point from where it was, then from
    where it is believed to be now."""
    variance = run(name, standing(rng, 0.5)).joint("r", []).cov[2, 2]
    if kept:
        assert variance == pytest.approx(0.25, rel=1e-9)
    else:
        assert variance < 0.9 * 0.25


@pytest.fixture
def rng():
    return np.random.default_rng(11)


def round_trip(rng, heading_variance, shift=0.0):
    """A robot on its way round landmarks of all kinds, noise as in `two_robots`; its start is not
    at the origin, about which the errors turn, and all of it moved by ``shift`` along both axes."""
    offset = np.array([shift, shift, 0.0])
    x = np.array([2.0, 1.0, 0.3]) + offset
    steps = [Step(0, {"r": Start(x, np.diag([POSITION, POSITION, heading_variance]))})]
    for k in range(1, 9):
        delta = np.array([0.6, 0.0, 0.5])
        x = compose(x, delta)
        noise = rng.multivariate_normal(np.zeros(3), MOTION_COV)
        motions = {"r": motion(k - 1, k, delta + noise, MOTION_COV)}
        seen = [
            see("r", k, i, MODEL_OF[i], x, place + offset[: len(place)], rng)
            for i, place in WORLD.items()
        ]
        steps.append(Step(k, {}, motions, tuple(seen)))
    return steps


def joint(name, heading_variance):
    """Means (d,), covariance (d, d), and how all of it moves with a turn about the start (d,)."""
    steps = round_trip(np.random.default_rng(11), heading_variance)
    found = run(name, steps).joint("r", [0, 1, 2])
    means = [found.pose, *found.landmarks]
    start = steps[0].starts["r"].pose
    turn = [np.array([start[1] - m[1], m[0] - start[0], 1.0])[: len(m)] for m in means]
    return np.concatenate(means), found.cov, np.concatenate(turn)


@pytest.mark.parametrize(("name", "exact"), [("invariant-ekf", True), ("ekf", False)])
def test_a_turn_of_the_whole_world_stays_as_open_as_it_was(name, exact):
    """Everything was seen from the robot, so how little the start's heading is known (0.001 or 0.3
    rad) changes neither the estimate nor its covariance but for a turn of all of it about the
    start: a matrix of rank one, and what the start says. Rounding is 1e-11."""
    mean, sure, _ = joint(name, 1e-6)
    other, open_, turn = joint(name, 0.09)
    gained = open_ - sure - (0.09 - 1e-6) * np.outer(turn, turn)
    if exact:
        np.testing.assert_allclose(other, mean, atol=1e-10)
        np.testing.assert_allclose(gained, 0.0, atol=1e-10)
    else:
        assert np.abs(other - mean).max() > 1e-3
        assert gained[2, 2] < -0.05 * 0.09  # of the heading


def test_where_the_origin_lies_does_not_matter():
    """Errors turn about the origin, and yet: exp of an error about one point is exp of the same
    error about another. 100 m away; rounding of 1e-14 of that, a few hundred times."""
    near, far = (
        run("invariant-ekf", round_trip(np.random.default_rng(11), 0.09, shift)).joint("r", [0, 2])
        for shift in (0.0, 100.0)
    )
    np.testing.assert_allclose(far.pose - near.pose, [100.0, 100.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(far.landmarks[0] - near.landmarks[0], [100.0, 100.0], atol=1e-9)
    np.testing.assert_allclose(far.cov, near.cov, atol=1e-9)


def test_small_noise_makes_it_the_filter_of_the_thesis():
    """Two robots, points and segments (a line has a gauge of 1 mm, which does not shrink with the
    noise). The errors differ in second order: a tenth of the noise, a hundredth of the distance.
    What is left out of that is of third order, measured 6 % at the larger noise of 3 to 6 mm."""
    gaps = []
    for scale in (0.03, 0.003):
        steps = without_lines(drive(np.random.default_rng(3), scale)[0])
        a, b = (run(name, steps).joint("a", [0, 2], ["b"]) for name in ("invariant-ekf", "ekf"))
        means = ([j.pose, *j.landmarks, *j.others] for j in (a, b))
        gaps.append(max(np.abs(m - n).max() for m, n in zip(*means, strict=True)))
        # covariances are of second order already; they differ by a share that falls with the noise
        np.testing.assert_allclose(a.cov, b.cov, atol=scale * np.abs(b.cov).max())
    assert gaps[0] > 1e-5  # they are two filters
    assert 80 < gaps[0] / gaps[1] < 120


def test_a_linear_problem_is_the_same_filter():
    """Known headings: all is linear in positions, and no turn carries anything. What is left is the
    heading's variance of 1e-14 rad², times tens of metres."""
    known, rng = 1e-14, np.random.default_rng(7)
    cov = np.diag([1e-2, 2e-2, known])
    x, steps = np.zeros(3), [Step(0, {"r": Start(np.zeros(3), cov)})]
    for k in range(1, 6):
        x = x + np.array([1.0, 0.0, 0.0])
        moved = {"r": motion(k - 1, k, [1.0, rng.normal(0.0, 0.1), 0.0], cov)}
        z = np.array([4.0, 2.0, 0.0]) - x + np.append(rng.normal(0.0, 0.1, 2), 0.0)
        steps.append(Step(k, {}, moved, (Association("r", k, 0, "segment", z, cov),)))
    a, b = (run(name, steps).joint("r", [0]) for name in ("invariant-ekf", "ekf"))
    np.testing.assert_allclose(a.pose, b.pose, atol=1e-10)
    np.testing.assert_allclose(a.landmarks[0], b.landmarks[0], atol=1e-10)
    np.testing.assert_allclose(a.cov, b.cov, atol=1e-12)


def test_iterations_are_refused():
    with pytest.raises(ConfigError, match=r"ekf\.iterations"):
        run("invariant-ekf", [], replace(PLAIN, ekf=EkfConfig(iterations=2)))
