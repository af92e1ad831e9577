"""iSAM2 that is looked into rarely: what it answers in between, and that nothing is lost."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from graphslam.backends.isam2 import Isam2Backend
from graphslam.backends.rare_looks import RareLooksBackend
from graphslam.config import RobustConfig, load_config
from graphslam.geometry import between, rotate_cov
from graphslam.logs import open_logs
from graphslam.slam import smooth

LAB = Path(__file__).parents[1] / "logs/lab.mcap"
CONFIG = load_config(overrides=["backend.reconsider=false"])


@pytest.fixture(scope="module")
def steps():
    """Of a robot in a cluttered room, as recorded: 20 m to and fro."""
    return smooth(open_logs([LAB], CONFIG), CONFIG).steps


class Counting(RareLooksBackend):
    """Counts how often the tree is asked for a covariance."""

    looks = 0

    def covariance(self, keys):
        self.looks += 1
        return super().covariance(keys)


def test_it_says_what_looking_every_time_says(steps):
    """Joint marginals of the pose and the landmarks of the step, at every step: poses within 0.6
    sigma (median: a fifth), lines within 1.5 (a tenth), sigmas within 40 % (5 %). The filter
    linearises once, its lines have a narrower gauge. Breaks with a step that the filter or the tree
    misses, or takes twice, and if the filter goes on without evidence that is late."""
    (robot,) = steps[0].starts
    plain, rare = Isam2Backend(CONFIG), Counting(CONFIG)
    known, off, ratio, lines = set(), [], [], []
    for step in steps:
        plain.add(step)
        rare.add(step)
        known |= {a.target for a in step.associations}
        ids = sorted({a.target for a in step.associations})
        a, b = plain.joint(robot, ids), rare.joint(robot, ids)
        assert [len(mean) for mean in b.landmarks] == [len(mean) for mean in a.landmarks]
        sigma = np.sqrt(np.diag(a.cov))[:3]
        off.append(np.abs(b.pose - a.pose) / sigma)
        ratio.append(np.sqrt(np.diag(b.cov))[:3] / sigma)
        for mean, other, block in zip(a.landmarks, b.landmarks, a.slices, strict=True):
            if len(mean) == 3:  # where a line's origin is on it means nothing
                moved, cov = between(mean, other)[1:], rotate_cov(a.cov[block, block], -mean[2])
                lines.append(np.abs(moved) / np.sqrt(np.diag(cov))[1:])
    assert np.max(off) < 0.6 and np.median(off) < 0.2
    assert np.min(ratio) > 0.6 and np.max(ratio) < 1.4 and abs(np.median(ratio) - 1) < 0.05
    assert np.max(lines) < 1.5 and np.median(lines) < 0.1
    assert rare.looks < 0.6 * len(steps)
    assert len(rare.landmark_means(sorted(known))) == len(known)


def test_in_the_end_it_is_the_same(steps):
    """Every factor is in the graph, whenever it got there, so without a kernel, where there is one
    optimum, both find it. Breaks if the last steps still wait."""
    config = replace(CONFIG, robust=RobustConfig("none"))
    (robot,) = steps[0].starts
    estimates = []
    for backend in (Isam2Backend(config), RareLooksBackend(config)):
        for step in steps:
            backend.add(step)
            backend.joint(robot, [])
        estimates.append(backend.finish())
    one, other = estimates
    assert one.dof == other.dof and sorted(one.landmarks) == sorted(other.landmarks)
    # lines are faced anew a few times, from different sides: a fiftieth of a sigma is left
    np.testing.assert_allclose(other.states[robot].poses, one.states[robot].poses, atol=2e-4)


def test_looking_every_time_can_be_asked_for(steps):
    config = replace(CONFIG, backend=replace(CONFIG.backend, look_every=1))
    (robot,) = steps[0].starts
    plain, rare = Isam2Backend(config), RareLooksBackend(config)
    for step in steps[:40]:
        plain.add(step)
        rare.add(step)
        np.testing.assert_array_equal(rare.joint(robot, []).cov, plain.joint(robot, []).cov)
