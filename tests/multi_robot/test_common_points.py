"""Which points of two maps did not move: distances tell, with the joint covariance of the maps."""

import numpy as np
import pytest

from graphslam.core.geometry import inverse, transform
from graphslam.multi_robot.common_points import common_points

RNG = np.random.default_rng(3)
#: nine posts in a hall
POSTS = RNG.uniform([0.0, 0.0], [20.0, 14.0], (9, 2))
#: m: of a map's points
SIGMA_M = 0.02


def maps(moves, pose=(0.4, -0.3, 0.05), shared=None):
    """The posts as two maps have them, the second one's at ``pose``; and the covariance.

    ``moves``: post -> by how much it was moved, m. ``shared`` (18,): an error of the first map that
    all its points share, in sigmas of one.
    """
    now = POSTS.copy()
    for post, by in moves.items():
        now[post] += by
    rng = np.random.default_rng(11)
    cov = 2 * SIGMA_M**2 * np.eye(2 * len(POSTS))
    before = POSTS + rng.normal(scale=SIGMA_M, size=POSTS.shape)
    now = transform(inverse(np.array(pose)), now + rng.normal(scale=SIGMA_M, size=POSTS.shape))
    if shared is not None:
        before = before + shared.reshape(-1, 2)
        cov = cov + np.outer(shared, shared)
    return before, now, cov


def test_all_points_are_where_they_were_wherever_the_second_map_lies():
    found = common_points(*maps({}))
    assert found.which.tolist() == list(range(9))
    # nine points of 4 cm (with the floor) at 8 m from their middle
    assert found.pose == pytest.approx([0.4, -0.3, 0.05], abs=0.06)
    assert not found.is_open


@pytest.mark.parametrize("moves", [{2: (0.3, -0.2)}, {2: (0.3, -0.2), 5: (0.3, -0.2)}, {
    0: (0.2, 0.0), 4: (-0.3, 0.1), 7: (0.0, 1.5)}])  # fmt: skip
def test_points_that_were_moved_are_not(moves):
    found = common_points(*maps(moves))
    assert found.which.tolist() == [k for k in range(9) if k not in moves]
    assert found.pose == pytest.approx([0.4, -0.3, 0.05], abs=0.06)


def test_points_that_were_moved_alike_are_another_pose_if_they_are_nearly_as_many():
    """Five of nine stayed, or four did: nothing in the two maps tells."""
    assert common_points(*maps(dict.fromkeys(range(4), (1.0, 0.5)))).is_open
    assert not common_points(*maps(dict.fromkeys(range(2), (1.0, 0.5)))).is_open


def test_two_points_tell_nothing():
    before, now, cov = maps({})
    assert common_points(before[:2], now[:2], cov[:4, :4]) is None
    alone = {k: (3.0 * np.cos(k), 3.0 * np.sin(2 * k + 1)) for k in range(8)}
    assert common_points(*maps(alone)) is None


def bend():
    """An error (18,) of a map whose half beyond 10 m has drifted 0.3 m aside."""
    error = np.zeros((9, 2))
    error[POSTS[:, 0] > 10.0, 1] = 0.3
    return error.ravel()


def test_a_bend_that_a_map_knows_of_moves_no_point():
    """Breaks where points are compared by marginals and each has to be near all the others."""
    assert common_points(*maps({}, shared=bend())).which.tolist() == list(range(9))


def test_a_point_that_moves_less_than_its_map_has_drifted_is_found():
    """The points around it have drifted as much; its marginal alone allows three times that."""
    moved = int(np.flatnonzero(POSTS[:, 0] > 10.0)[0])
    found = common_points(*maps({moved: (0.05, 0.28)}, shared=bend()))
    assert found.which.tolist() == [k for k in range(9) if k != moved]


def test_a_point_is_one_other_at_most():
    """A point beside another one is a candidate for both places."""
    before, now, cov = maps({})
    before = np.concatenate([before, before[:1] + np.array([[0.6, 0.0]])])
    now = np.concatenate([now, now[:1]])
    wider = np.zeros((20, 20))
    wider[:18, :18] = cov
    wider[18:, 18:] = 2 * SIGMA_M**2 * np.eye(2)
    wider[18:, :2] = wider[:2, 18:] = SIGMA_M**2 * np.eye(2)
    assert common_points(before, now, wider).which.tolist() == list(range(9))
