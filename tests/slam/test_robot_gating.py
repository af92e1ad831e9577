"""Sightings of robots, decided again in the solution of the whole log."""

from dataclasses import replace

import numpy as np
import pytest
from backend_cases import PLAIN, run, see, two_robots

from graphslam.core.config import OdometryConfig, RobotConfig
from graphslam.core.records import OdometryPose, Sighting
from graphslam.odometry.preintegration import Track
from graphslam.slam.robot_gating import RobotOffers
from graphslam.slam.robot_sightings import RobotCandidates
from graphslam.slam.robot_state import RobotState

S = 1_000_000_000


def sighting(time_ns, name=None, may_be="robot"):
    return Sighting("a", time_ns, time_ns, np.ones(2), np.eye(2), None, name, np.zeros(3), may_be)


def offered(steps, kept=()):
    """The steps with the associations ``kept`` of robots (by number), and what they could be.

    Sighting 0 is the first meeting, sighting 1 the second; each may be of b."""
    steps, offers, number = list(steps), {}, 0
    for n, step in enumerate(steps):
        others = [a for a in step.associations if not isinstance(a.target, str)]
        for a in step.associations:
            if isinstance(a.target, str):
                offers[n] = [replace(a, source=number)]
                others += offers[n] if number in kept else []
                number += 1
        steps[n] = replace(step, associations=tuple(others))
    return steps, offers


def used(steps):
    return {a.source for s in steps for a in s.associations if isinstance(a.target, str)}


@pytest.mark.parametrize("kept", [(), (0,), (1,), (0, 1)])
def test_what_fits_all_other_data_is_used_whatever_was_decided_before(kept):
    """Breaks if what was rejected while the log was read stays so."""
    steps, offers = offered(two_robots(np.random.default_rng(1))[0], kept)
    estimate = run("batch", steps, PLAIN).finish()
    robots = RobotOffers(offers, [sighting(2, "b"), sighting(5, "b")])
    assert robots.unused(steps) == 2 - len(kept)
    made = robots.associated_again(steps, estimate, PLAIN.robust, PLAIN)
    assert used(made) == {0, 1} and robots.unused(made) == 0
    assert [len(s.associations) for s in made] == [
        len(s.associations) for s in two_robots(np.random.default_rng(1))[0]
    ]


@pytest.mark.parametrize("kept", [(0,), (0, 1)])
def test_what_contradicts_all_other_data_is_not(kept):
    """The second meeting is 1 m off; used, it has pulled the estimate towards itself."""
    steps, offers = offered(two_robots(np.random.default_rng(1))[0], kept)
    ((n, (false,)),) = [(n, own) for n, own in offers.items() if own[0].source == 1]
    wrong = replace(false, z=false.z + np.array([0.0, 1.0]))
    offers[n] = [wrong]
    steps[n] = replace(
        steps[n],
        associations=tuple(wrong if a.source == 1 else a for a in steps[n].associations),
    )
    estimate = run("batch", steps, PLAIN).finish()
    robots = RobotOffers(offers, [sighting(2, "b"), sighting(5, "b")])
    made = robots.associated_again(steps, estimate, PLAIN.robust, PLAIN)
    assert used(made) == {0} and robots.unused(made) == 1


def test_a_robot_takes_one_sighting_of_an_image():
    """Of two sightings at one time that may be of b the nearer one is; what may be a landmark as
    well is not counted as unused, since it may be one."""
    steps, offers = offered(two_robots(np.random.default_rng(1))[0], (0, 1))
    ((n, (near,)),) = [(n, own) for n, own in offers.items() if own[0].source == 1]
    offers[n] = [near, replace(near, z=near.z + np.array([0.02, 0.0]), source=2)]
    estimate = run("batch", steps, PLAIN).finish()
    for may_be, unused in (("robot", 1), ("either", 0)):
        seen = [sighting(2), sighting(5), sighting(5, may_be=may_be)]
        robots = RobotOffers(offers, seen)
        made = robots.associated_again(steps, estimate, PLAIN.robust, PLAIN)
        assert used(made) == {0, 1} and robots.unused(made) == unused


def test_a_sighting_that_is_of_a_landmark_is_of_no_robot():
    steps, offers = offered(two_robots(np.random.default_rng(1))[0], (0,))
    x, t = np.zeros(3), np.array([4.0, 2.0])
    landmark = replace(see("a", 6, 0, "point", x, t), source=1)
    last = steps[-1]
    steps[-1] = replace(last, associations=(*last.associations, landmark))
    estimate = run("batch", [*steps[:-1], last], PLAIN).finish()
    robots = RobotOffers(offers, [sighting(2), sighting(5, may_be="either")])
    made = robots.associated_again(steps, estimate, PLAIN.robust, PLAIN)
    assert used(made) == {0}


def test_an_unknown_clock_is_an_unknown_place_along_the_path():
    """At 0.4 m/s and half a second 0.2 m ahead; nothing once clocks are known."""
    track = Track(OdometryConfig(), RobotConfig())
    for k in range(21):
        pose = np.array([0.0, 0.04 * k, np.pi / 2])
        track.add(OdometryPose("b", k * S // 10, k * S // 10, pose))
    runs = {"b": RobotState(track)}
    for sigma_s, ahead in ((0.5, 0.2), (0.0, 0.0)):
        candidates = RobotCandidates(runs, {"b": "b"}, PLAIN, sigma_s)
        np.testing.assert_allclose(candidates.clock_shift("b", S), [ahead, 0.0], atol=1e-9)
