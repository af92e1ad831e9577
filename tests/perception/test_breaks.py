"""Walls that look straight to within split_m, but are two."""

import numpy as np
import pytest
from line_checks import near
from test_front_ends import CONFIG, scan_of, segments

from graphslam.core.geometry import wrap
from graphslam.perception.breaks import FALSE_BREAK, Returns, moved_breaks, without_breaks
from graphslam.perception.line_moments import point_moments


def noisy(points, sigma, seed=0):
    return np.asarray(points) + [0.0, sigma] * np.random.default_rng(seed).normal(
        size=(len(points), 2)
    )


def whole(points, sigma_m=0.02):
    returns = Returns(point_moments(points), sigma_m**2)
    return returns, np.array([0]), np.array([len(points) - 1])


@pytest.mark.parametrize("seed", range(5))
def test_a_door_in_its_niche_is_not_one_line_with_its_wall(seed):
    """A line through both turns by 50 mrad: ten of the sigmas that its returns would say."""
    wall, door = [[3.0, -1.5], [3.0, 0.0]], [[3.08, 0.0], [3.08, 0.9]]
    found = near(segments(scan_of([wall, door], sigma=0.015, seed=seed), CONFIG), wall, 0.2)
    assert found
    for o in found:
        off = wrap(o.z[2] - np.pi / 2)
        off = off - np.pi * np.round(off / np.pi)
        assert abs(off) < 4 * np.sqrt(o.cov[2, 2])


@pytest.mark.parametrize("seed", range(5))
def test_a_door_is_told_from_its_wall_from_afar(seed):
    """Seven returns of a wall and four of a door 0.11 m behind it, from 12 m: one line through them
    is turned by 70 mrad, seven sigmas, from wherever the robot sees both."""
    x = np.arange(11) * 0.21
    points = noisy(np.column_stack([x, 12.0 + 0.11 * (x > 1.4)]), 0.015, seed)
    first, _ = without_breaks(*whole(points), 0.01)
    assert list(first) == [0, 7]


def test_a_straight_run_is_not_broken_by_noise():
    # at most that chance for each run: as many on average, and three sigmas of it more
    runs = 500
    x = np.linspace(0.0, 4.0, 120)
    broken = 0
    for seed in range(runs):
        points = noisy(np.column_stack([x, np.full_like(x, 2.0)]), 0.02, seed)
        first, _ = without_breaks(*whole(points), 0.02)
        broken += len(first) > 1
    assert broken <= FALSE_BREAK * runs + 3 * np.sqrt(FALSE_BREAK * runs)


@pytest.mark.parametrize("step_m", [0.06, 0.1])
def test_a_step_is_found_where_it_is(step_m):
    x = np.linspace(0.0, 3.0, 100)
    points = noisy(np.column_stack([x, 2.0 + step_m * (x > 1.0)]), 0.01)
    first, last = without_breaks(*whole(points), 0.01)
    assert len(first) == 2
    assert abs(x[first[1]] - 1.0) < 0.05  # two returns
    assert last[0] + 1 == first[1]


def test_breaks_move_to_the_corner():
    corner = np.concatenate(
        [
            np.column_stack([np.linspace(0, 1, 30), np.zeros(30)]),
            np.column_stack([np.ones(30), np.linspace(0.03, 1, 30)]),
        ]
    )
    returns = Returns(point_moments(corner), 0.02**2)
    for wrong in (25, 34):
        first, last = moved_breaks(returns, np.array([0, wrong]), np.array([wrong, 59]))
        assert last[0] == first[1]
        assert abs(int(first[1]) - 29) <= 1


def test_beams_that_graze_a_wall_have_less_noise_across_it():
    x = np.linspace(4.0, 6.0, 20)
    points = np.column_stack([x, np.full_like(x, 0.5)])
    ends = np.array([0]), np.array([19])
    square = 0.25 / (x**2 + 0.25)
    even, _, _ = whole(points, 0.1)
    assert even.variance_across(*ends) == pytest.approx(0.01 * np.mean(square))
    growing = Returns(point_moments(points), 1e-4 * (x**2 + 0.25))
    assert growing.variance_across(*ends) == pytest.approx(1e-4 * 0.25)
