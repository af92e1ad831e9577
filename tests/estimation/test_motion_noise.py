"""The noise of odometry from a solution that was made with another noise than the track's."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

import graphslam
from graphslam.core.config import OdometryConfig, RobotConfig
from graphslam.core.motion_models import RATES, with_rates
from graphslam.core.records import (
    Association,
    Estimate,
    Motion,
    OdometryPose,
    Start,
    Step,
    Trajectory,
)
from graphslam.estimation.motion_arrays import increments_of
from graphslam.estimation.motion_noise import (
    FEW_MOTIONS,
    fit_odometry_noise,
    measured_motion_noise,
    middle_of_paths,
    scale_motion_noise,
)
from graphslam.estimation.posterior_residuals import Residuals
from graphslam.odometry.noise_estimation import (
    motion_variances,
    variance_sigma,
    with_fit_uncertainty,
)
from graphslam.odometry.preintegration import Track
from graphslam.simulation import load_scenario, simulate

S = 1_000_000_000
N = 1500
#: the sigmas of motions by those that the track states, as they are and as they were solved
FACTOR = 2.0
#: share of the noise that the solution has absorbed: the log constrains the motions weakly
ABSORBED = 0.9


@dataclass
class Solution:
    """Stands for a `Posterior` that has absorbed `ABSORBED` of the noise it was made with."""

    steps: list
    stated: np.ndarray

    @property
    def made(self):
        return increments_of(self.steps)

    def motions(self, robot, made, *, over_spans=False):
        variances = np.diagonal(made.cov, axis1=1, axis2=2)
        noise = FACTOR**2 * (self.stated.mean(axis=0) * len(self.stated) / len(made.delta))
        noise = np.broadcast_to(noise, made.delta.shape)
        left = (1 - ABSORBED) * noise
        residual = np.sqrt(left) * np.random.default_rng(3).normal(size=noise.shape)
        return Residuals(residual, variances, noise - left)


def driven():
    """A track that drives straight on at 0.5 m/s, its motions of a second, solved with more noise
    than it states, and the solution."""
    track = Track(OdometryConfig(floor_sigma_m=5e-4, floor_sigma_rad=1e-4), RobotConfig())
    for k in range(N + 1):
        track.add(OdometryPose("r", (k + 3) * S, (k + 3) * S, np.array([0.5 * k, 0.0, 0.0])))
    times = S * np.arange(3, N + 3), S * np.arange(4, N + 4)
    track.calibration = track.calibration.held()  # it is a variable of the solution
    made = track.motions(*times)
    steps = [
        Step(time_ns=int(end), motions={"r": made.one(k, int(begin), int(end))})
        for k, (begin, end) in enumerate(zip(*times, strict=True))
    ]
    (stated,) = motion_variances([(track, *times)], [track.config])
    steps = scale_motion_noise(steps, {"r": np.full(3, FACTOR)})
    return track, times, steps, stated


def test_noise_is_found_by_the_covariances_that_the_solution_was_made_with():
    """Nine tenths of the noise are absorbed. By the stated variances, a quarter of those solved
    with, nothing at all would be left in the residuals, and noise comes out five times as large."""
    track, times, steps, stated = driven()
    fit_odometry_noise({"r": track}, Solution(steps, stated), relax=False)
    (found,) = motion_variances([(track, *times)], [track.config])
    found = found / stated
    np.testing.assert_allclose(found[:, [0, 2]].mean(axis=0), FACTOR**2, rtol=0.15)


def test_few_motions_tell_of_their_noise_too():
    """Of a log of one image in 20 s. With what is assumed before any data instead (fifty motions
    were asked for) such logs had a NEES of up to 43."""
    track, _, steps, stated = driven()
    before = track.config
    few = Solution(steps[:FEW_MOTIONS], stated)
    assert fit_odometry_noise({"r": track}, few, relax=False).keys() == {"r"}
    assert track.config != before


def test_hardly_any_motions_leave_the_noise_as_it_is():
    track, _, steps, stated = driven()
    before = track.config
    fewer = Solution(steps[: FEW_MOTIONS - 1], stated)
    assert fit_odometry_noise({"r": track}, fewer, relax=False) == {}
    assert track.config is before


def test_factors_on_stated_noise_are_those_of_the_log_whatever_it_was_solved_with():
    track, _, steps, stated = driven()
    found = measured_motion_noise(track, "r", Solution(steps, stated))
    np.testing.assert_allclose(found[[0, 2]], FACTOR**2, rtol=0.25)


@pytest.mark.parametrize("count", [8, 20])
def test_errors_are_as_large_on_average_as_noise_that_few_residuals_show(count):
    """Variances that `count` residuals show, over 40 000 draws. By the likeliest ones errors
    squared are count / (count - 2) times as large as they should be: 1.33 and 1.11."""
    rng = np.random.default_rng(0)
    shown = rng.chisquare(count, size=40_000) / count
    config = with_rates(OdometryConfig(), np.ones(len(RATES)))
    wider = with_fit_uncertainty(config, variance_sigma(np.ones((count, 3))))
    for name in RATES:
        squared = np.mean(1.0 / (getattr(wider, name) * shown))
        assert squared == pytest.approx(1.0, abs=0.08)  # higher orders of 1 / count, and a prior


@pytest.mark.parametrize("seed", [0, 1])
def test_odometry_that_is_nearly_exact_is_told_beside_lines_of_far_larger_noise(seed, tmp_path):
    """Wheels slip by 1 mm per root of a metre, so the variance along is 5e-7 m² per m. Lines hold
    ten times less; by the noise that the front end states for them, and one solution, it came out
    as 3.8e-6. With steps of 2 mm of the counters and a prior at 1e-4 it is 2.3e-6 now."""
    scenario = load_scenario("lab")
    (robot,) = scenario.robots.values()
    robot = replace(robot, encoders=replace(robot.encoders, slip_m=0.001))
    log = tmp_path / "lab.mcap"
    simulate(replace(scenario, robots={"vehicle": robot}), log, seed)
    rates = graphslam.smooth(log).summary["noise"]["vehicle odometry"]
    assert rates["k_x_m"] + rates["k_x_s"] / robot.speed_m_s < 3e-6


def test_the_middle_of_every_path_is_a_log_of_its_own():
    """Half as many states as there are, of each of two robots; what is seen from others is not
    there, and each begins where the estimate has it."""
    seen, states = [], {}
    for n, name in enumerate(("a", "b")):
        times = np.arange(10) * S + n
        states[name] = Trajectory(times, np.column_stack([times / S, n + 0 * times, 0 * times]),
                                  np.zeros((10, 3, 3)))  # fmt: skip
        for k, now in enumerate(times.tolist()):
            motion = Motion(now - S, now, np.zeros(3), np.eye(3), np.zeros((3, 0)), 1.0)
            # each image has been associated one step later
            late = Association(name, max(now - S, n), 5, "line", np.zeros(3), np.eye(3))
            start = {name: Start(np.zeros(3), np.eye(3))}
            seen.append(Step(now, {} if k else start, {name: motion} if k else {}, (late,)))
    steps, estimate = middle_of_paths(
        sorted(seen, key=lambda step: step.time_ns), Estimate(states, {}, 0.0, 0), 10
    )
    for n, name in enumerate(("a", "b")):
        own = [step for step in steps if name in step.starts or name in step.motions]
        assert [step.time_ns for step in own] == (np.arange(2, 7) * S + n).tolist()
        assert estimate.states[name].stamps_ns.tolist() == [step.time_ns for step in own]
        np.testing.assert_allclose(own[0].starts[name].pose, [2.0, n, 0.0], atol=1e-8)
        assert all(name in step.motions for step in own[1:])
        assert [a.time_ns for step in own for a in step.associations] == (
            np.arange(2, 6) * S + n
        ).tolist()
