"""Biases of surfaces: how they move fitted lines, and by these the mount."""

import numpy as np
import pytest
from room_log import drive

import graphslam
from graphslam.core.config import FrontEndConfig
from graphslam.core.geometry import compose
from graphslam.core.record import replace
from graphslam.perception.line_fit import fit_lines
from graphslam.slam import batch_optimisation, surface_bias
from graphslam.slam.surface_bias import bias_of_lines, mount_bias, mount_shifts

BIAS_M = 0.002
#: equal weights
PLAIN = FrontEndConfig(covariance="thesis")


@pytest.mark.parametrize("degrees", [(-60, -40), (-30, 35), (10, 75), (-5, 5)])
def test_a_line_moves_as_one_that_is_fitted_to_biased_ranges(degrees):
    """A wall 3 m ahead, seen between these angles from its normal."""
    angles = np.radians(np.linspace(*degrees, 200))

    def fitted(bias):
        ranges = 3.0 / np.cos(angles) + bias
        points = ranges[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
        return fit_lines(points, np.zeros(1, dtype=np.intp), PLAIN)

    clean, moved = fitted(0.0), fitted(BIAS_M)
    half = clean.length / 2
    found = bias_of_lines(clean.z, np.column_stack([-half, half]))[0] * BIAS_M
    # beams of equal angles are not equally spaced along the wall, and BEAMS are not 200
    np.testing.assert_allclose(compose(clean.z[0], found)[:2], moved.z[0, :2], atol=1e-4)
    assert compose(clean.z[0], found)[2] == pytest.approx(moved.z[0, 2], abs=1e-4)
    assert found[1] < 0  # away


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    return drive(tmp_path_factory.mktemp("room") / "room.mcap")


def solved(log, monkeypatch, change):
    """The mount, and what it was found from, with final observations changed."""
    made = []
    with monkeypatch.context() as patch:
        closed, bias = batch_optimisation.with_closures, batch_optimisation.mount_bias
        calls = []

        def last_changed(steps, closures):
            calls.append(1)
            return closed(change(steps) if len(calls) == 2 else steps, closures)

        def seen(steps, estimate, sigma):
            made.append((steps, estimate))
            return bias(steps, estimate, sigma)

        patch.setattr(batch_optimisation, "with_closures", last_changed)
        patch.setattr(batch_optimisation, "mount_bias", seen)
        patch.setattr(batch_optimisation, "CONVERGED_ERROR", 1e-12)
        result = graphslam.smooth(log, robust={"kernel": "none"})
    names = ("laser_x_m", "laser_y_m", "laser_yaw_rad")
    found = result.summary["calibration"]
    return np.array([found[f"robot.{name}"]["value"] for name in names]), made[0]


def test_the_mount_moves_as_the_solution_does_when_a_surface_is_biased(log, monkeypatch):
    mount, (steps, estimate) = solved(log, monkeypatch, lambda steps: steps)
    shifts = dict(zip(*mount_shifts(steps, estimate), strict=True))
    strongest = sorted(shifts, key=lambda n: -np.hypot(*shifts[n][:2]))[:2]
    for landmark in strongest:

        def biased(steps, landmark=landmark):
            def one(a):
                if a.target != landmark:
                    return a
                moved = bias_of_lines(a.z[None], a.extent[None])[0] * BIAS_M
                return replace(a, z=compose(a.z, moved))

            return tuple(
                replace(step, associations=tuple(map(one, step.associations))) for step in steps
            )

        moved, _ = solved(log, monkeypatch, biased)
        expected = shifts[landmark] * BIAS_M
        # single observations move it as expected to a few per cent; most of that cancels in their
        # sum, so that a third may be left: wrong signs or angles leave several times as much
        assert np.linalg.norm(moved - mount - expected) < 0.35 * np.linalg.norm(expected)


def test_half_of_the_variance_is_that_of_all_surfaces_together(monkeypatch):
    """Two walls that face each other move the mount in opposite directions: what they have in
    common cancels. Two that move it in one direction add up."""
    opposite = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    # without a wall in the map there is no bias of one
    for moved, variance in ((opposite, 1.0), (np.abs(opposite), 1.0 + 2.0), (opposite[:0], 0.0)):
        monkeypatch.setattr(surface_bias, "mount_shifts", lambda *_, moved=moved: ([], moved))
        cov = mount_bias((), None, 0.01)
        np.testing.assert_allclose(cov, np.diag([0.01**2 * variance, 0.0, 0.0]), atol=1e-15)
