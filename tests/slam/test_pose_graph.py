"""Logs of relative poses only: solved at once, with the same result as step by step."""

import re
from dataclasses import replace

import numpy as np
import pytest
from pose_checks import assert_same_pose

from graphslam.core.config import Config
from graphslam.core.config_io import load_config
from graphslam.core.geometry import between, compose, exp
from graphslam.logs import LogWriter, open_logs
from graphslam.slam import smooth as job
from graphslam.slam.pose_graph import is_pose_graph
from graphslam.slam.smooth import smooth

S = 1_000_000_000
SIGMAS = np.array([0.05, 0.05, 0.02])
COV = np.diag(SIGMAS**2)
#: where b begins in the frame of a
START = np.array([1.0, 2.0, 0.7])


def grid_drive(n, rng):
    """n poses on a grid 6 m wide, one apart, with turns by 90 degrees."""
    at, poses = np.array([3.0, 3.0, 0.0]), []
    for _ in range(n):
        poses.append(at)
        turn = rng.choice([0.0, 0.0, np.pi / 2, -np.pi / 2])
        ahead = compose(compose(at, np.array([0.0, 0.0, turn])), np.array([1.0, 0.0, 0.0]))
        while not ((ahead[:2] >= -0.5) & (ahead[:2] <= 6.5)).all():
            turn += np.pi / 2
            ahead = compose(compose(at, np.array([0.0, 0.0, turn])), np.array([1.0, 0.0, 0.0]))
        at = ahead
    return np.array(poses)


def write_log(path, *, n=150, stated=1.0, closures=1.0, links=1, robots=("a", "b"), notes=True):
    """Noisy odometry of robots with one pose per second, and closures between poses near each
    other; the odometry states ``stated`` times its sigmas, closures have ``closures`` times as much
    noise, ``links`` per pose."""
    rng = np.random.default_rng(0)
    truth = {robot: grid_drive(n, rng) for robot in robots}
    stamps = [(k + 1) * S for k in range(n)]

    def drawn(x, y, scale):
        return between(x, compose(y, scale * SIGMAS * rng.normal(size=3)))

    with LogWriter(path, {"keyframe.mode": "all"} if notes else {}) as log:
        for k in range(1, n):
            for robot, poses in truth.items():
                delta = drawn(poses[k - 1], poses[k], 1.0)
                log.increment(robot, stamps[k - 1], stamps[k], delta=delta, cov=stated**2 * COV)
                other = robots[int(rng.integers(len(robots)))]
                off = np.hypot(*(truth[other][:k] - poses[k])[:, :2].T)
                near = np.flatnonzero((off < 1.5) & (np.arange(k) < k - 5))
                for j in rng.permutation(near)[: links if k % 2 or links > 1 else 0].tolist():
                    log.relative_pose(
                        robot,
                        stamps[j],
                        stamps[k],
                        delta=drawn(truth[other][j], poses[k], closures),
                        other=other,
                        cov=closures**2 * COV,
                    )
    return path


def run(path, config, monkeypatch=None):
    """Smoothed; with ``monkeypatch`` step by step, as logs of other kinds are."""
    if monkeypatch is not None:
        monkeypatch.setattr(job, "is_pose_graph", lambda _log, _config: False)
    return smooth(open_logs([path], config), config)


@pytest.mark.parametrize("settings", [(), ("keyframe.mode=motion", "keyframe.distance_m=2.5")])
def test_at_once_is_the_same_as_step_by_step(settings, tmp_path, monkeypatch):
    """Two robots, the second placed by closures: the same states, closures, poses, covariances and
    error, with a state for every pose and with states only where the robot has driven far enough,
    between which closures are carried by odometry."""
    path = write_log(tmp_path / "log.mcap", notes=not settings)
    config = load_config(overrides=settings)
    at_once, stepwise = run(path, config), run(path, config, monkeypatch)
    for name in ("counts", "closures", "dropped", "frames", "world", "warnings"):
        assert at_once.summary[name] == stepwise.summary[name], name
    assert at_once.summary["frames"] == {"a": "a", "b": "a"}
    assert at_once.estimate.dof == stepwise.estimate.dof > 0
    assert at_once.estimate.error == pytest.approx(stepwise.estimate.error, rel=1e-4)
    for robot, expected in stepwise.robots.items():
        found = at_once.robots[robot].final
        np.testing.assert_array_equal(found.stamps_ns, expected.final.stamps_ns)
        assert_same_pose(found.poses, expected.final.poses, atol=1e-3)
        np.testing.assert_allclose(found.covs, expected.final.covs, rtol=0.02, atol=1e-6)
    made, expected = (
        sorted((c.pair, *c.delta) for step in result.steps for c in step.closures)
        for result in (at_once, stepwise)
    )
    assert [pair for pair, *_ in made] == [pair for pair, *_ in expected]
    deltas = [np.array([delta for _, *delta in found]) for found in (made, expected)]
    assert_same_pose(*deltas, atol=1e-9)


#: motion of a robot (m, m, rad) in a second: a round in 40 s, 40 m long
TWIST = np.array([1.0, 0.0, 2 * np.pi / 40])


def write_rounds(path, robots=("a",), offset_s=0.0, seconds=160):
    """Robots on a circle, each a second behind the next; the fourth round is seen from the first.

    ``offset_s``: from readings to ends of closures, which are ten times as accurate as odometry.
    """
    rng, sigmas = np.random.default_rng(2), np.array([0.03, 0.03, 0.01])
    begins = {robot: exp(n * TWIST) for n, robot in enumerate(robots)}
    offset_ns = round(offset_s * S)

    def at(robot, second):
        return compose(begins[robot], exp(second * TWIST))

    with LogWriter(path) as log:
        for k in range(seconds):
            for robot, other in zip(robots, robots[::-1], strict=True):
                delta = exp(TWIST) + rng.normal(0, sigmas)
                log.increment(robot, k * S, (k + 1) * S, delta=delta, cov=np.diag(sigmas**2))
                if k < 120 or k % 4:
                    continue
                ends = k - 117 + offset_s, k + offset_s
                delta = between(at(other, ends[0]), at(robot, ends[1]))
                log.relative_pose(
                    robot,
                    (k - 117) * S + offset_ns,
                    k * S + offset_ns,
                    other=other,
                    delta=delta + rng.normal(0, sigmas / 10),
                    cov=np.diag(sigmas / 10) ** 2,
                )
    return path


@pytest.mark.parametrize("robots", [("a",), ("a", "b")])
@pytest.mark.parametrize("offset_s", [0.0, 0.4])
def test_states_at_closures_are_enough(robots, offset_s, tmp_path):
    """As logs are written, without saying where states are: closures begin and end at states, and
    both paths and covariances are those with a state at every reading. A closure carried to the
    state before its start, up to 118 m by odometry that the motions have too, moved the path by
    metres."""
    path = write_rounds(tmp_path / "log.mcap", robots, offset_s)
    found, full = (
        run(path, load_config(overrides=settings)) for settings in ((), ("keyframe.mode=all",))
    )
    assert found.summary["counts"]["keyframes"] < 0.6 * full.summary["counts"]["keyframes"]
    assert found.summary["counts"]["loop_closures"] == 10 * len(robots)
    for robot in robots:
        ours, theirs = found.robots[robot].final, full.robots[robot].final
        np.testing.assert_array_equal(ours.stamps_ns, theirs.stamps_ns)
        # between states poses are interpolated over 3 m at most, where odometry is good to 5 cm
        assert_same_pose(ours.poses, theirs.poses, atol=0.05)
        sigmas = np.sqrt(np.diagonal(ours.covs, axis1=1, axis2=2)[1:])
        expected = np.sqrt(np.diagonal(theirs.covs, axis1=1, axis2=2)[1:])
        np.testing.assert_allclose(sigmas, expected, rtol=0.15, atol=0.01)


def test_states_at_the_starts_of_closures_step_by_step(tmp_path, monkeypatch):
    """The same log taken in step by step, as a filter and a finite horizon do: a state at each
    start, so that no closure is less certain than it was written."""
    path = write_rounds(tmp_path / "log.mcap")
    result = run(path, Config(), monkeypatch)
    covs = [c.cov for step in result.steps for c in step.closures]
    assert len(covs) == 10
    np.testing.assert_allclose(covs, [np.diag([0.003, 0.003, 0.001]) ** 2] * 10, rtol=1e-6)


def test_odometry_that_is_noisier_than_it_states_is_used_as_stated_and_warned_of(tmp_path):
    """Stated at a quarter of its noise, against many closures less noisy: the noise of the log is
    used to the digit, and a warning names the factor. Stated as it is, it is no cause to warn."""
    warned = {}
    for stated in (0.25, 1.0):
        path = tmp_path / f"{stated}.mcap"
        write_log(path, n=150, stated=stated, closures=0.2, links=8, robots=("a",))
        result = run(path, load_config(overrides=["backend.verify_closures=false"]))
        covs = [step.motions["a"].cov for step in result.steps if step.motions]
        np.testing.assert_allclose(covs, [stated**2 * COV] * len(covs), rtol=1e-12, atol=1e-20)
        warned[stated] = [w for w in result.summary["warnings"] if "as the log states" in w]
    assert len(warned[0.25]) == 1 and not warned[1.0]
    factor = float(re.search(r"is ([0-9.]+) times as noisy", warned[0.25][0])[1])
    assert factor == pytest.approx(4.0, rel=0.35)


def test_relative_poses_that_cannot_be_used_are_counted(tmp_path, monkeypatch):
    """Of a robot that is not there, from before the first pose, and after the last: the same
    reasons as step by step."""
    path = tmp_path / "log.mcap"
    with LogWriter(path, {"keyframe.mode": "all"}) as log:
        for k in range(10):
            log.increment("a", k * S, (k + 1) * S, delta=np.array([1.0, 0, 0]), cov=COV)
        straight = {"delta": np.array([3.0, 0, 0]), "cov": COV}
        log.relative_pose("a", 2 * S, 5 * S, **straight)
        log.relative_pose("a", 2 * S, 5 * S, other="nobody", **straight)
        log.relative_pose("a", -2 * S, 1 * S, **straight)
        log.relative_pose("a", 9 * S, 12 * S, **straight)
    found = run(path, Config()).summary
    assert found["counts"]["loop_closures"] == 1
    assert found["dropped"] == run(path, Config(), monkeypatch).summary["dropped"]
    assert sum(found["dropped"].values()) == 3


def test_what_is_asked_of_a_back_end_is_done_by_it(tmp_path):
    """A filter, a finite horizon, or the back end's own end goes through the log step by step."""
    config = Config()
    log = open_logs([write_log(tmp_path / "log.mcap", n=20)], config)
    assert is_pose_graph(log, config)
    for changes in ({"name": "ekf"}, {"horizon_s": 5.0}, {"reoptimise": False}):
        assert not is_pose_graph(log, replace(config, backend=replace(config.backend, **changes)))
    with LogWriter(tmp_path / "seen.mcap") as other:
        other.increment("a", 0, S, delta=np.zeros(3), cov=COV)
        other.relative_pose("a", 0, S, delta=np.zeros(3), cov=COV)
        other.sighting("a", S, [0.0, 1.0], np.eye(2), identity="tree")
    assert not is_pose_graph(open_logs([tmp_path / "seen.mcap"], config), config)


def test_false_closures_taken_for_true_do_not_decide_where_the_solution_begins(tmp_path):
    """Closures are not verified, and every fifth is false: what the kernel leaves of the error is
    no more than from the true poses."""
    path, rng = tmp_path / "log.mcap", np.random.default_rng(1)
    truth = grid_drive(120, rng)
    with LogWriter(path, {"keyframe.mode": "all"}) as log:
        for k in range(1, len(truth)):
            delta = between(truth[k - 1], truth[k])
            log.increment("a", k * S, (k + 1) * S, delta=delta, cov=COV)
            if k > 10 and k % 2:
                j = int(rng.integers(k - 8))
                delta = between(truth[j], truth[k])
                if k % 5 == 0:
                    delta = rng.uniform([-5, -5, -3], [5, 5, 3])
                log.relative_pose("a", (j + 1) * S, (k + 1) * S, delta=delta, cov=COV)
    found = run(path, load_config(overrides=["backend.verify_closures=false"]))
    states = found.estimate.states["a"]
    assert_same_pose(states.poses, between(truth[0], truth), atol=0.05)
