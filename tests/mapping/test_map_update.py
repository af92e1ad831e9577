"""What one more log tells of a map whose walls look nearer or farther on each day."""

import numpy as np
import pytest

from graphslam.core.geometry import between, compose, exp
from graphslam.core.known_landmarks import KnownLandmarks
from graphslam.core.records import Landmark
from graphslam.core.sparse_gaussian import sparse_root
from graphslam.mapping.map_update import with_surface_biases, without_days_biases

BIAS_M = 0.01
WALLS = {3: np.array([1.0, 2.0, 0.4]), 5: np.array([-2.0, 0.5, 2.0])}


def landmark(number, position, kind="line"):
    ends = compose(
        np.array([*position[:2], np.nan_to_num(position[2])]), np.array([[1.0, 0, 0]] * 2)
    )
    line = (0.0, 0.0, np.eye(2)) if kind != "point" else None
    return Landmark(number, kind, position, 1e-4 * np.eye(3), ends[:, :2], line, 1, 0, 1, None)


def known_from(marks, cov):
    means = {m.id: m.position[: 2 if m.kind == "point" else 3] for m in marks}
    return KnownLandmarks(means, tuple(means), sparse_root(cov, [len(m) for m in means.values()]))


def a_day(known, marks, shifts, sigma=1e-4):
    """Landmarks as a log sees them that measures each wall across, with ``shifts`` (n,) m."""
    K = known.covariance([m.id for m in marks])
    H = np.zeros((len(marks), len(K)))
    H[np.arange(len(marks)), 3 * np.arange(len(marks)) + 1] = 1.0
    gain = K @ H.T @ np.linalg.inv(H @ K @ H.T + sigma**2 * np.eye(len(marks)))
    off = np.array([between(known.means[m.id], WALLS[m.id]) for m in marks])[:, 1]
    error = gain @ (off + shifts)
    seen = [
        landmark(m.id, compose(known.means[m.id], exp(error[3 * k : 3 * k + 3])))
        for k, m in enumerate(marks)
    ]
    return seen, K - gain @ H @ K


def test_walls_are_averaged_over_days():
    """However exactly a day measures them: by the mean of n days, to the bias over the root of n.
    If what a day leaves had the error added, the last day alone would say where they are."""
    rng = np.random.default_rng(2)
    marks = [landmark(n, pose) for n, pose in WALLS.items()]
    cov = np.diag([1.0, 1.0, 1e-6] * 2)
    days = BIAS_M * rng.normal(size=(8, 2))
    for shifts in days:
        known = known_from(marks, with_surface_biases(marks, cov, BIAS_M))
        seen, after = a_day(known, marks, shifts)
        marks, cov = without_days_biases(known, None, BIAS_M, seen, after)
    across = [between(WALLS[m.id], m.position)[1] for m in marks]
    # the last days' lines are 1e-3 rad apart at most: the means are along the axes of the first
    np.testing.assert_allclose(across, days.mean(axis=0), atol=0.02 * BIAS_M)
    np.testing.assert_allclose(
        np.sqrt(np.diag(cov)[[1, 4]]), BIAS_M / np.sqrt(len(days)), rtol=0.02
    )


def test_without_biases_a_day_leaves_what_it_saw():
    marks = [landmark(n, pose) for n, pose in WALLS.items()]
    known = known_from(marks, np.diag([1.0, 1e-2, 1e-4] * 2))
    seen, after = a_day(known, marks, [0.02, -0.01])
    found, cov = without_days_biases(known, None, 0.0, seen, after)
    np.testing.assert_allclose(cov, after, atol=1e-9)
    for one, other in zip(found, seen, strict=True):
        np.testing.assert_allclose(one.position, other.position, atol=1e-9)
        np.testing.assert_allclose(one.extent, other.extent, atol=1e-9)


@pytest.mark.parametrize("kind", ["line", "segment"])
def test_the_error_of_a_day_is_across_walls_alone(kind):
    marks = [landmark(1, np.array([0.0, 1.0, np.nan]), "point"), landmark(2, WALLS[3], kind)]
    added = with_surface_biases(marks, np.eye(5), BIAS_M) - np.eye(5)
    np.testing.assert_allclose(added, np.diag([0, 0, 0, BIAS_M**2, 0]), atol=1e-15)


def test_a_new_landmark_stays_where_the_log_saw_it():
    """It has no day before: only walls of the map go back to what all days say."""
    marks = [landmark(3, WALLS[3])]
    known = known_from(marks, with_surface_biases(marks, np.diag([1.0, 1e-8, 1e-8]), BIAS_M))
    seen, after = a_day(known, marks, [0.02])
    new = landmark(9, compose(seen[0].position, np.array([1.0, 0.0, 0.0])))
    joint = np.block([[after, after], [after, after + 1e-6 * np.eye(3)]])
    (wall, other), cov = without_days_biases(known, None, BIAS_M, [*seen, new], joint)
    assert wall.id == 3
    assert other is new
    assert np.linalg.eigvalsh(cov).min() > 0
    # the map knew where the wall was: the day saw it 2 cm off, by its bias
    assert abs(between(WALLS[3], wall.position)[1]) < 0.1 * BIAS_M


def test_a_new_wall_weighs_as_much_as_the_days_after():
    """Breaks if the day that a wall is new says exactly where it is, and later ones hardly do."""
    marks, shifts = [landmark(3, WALLS[3])], np.array([0.012, -0.006])
    nothing = known_from([landmark(5, WALLS[5])], np.eye(3))
    exact = np.diag([1.0, 1e-8, 1e-8])
    at_first = landmark(3, compose(WALLS[3], np.array([0.0, shifts[0], 0.0])))
    (first,), cov = without_days_biases(nothing, None, BIAS_M, [at_first], exact)
    known = known_from([first], with_surface_biases([first], cov, BIAS_M))
    seen, after = a_day(known, marks, shifts[1:])
    (found,), _ = without_days_biases(known, known_from([first], cov), BIAS_M, seen, after)
    # a tenth of a millimetre is what is known of its line, and turns by as much
    assert between(WALLS[3], found.position)[1] == pytest.approx(shifts.mean(), abs=2e-4)


def test_what_is_known_of_walls_is_not_hidden_by_the_error_of_a_day():
    """A day's sparse form is exact to a few per cent of its error, 1 cm: more than is known of a
    wall, 1 mm. Breaks if a wall is averaged by what is left of it."""
    marks = [landmark(3, WALLS[3])]
    cov = np.diag([1.0, 1e-6, 1e-8])
    wider = 1.1 * with_surface_biases(marks, cov, BIAS_M)
    known = known_from(marks, wider)
    seen, after = a_day(known, marks, np.array([BIAS_M]))
    itself = known_from(marks, cov)
    (found,), left = without_days_biases(known, itself, BIAS_M, seen, after)
    # gain 1e-6 over 1.1 * 1.01e-4: 0.09 mm, where it would be 1 mm
    assert 0.0 < between(WALLS[3], found.position)[1] < 1.2e-4
    assert left[1, 1] <= cov[1, 1]
