"""The kernel of scan matching: normal equations of points on lines and on points."""

import numpy as np

from graphslam.core.geometry import transform
from graphslam.perception.correlation import grid_spectrum, occupancy_grid
from graphslam.perception.point_to_line import (
    line_metrics,
    normal_equations,
    offset_jacobian,
    point_terms,
)


def case(rng):
    """A pose, points on it, their counterparts, normals and metrics: of lines, and of points."""
    pose = rng.normal(size=3)
    points = rng.normal(size=(12, 2))
    angle = rng.uniform(-np.pi, np.pi, 12)
    normals = np.column_stack([np.cos(angle), np.sin(angle)])
    metrics = np.where((np.arange(12) < 6)[:, None, None], line_metrics(normals), np.eye(2))
    return pose, points, transform(pose, points) + 0.1 * rng.normal(size=(12, 2)), normals, metrics


def by_differences(f, pose, step=1e-6):
    """Derivative of f (...) by a pose (3,), the last axis."""
    shifts = step * np.eye(3)
    return np.stack([(f(pose + s) - f(pose - s)) / (2 * step) for s in shifts], axis=-1)


def test_gradient_and_information_are_those_of_the_weighted_squares():
    """Breaks with a wrong sign or arm, or with entries in another order."""
    rng = np.random.default_rng(0)
    pose, points, target, _, metrics = case(rng)
    weight = rng.uniform(0.5, 2.0, 12)

    def residuals(x):
        return transform(x, points) - target

    terms, squared = point_terms(residuals(pose), metrics, transform(pose, points) - pose[:2])
    A, g = normal_equations(terms @ weight)
    J, r = by_differences(residuals, pose), residuals(pose)
    np.testing.assert_allclose(squared, np.einsum("ni,nij,nj->n", r, metrics, r))
    np.testing.assert_allclose(g, np.einsum("n,nia,nij,nj->a", weight, J, metrics, r), atol=1e-8)
    np.testing.assert_allclose(A, np.einsum("n,nia,nij,njb->ab", weight, J, metrics, J), atol=1e-7)


def test_many_poses_have_the_equations_of_each():
    rng = np.random.default_rng(1)
    cases = [case(rng) for _ in range(3)]
    many = [
        point_terms(transform(x, p) - q, M, transform(x, p) - x[:2])[0] for x, p, q, _, M in cases
    ]
    A, g = normal_equations(np.stack(many, axis=1).sum(axis=-1))
    for k, terms in enumerate(many):
        one = normal_equations(terms.sum(axis=-1))
        np.testing.assert_allclose(A[k], one[0])
        np.testing.assert_allclose(g[k], one[1])


def test_the_derivative_of_an_offset_is_that_of_differences():
    pose, points, target, normals, _ = case(np.random.default_rng(2))
    J = by_differences(lambda x: ((transform(x, points) - target) * normals).sum(axis=1), pose)
    arms = transform(pose, points) - pose[:2]
    np.testing.assert_allclose(offset_jacobian(normals, arms), J, atol=1e-8)


def test_a_window_and_the_whole_grid_give_the_same_correlation():
    """Breaks with a spectrum that is conjugated, or a grid whose origin is elsewhere."""
    rng = np.random.default_rng(3)
    occupied, points = rng.uniform(-3, 3, (40, 2)), rng.uniform(-1, 1, (15, 2))
    grid = occupancy_grid(occupied, 0.25, 8, rng.uniform(-9, 9, (60, 2)), -0.5)
    spectrum = grid_spectrum(grid)
    scores = spectrum.correlate(points)
    x, y = 10, 12
    window = grid.correlate_window((points + grid.low + 0.25 * np.array([x, y]))[None], (4, 5))[0]
    np.testing.assert_allclose(window, scores[x : x + 4, y : y + 5], atol=1e-6)


def test_the_mean_over_many_points_is_that_of_the_values_under_them():
    """Breaks where sums of many values do not fit in what they are summed in, or wrong cells."""
    rng = np.random.default_rng(4)
    grid = occupancy_grid(rng.uniform(-3, 3, (2000, 2)), 0.25, 8, rng.uniform(-5, 5, (60, 2)), -0.5)
    points = rng.uniform(-2, 2, (3, 700, 2))
    found = grid.correlate_window(points, (5, 4))
    cells = grid.cells(points)
    for i, j in np.ndindex(5, 4):
        under = grid.values[cells[..., 0] + i, cells[..., 1] + j]
        np.testing.assert_allclose(found[:, i, j], under.mean(axis=1), rtol=1e-6)
