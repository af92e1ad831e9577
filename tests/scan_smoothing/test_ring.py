"""One round of a ring of corridors, whose end sees hardly more of the start than two walls."""

from dataclasses import replace

import numpy as np

import graphslam
from graphslam.core.geometry import between
from graphslam.simulation import load_scenario, simulate
from graphslam.simulation.scenario import Leg

#: corners of the outer ring of scenario office-loop, from where its vehicle starts, m
RING_M = ((33.1, 6.1), (33.1, 17.9), (6.9, 17.9), (6.9, 6.1))


def test_closures_that_no_landmark_replaces_stay_in_the_final_solution(tmp_path):
    """The round ends where it began. Its walls are not tied across the gap, so only closures hold
    it; without them the ends are 14 cm apart, with them 6 cm, and 10 cm is in the middle."""
    office = load_scenario("office-loop")
    vehicle = replace(office.robots["vehicle"], drive=(Leg(through_m=RING_M),))
    log = tmp_path / "ring.mcap"
    simulate(replace(office, robots={"vehicle": vehicle}), log, seed=2)
    result = graphslam.smooth(log)
    found = result.summary["consolidated"]
    assert found["closures_kept"] >= 1
    poses = result.robots["vehicle"].final.poses
    assert np.hypot(*between(poses[0], poses[-1])[:2]) < 0.1
