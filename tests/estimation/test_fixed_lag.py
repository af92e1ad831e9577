"""Landmarks out of the window's sight: exact, bounded in cost, and never lost."""

from dataclasses import replace

import numpy as np
import pytest

from graphslam.core.config import Config, RobustConfig
from graphslam.core.geometry import between, compose, rotate_cov, wrap
from graphslam.core.known_landmarks import KnownLandmarks
from graphslam.core.observation_models import MODELS
from graphslam.core.records import Association, Closure, Motion, Start, Step
from graphslam.core.sparse_gaussian import MAX_WIDENING, sparse_root
from graphslam.estimation import dormant_variables, factors, window
from graphslam.estimation.backends import BACKENDS

S = 1_000_000_000
RADIUS_M, SIGHT_M, LANDMARKS = 12.0, 4.0, 36
LAP_S = 48  # steps of a round, one a second
KINDS = ("point", "segment", "line")


def ring():
    """Landmarks of all kinds along a circle: number -> model and true place."""
    angles = 2 * np.pi * np.arange(LANDMARKS) / LANDMARKS
    out = {}
    for i, angle in enumerate(angles):
        radius = RADIUS_M + (1.5 if i % 2 else -1.5)
        place = np.array([radius * np.cos(angle), radius * np.sin(angle), wrap(angle + np.pi / 2)])
        model = KINDS[i % 3]
        out[i] = model, place[: MODELS[model].dim]
    return out


def rounds(seed, steps, robots="a"):
    """Robots on the circle, half a round apart, that see what is near; all noise as claimed."""
    rng = np.random.default_rng(seed)
    turn = 2 * np.pi / LAP_S
    delta = np.array([RADIUS_M * np.sin(turn), RADIUS_M * (1 - np.cos(turn)), turn])
    motion_cov = np.diag([4e-4, 1e-4, 2e-5])
    where = {"a": np.array([RADIUS_M, 0.0, np.pi / 2]), "b": np.array([-RADIUS_M, 0.0, -np.pi / 2])}
    where = {robot: where[robot] for robot in robots}
    made = [Step(0, {robot: Start(x, 1e-4 * np.eye(3)) for robot, x in where.items()})]
    for k in range(1, steps + 1):
        motions, seen = {}, []
        for robot, x in where.items():
            where[robot] = compose(x, delta)
            noisy = delta + rng.multivariate_normal(np.zeros(3), motion_cov)
            motions[robot] = Motion((k - 1) * S, k * S, noisy, motion_cov, np.zeros((3, 0)), 1.5)
            for i, (model, place) in ring().items():
                if np.hypot(*(place - where[robot][: len(place)])[:2]) < SIGHT_M:
                    z = MODELS[model].predict(where[robot], place)
                    cov = np.diag([1e-4, 4e-4])
                    if len(z) == 3:
                        cov = rotate_cov(np.diag([2e-3, 4e-4, 2e-4]), z[2])
                    z = z + rng.multivariate_normal(np.zeros(len(z)), cov)
                    seen.append(Association(robot, k * S, i, model, z, cov))
        made.append(Step(k * S, {}, motions, tuple(seen)))
    return made


def smoother(horizon_s, kernel="cauchy"):
    config = Config(robust=RobustConfig(kernel))
    backend = replace(config.backend, name="isam2", horizon_s=horizon_s)
    return BACKENDS["isam2"](replace(config, backend=backend))


def joints(steps, horizon_s):
    """The joint of both robots and all landmarks so far after every step, and the estimate."""
    backend, seen, out = smoother(horizon_s), set(), []
    for step in steps:
        backend.add(step)
        seen |= {a.target for a in step.associations}
        out.append(backend.joint("a", sorted(seen), ["b"]))
    return out, backend.finish()


@pytest.mark.parametrize("horizon_s", [0.0, 2.0, 5.0])
def test_landmarks_out_of_use_are_exact(monkeypatch, horizon_s):
    """After every step, the joint of robots and map is that of a back end in which
    nothing sleeps. Without their correlations, or with means that stay behind when the second
    round corrects the map, it would be sigmas off."""
    steps = rounds(3, 2 * LAP_S // 3, "ab")  # each sees again what the other saw
    # to the same end: iterations stop by how far the variables in use have moved
    monkeypatch.setattr(window, "CONVERGED", 1e-10)
    monkeypatch.setattr(window, "RELINEARISE", 1e-8)
    monkeypatch.setattr(window, "MAX_ITERATIONS", 100)
    monkeypatch.setattr(dormant_variables, "AT_ONCE", 4)
    found, estimate = joints(steps, horizon_s)
    monkeypatch.setattr(dormant_variables, "AT_ONCE", 10**6)
    expected, whole = joints(steps, horizon_s)
    for mine, other in zip(found, expected, strict=True):
        sigmas = np.sqrt(np.diag(other.cov))
        assert np.max(np.abs(mine.cov - other.cov) / np.outer(sigmas, sigmas)) < 1e-4
        for a, b in zip([mine.pose, *mine.landmarks], [other.pose, *other.landmarks], strict=True):
            np.testing.assert_allclose(a, b, rtol=0, atol=1e-6)
    assert estimate.error == pytest.approx(whole.error, rel=1e-6)
    for landmark, (mean, cov) in whole.landmarks.items():
        np.testing.assert_allclose(estimate.landmarks[landmark][0], mean, rtol=0, atol=1e-6)
        np.testing.assert_allclose(estimate.landmarks[landmark][1], cov, rtol=1e-4, atol=1e-8)


def test_a_step_costs_its_window_and_not_the_map(monkeypatch):
    """The number of variables that a step solves: in the second round, with all landmarks in the
    map, it is no more than in the first half of the first, but for what waits to sleep."""
    monkeypatch.setattr(dormant_variables, "AT_ONCE", 4)
    backend, sizes = smoother(4.0), []
    for step in rounds(1, 2 * LAP_S):
        backend.add(step)
        sizes.append(len(backend._window.dims))
    assert len(backend.finish().landmarks) == LANDMARKS
    assert max(sizes[LAP_S:]) <= max(sizes[: LAP_S // 2]) + 4 < 0.7 * LANDMARKS


def test_without_sleep_a_step_costs_the_map(monkeypatch):
    """So that the bound above is one that can be missed."""
    monkeypatch.setattr(dormant_variables, "AT_ONCE", 10**6)
    backend, sizes = smoother(4.0), []
    for step in rounds(1, 2 * LAP_S):
        backend.add(step)
        sizes.append(len(backend._window.dims))
    assert max(sizes[LAP_S:]) > 1.5 * max(sizes[: LAP_S // 2])


@pytest.mark.parametrize("horizon_s", [0.0, 3.0])
def test_no_landmark_vanishes_from_the_result(monkeypatch, horizon_s):
    """However long it sleeps: every landmark that was ever seen is in the estimate, with the mean
    and covariance that the back end gave when asked, near the truth within its sigma."""
    monkeypatch.setattr(dormant_variables, "AT_ONCE", 4)
    backend = smoother(horizon_s, "none")
    for step in rounds(2, LAP_S - 2):
        backend.add(step)
        seen = {a.target for a in step.associations}
    estimate = backend.finish()
    assert set(estimate.landmarks) == set(ring()) and len(seen) < 8
    joint = backend.joint("a", sorted(ring()))
    for i, mean, at in zip(sorted(ring()), joint.landmarks, joint.slices, strict=True):
        np.testing.assert_allclose(estimate.landmarks[i][0], mean, atol=1e-12)
        np.testing.assert_allclose(estimate.landmarks[i][1], joint.cov[at, at], rtol=1e-9)
        model, place = ring()[i]
        if model != "line":
            sigmas = np.sqrt(np.diag(joint.cov[at, at]))
            assert np.all(np.abs(mean - place) < 5 * sigmas)


def known_ring(seed):
    """The landmarks of the ring as an earlier estimate has them: 4 cm each, half of it shared."""
    rng = np.random.default_rng(seed)
    places = {i: place for i, (_, place) in ring().items()}
    dims = [len(place) for place in places.values()]
    shared = np.concatenate([np.eye(dim, 3) for dim in dims])
    cov = 0.03**2 * (np.eye(sum(dims)) + shared @ shared.T)
    ends = np.cumsum(dims)
    off = np.split(rng.multivariate_normal(np.zeros(sum(dims)), cov), ends[:-1])
    means = {
        i: compose(place, e) if len(e) == 3 else place + e
        for (i, place), e in zip(places.items(), off, strict=True)
    }
    return KnownLandmarks(means, list(means), sparse_root(cov, dims)), cov


@pytest.mark.parametrize("horizon_s", [5, 1000])
def test_known_landmarks_enter_as_in_a_batch(horizon_s):
    """With their joint covariance, seen or not; half a round of the ring is seen.

    A tenth of a sigma, 5 % of sigma: the window keeps the first points of what left it.
    """
    known, _ = known_ring(3)
    first, *rest = rounds(4, LAP_S // 2)
    steps = [replace(first, known=known), *rest]
    lag, full = smoother(horizon_s, "none"), smoother(np.inf, "none")
    for step in steps:
        lag.add(step)
        full.add(step)
    whole, found = full.finish(), lag.finish()
    assert found.landmarks.keys() == whole.landmarks.keys() == set(range(LANDMARKS))
    for i, (mean, cov) in whole.landmarks.items():
        sigma = np.sqrt(np.diag(cov))
        np.testing.assert_array_less(np.abs(found.landmarks[i][0] - mean), 0.1 * sigma)
        np.testing.assert_allclose(np.sqrt(np.diag(found.landmarks[i][1])), sigma, rtol=0.05)


def test_known_landmarks_out_of_sight_are_dormant_at_once():
    """A large map costs the window nothing, and keeps its covariance, widened as it was."""
    known, cov = known_ring(5)
    first, second = rounds(6, 1)
    backend = smoother(5, "none")
    backend.add(replace(first, known=known))
    assert set(backend._window.dims) == {factors.state_key(0, 0)}
    keys = [factors.landmark_key(i) for i in known.means]
    there = backend.covariance(keys)
    assert 1.0 <= known.root.widening <= MAX_WIDENING
    # nowhere more certain than the joint; what the sparse root neglects makes it less so
    ratio = np.linalg.eigvals(np.linalg.solve(cov, there)).real
    assert ratio.min() > 1.0 - 1e-9
    assert ratio.max() < 3.0
    backend.add(second)
    assert 3 < len(backend._window.dims) < 20


def test_a_kept_state_sleeps_again_after_a_closure_and_can_be_dropped():
    """Breaks if what is forgotten meanwhile lets it stay in the window, or the prior, for ever."""
    backend = smoother(5.0)
    steps = rounds(3, 2 * LAP_S)
    for k, step in enumerate(steps):
        if k == LAP_S + 3:
            (there, here), cov = backend.poses([("a", 3 * S), ("a", (k - 1) * S)])
            assert np.linalg.eigvalsh(cov)[0] > 0
            delta = between(there, here)
            closed = Closure("a", (k - 1) * S, "a", 3 * S, delta, 1e-4 * np.eye(3), verified=True)
            backend.add(Step((k - 1) * S, closures=(closed,)))
        backend.add(step)
        if k == 3:
            backend.keep("a", 3 * S)
        backend.forget()
    (key,) = backend.builder.kept
    assert key in backend._dormant
    assert backend.drop("a", 3 * S)
    assert key not in backend._window.dims
    assert not backend.builder.kept


@pytest.mark.parametrize("robots", ["a", "ab"])
def test_a_window_of_so_many_states_is_one_of_a_shorter_horizon(robots):
    """A state a second of each robot: of a horizon of 4 s there are five of each. To the bit."""
    by_number, by_time = smoother(1000.0), smoother(4.0)
    by_number.most_states = 5 * len(robots)
    for step in rounds(3, 60, robots):
        for backend in (by_number, by_time):
            backend.add(step)
        for robot in robots:
            assert np.array_equal(by_number.state_mean(robot), by_time.state_mean(robot))
    held = [key for key in by_number._window.dims if factors.is_state(key)]
    # those of the prior that landmarks still tie wait for a block
    assert len(held) == len([k for k in by_time._window.dims if factors.is_state(k)])


def test_the_latest_state_of_each_robot_stays():
    """However few states there may be."""
    backend = smoother(1000.0)
    backend.most_states = 1
    for step in rounds(3, 20, "ab"):
        backend.add(step)
    for robot in "ab":
        assert np.isfinite(backend.state_mean(robot)).all()
        assert np.linalg.eigvalsh(backend.joint(robot, []).cov).min() > 0


@pytest.mark.parametrize("robots", ["a", "ab"])
@pytest.mark.parametrize("horizon_s", [2.0, 5.0])
def test_a_window_built_again_at_the_solution_is_of_the_whole_past(horizon_s, robots):
    """Means and covariances are those of a smoother without horizon; so they stay afterwards.

    What left a window while it was added is linearised where it was believed to be: it is off.
    """
    made = rounds(3, 2 * LAP_S, robots)
    past, rest = made[: LAP_S + 20], made[LAP_S + 20 : LAP_S + 22]
    whole, filtered, built = smoother(1000), smoother(horizon_s), smoother(horizon_s)
    for step in past:
        whole.add(step)
        filtered.add(step)
    solved = whole.finish()
    for step in past[:10]:  # what it had before is forgotten
        built.add(step)
    built.restart(past, solved)
    everything = sorted(solved.landmarks)
    wanted = whole.joint("a", everything, list(robots[1:]))
    found = built.joint("a", everything, list(robots[1:]))
    # the window is optimised once more: as well as its Gauss-Newton steps converge
    assert off(found, wanted) < 1e-3
    assert off(filtered.joint("a", everything, list(robots[1:])), wanted) > 5e-3
    np.testing.assert_allclose(found.cov, wanted.cov, rtol=0, atol=2e-3 * wanted.cov.max())
    for step in rest:
        for backend in (whole, filtered, built):
            backend.add(step)
    assert set(built.finish().landmarks) == set(whole.finish().landmarks)
    # what has left is not linearised again where the second round moves it
    wanted = whole.joint("a", everything)
    kept, lost = (off(one.joint("a", everything), wanted) for one in (built, filtered))
    assert kept < 0.5 * lost


def off(found, wanted):
    """The largest difference of two means, m or rad."""
    pairs = zip([found.pose, *found.landmarks], [wanted.pose, *wanted.landmarks], strict=True)
    return max(np.abs(a - b).max() for a, b in pairs)


def test_a_window_that_is_built_in_parts_is_the_one_that_is_built_at_once():
    """Though steps come meanwhile, of which states are kept and are kept no longer."""
    steps = rounds(3, 2 * LAP_S)
    count = LAP_S + 20
    whole, now, parts = smoother(1000), smoother(5), smoother(5)
    for step in steps[:count]:
        whole.add(step)
        parts.add(step)
    for second in (count - 4, count - 3):
        parts.keep("a", second * S)
    solved = whole.finish()
    begun, end = parts.begin_restart(count, solved), count
    while not begun.advance(steps[:end]):
        parts.add(steps[end])
        end += 1
        if end == count + 3:
            parts.drop("a", (count - 3) * S)
            parts.keep("a", (count + 1) * S)
    parts.finish_restart(begun)
    # four parts have the past; each of the next brings it two steps nearer to the latest one
    assert end == count + 5
    now.restart(steps[:count], solved)
    for k, step in enumerate(steps[count:end], start=count):
        now.add(step)
        if k == count + 1:
            now.keep("a", k * S)
    everything = sorted(solved.landmarks)
    mine, other = parts.joint("a", everything), now.joint("a", everything)
    assert off(mine, other) < 1e-6
    np.testing.assert_allclose(mine.cov, other.cov, rtol=0, atol=1e-6 * other.cov.max())
    kept = [("a", (count - 4) * S), ("a", (count + 1) * S)]
    assert sorted(parts._kept) == kept
    assert parts.poses(kept)[0].shape == (2, 3)
