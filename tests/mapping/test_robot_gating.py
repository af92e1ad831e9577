"""Sightings of robots, decided again in the solution of the whole log."""

from dataclasses import replace

import numpy as np
import pytest
from backend_cases import PLAIN, run, see, two_robots
from three_robots import STARTS, write

from graphslam.core.config import KeyframeConfig, OdometryConfig, RobotConfig
from graphslam.core.config_io import load_config
from graphslam.core.records import OdometryPose, Sighting
from graphslam.logs import open_logs
from graphslam.mapping.landmark_map import LandmarkMap
from graphslam.mapping.robot_candidates import NOT_THERE
from graphslam.mapping.robot_gating import RobotOffers
from graphslam.odometry.preintegration import Track
from graphslam.pipeline.keyframes import KeyframeSelector
from graphslam.pipeline.pipeline import Pipeline
from graphslam.pipeline.robot_sightings import RobotCandidates
from graphslam.pipeline.robot_state import RobotState
from graphslam.scan_smoothing.reoptimise_scans import reoptimise_scan_log
from graphslam.slam.initialisation import initialise

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


@pytest.mark.parametrize("may_be", ["robot", "either", "landmark"])
def test_what_may_be_a_robot_has_a_state_of_its_own(may_be):
    """A robot is moved to the time at which it was seen, so its observer has to be there, too."""
    track = Track(OdometryConfig(), RobotConfig())
    track.add(OdometryPose("a", 0, 0, np.zeros(3)))
    track.add(OdometryPose("a", S, S, np.zeros(3)))
    standing = RobotState(track)
    standing.append(0, np.zeros(3))
    selector = KeyframeSelector(KeyframeConfig())
    assert selector.gets_state([sighting(S, may_be=may_be)], standing) == (may_be != "landmark")
    assert selector.gets_state([sighting(S, "b", "landmark")], standing)


@pytest.mark.parametrize("mode", ["motion", "all"])
def test_a_pass_keeps_what_it_rejected(tmp_path, mode):
    """Every sighting of a robot, used or not, by its step, between states that exist, so that it
    can be decided again; in batches and at their own times."""
    write(tmp_path / "log.mcap", seconds=6.0, spoil=lambda z, *_: z + np.array([0.0, 2.0]))
    starts = [f"start.poses.{r}=[{x}, {y}, {phi}]" for r, (x, y, phi) in STARTS.items()]
    config = load_config(overrides=[*starts, "backend.name=ekf", f"keyframe.mode={mode}"])
    log = open_logs([tmp_path / "log.mcap"], config)
    one = Pipeline(log, config, initialise(log, config))
    one.run(lambda _count: None)
    offers = [a for own in one.offers.values() for a in own]
    robots = RobotOffers(one.offers, one.sources or one.robot_sightings)
    assert len({a.source for a in offers}) == len(offers) == robots.count == 6 * 12
    assert robots.unused(one.steps) == one.rejected[NOT_THERE] > 60
    for n, own in one.offers.items():
        for a in own:
            assert robots.sightings[a.source].seen_robot == a.target
            assert one.steps[n].time_ns in one.runs[a.target].times
            assert a.time_ns in one.runs[a.robot].times


def test_an_unknown_clock_is_an_unknown_place_along_the_path():
    """At 0.4 m/s and half a second 0.2 m ahead; nothing once clocks are known."""
    track = Track(OdometryConfig(), RobotConfig())
    for k in range(21):
        pose = np.array([0.0, 0.04 * k, np.pi / 2])
        track.add(OdometryPose("b", k * S // 10, k * S // 10, pose))
    runs = {"b": RobotState(track)}
    for sigma_s, ahead in ((0.5, 0.2), (0.0, 0.0)):
        candidates = RobotCandidates(runs, {"b": "b"}, PLAIN, sigma_s, lambda *_: True)
        np.testing.assert_allclose(candidates.clock_shift("b", S), [ahead, 0.0], atol=1e-9)


def test_logs_of_scans_decide_again_too():
    """Before the last solution: what was rejected while the log was read is in it."""
    steps, offers = offered(two_robots(np.random.default_rng(1))[0], (0,))
    of_robots = [
        replace(
            step,
            associations=tuple(a for a in step.associations if isinstance(a.target, str)),
            closures=(),
        )
        for step in steps
    ]
    config = replace(PLAIN, odometry=replace(PLAIN.odometry, calibrate=False))
    estimate = run("batch", of_robots, config).finish()
    robots = RobotOffers(offers, [sighting(2, "b"), sighting(5, "b")])
    for known, expected in ((robots, {0, 1}), (None, {0})):
        _, made, *_ = reoptimise_scan_log(
            of_robots, estimate, {}, LandmarkMap(), (), config, None, known
        )
        assert used(made) == expected
