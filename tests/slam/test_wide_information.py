"""Pose graphs whose stated information spans ten decades, against GTSAM on the file itself."""

from itertools import pairwise

import numpy as np
import pytest
from wide_information import KINDS, errors, ring_pose_graph

from graphslam.core.config import Config
from graphslam.core.errors import LogError
from graphslam.core.geometry import compose, exp
from graphslam.core.records import Motion, Start, Step
from graphslam.estimation import factors
from graphslam.estimation.initial_estimate import initial_estimate
from graphslam.estimation.isam2 import Reoptimiser
from graphslam.importers import IMPORTERS
from graphslam.logs import LogWriter, open_logs
from graphslam.odometry.given_increments import consecutive_motions
from graphslam.pipeline.recorded_closures import take_relative_poses
from graphslam.pipeline.robot_settings import make_tracks
from graphslam.slam.smooth import smooth


@pytest.mark.parametrize("kind", KINDS)
def test_the_optimum_is_reached_whatever_the_stated_noise(kind, tmp_path):
    """300 poses: no more than 1e-4 above the best of GTSAM's solutions by QR, those from the true
    poses and from ours included. (Wrong where Cholesky loses the weakest information, where
    covariances are differences of sums, or where a true closure is refused.)"""
    source = tmp_path / "graph.g2o"
    text, truth = ring_pose_graph(kind, 300, 1)
    source.write_text(text)
    ours, own, _ = errors(source, truth)
    assert ours <= min(own) * (1 + 1e-4)


def test_a_motion_of_one_increment_is_the_increment_as_recorded(tmp_path):
    """After steps with sigmas of 0.3 m and rad, one of 1e-6: what a prefix sum makes of it is
    rounding of the others. An exact stand still keeps its stated noise too."""
    tight, s = np.diag([1e-12, 2e-12, 3e-13]), 10**9
    with LogWriter(tmp_path / "log.mcap") as log:
        for k in range(200):
            log.increment(
                "a", k * s, (k + 1) * s, delta=np.array([1.0, 0.1, 0.2]), cov=0.1 * np.eye(3)
            )
        log.increment("a", 200 * s, 201 * s, delta=np.array([0.5, 0.0, -0.3]), cov=tight)
        log.increment("a", 201 * s, 202 * s, delta=np.zeros(3), cov=tight)
    opened = open_logs([tmp_path / "log.mcap"], Config())
    tracks = make_tracks(opened, Config())
    take_relative_poses(opened.messages(()), tracks)
    made = consecutive_motions(tracks["a"], np.arange(203) * s)
    np.testing.assert_allclose(made.cov[200:], [tight, tight], rtol=1e-12, atol=0)
    np.testing.assert_allclose(made.delta[200], [0.5, 0.0, -0.3], rtol=0, atol=1e-15)
    # several increments, and times that cut them: as one by one
    times = np.array([0, 3, 3.5, 10, 200, 202]) * s
    several = consecutive_motions(tracks["a"], times.astype(np.int64))
    for k, (begin, end) in enumerate(pairwise(times)):
        one = tracks["a"].motion(int(begin), int(end))
        np.testing.assert_allclose(several.delta[k, :2], one.delta[:2], atol=1e-12)
        np.testing.assert_allclose(several.cov[k], one.cov, rtol=1e-9, atol=1e-18)
        assert several.length_m[k] == pytest.approx(one.length_m)


def test_whitening_keeps_the_weakest_direction():
    """A covariance with eigenvalues from 1e-12 to 0.1, turned anyhow: one sigma along each axis
    has an error of one half. (GTSAM inverts it first, and is wrong by a factor of thousands.)"""
    rng = np.random.default_rng(0)
    for _ in range(50):
        sigmas = 10 ** rng.uniform(-6, -0.5, 3)
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        cov = (turn * sigmas**2) @ turn.T
        whiten = factors.gaussian((cov + cov.T) / 2).whiten
        for sigma, axis in zip(sigmas, turn.T, strict=True):
            # the smallest eigenvalue of what is written down is rounding of the largest, too
            rounding = 1e-15 * sigmas.max() ** 2 / sigma**2
            assert np.linalg.norm(whiten(sigma * axis)) == pytest.approx(1.0, abs=1e-6 + rounding)


def test_a_start_far_from_stiff_motions_is_no_trap():
    """Steps with sigmas of 1e-6 and headings wrong by 0.3 rad in the start: Levenberg-Marquardt
    creeps along the valley that stiff factors leave, unless they are softened first."""
    rng, s = np.random.default_rng(2), 10**9
    path = [np.zeros(3)]
    cov = np.diag([1e-6, 1e-6, 1e-6]) ** 2
    steps = [Step(0, {"a": Start(np.zeros(3), 1e-6 * np.eye(3))})]
    for k in range(150):
        delta = np.array([0.3, 0.0, 0.05 * rng.normal()])
        path.append(compose(path[-1], delta))
        steps.append(
            Step(
                (k + 1) * s,
                {},
                {"a": Motion(k * s, (k + 1) * s, delta, cov, np.zeros((3, 0)), 0.3)},
            )
        )
    start = initial_estimate(steps, [])
    bent = compose(
        start.states["a"].poses, exp(np.array([0.0, 0.0, 0.3]) * rng.normal(size=(151, 3)))
    )
    start.states["a"].poses[1:] = bent[1:]
    found = Reoptimiser(Config(), steps, start)
    found._builder.is_wide = True
    assert found.solve().error < 1e-6


@pytest.mark.parametrize(
    ("upper", "weakest"),
    [
        ("100 100 0 100 0 400", 1e-12),  # rank 2
        ("3e12 1.7320509e12 0 1e12 0 400", 1e-12),  # rounded to eight digits
        ("4 1 0 4 0 9", None),
    ],
)
def test_singular_information_is_solved_and_said(upper, weakest, tmp_path):
    """One edge of a chain knows nothing across some axis; a closure does. What GTSAM makes of the
    file is no measure: its Cholesky factor of such a matrix is undefined."""
    source = tmp_path / "graph.g2o"
    source.write_text(
        f"EDGE_SE2 0 1 1 0 0 {upper}\n"
        "EDGE_SE2 1 2 1 0 0 4 0 0 4 0 9\n"
        "EDGE_SE2 0 2 2 0.5 0 100 0 0 100 0 100\n"
    )
    summary = IMPORTERS["g2o"](source, tmp_path / "log.mcap")
    assert any("without information" in w for w in summary.warnings) == (weakest is not None)
    result = smooth(open_logs([tmp_path / "log.mcap"], Config()), Config())
    assert np.isfinite(result.estimate.states["robot"].covs).all()
    assert result.estimate.error < 1.0


def test_information_that_is_clearly_not_positive_is_refused(tmp_path):
    source = tmp_path / "graph.g2o"
    source.write_text("EDGE_SE2 0 1 1 0 0 4 5 0 4 0 9\n")
    with pytest.raises(LogError, match=r"line 1 .*positive definite"):
        IMPORTERS["g2o"](source, tmp_path / "log.mcap")
