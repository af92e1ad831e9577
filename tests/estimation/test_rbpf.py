"""The particle filter: exact where it is Gaussian, right in the limit, honest where it is not."""

from dataclasses import replace

import numpy as np
import pytest
from backend_cases import MOTION_COV, PLAIN, WORLD, motion, run, see, two_robots
from scipy.stats import multivariate_normal

from graphslam.core.config import RbpfConfig
from graphslam.core.config_io import load_config
from graphslam.core.errors import ConfigError, EstimationError
from graphslam.core.geometry import compose
from graphslam.core.observation_models import MODELS
from graphslam.core.records import Association, Closure, Start, Step
from graphslam.estimation import rbpf
from graphslam.estimation.backends import BACKENDS
from graphslam.estimation.rbpf import RbpfBackend, low_variance_sample


def settings(particles, seed=0, proposal="observation"):
    return replace(PLAIN, rbpf=RbpfConfig(particles, seed, proposal))


# ------------------------------------------------------------ against the Kalman filter

#: m² or rad²: a heading that is known, so that everything is linear in positions
KNOWN = 1e-14


def linear_world(robots=1):
    """Robots that drive along x with known headings and see three landmarks, with directions: every
    relation is linear in positions. Noise as claimed."""
    rng = np.random.default_rng(4)
    R, Q = np.diag([4e-2, 4e-2, KNOWN]), np.diag([2e-2, 1e-2, KNOWN])
    names = "ab"[:robots]
    where = {name: np.array([0.0, 3.0 * k, 0.0]) for k, name in enumerate(names)}
    places = [np.array([2.0, 2.0, 0.0]), np.array([4.0, -1.0, 0.0]), np.array([5.0, 3.0, 0.0])]
    start = {name: Start(pose.copy(), np.diag([0.09, 0.04, KNOWN])) for name, pose in where.items()}
    steps = [Step(0, start)]
    for name in names:
        where[name] = where[name] + [*rng.normal(0.0, [0.3, 0.2]), 0.0]

    def noisy(z, cov):
        return z + np.sqrt(cov.diagonal()) * [*rng.standard_normal(2), 0.0]

    for k in range(1, 6):
        motions, seen = {}, []
        for name in names:
            where[name] = where[name] + [1.0, 0.0, 0.0]
            motions[name] = motion(k - 1, k, noisy(np.array([1.0, 0.0, 0.0]), Q), Q)
            for i, place in enumerate(places):
                if (k > 1 or i == 0) and (name == "a" or k < 5):
                    z = noisy(place - where[name], R)
                    seen.append(Association(name, k, i, "segment", z, R))
        if robots > 1 and k in (3, 5):  # at last of b by what a sees alone
            z = noisy(where["b"] - where["a"], R)
            seen.append(Association("a", k, "b", "robot-pose", z, R))
        steps.append(Step(k, {}, motions, tuple(seen)))
    return steps


def positions(backend, others=()):
    """Mean and covariance of the positions of robots and landmarks; headings are known."""
    joint = backend.joint("a", [0, 1, 2], others)
    mean = np.concatenate([joint.pose, *joint.landmarks, *joint.others])
    index = np.flatnonzero(np.arange(len(mean)) % 3 < 2)
    return mean[index], joint.cov[np.ix_(index, index)]


@pytest.mark.parametrize(
    ("proposal", "robots", "stray"),
    [("observation", 1, 0.15), ("observation", 2, 0.4), ("motion", 1, 0.4), ("motion", 2, 0.9)],
)
def test_many_particles_are_the_kalman_filter(proposal, robots, stray):
    """Linear and Gaussian, so the Kalman filter is exact. Over 20 seeds of 1000 particles the mean
    of the means lies within four standard errors of it (their spread says how large one is), and so
    does every entry of the mean covariance. No seed strays by more than ``stray`` sigmas, half as
    much again as measured: resampling throws away what the start left open, the more the less the
    draws know. A weight that counts a sighting twice or forgets the landmark's uncertainty fails.
    """
    steps, others = linear_world(robots), ["b"][: robots - 1]
    exact, P = positions(run("ekf", steps), others)
    found = [positions(run("rbpf", steps, settings(1000, s, proposal)), others) for s in range(20)]
    sigmas = np.sqrt(np.diag(P))
    off = np.array([mean - exact for mean, _ in found]) / sigmas
    assert np.abs(off).max() < stray
    assert np.all(np.abs(off.mean(axis=0)) < 4 * off.std(axis=0, ddof=1) / np.sqrt(20))
    miss = np.array([cov - P for _, cov in found]) / np.outer(sigmas, sigmas)
    assert np.all(np.abs(miss.mean(axis=0)) < 4 * miss.std(axis=0, ddof=1) / np.sqrt(20))


def test_the_distance_from_the_kalman_filter_falls_with_the_root_of_the_particles():
    """Root mean square over 20 seeds and 11 coordinates, in sigmas. With 16 times the particles it
    falls to a quarter; an estimate of 20 draws is uncertain by a factor of 1.17 even if all
    coordinates err as one, so the ratio of two by 1.25, and thrice that is 0.13 to 0.49. Means of
    particles that are biased, by weights that are wrong, stay where they are."""
    steps = linear_world()
    exact, P = positions(run("ekf", steps))

    def stray(particles):
        means = [positions(run("rbpf", steps, settings(particles, s)))[0] for s in range(20)]
        return np.sqrt(np.mean(np.square(np.array(means) - exact) / np.diag(P)))

    assert 0.13 < stray(3200) / stray(200) < 0.49


def test_one_particle_whose_pose_is_known_is_the_kalman_filter():
    """Nothing is left to sample where start and motion leave nothing open (1e-8 m and rad): what
    remains is a Kalman filter per landmark. Seven draws of up to 4e-8, with a lever of up to 7 m.
    """
    sure = 1e-16 * np.eye(3)
    steps, _ = two_robots(np.random.default_rng(21))
    steps = [
        Step(
            step.time_ns,
            {name: replace(start, cov=sure) for name, start in step.starts.items()},
            {name: replace(moved, cov=sure) for name, moved in step.motions.items()},
            tuple(s for s in step.associations if isinstance(s.target, int) and not s.late),
        )
        for step in steps
    ]
    exact, found = (run(name, steps, settings(1)).finish() for name in ("ekf", "rbpf"))
    for i, (mean, cov) in exact.landmarks.items():
        np.testing.assert_allclose(found.landmarks[i][0], mean, atol=2e-6)
        np.testing.assert_allclose(found.landmarks[i][1], cov, rtol=1e-4, atol=1e-10)


def test_a_meeting_before_anything_is_seen_is_a_kalman_update():
    """Nothing is sampled yet, so exactly: robots that know of each other only."""
    steps, where = two_robots(np.random.default_rng(5))
    meeting = see("a", 1, "b", "robot-pose", where["a"], where["b"])
    steps = [steps[0], Step(1, {}, steps[1].motions, (meeting,))]
    exact, found = (run(name, steps).joint("a", [], ["b"]) for name in ("ekf", "rbpf"))
    np.testing.assert_allclose(found.pose, exact.pose, atol=1e-12)
    np.testing.assert_allclose(found.others[0], exact.others[0], atol=1e-12)
    np.testing.assert_allclose(found.cov, exact.cov, atol=1e-14)


# ------------------------------------------------------------ sampling


def test_a_draw_changes_what_is_sampled_and_not_what_is_known():
    """Two robots know each other's places by a meeting; then one is drawn. Spread of the draws and
    what remains within each add up to what was before, of both together: 20 000 draws leave 1 % of
    a variance open, and five of those are allowed. What is left of the other robot alone is known
    from the drawn one."""
    starts = {
        "a": Start(np.zeros(3), np.diag([0.1, 0.2, 0.01])),
        "b": Start(np.array([2.0, 1.0, 0.5]), np.diag([0.3, 0.3, 0.1])),
    }
    seen = see("a", 0, "b", "robot-pose", starts["a"].pose, starts["b"].pose)
    seen = replace(seen, cov=np.diag([1e-3, 1e-3, 1e-4]))
    backend = run("rbpf", [Step(0, starts), Step(0, associations=(seen,))], settings(20_000))
    before = backend.joint("a", [], ["b"]).cov
    alone = backend._P[0, 3:, 3:].copy()
    backend._sample_pose("a")
    sigmas = np.sqrt(np.diag(before))
    after = backend.joint("a", [], ["b"]).cov
    np.testing.assert_allclose((after - before) / np.outer(sigmas, sigmas), 0.0, atol=0.05)
    assert np.all(np.diag(backend._P[0, 3:, 3:]) < 0.1 * np.diag(alone))


def test_resampling_is_unbiased_and_of_low_variance():
    """Each particle survives N w times on average over the share, which is all that is drawn, and
    never a whole time more or less. The average is over a grid: off by at most N steps of it."""
    rng = np.random.default_rng(3)
    weights = rng.gamma(0.3, size=40)
    weights /= weights.sum()
    shares = (np.arange(20_000) + 0.5) / 20_000
    counts = np.array([np.bincount(low_variance_sample(weights, u), minlength=40) for u in shares])
    np.testing.assert_allclose(counts.mean(axis=0), 40 * weights, atol=40 / 20_000)
    assert np.all(counts.sum(axis=1) == 40)
    assert np.all(np.abs(counts - 40 * weights) < 1)


def test_equal_weights_keep_every_particle():
    """Resampling where there is nothing to choose throws nothing away."""
    for share in (1e-9, 0.5, 1 - 1e-9):
        np.testing.assert_array_equal(
            low_variance_sample(np.full(1000, 1e-3), share), np.arange(1000)
        )


def test_particles_are_drawn_again_when_too_few_carry_the_weight(monkeypatch):
    """And not before: the effective number of those that were replaced was below half of all, of
    those that were kept above. Sightings that say next to nothing leave all of them alive."""
    replaced = []

    def spy(weights, share):
        replaced.append(1 / np.sum(weights**2))
        return low_variance_sample(weights, share)

    monkeypatch.setattr(rbpf, "low_variance_sample", spy)
    kept = []
    for factor in (1, 30, 1e3, 1e5):  # of all variances: sightings say less and less
        steps = [
            replace(s, associations=tuple(replace(a, cov=factor * a.cov) for a in s.associations))
            for s in two_robots(np.random.default_rng(21))[0]
        ]
        backend = RbpfBackend(settings(200))
        for step in steps:
            before = len(replaced)
            backend.add(step)
            if len(replaced) > before:
                np.testing.assert_array_equal(backend._weights, 1 / 200)
            elif step.associations:
                kept.append(1 / np.sum(backend._weights**2))
    assert 80 < max(replaced) < 100 <= min(kept) < 120  # close to the threshold on both sides
    assert max(kept) > 190


def test_weights_are_how_probable_the_sighting_was(monkeypatch):
    """By SciPy's normal density, particle by particle: mean and covariance of what a drawn pose
    expects, which near a landmark differ from pose to pose. Rounding only."""
    monkeypatch.setattr(rbpf, "RESAMPLE_BELOW", 0.0)
    x = np.array([0.5, 0.0, 0.0])
    place, model, R = np.array([1.0, 1.0]), MODELS["point"], np.diag([4e-2, 9e-2])
    first, second = (
        Association("r", k, 0, "point", model.predict(pose, place), R)
        for k, pose in enumerate((np.zeros(3), x))
    )
    start = Start(np.zeros(3), 1e-20 * np.eye(3))
    moved = motion(0, 1, x, np.diag([0.09, 0.09, 0.04]))
    backend = RbpfBackend(settings(50, proposal="motion"))
    backend.add(Step(0, {"r": start}, {}, (first,)))
    mean, P = (*backend.landmark_means([0]), backend.joint("r", [0]).cov[3:, 3:])
    backend.add(Step(1, {}, {"r": moved}, (second,)))
    expected = []
    for pose in backend._poses("r"):
        _, H = model.jacobians(second.z, pose, mean)
        z = model.predict(pose, mean)
        expected.append(multivariate_normal.pdf(second.z, z, H @ P @ H.T + R))
    np.testing.assert_allclose(backend._weights, expected / np.sum(expected), rtol=1e-6)


def test_the_seed_decides_all_of_it():
    steps, _ = two_robots(np.random.default_rng(21))
    same, again, other = (run("rbpf", steps, settings(50, seed)).finish() for seed in (7, 7, 8))
    np.testing.assert_array_equal(same.states["a"].poses, again.states["a"].poses)
    np.testing.assert_array_equal(same.landmarks[0][1], again.landmarks[0][1])
    assert not np.array_equal(same.states["a"].poses, other.states["a"].poses)


def test_one_particle_that_draws_from_motion_is_odometry_with_a_map():
    """With nothing to choose between, sightings cannot move the path: other sightings, same path;
    only the map, which given the path is a Kalman filter of its own, follows them."""

    def steps(seed):
        rng, x = np.random.default_rng(seed), np.zeros(3)
        found = [Step(0, {"r": Start(x, np.diag([1e-2, 1e-2, 1e-3]))})]
        for k in range(1, 6):
            delta = np.array([0.5, 0.0, 0.1])
            x = compose(x, delta)
            seen = (see("r", k, 0, "point", x, WORLD[0], rng),)
            found.append(Step(k, {}, {"r": motion(k - 1, k, delta, MOTION_COV)}, seen))
        return found

    one, other = (run("rbpf", steps(seed), settings(1, proposal="motion")) for seed in (1, 2))
    path, same = one.finish().states["r"], other.finish().states["r"]
    np.testing.assert_array_equal(path.poses, same.poses)
    assert not np.array_equal(one.landmark_means([0]), other.landmark_means([0]))
    # and with the observations in the proposal it does not stay there
    drawn = run("rbpf", steps(1), settings(1)).finish().states["r"]
    assert np.abs(drawn.poses[-1] - path.poses[-1]).max() > 1e-3
    # the map given the path: least squares over all sightings, linearised where it ended
    model, info = MODELS["point"], np.zeros((2, 2))
    (landmark,) = one.landmark_means([0])
    for k, step in enumerate(steps(1)[1:], start=1):
        (seen,) = step.associations
        _, H = model.jacobians(seen.z, path.poses[k], landmark)
        info += H.T @ np.linalg.solve(seen.cov, H)
    cov = one.finish().landmarks[0][1]
    np.testing.assert_allclose(cov, np.linalg.inv(info), rtol=0.05)  # linearised on the way


def test_odometry_alone_costs_no_samples():
    """Until a landmark is seen every particle is the same Gaussian: dead reckoning to the digit
    that sums of weights leave."""
    steps, _ = two_robots(np.random.default_rng(21))
    blind = [replace(step, associations=(), closures=()) for step in steps]
    a, b = (run(name, blind).finish() for name in ("rbpf", "dead-reckoning"))
    for robot in ("a", "b"):
        np.testing.assert_allclose(a.states[robot].poses, b.states[robot].poses, atol=1e-12)
        np.testing.assert_allclose(a.states[robot].covs, b.states[robot].covs, atol=1e-14)


def test_the_mean_of_headings_goes_the_short_way_round():
    """Particles on both sides of pi: the mean is at pi, not at zero."""
    start = Start(np.array([0.0, 0.0, np.pi - 0.01]), np.diag([1e-2, 1e-2, 1e-2]))
    seen = see("r", 0, 0, "point", start.pose, np.array([-3.0, 1.0]))
    backend = run("rbpf", [Step(0, {"r": start}), Step(0, associations=(seen,))])
    pose = backend.joint("r", []).pose
    assert np.cos(pose[2]) < -0.99  # 0.1 rad over the root of 500 particles, and 0.01
    assert backend.joint("r", []).cov[2, 2] == pytest.approx(1e-2, rel=0.3)


# ------------------------------------------------------------ what it cannot use, bad input


def test_what_belongs_to_the_past_is_skipped_and_counted():
    steps, _ = two_robots(np.random.default_rng(21))
    early = replace(steps[4].associations[-1], time_ns=3)
    backend = run("rbpf", [*steps, Step(6, associations=(early,))])
    assert dict(backend.skipped) == {
        "late evidence": 3,
        "observation from a past state": 1,
        "closure to a past state": 1,
    }


def test_a_closure_between_latest_poses_is_a_meeting():
    steps, where = two_robots()
    seen = see("a", 6, "b", "robot-pose", where["a"], where["b"])
    met = run("rbpf", [*steps, Step(6, associations=(seen,))]).joint("a", [0], ["b"])
    closure = Closure("b", 6, "a", 6, seen.z, seen.cov)
    closed = run("rbpf", [*steps, Step(6, closures=(closure,))]).joint("a", [0], ["b"])
    np.testing.assert_array_equal(met.cov, closed.cov)


@pytest.mark.parametrize("earlier", [0, 1, 2])
def test_noise_that_is_no_covariance_is_named_by_landmark_and_time(earlier):
    """At the first sighting, at one that corrects the pose, and at a second one of the same step,
    which corrects the landmark alone. The landmark's own variance would make up for it."""
    start = Start(np.zeros(3), 1e-4 * np.eye(3))
    good = Association("r", 0, 7, "point", np.array([0.1, 3.0]), 1e-2 * np.eye(2))
    bad = replace(good, cov=np.diag([1e-2, -1e-3]))
    steps = [Step(0, {"r": start})]
    if earlier:
        steps.append(Step(0, associations=(good,)))
    steps.append(Step(0, associations=(good, bad) if earlier == 2 else (bad,)))
    with pytest.raises(EstimationError, match="at landmark 7, seen from robot r at 0 ns:"):
        run("rbpf", steps)


def test_a_meeting_without_a_covariance_is_named():
    steps, where = two_robots()
    seen = see("a", 6, "b", "robot-pose", where["a"], where["b"])
    with pytest.raises(EstimationError, match="at robot b, seen from robot a at 6 ns:"):
        run("rbpf", [*steps, Step(6, associations=(replace(seen, cov=-seen.cov),))])
    closure = Closure("b", 6, "a", 6, seen.z, -seen.cov)
    with pytest.raises(EstimationError, match="at closure of robot b at 6 ns:"):
        run("rbpf", [*steps, Step(6, closures=(closure,))])


def test_an_unknown_landmark_is_named():
    with pytest.raises(EstimationError, match="landmark 7 is not in the filter"):
        run("rbpf", two_robots()[0]).joint("a", [7])


def test_settings_say_how_many_and_which():
    assert RbpfBackend is BACKENDS["rbpf"]
    with pytest.raises(ConfigError, match=r"rbpf\.particles: must be greater than 0"):
        load_config(None, ["rbpf.particles=0"])
