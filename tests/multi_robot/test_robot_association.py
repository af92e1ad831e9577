"""Sightings of robots: gated by name, and associated without one."""

import zlib
from functools import cache

import numpy as np
import pytest
from three_robots import STARTS, T0, pose, write

from graphslam.core.config_io import load_config
from graphslam.logs import open_logs
from graphslam.logs.schemas import ANYTHING, SOME_ROBOT
from graphslam.mapping.robot_candidates import NOT_THERE
from graphslam.slam.smooth import smooth

#: the posts stand apart from the robots' circles
POSTS = {"6": (3.0, 2.0), "7": (-1.0, 4.0), "8": (6.0, 5.0)}


def named(observer, seen, seconds):
    return {"seen_robot" if seen in STARTS else "identity": seen}


def is_exchanged(observer, seen, seconds):
    """A tenth of the sightings of robots."""
    if seen not in STARTS:
        return False
    return zlib.crc32(f"{observer} {seen} {seconds}".encode()) % 10 == 0


def exchanged(observer, seen, seconds):
    if is_exchanged(observer, seen, seconds):
        (seen,) = set(STARTS) - {observer, seen}
    return named(observer, seen, seconds)


def unnamed(observer, seen, seconds):
    return {"seen_robot": SOME_ROBOT} if seen in STARTS else {"identity": seen}


def anything(observer, seen, seconds):
    return {"seen_robot": ANYTHING}


@pytest.fixture(scope="module")
def with_names(tmp_path_factory):
    """`run` of the log in which every sighting names what it is of, once for every back end."""
    return cache(lambda backend: run(tmp_path_factory.mktemp("named"), named, backend))


def run(tmp_path, say, backend):
    """The result, its error (m, root mean square) and the sightings that name the wrong robot."""
    wrong = []

    def spoken(observer, seen, seconds):
        wrong.extend([(observer, seen)] * is_exchanged(observer, seen, seconds))
        return say(observer, seen, seconds)

    write(tmp_path / "log.mcap", marks=POSTS, seed=4, say=spoken, seconds=40.0)
    starts = [f"start.poses.{r}=[{x}, {y}, {phi}]" for r, (x, y, phi) in STARTS.items()]
    config = load_config(overrides=[*starts, f"backend.name={backend}"])
    result = smooth(open_logs([tmp_path / "log.mcap"], config), config)
    off = []
    for name, robot in result.robots.items():
        true = np.array([pose(name, t) for t in (robot.final.stamps_ns - T0) * 1e-9])
        off.append((robot.final.poses - true)[:, :2])
    error = float(np.sqrt(np.mean(np.sum(np.concatenate(off) ** 2, axis=1))))
    return result, error, wrong


def robots_used(result):
    return sum(isinstance(a.target, str) for step in result.steps for a in step.associations)


@pytest.mark.parametrize("backend", ["batch", "isam2", "ekf"])
def test_exchanged_names_are_rejected_and_hardly_anything_else(with_names, tmp_path, backend):
    """The robots are metres apart, so every false name shows; breaks if names are trusted, or if
    the gates are too narrow for true ones."""
    right, error, wrong = with_names(backend)
    total = robots_used(right)
    assert right.summary["rejected"].get(NOT_THERE, 0) <= 0.02 * total
    result, after, _ = run(tmp_path, exchanged, backend)
    assert len(wrong) > 0.07 * total
    rejected = result.summary["rejected"][NOT_THERE]
    assert len(wrong) <= rejected <= len(wrong) + 0.02 * total
    assert after < 1.15 * error + 0.005


@pytest.mark.parametrize("backend", ["batch", "ekf"])
@pytest.mark.parametrize("say", [unnamed, anything])
def test_robots_without_names_are_recognised(with_names, tmp_path, backend, say):
    """As many sightings of robots are used as with names, and the paths are as good; breaks if a
    robot is taken for another, or for a landmark, or if landmarks come of robots."""
    right, error, _ = with_names(backend)
    result, after, _ = run(tmp_path, say, backend)
    assert robots_used(result) > 0.97 * robots_used(right)
    # without landmarks' names the filter's map is poorer, whatever becomes of the robots
    assert after < (1.15 if say is unnamed else 1.6) * error + 0.005
    if backend == "batch":
        assert len(result.landmarks) == len(POSTS)


@pytest.mark.parametrize("backend", ["batch", "ekf"])
def test_what_is_rejected_changes_nothing(tmp_path, backend):
    """A tenth of the sightings of robots are 2 m too far: every trajectory is that of a log without
    these, the causal ones to rounding, the final ones as far as they have converged: the noise that
    is found may differ by a tenth, which is 0.1 mm here. Breaks if one of the ways to an estimate
    takes in what another one rejects."""

    def spoil(z, rng, observer, seen, seconds):
        return z + np.array([0.0, 2.0 * is_exchanged(observer, seen, seconds)])

    def left_out(observer, seen, seconds):
        return None if is_exchanged(observer, seen, seconds) else named(observer, seen, seconds)

    starts = [f"start.poses.{r}=[{x}, {y}, {phi}]" for r, (x, y, phi) in STARTS.items()]
    config = load_config(overrides=[*starts, f"backend.name={backend}"])
    results = []
    for name, say in (("false", named), ("absent", left_out)):
        path = tmp_path / f"{name}.mcap"
        write(path, marks=POSTS, seed=4, spoil=spoil, say=say, seconds=30.0)
        results.append(smooth(open_logs([path], config), config))
    false, absent = results
    assert false.summary["rejected"][NOT_THERE] > 20
    for robot, right in absent.robots.items():
        found = false.robots[robot]
        for a, b, atol in ((found.causal, right.causal, 1e-7), (found.final, right.final, 2e-4)):
            np.testing.assert_array_equal(a.stamps_ns, b.stamps_ns)
            np.testing.assert_allclose(a.poses, b.poses, atol=atol)


def test_ignored_sightings_of_robots_are_no_landmarks(tmp_path):
    write(tmp_path / "log.mcap", marks=POSTS, say=unnamed, seconds=10.0)
    starts = [f"start.poses.{r}=[{x}, {y}, {phi}]" for r, (x, y, phi) in STARTS.items()]
    config = load_config(overrides=[*starts, "association.robot_sightings=ignore"])
    result = smooth(open_logs([tmp_path / "log.mcap"], config), config)
    assert not robots_used(result)
    assert {mark.identity for mark in result.landmarks} == set(POSTS)
    ignored = "sighting: of a robot, ignored by association.robot_sightings"
    assert result.summary["dropped"][ignored] == 20 * 6
