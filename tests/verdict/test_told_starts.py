"""Starts that were told of several robots, against where the robots saw that they are."""

from dataclasses import replace

import numpy as np
import pytest
from test_verdict import evidence

from graphslam.core.config_io import load_config
from graphslam.core.geometry import compose
from graphslam.core.records import Start
from graphslam.logs import open_logs
from graphslam.simulation import load_scenario, simulate
from graphslam.slam.smooth import smooth
from graphslam.verdict.told_starts import ToldStart, contradictions
from graphslam.verdict.verdict import judge

SIGMAS = np.array([0.05, 0.05, 0.03])
TRUE = {"a": [7.0, 6.0, 0.0], "b": [33.0, 6.0, np.pi], "c": [7.0, 18.0, -1.0]}


def told(moved=(0.0, 0.0, 0.0), frames="www", **errors):
    """Starts off the true ones by ``errors`` (3,); the map is true, but ``moved`` as a whole."""
    cov = np.diag(SIGMAS**2)
    return [
        ToldStart(
            name, frame, Start(np.array(pose) + errors.get(name, 0.0), cov),
            compose(np.array(moved), np.array(pose)),
        )
        for (name, pose), frame in zip(TRUE.items(), frames, strict=True)
    ]  # fmt: skip


def test_starts_as_exact_as_stated_do_not_contradict_each_other():
    rng = np.random.default_rng(0)
    for _ in range(500):
        drawn = {name: SIGMAS * rng.normal(size=3) for name in TRUE}
        assert contradictions(told(**drawn)) == []


@pytest.mark.parametrize("moved", [(0.0, 0.0, 0.0), (0.5, 0.0, 0.0), (9.0, -4.0, 2.0)])
def test_the_one_start_that_is_wrong_is_named_wherever_the_map_lies(moved):
    """Pulled by all starts the map lies between them; only where they are from each other tells."""
    starts = told(moved, b=np.array([1.0, 0.0, 0.0]))
    assert {pair.robots for pair in contradictions(starts)} == {("a", "b"), ("b", "c")}
    assert contradictions(starts)[0].off_m == pytest.approx(1.0)
    verdict = judge(replace(evidence(), told=tuple(starts)))
    (reason,) = verdict["reasons"]
    assert verdict["verdict"] == "doubtful" and "that of b is wrong" in reason["text"]


def test_starts_in_different_frames_are_not_compared():
    assert contradictions(told(frames="wvu", b=np.array([1.0, 0.0, 0.0]))) == []


def test_a_start_to_the_side_is_as_likely_as_headings_that_are_off():
    """1 m of 26 m is 1.3 of the sigmas of a heading."""
    starts = told(b=np.array([0.0, 1.0, 0.0]))[:2]
    assert contradictions(starts) == []
    assert contradictions([s._replace(start=_surer(s.start)) for s in starts]) != []


def _surer(start):
    """The same with a tenth of the sigma of its heading."""
    return replace(start, cov=start.cov * np.array([1.0, 1.0, 0.01]))


@pytest.mark.parametrize(("off_m", "verdict"), [(0.0, "good"), (0.7, "doubtful")])
def test_two_told_starts_that_the_robots_contradict_are_doubted(off_m, verdict, tmp_path):
    path = tmp_path / "log.mcap"
    simulate(load_scenario("two-robots"), path, 1)
    poses = f"{{vehicle = [0.0, 0.0, 0.0], pioneer = [{1.5 + off_m}, 0.0, 0.0]}}"
    config = load_config(overrides=[f"start.poses={poses}"])
    found = smooth(open_logs([path], config), config).summary["verdict"]
    assert found["verdict"] == verdict
    assert any("pioneer and vehicle" in one["text"] for one in found["reasons"]) == (off_m > 0)
