"""Simulated steps with exactly the noise that they state and true associations, without a log.

The robots follow a planned path. Only the start is drawn from the prior, so the first motion
differs from run to run and every later pose is as planned. All runs therefore have the same graph
and one Cramér-Rao bound (see `graphslam.evaluation.cramer_rao_bound`).
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from graphslam.core.geometry import Array, between, compose, inverse, rotate_cov
from graphslam.core.observation_models import MODELS
from graphslam.core.records import Association, Motion, Start, Step
from graphslam.evaluation.monte_carlo_definition import Bench, BenchRobot

STEP_NS = 1_000_000_000


@dataclass(frozen=True, slots=True, eq=False)
class BenchRun:
    """The steps of a run and the truth.

    ``truth[robot]`` (K+1, 3) is the true pose at each step, the start first; ``landmarks[id]`` is
    (2,) of a point, (3,) of a line: a pose on it where it is first observed, x axis along it. The
    ids of points come first. World frame.
    """

    steps: tuple[Step, ...]
    truth: Mapping[str, Array]
    landmarks: Mapping[int, Array]


@dataclass(frozen=True, slots=True, eq=False)
class Noise:
    """Covariances (3, 3) or (2, 2) of the errors of a run: m and rad, along each frame's axes."""

    start: Array
    motion: Array
    point: Array
    line: Array
    robot: Array

    @classmethod
    def of(cls, bench: Bench, scale: float) -> "Noise":
        """The noise of a bench; ``scale`` multiplies every standard deviation."""
        s = bench.sigma

        def cov(*sigmas: float) -> Array:
            return np.diag(np.square(scale * np.array(sigmas)))

        return cls(
            start=cov(s.start_m, s.start_m, np.radians(s.start_deg)),
            motion=cov(s.along_m, s.across_m, np.radians(s.turn_deg)),
            point=cov(np.radians(s.bearing_deg), s.range_m),
            # there is no information along a line: the first value must not matter
            line=cov(s.line_m, s.line_m, np.radians(s.line_deg)),
            robot=cov(s.robot_m, s.robot_m, np.radians(s.robot_deg)),
        )


def planned_path(robot: BenchRobot) -> Array:
    """Poses (K+1, 3) of the planned path, world frame."""
    poses = [np.array([*robot.start_m, np.radians(robot.start_deg)])]
    for leg in robot.path:
        delta = np.array([leg.forward_m, 0.0, np.radians(leg.turn_deg)])
        for _ in range(leg.steps):
            poses.append(compose(poses[-1], delta))
    return np.array(poses)


def run_seed(seed: int, scale: float, run: int) -> np.random.SeedSequence:
    """The seed of a run: it depends on the experiment, the scale and the run alone.

    All variants get the same draws, whichever process runs them.
    """
    return np.random.SeedSequence(seed, spawn_key=(round(1e6 * scale), run))


def draw_run(
    bench: Bench, scale: float, rng: np.random.Generator | None, *, told: bool = False
) -> BenchRun:
    """Draw a run; without ``rng`` all errors are zero. ``told``: slipping motions state that.

    Errors of starts, motions and sightings of points are additive; those of the pose of a line or a
    robot are along its own axes, as its covariance is given.
    """
    noise = Noise.of(bench, scale)

    def error(cov: Array) -> Array:
        sigmas = np.sqrt(np.diag(cov))
        return sigmas * rng.standard_normal(len(cov)) if rng is not None else 0.0 * sigmas

    plans = {name: planned_path(robot) for name, robot in sorted(bench.robots.items())}
    truth = {name: plan.copy() for name, plan in plans.items()}
    for poses in truth.values():
        poses[0] += error(noise.start)
    landmarks: dict[int, Array] = {
        i: np.array(point, dtype=float) for i, point in enumerate(bench.points_m)
    }
    names, first = list(plans), next(iter(plans))
    steps = [Step(0, {name: Start(plans[name][0], noise.start) for name in names})]
    for k in range(1, len(plans[first])):
        now = k * STEP_NS
        motions, seen = {}, []
        for name in names:
            cov = noise.motion
            if bench.slip and rng is not None and rng.random() < bench.slip.share:
                cov = bench.slip.scale**2 * cov
            delta = between(truth[name][k - 1], truth[name][k]) + error(cov)
            length = float(np.hypot(delta[0], delta[1]))
            stated = cov if told else noise.motion
            motions[name] = Motion(now - STEP_NS, now, delta, stated, np.zeros((3, 0)), length)
            x = truth[name][k]
            for i, point in enumerate(bench.points_m):
                if np.hypot(*(np.array(point) - x[:2])) <= bench.point_reach_m:
                    z = MODELS["point"].predict(x, landmarks[i]) + error(noise.point)
                    seen.append(Association(name, now, i, "point", z, noise.point))
            for i, wall in enumerate(bench.walls_m, start=len(bench.points_m)):
                nearest = _nearest(np.array(wall), x[:2])
                if np.hypot(*(nearest[:2] - x[:2])) <= bench.line_reach_m:
                    landmarks.setdefault(i, nearest)
                    z = _disturbed(between(x, nearest), error(noise.line))
                    cov = rotate_cov(noise.line, z[2])
                    seen.append(Association(name, now, i, "line", z, cov))
        if bench.meet_every and k % bench.meet_every == 0:
            for other in names[1:]:
                z = _disturbed(between(truth[first][k], truth[other][k]), error(noise.robot))
                cov = rotate_cov(noise.robot, z[2])
                seen.append(Association(first, now, other, "robot-pose", z, cov))
        steps.append(Step(now, {}, motions, tuple(seen)))
    return BenchRun(tuple(steps), truth, landmarks)


def _nearest(wall: Array, point: Array) -> Array:
    """The point of a wall (2, 2) that is nearest to ``point`` (2,), as a pose along the wall."""
    along = wall[1] - wall[0]
    share = np.clip((point - wall[0]) @ along / (along @ along), 0.0, 1.0)
    return np.array([*(wall[0] + share * along), np.arctan2(along[1], along[0])])


def _disturbed(z: Array, error: Array) -> Array:
    """The measured pose (3,): the true one ``z`` is off by ``error`` (3,) along its own axes."""
    return compose(z, inverse(error))
