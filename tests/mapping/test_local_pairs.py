"""Observations and landmarks in the robot's frame, compared at once as `MODELS` do one by one."""

import numpy as np
import pytest

from graphslam.core.config import AssociationConfig
from graphslam.core.observation_arrays import (
    KINDS,
    LINE,
    POINT,
    ROWS,
    SEGMENT,
    ObservationArrays,
)
from graphslam.core.observation_models import MODELS
from graphslam.mapping.local_pairs import LocalLandmarks, candidate_pairs, compare


def random_cov(rng, k):
    A = rng.normal(size=(k, 3, 3))
    return A @ A.mT + 0.1 * np.eye(3)


@pytest.mark.parametrize("only", [None, *range(len(KINDS))])
def test_all_kinds_at_once_are_compared_as_by_their_models(only):
    """A wrong entry of a Jacobian or of the noise, a row of the wrong kind, or a wall that slides
    where both its ends were seen breaks it. Landmarks are up to 2 m and half a turn away."""
    rng, k = np.random.default_rng(3), 40
    model = rng.integers(0, 3, k) if only is None else np.full(k, only)
    z, t = rng.uniform(-3, 3, (k, 3)), rng.uniform(-3, 3, (k, 3))
    cov = random_cov(rng, k)
    r, H, R = compare(model, z, cov, t)
    for n, code in enumerate(model):
        one, rows, d = MODELS[KINDS[code]], ROWS[code], MODELS[KINDS[code]].dim
        size = 2 if code == POINT else 3
        given = z[n, :size], cov[n, :size, :size], np.zeros(3), t[n, :d]
        expected_r, expected_H, expected_R = np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3))
        expected_r[:rows] = one.residual(given[0], given[2], given[3])
        expected_H[:rows, :d] = one.jacobians(given[0], given[2], given[3])[1]
        expected_R[:rows, :rows] = one.noise(*given)
        np.testing.assert_allclose(r[n], expected_r, atol=1e-12)
        np.testing.assert_allclose(H[n], expected_H, atol=1e-12)
        np.testing.assert_allclose(R[n], expected_R, atol=1e-11)


def test_pairs_are_of_walls_that_overlap_in_any_direction_and_of_points_nearby():
    """A wall seen the other way round is turned, one beyond the gap is no candidate, and a point is
    never compared with a wall."""
    wall = [4.0, 0.0, np.pi / 2]
    image = ObservationArrays(
        np.array([SEGMENT, SEGMENT, POINT]),
        np.array([[4.0, 0.1, -np.pi / 2], [4.0, 9.0, np.pi / 2], [0.0, 4.0, 0.0]]),
        np.tile(1e-4 * np.eye(3), (3, 1, 1)),
        np.array([[-1.0, 1.0], [-1.0, 1.0], [0.0, 0.0]]),
    )
    known = LocalLandmarks(
        np.array([wall, [4.0, 0.1, 0.0]]),
        np.tile(1e-4 * np.eye(3), (2, 1, 1)),
        np.array([SEGMENT, POINT]),
        np.array([[-1.0, 1.0], [0.0, 0.0]]),
    )
    config = AssociationConfig(directed=False)
    pairs = candidate_pairs(image, known, np.tile(1e-6 * np.eye(3), (3, 1, 1)), config)
    assert list(zip(pairs.observation, pairs.landmark, pairs.model, strict=True)) == [
        (0, 0, SEGMENT),
        (2, 1, POINT),
    ]
    assert pairs.flipped.tolist() == [True, False]
    assert abs(np.sin(pairs.z[0, 2] - np.pi / 2)) < 1e-12
    # 10 cm along the wall, and across the line of sight: many sigmas of 1 cm
    np.testing.assert_allclose(pairs.d2[0], 0.01 / 2.01e-4, rtol=1e-2)


def paired(middle_m, half_m, known_m, flipped=False):
    """Whether a wall that is seen there is compared with one along x that begins at -5 m."""
    heading = np.pi if flipped else 0.0
    image = ObservationArrays(
        np.array([LINE]),
        np.array([[middle_m, 0.05, heading]]),
        1e-4 * np.eye(3)[None],
        np.array([[-half_m, half_m]]),
    )
    known = LocalLandmarks(
        np.zeros((1, 3)), 1e-4 * np.eye(3)[None], np.array([LINE]), np.array([[-5.0, known_m]])
    )
    floor = np.tile(1e-6 * np.eye(3), (3, 1, 1))
    return bool(len(candidate_pairs(image, known, floor, AssociationConfig(directed=False)).d2))


@pytest.mark.parametrize("flipped", [False, True])
@pytest.mark.parametrize("side", [1, -1])
def test_walls_are_compared_where_a_fifth_of_the_shorter_one_overlaps(side, flipped):
    """A door leaf, 0.8 m wide and 5 cm out of the wall's line, is not compared with the wall that
    ends beside it: taken for it, it turned who saw both by tens of mrad. A wall of which a part is
    known is, as the robot drives along it."""
    end = 5.0
    assert paired(side * (end + 0.2), 0.4, end, flipped)
    assert not paired(side * (end + 0.3), 0.4, end, flipped)
    assert not paired(side * (end + 0.45), 0.4, end, flipped)
    # a longer one must have as much of what is known, 2 of 10 m, in common
    assert paired(side * 20.0, 17.5, end, flipped)
    assert not paired(side * 20.0, 16.5, end, flipped)


@pytest.mark.parametrize(("gap", "is_near"), [(-3.0, True), (0.25, True), (0.35, False)])
def test_a_wall_without_ends_is_compared_where_it_is_near(gap, is_near):
    """overlap_gap_m is 0.3: nothing is known of a length that they could have in common."""
    assert paired(5.0 + gap, 0.0, 5.0) == is_near
