"""Biases of surfaces: how they move fitted lines, and by these all that is estimated."""

import numpy as np
import pytest
from room_log import drive

import graphslam
from graphslam.core.config import FrontEndConfig
from graphslam.core.geometry import adjoint, between, compose, inverse, rotate_cov, rotation3
from graphslam.core.geometry import log as logarithm
from graphslam.core.information_root import InformationRoot
from graphslam.core.record import replace
from graphslam.estimation import calibration_graph, surface_bias
from graphslam.estimation.factors import FIRST_STATE
from graphslam.estimation.joint_covariances import joint_covariance
from graphslam.estimation.surface_bias import COMMON, bias_of_lines, surface_errors
from graphslam.estimation.weighed_walls import WeighedWalls
from graphslam.perception.line_fit import fit_lines
from graphslam.scan_smoothing import batch_optimisation

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
    """The result, and what biases of surfaces do to it, with final observations changed."""
    made = []
    with monkeypatch.context() as patch:
        closed, with_bias = batch_optimisation.with_closures, calibration_graph.with_surface_bias
        calls = []

        def last_changed(steps, closures):
            calls.append(1)
            # the first solution, the noise and the last one
            return closed(change(steps) if len(calls) == 3 else steps, closures)

        def seen(estimate, walls, sigma):
            made.append((walls, with_bias(estimate, walls, sigma)))
            return made[0][1]

        patch.setattr(batch_optimisation, "with_closures", last_changed)
        # covariances by the weights that the estimate is made with
        patch.setattr(calibration_graph, "fit_line_noise", lambda _: {})
        patch.setattr(calibration_graph, "with_surface_bias", seen)
        patch.setattr(batch_optimisation, "CONVERGED_ERROR", 1e-12)
        result = graphslam.smooth(log, robust={"kernel": "none"})
    return result, *made[0]


def test_the_solution_moves_as_its_shared_errors_do_when_a_surface_is_biased(log, monkeypatch):
    """The mount, and the middle of the path as seen from its beginning. Most of what single
    observations do cancels in their sum, so that a tenth may be left: wrong signs or angles, or
    observations that are left out, leave several times as much."""
    before, walls, estimate = solved(log, monkeypatch, lambda steps: steps)
    root = estimate.root
    errors = surface_errors(walls, root)[:, :-1] / np.sqrt(1 - COMMON)
    numbers = np.unique(np.concatenate([one.targets for one in walls])).tolist()
    by_mount = errors[root.mounts["robot"]]
    middle = len(root.states["robot"]) // 2
    first, last = (root.states["robot"][n] + np.arange(3) for n in (0, middle))
    poses = before.estimate.states["robot"].poses
    seen_from = adjoint(inverse(between(poses[0], poses[middle])))
    by_middle = errors[last] - seen_from @ errors[first]

    def mount_of(result):
        names = ("laser_x_m", "laser_y_m", "laser_yaw_rad")
        found = result.summary["calibration"]
        return np.array([found[f"robot.{name}"]["value"] for name in names])

    def relative(result):
        poses = result.estimate.states["robot"].poses
        return between(poses[0], poses[middle])

    for expected in (by_mount, by_middle):
        for column in np.argsort(-np.hypot(*expected[:2]))[:2]:
            landmark = numbers[column]

            def biased(steps, landmark=landmark):
                def one(a):
                    if a.target != landmark:
                        return a
                    moved = bias_of_lines(a.z[None], a.extent[None])[0] * BIAS_M
                    return replace(a, z=compose(a.z, moved))

                return tuple(
                    replace(step, associations=tuple(map(one, step.associations))) for step in steps
                )

            after, *_ = solved(log, monkeypatch, biased)
            if expected is by_mount:
                moved = mount_of(after) - mount_of(before)
            else:
                moved = logarithm(between(relative(before), relative(after)))
            expect = expected[:, column] * BIAS_M
            assert np.linalg.norm(moved - expect) < 0.15 * np.linalg.norm(expect)


def test_covariances_have_what_surfaces_share(log, monkeypatch):
    """Those of states, landmarks and mounts agree with the joint ones, which have it too."""
    _, _, estimate = solved(log, monkeypatch, lambda steps: steps)
    root, states = estimate.root, estimate.states["robot"]
    assert root.shared.any()
    for number in (0, len(states.poses) // 2):
        rows = root.states["robot"][number] + np.arange(3)
        joint = rotate_cov(joint_covariance(root, rows), states.poses[number, 2])
        np.testing.assert_allclose(states.covs[number], joint, rtol=1e-6, atol=1e-12)
    for number, (mean, cov) in list(estimate.landmarks.items())[:3]:
        rows = root.landmarks[number] + np.arange(3)
        joint = rotate_cov(joint_covariance(root, rows), mean[2])
        np.testing.assert_allclose(cov, joint, rtol=1e-6, atol=1e-12)
    rows = root.mounts["robot"]
    joint = joint_covariance(root, rows[rows >= 0])
    of_mount = estimate.mounts.cov[np.ix_(rows >= 0, rows >= 0)]
    np.testing.assert_allclose(of_mount, joint, rtol=1e-6)
    state = int(root.states["robot"][3])
    both = np.append(state + np.arange(3), rows[rows >= 0])
    cross = rotation3(states.poses[3, 2]) @ joint_covariance(root, both)[:3, 3:]
    np.testing.assert_allclose(
        estimate.mounts.states["robot"][3][:, rows >= 0], cross, rtol=1e-5, atol=1e-12
    )


def lines_of(numbers):
    """Two observations of each landmark from the first state, at a slant."""
    n = 2 * len(numbers)
    rng = np.random.default_rng(3)
    z = np.column_stack([rng.uniform(1, 3, (n, 2)), rng.uniform(-1, 1, n)])
    cov = np.tile(1e-4 * np.eye(3), (n, 1, 1))
    return WeighedWalls(
        "line", ("robot",), np.full(n, FIRST_STATE), np.repeat(numbers, 2), z, cov,
        np.zeros((n, 3)), np.repeat(z[::2], 2, axis=0), np.tile([-1.0, 1.0], (n, 1)),
    )  # fmt: skip


def test_more_surfaces_than_errors_share_them_with_either_sign(monkeypatch):
    """Far-away surfaces of one error leave the variances as they are; its columns are bounded."""
    monkeypatch.setattr(surface_bias, "MOST_ERRORS", 4)
    n = 12
    size = 3 * (n + 1)
    root = InformationRoot(
        np.array([-1]), np.array([size]), np.array([0]), np.zeros(0, dtype=np.int64),
        np.eye(size).ravel(), {"robot": np.array([0])}, {k: 3 * k + 3 for k in range(n)},
    )  # fmt: skip
    found = surface_errors([lines_of(np.arange(n))], root)
    assert found.shape == (size, 5)
    monkeypatch.setattr(surface_bias, "MOST_ERRORS", 100)
    alone = surface_errors([lines_of(np.arange(n))], root)
    assert alone.shape == (size, n + 1)
    # what is common to all, and what each landmark has by itself
    np.testing.assert_allclose(found[:, -1], alone[:, -1])
    np.testing.assert_allclose(np.diag(found @ found.T)[3:], np.diag(alone @ alone.T)[3:])
    shared = np.diag(alone @ alone.T)[3:] - alone[3:, -1] ** 2
    np.testing.assert_allclose(alone[3:, -1] ** 2, COMMON / (1 - COMMON) * shared)
