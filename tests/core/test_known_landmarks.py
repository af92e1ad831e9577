"""What an earlier map says of its landmarks."""

import numpy as np

from graphslam.core.geometry import adjoint, compose, exp, inverse
from graphslam.core.known_landmarks import MOST_HOLDING, UNKNOWN, KnownLandmarks
from graphslam.core.sparse_gaussian import sparse_root


def test_a_landmark_given_the_others_is_that_of_the_joint_gaussian():
    """Of two walls and a point, by the formula for conditional Gaussians in a dense covariance."""
    rng = np.random.default_rng(1)
    means = {4: np.array([1.0, 2.0, 0.3]), 9: np.array([3.0, -1.0]), 2: np.array([0.0, 1.0, 2.0])}
    slices = {4: slice(0, 3), 9: slice(3, 5), 2: slice(5, 8)}
    A = 0.1 * rng.normal(size=(8, 8))
    cov = A @ A.T + 1e-3 * np.eye(8)
    # with all parents nothing is left out
    known = KnownLandmarks(means, tuple(means), sparse_root(cov, [3, 2, 3]))
    error = 0.05 * rng.normal(size=8)
    placed = {
        n: (m + error[slices[n]] if len(m) == 2 else compose(m, exp(error[slices[n]])), np.eye(2))
        for n, m in means.items()
    }
    for n, (off, own) in known.given_the_others(placed).items():
        i = np.arange(8)[slices[n]]
        others = np.setdiff1d(np.arange(8), i)
        gain = cov[np.ix_(i, others)] @ np.linalg.inv(cov[np.ix_(others, others)])
        np.testing.assert_allclose(off, gain @ error[others] - error[i], rtol=0, atol=1e-9)
        left = cov[np.ix_(i, i)] - gain @ cov[np.ix_(others, i)]
        np.testing.assert_allclose(own, known.root.widening * left, rtol=1e-6)


#: m, m, rad: how well the pose of a map is known in the world
SIGMAS = np.array([0.2, 0.3, 0.05])


def turned_map(count=40):
    """Walls that are known to millimetres relative to each other, but not where they all are."""
    rng = np.random.default_rng(2)
    means = {
        n: np.array([*rng.uniform(-20, 20, 2), rng.uniform(-np.pi, np.pi)]) for n in range(count)
    }
    G = np.concatenate([adjoint(inverse(mean)) for mean in means.values()])
    cov = G * SIGMAS**2 @ G.T + 1e-6 * np.eye(3 * count)
    known = KnownLandmarks(means, tuple(means), sparse_root(cov, [3] * count))
    return known, np.sqrt(known.root.widening)


def test_the_pose_of_a_map_is_known_as_it_was():
    """As one motion of all landmarks, and no better by their number."""
    known, widening = turned_map()
    sigmas = np.sqrt(np.diag(known.pose_covariance()))
    np.testing.assert_allclose(sigmas, widening * SIGMAS, rtol=0.01)  # 40 walls of 1 mm each


def test_rows_tell_nothing_more_of_a_map_that_was_turned():
    """As rows at the means do, taken elsewhere: four times as much where walls slid along."""
    known, widening = turned_map()
    rng = np.random.default_rng(3)
    slid = {n: compose(m, [rng.normal(0, 0.3), 0, 0]) for n, m in known.means.items()}
    values = {n: compose([0.5, -0.3, 0.06], at) for n, at in slid.items()}
    moved = {n: adjoint(inverse(at)) for n, at in values.items()}

    def sigmas(rows):
        J = [row @ np.concatenate([moved[n] for n in numbers]) for numbers, row in rows]
        return np.sqrt(np.diag(np.linalg.inv(sum(j.T @ j for j in J))))

    np.testing.assert_allclose(sigmas(known.rows_at(values)), widening * SIGMAS, rtol=0.01)
    assert sigmas(known.rows())[2] < 0.5 * widening * SIGMAS[2]


def test_rows_of_the_pose_are_those_of_the_motion_of_all():
    """Of a map that was moved as a whole: its motion in sigmas, by few of its landmarks."""
    known, _ = turned_map(3 * MOST_HOLDING)
    twist = np.array([0.1, -0.2, 0.03])
    numbers, rows = known.pose_rows()
    assert len(numbers) <= MOST_HOLDING
    errors = np.concatenate([adjoint(inverse(known.means[n])) @ twist for n in numbers])
    information = np.linalg.inv(known.pose_covariance())
    assert np.isclose((rows @ errors) @ (rows @ errors), twist @ information @ twist, rtol=1e-6)


def test_a_map_without_landmarks_is_known_nowhere():
    """All of it was retired, and nothing new seen."""
    known = KnownLandmarks({}, (), sparse_root(np.zeros((0, 0)), []))
    assert known.rows() == []
    np.testing.assert_allclose(known.pose_covariance(), UNKNOWN**2 * np.eye(3))
