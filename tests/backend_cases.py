"""Small problems for back ends: steps, their truth, and what every estimate must satisfy."""

from dataclasses import replace

import numpy as np

from graphslam.core.config import Config, RobustConfig
from graphslam.core.geometry import between, compose, rotate_cov
from graphslam.core.observation_models import MODELS, PointModel
from graphslam.core.records import Association, Closure, Motion, Start, Step
from graphslam.estimation.backends import BACKENDS

PLAIN = Config(robust=RobustConfig(kernel="none"))
MODEL_OF = {0: "point", 1: "line", 2: "segment"}
WORLD = {
    0: np.array([4.0, 2.0]),
    1: np.array([3.0, -2.0, 0.2]),
    2: np.array([7.0, 1.0, 1.8]),
}


def motion(start_ns, end_ns, delta, cov):
    length = float(np.hypot(delta[0], delta[1]))
    return Motion(start_ns, end_ns, np.asarray(delta, float), cov, np.zeros((3, 0)), length)


def noise_cov(model, z):
    """A measurement covariance; a line's first row is whatever a front end puts there."""
    if isinstance(MODELS[model], PointModel):
        return np.diag([4e-4, 9e-4])
    return rotate_cov(np.diag([0.3, 4e-4, 1e-4]), float(z[2]))


def see(robot, time_ns, target, model, x, t, rng=None, late=False):
    """The association of a sighting of t from x, with noise if ``rng`` is given."""
    z = MODELS[model].predict(x, t)
    cov = noise_cov(model, z)
    if rng is not None:
        z = z + rng.multivariate_normal(np.zeros(len(z)), 0.25 * cov)
    return Association(robot, time_ns, target, model, z, cov, late)


MOTION_COV = np.diag([4e-3, 1e-3, 5e-4])


def two_robots(rng=None):
    """Robots `a` and `b` on their ways, three landmarks of all kinds, two meetings, a closure and
    late evidence: (steps, true final poses). The noise is half of what is claimed, or none at
    all."""
    starts = {"a": np.array([0.0, 0.0, 0.3]), "b": np.array([2.0, -1.0, 2.0])}
    start_cov = np.array([[1e-2, 2e-3, 0], [2e-3, 2e-2, 1e-3], [0, 1e-3, 5e-3]])
    where = dict(starts)
    steps = [Step(0, {r: Start(pose, start_cov) for r, pose in starts.items()})]
    first = {}
    for k in range(1, 7):
        motions, seen, closures = {}, [], []
        for robot, moved in (("a", [0.8, 0.05, 0.2]), ("b", [0.5, 0.0, -0.4])):
            delta = np.array(moved)
            where[robot] = compose(where[robot], delta)
            noise = np.zeros(3)
            if rng is not None:
                noise = rng.multivariate_normal(noise, 0.25 * MOTION_COV)
            motions[robot] = motion(k - 1, k, delta + noise, MOTION_COV)
            for landmark, model in MODEL_OF.items():
                found = see(robot, k, landmark, model, where[robot], WORLD[landmark], rng)
                if k == 1 and robot == "a":
                    first[landmark] = found  # enters two steps later, as late evidence
                elif k == 3 and robot == "a":
                    early = first[landmark]
                    late = Association("a", 1, landmark, model, early.z, early.cov, late=True)
                    seen += [late, found]
                elif k > 3:
                    seen.append(found)
        if k in (2, 5):
            kind = "robot-pose" if k == 2 else "robot-point"
            seen.append(see("a", k, "b", kind, where["a"], where["b"], rng))
        if k == 6:
            delta = between(starts["a"], where["a"])
            closures.append(Closure("a", k, "a", 0, delta, np.diag([1e-2, 1e-2, 1e-3])))
        steps.append(Step(k, {}, motions, tuple(seen), tuple(closures)))
    return steps, where


def make(name, config=PLAIN):
    """The estimator NAME or NAME:HORIZON."""
    name, _, horizon = name.partition(":")
    if horizon:
        config = replace(config, backend=replace(config.backend, horizon_s=float(horizon)))
    return BACKENDS[name](config)


def run(name, steps, config=PLAIN):
    backend = make(name, config)
    for step in steps:
        backend.add(step)
    return backend


def assert_covariance(cov):
    """Symmetric, positive semidefinite, finite."""
    assert np.isfinite(cov).all()
    np.testing.assert_allclose(cov, np.swapaxes(cov, -1, -2), atol=1e-12 * np.abs(cov).max())
    assert np.linalg.eigvalsh(cov).min() > -1e-12 * np.abs(cov).max()


def without_lines(steps):
    """A line's factor is built at the estimate of the moment, so two estimators with other
    estimates on the way have slightly other graphs; points and segments do not."""
    return [
        replace(s, associations=tuple(a for a in s.associations if a.model != "line"))
        for s in steps
    ]


def drive(rng, scale):
    """Two robots among three landmarks for ten steps, all noise (sigmas times ``scale``) as
    claimed, starts drawn from their priors: (steps, true poses)."""
    cov = scale**2 * np.diag([4e-2, 1e-2, 1e-2])
    claim = {2: scale**2 * np.diag([1e-2, 1e-2]), 3: scale**2 * np.diag([4e-2, 1e-2, 1e-2])}
    starts = {"a": np.array([0.0, 0.0, 0.3]), "b": np.array([2.0, -1.0, 2.0])}
    prior = scale**2 * np.diag([4e-2, 4e-2, 1e-2])
    true = {r: x + rng.multivariate_normal(np.zeros(3), prior) for r, x in starts.items()}
    steps = [Step(0, {r: Start(x, prior) for r, x in starts.items()})]
    for k in range(1, 11):
        motions, seen = {}, []
        for robot, delta in (("a", [0.4, 0.0, 0.15]), ("b", [0.3, 0.0, -0.3])):
            true[robot] = compose(true[robot], delta)
            measured = delta + rng.multivariate_normal(np.zeros(3), cov)
            motions[robot] = motion(k - 1, k, measured, cov)
        for robot in "ab":
            pairs = [(i, MODEL_OF[i], WORLD[i]) for i in (0, 1, 2)]
            if robot == "a":
                pairs.append(("b", "robot-point", true["b"]))
            for target, model, t in pairs:
                z = MODELS[model].predict(true[robot], t)
                R = claim[len(z)]
                if model == "line":  # another part of the wall each time; nothing known along it
                    z = compose(z, np.array([rng.normal(), 0.0, 0.0]))
                    R = rotate_cov(R, z[2])
                noise = rng.multivariate_normal(np.zeros(len(z)), R)
                seen.append(Association(robot, k, target, model, z + noise, R))
        steps.append(Step(k, {}, motions, tuple(seen)))
    return steps, true
