"""Odometry that the calibration made much longer or shorter is told, though no reason for doubt."""

from dataclasses import replace

import pytest
from test_verdict import SUMMARY, evidence

from graphslam.verdict.verdict import judge


def judged(value, sigma=0.001):
    """The verdict on a run whose calibration found this scale of lengths."""
    found = {"tom.translation_scale": {"value": value, "sigma": sigma, "observable": True}}
    made = evidence()
    return judge(replace(made, summary={**made.summary, "calibration": found}))


@pytest.mark.parametrize(
    ("value", "words"), [(0.05, "drove 5.0 % farther"), (-0.05, "drove 5.0 % less far")]
)
def test_a_large_scale_is_a_fact_and_no_doubt(value, words):
    """It may be the odometry's error, which is corrected, or the ranges', which bends the map."""
    verdict = judged(value)
    assert verdict["verdict"] == "good"
    (fact,) = verdict["facts"]
    assert (fact["check"], fact["about"], fact["share"]) == ("odometry_scale", "tom", None)
    assert words in fact["text"]


@pytest.mark.parametrize(("value", "sigma"), [(0.02, 0.001), (0.05, 0.02)])
def test_what_wheels_often_have_and_what_is_hardly_known_are_not_told(value, sigma):
    assert judged(value, sigma)["facts"] == []


def test_a_run_without_a_calibration_has_none():
    """Such as those of back ends that estimate none."""
    assert "calibration" not in SUMMARY
    assert judge(evidence())["facts"] == []
