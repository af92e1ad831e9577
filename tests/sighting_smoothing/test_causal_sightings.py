"""Causal trajectories of sightings whose errors are shared: by the noise that was seen so far."""

from dataclasses import replace

import numpy as np
import pytest
from test_sighting_noise import judged, simulate, solved

from graphslam.core.geometry import wrap
from graphslam.core.records import Association, Step
from graphslam.estimation.recorded_graph import SHARED_NS
from graphslam.sighting_smoothing import causal_noise
from graphslam.sighting_smoothing.causal_noise import count_so_far
from graphslam.sighting_smoothing.causal_sightings import _merged

S = 1_000_000_000


def test_sightings_are_counted_up_to_their_step():
    """Of the same target, back to where errors are no longer shared."""
    seen = np.array([0, 3 * S, 3 * S, 4 * S, SHARED_NS + 2 * S], dtype=np.int64)
    targets = np.array([1, 1, 2, 1, 1])
    until = np.array([0, 4 * S, 4 * S, 4 * S, SHARED_NS + 2 * S], dtype=np.int64)
    # the second one's step ends with the third of its target, the last one no longer has the first
    np.testing.assert_array_equal(count_so_far(targets, seen, until), [1, 3, 1, 3, 3])


@pytest.fixture(scope="module")
def bursty():
    return simulate(1, seconds=120.0, shared=2.0, noise=0.3)


@pytest.fixture(scope="module")
def found(tmp_path_factory, bursty):
    return solved(tmp_path_factory.mktemp("bursty") / "log.mcap", bursty, increments=True)


def test_shared_errors_are_weighed_as_the_log_has_shown_them(tmp_path, monkeypatch, bursty, found):
    """They are twice what the log states, and by that all of them would be independent."""
    monkeypatch.setattr(causal_noise, "MEASURED_AFTER", 10**9)
    stated = solved(tmp_path / "log.mcap", bursty, increments=True)
    (_, before), (_, after) = (judge_causal(result, bursty) for result in (stated, found))
    assert after < 0.6 * before
    assert after < 1.5


def judge_causal(result, world):
    """Error and NEES of the second half, in which the noise is known."""
    causal, half = result.robots["robot"].causal, len(world.poses) // 2
    return judged(causal.poses[half:], causal.covs[half:], replace(world, poses=world.poses[half:]))


def test_what_comes_later_is_not_known(tmp_path, bursty, found):
    """The noise is measured after 3000 sightings, 60 s. A log that ends after 90 s has the same."""
    seen = [one for one in bursty.seen if one[0] <= 900]
    short = replace(bursty, poses=bursty.poses[:901], twists=bursty.twists[:900], seen=seen)
    half = solved(tmp_path / "half.mcap", short, increments=True).robots["robot"].causal
    whole = found.robots["robot"].causal
    known = half.stamps_ns < half.stamps_ns[0] + 88 * S
    np.testing.assert_allclose(half.poses[known], whole.poses[: known.sum()], rtol=0, atol=1e-9)


def test_sightings_of_one_target_in_a_step_are_one_that_tells_as_much():
    """The mean by information, also of bearings on both sides of π; others are left alone."""
    covs = [np.diag([0.01, 0.04]), np.array([[0.02, 0.005], [0.005, 0.01]])]
    z = [np.array([np.pi - 0.01, 2.0]), np.array([0.02 - np.pi, 2.1])]
    one, two = (Association("a", S, 7, "point", z[k], covs[k]) for k in range(2))
    others = [Association(*who, "point", z[0], covs[0]) for who in (("a", S, 8), ("b", S, 7))]
    step = Step(S, {}, {}, (one, others[0], two, others[1]))
    assert _merged(step, {("b", "point")}).associations == step.associations
    merged = _merged(step, {("a", "point")}).associations
    (found,) = (a for a in merged if (a.robot, a.target) == ("a", 7))
    np.testing.assert_allclose(
        np.linalg.inv(found.cov), sum(np.linalg.inv(cov) for cov in covs), rtol=1e-12
    )
    information = [np.linalg.inv(cov) for cov in covs]
    expected = found.cov @ (information[0] @ [-0.01, 2.0] + information[1] @ [0.02, 2.1])
    np.testing.assert_allclose([wrap(found.z[0] - np.pi), found.z[1]], expected, rtol=0, atol=1e-12)
    assert set(map(id, others)) <= set(map(id, merged)) and len(merged) == 3
