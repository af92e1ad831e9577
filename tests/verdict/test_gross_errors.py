"""Gross errors: a few, each by itself, are a fact; many, or together, are doubted as before."""

from dataclasses import replace

import numpy as np
import pytest
from test_verdict import SUMMARY, evidence, only

from graphslam.core.config import RobustConfig
from graphslam.core.geometry import between
from graphslam.verdict.verdict import judge, with_truth

FAR_D2 = 2000.0


def with_errors(change, kernel="cauchy"):
    """A healthy run but for what ``change`` gives: which sightings (n,), and their z (n, 2)."""

    def seen(own):
        which, z = change(own)
        d2 = np.where(which, FAR_D2, 1.0)
        return replace(own, d2=d2, z=np.where(which[:, None], z, own.z))

    found = evidence(seen=seen)
    d2 = found.robots[0].seen.d2
    # half of the squared residuals of all sightings, two rows each
    graph = {"error_without_kernels": float(d2.sum()), "dof": 2 * len(d2)}
    summary = {**SUMMARY, "graph": graph}
    return judge(replace(found, summary=summary, kernel=RobustConfig(kernel)))


def outliers(share):
    def change(own):
        rng = np.random.default_rng(3)
        n = len(own.z)
        return rng.random(n) < share, rng.uniform((-1.8, 0.3), (1.8, 6.0), (n, 2))

    return change


def in_a_burst(own):
    """All sightings of 3 s of 60."""
    seconds = (own.times_ns - own.times_ns[0]) * 1e-9
    return (seconds > 20) & (seconds < 23), outliers(1.0)(own)[1]


def of_another(own):
    """An eighth of the sightings of one point are of another one that stands elsewhere."""
    which = own.targets == 0
    which[which] = np.arange(which.sum()) % 8 == 0
    z = own.z.copy()
    for k in np.flatnonzero(which):
        x, y, _ = between(own.poses[k], np.array([3.0, 6.5, 0.0]))
        z[k] = np.arctan2(y, x), np.hypot(x, y)
    return which, z


@pytest.mark.parametrize("share", [0.01, 0.05])
def test_few_gross_errors_each_by_itself_are_a_fact(share):
    verdict = with_errors(outliers(share))
    assert verdict["verdict"] == "good"
    (fact,) = verdict["facts"]
    assert fact["share"] == pytest.approx(share, rel=0.5)  # some dozen by chance
    assert "each by itself" in fact["text"]


@pytest.mark.parametrize("change", [outliers(0.2), in_a_burst, of_another])
def test_many_gross_errors_or_such_that_come_together_are_doubted(change):
    verdict = with_errors(change)
    assert verdict["verdict"] != "good"
    assert "by itself:" not in verdict["facts"][0]["text"]


@pytest.mark.parametrize("kernel", ["none", "huber"])
def test_gross_errors_that_the_kernel_lets_pull_are_doubted(kernel):
    """Huber's influence does not decrease: each of them pulls as much as two sigmas."""
    assert with_errors(outliers(0.05), kernel)["verdict"] != "good"


def test_a_healthy_run_has_no_facts():
    assert judge(evidence())["facts"] == []


def test_facts_stay_where_the_truth_is_known():
    verdict = with_errors(outliers(0.05))
    assert with_truth(verdict, None)["facts"] == verdict["facts"]


def test_a_landmark_that_is_mostly_seen_elsewhere_is_doubted():
    """Two of three sightings, as of one only seen under false names: hardly any residual."""

    def seen(own):
        kept = np.ones(len(own.z), dtype=bool)
        kept[np.flatnonzero(own.targets == 3)[3:]] = False
        own = only(own, kept)
        d2 = np.ones(len(own.z))
        d2[np.flatnonzero(own.targets == 3)[:2]] = FAR_D2
        return replace(own, d2=d2)

    verdict = judge(evidence(seen=seen))
    (reason,) = verdict["reasons"]
    assert "p3" in reason["text"]
