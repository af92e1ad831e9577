"""Where landmarks are by all their observations, from poses taken for exact."""

import numpy as np
import pytest

from graphslam.core.geometry import between, compose
from graphslam.core.observation_models import MODELS
from graphslam.core.records import Association, Estimate, Step, Trajectory
from graphslam.mapping.landmark_map import mean_landmarks, seen_extents

N = 40
WALL = np.array([2.0, 3.0, 0.4])
POINT = np.array([1.0, -2.0])
SIGMAS = np.array([0.03, 0.02, 0.01])


def path(rng):
    times = np.arange(N, dtype=np.int64)
    poses = np.column_stack([rng.uniform(-3, 3, (N, 2)), rng.uniform(-3, 3, N)])
    return {"r": Trajectory(times, poses, np.zeros((N, 3, 3)))}


def walls_seen(states, rng, model, noise):
    """Each state sees another part of the wall, with noise along the axes of that part."""
    cov = np.diag(SIGMAS**2)
    for k, x in enumerate(states["r"].poses):
        slide = rng.uniform(-4, 4) if model == "line" else 0.0
        part = compose(WALL, np.array([slide, 0.0, 0.0]))
        z = between(x, compose(part, noise * SIGMAS * rng.normal(size=3)))
        turn = np.eye(3)
        c, s = np.cos(z[2]), np.sin(z[2])
        turn[:2, :2] = [[c, -s], [s, c]]
        yield Step(k, associations=(Association("r", k, 7, model, z, turn @ cov @ turn.T),))


@pytest.mark.parametrize("model", ["line", "segment"])
def test_exact_observations_give_the_wall(model):
    rng = np.random.default_rng(0)
    states = path(rng)
    (mean, cov) = mean_landmarks(list(walls_seen(states, rng, model, 0.0)), states)[7]
    off = between(WALL, mean)
    np.testing.assert_allclose(off[1:], 0.0, atol=1e-12)  # rounding
    if model == "segment":
        np.testing.assert_allclose(off[0], 0.0, atol=1e-12)
    assert np.isnan(cov).all()


def test_the_mean_is_nearer_than_single_observations():
    """Over many draws the mean of 40 has a sixth of the error of one; a third is asserted."""
    errors = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        states = path(rng)
        mean, _ = mean_landmarks(list(walls_seen(states, rng, "segment", 1.0)), states)[7]
        errors.append(between(WALL, mean) / SIGMAS)
    assert (np.sqrt(np.mean(np.square(errors), axis=0)) < 1 / 3).all()


def test_a_vague_observation_hardly_counts():
    rng = np.random.default_rng(1)
    states = path(rng)
    steps = list(walls_seen(states, rng, "line", 0.0))
    wrong = compose(WALL, np.array([0.0, 0.5, 0.3]))
    z = between(states["r"].poses[3], wrong)
    steps.append(Step(3, associations=(Association("r", 3, 7, "line", z, 1e4 * np.eye(3)),)))
    mean, _ = mean_landmarks(steps, states)[7]
    np.testing.assert_allclose(between(WALL, mean)[1:], 0.0, atol=1e-4)


def test_points_are_weighted_by_their_information():
    """Two ranges are right and the bearings are wrong: crossing arcs give the point all the same,
    which a plain mean of positions does not."""
    poses = np.array([[1.0, 8.0, -np.pi / 2], [11.0, -2.0, np.pi]])
    states = {"r": Trajectory(np.arange(2, dtype=np.int64), poses, np.zeros((2, 3, 3)))}
    model, steps = MODELS["point"], []
    for k, bearing in enumerate([0.02, -0.03]):
        seen = np.array([bearing, 10.0])
        np.testing.assert_allclose(model.invert(np.array([0.0, 10.0]), poses[k]), POINT, atol=1e-9)
        a = Association("r", k, 3, "point", seen, np.diag([0.1**2, 0.001**2]))
        steps.append(Step(k, associations=(a,)))
    mean, _ = mean_landmarks(steps, states)[3]
    # 10 m times the angle squared, by which an arc leaves its tangent
    assert np.hypot(*(mean - POINT)) < 0.015
    plain = np.mean([model.invert(s.associations[0].z, poses[k]) for k, s in enumerate(steps)], 0)
    assert np.hypot(*(plain - POINT)) > 0.1


@pytest.mark.parametrize("backwards", [False, True])
def test_a_wall_does_not_end_where_one_observation_alone_reaches(backwards):
    """Of a hundred one had a return in it from beyond a corridor: the wall was 2 m too long. Of few
    each may have seen a part of its own."""
    parts = [(-1.0, 0.5), (-0.9, 1.0), (-0.5, 3.2), (0.0, 1.1), *[(-0.2, 0.3)] * 6]
    pose, cov = np.array([1.0, -2.0, 0.3]), np.eye(3)
    x = compose(WALL, np.array([0.0, 0.0, np.pi])) if backwards else WALL
    seen = [np.array(part)[::-1] * (-1.0 if backwards else 1.0) for part in parts]
    z = between(pose, x)
    steps = [
        Step(k, associations=(Association("r", k, 7, "line", z, cov, False, np.sort(part)),))
        for k, part in enumerate(seen)
    ]
    states = {"r": Trajectory(np.arange(10), np.tile(pose, (10, 1)), np.zeros((10, 3, 3)))}
    estimate = Estimate(states, {7: (WALL, cov)}, 0.0, 0)
    assert seen_extents(steps, estimate)[7] == pytest.approx([-0.9, 1.1])
    assert seen_extents(steps[:9], estimate)[7] == pytest.approx([-1.0, 3.2])
