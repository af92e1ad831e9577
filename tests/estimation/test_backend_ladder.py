"""The ladder of back ends: each rung is held to the next where the two must agree, down to algebra.

    closed form = every back end                    where the problem is linear
    `ekf` with body errors = horizon 0              anywhere: numpy and GTSAM, mean and covariance
    horizon 0 -> finite horizons -> inf -> batch    the distance falls with the horizon
    iSAM2, every variable linearised anew = batch   after enough empty updates
    filter -> batch                                 with the square of the noise

The models' Jacobians against finite differences are in test_observation_models.py, GTSAM's
factors against the models in test_factors.py. The last test shows what the ladder is worth: a
Jacobian with one entry wrong by 5 %, which no NEES would notice, breaks it.
"""

import math
from dataclasses import replace

import gtsam
import numpy as np
import pytest

from graphslam.core.config import Config, EkfConfig, RobustConfig
from graphslam.core.geometry import between, compose, rotate_cov, wrap
from graphslam.core.observation_models import MODELS
from graphslam.core.records import Association, Closure, Motion, Start, Step
from graphslam.estimation import compressed_filter as compressed
from graphslam.estimation import ekf, factors, isam2
from graphslam.estimation.backends import BACKENDS
from graphslam.estimation.replay import replay

S = 1_000_000_000
PLAIN = Config(robust=RobustConfig(kernel="none"))
HORIZONS_S = (0.0, 2.0, 5.0, 10.0, 20.0, math.inf)

#: landmarks about the origin: number -> model and true place
LANDMARKS = {
    0: ("point", np.array([6.0, 0.5])),
    1: ("point", np.array([-1.0, 6.0])),
    2: ("line", np.array([0.0, -7.0, 0.0])),
    3: ("line", np.array([8.0, 0.0, 1.6])),
    4: ("segment", np.array([-6.0, 2.0, -1.2])),
    5: ("segment", np.array([3.0, 6.5, 2.9])),
}
START_COV = np.array([[4e-2, 5e-3, 0], [5e-3, 4e-2, 1e-3], [0, 1e-3, 1e-2]])
MOTION_COV = np.array([[4e-3, 0, 0], [0, 1e-3, 3e-4], [0, 3e-4, 1e-3]])


def promoted_late(steps, count):
    """The same steps, a landmark's first ``count`` sightings coming with the next one."""
    waiting = {}
    made = []
    for step in steps:
        seen = []
        for a in step.associations:
            before = waiting.setdefault(a.target, []) if isinstance(a.target, int) else None
            if before is not None and len(before) < count:
                before.append(a)
                continue
            if before and before[0] is not None:
                seen += [replace(b, late=b.time_ns != step.time_ns) for b in before]
                waiting[a.target] = [None] * count
            seen.append(a)
        made.append(replace(step, associations=tuple(seen)))
    return made


def noise_cov(model, z):
    """Covariance of a measurement; of a line's middle the first row means nothing."""
    if len(z) == 2:
        return np.diag([1e-3, 4e-3])
    return rotate_cov(np.diag([2e-2, 4e-3, 2e-3]), float(z[2]))


def drive(seed, scale=1.0, steps=30, horizon_of_sight_m=9.0):
    """Robots `a` and `b` on circles in opposite senses, a state per second, among `LANDMARKS`; they
    see each other now and then. Noise is what is claimed, drawn with the seed; all sigmas times
    ``scale``. The starts are drawn, too."""
    rng = np.random.default_rng(seed)

    def draw(cov):
        return scale * rng.multivariate_normal(np.zeros(len(cov)), cov)

    def see(robot, k, target, model, x, t):
        z = MODELS[model].predict(x, t)
        cov = noise_cov(model, z)
        return Association(robot, k * S, target, model, z + draw(cov), scale**2 * cov)

    where = {"a": np.array([4.0, 0.0, np.pi / 2]), "b": np.array([-3.0, -1.0, -np.pi / 2])}
    moves = {"a": np.array([0.8, 0.0, 0.2]), "b": np.array([0.6, 0.05, -0.15])}
    starts = {r: Start(x + draw(START_COV), scale**2 * START_COV) for r, x in where.items()}
    made = [Step(0, starts)]
    for k in range(1, steps + 1):
        where = {r: compose(x, moves[r]) for r, x in where.items()}
        motions = {
            r: Motion((k - 1) * S, k * S, move + draw(MOTION_COV), scale**2 * MOTION_COV,
                      np.zeros((3, 0)), float(move[0]))
            for r, move in moves.items()
        }  # fmt: skip
        seen = [
            see(r, k, i, model, where[r], t)
            for r in where
            for i, (model, t) in LANDMARKS.items()
            if (k + i) % 3 and np.hypot(*(t - where[r][: len(t)])[:2]) < horizon_of_sight_m
        ]
        if k % 5 == 0:
            other = "robot-pose" if k % 2 else "robot-point"
            seen.append(see("a", k, "b", other, where["a"], where["b"]))
            seen.append(see("b", k, "a", "robot-point", where["b"], where["a"]))
        made.append(Step(k * S, {}, motions, tuple(seen)))
    return made


def promoted(steps, sightings=3):
    """The same evidence as a pipeline has it: landmarks enter with their third sighting, and the
    ones before it, then, as late evidence."""
    waiting, made = {}, []
    for step in steps:
        seen = []
        for one in step.associations:
            if not isinstance(one.target, int):
                seen.append(one)
                continue
            held = waiting.setdefault(one.target, [])
            if len(held) < sightings:
                held.append(one)
                if len(held) == sightings:
                    seen += [replace(h, late=h.time_ns != one.time_ns) for h in held]
            else:
                seen.append(one)
        made.append(replace(step, associations=tuple(seen)))
    return made


def remembering(past_states):
    """Settings of filters that keep so many past states of each robot."""
    return replace(PLAIN, ekf=EkfConfig(past_states=past_states))


def configured(name, horizon_s=math.inf, error="body", base=PLAIN, **backend):
    settings = replace(base.backend, horizon_s=horizon_s, **backend)
    return BACKENDS[name](replace(base, backend=settings, ekf=replace(base.ekf, error=error)))


def run(steps, name, horizon_s=math.inf, error="body", base=PLAIN, watch=lambda _s, _b: None):
    return replay(steps, configured(name, horizon_s, error, base), watch)


def normalised(found, expected, cov):
    """Differences (d,) of two means in the sigmas (d,) of ``cov``, headings wrapped."""
    apart = found - expected
    if len(apart) == 3:
        apart[2] = wrap(apart[2])
    return np.abs(apart) / np.sqrt(np.diag(cov))


# ------------------------------------------------------------ horizon 0 is the EKF


def snapshots(steps, name, horizon_s, base=PLAIN):
    """The joint of both robots and all landmarks after every step: means and covariance."""
    out = []

    def watch(_step, backend):
        known = [i for i in LANDMARKS if i in seen]
        joint = backend.joint("a", known, ["b"])
        out.append(([joint.pose, *joint.landmarks, *joint.others], joint.cov))

    seen = set()
    backend = configured(name, horizon_s, base=base)
    for step in steps:
        backend.add(step)
        seen |= {a.target for a in step.associations}
        watch(step, backend)
    return out


def assert_twins(steps, tolerance=1e-6, base=PLAIN):
    """Joint mean and covariance after every step agree within ``tolerance`` of their own sigmas.

    Numpy on covariances against QR on square root information: what is left is the rounding of two
    condition numbers, measured 1e-9.
    """
    pairs = zip(
        snapshots(steps, "ekf", 0.0, base), snapshots(steps, "isam2", 0.0, base), strict=True
    )
    for (means, cov), (twins, twin_cov) in pairs:
        sigmas = np.sqrt(np.diag(cov))
        apart = np.concatenate([m - t for m, t in zip(means, twins, strict=True)])
        headings = np.abs(apart) > 3.0  # two that lie on either side of pi
        apart[headings] = wrap(apart[headings])
        assert np.max(np.abs(apart) / sigmas) < tolerance
        assert np.max(np.abs(cov - twin_cov) / np.outer(sigmas, sigmas)) < tolerance


@pytest.mark.parametrize("seed", range(5))
def test_horizon_zero_is_the_body_frame_filter(seed):
    """All of it: both robots, every landmark kind, meetings of both models, all cross terms. A
    reset of the covariance after a correction, a factor linearised after the next one, or two taken
    together would show at 1e-2."""
    assert_twins(drive(seed))


@pytest.mark.parametrize("kernel", ["huber", "cauchy", "geman-mcclure"])
def test_horizon_zero_is_the_filter_under_a_kernel_too(kernel):
    """Weights are found by iteration on either side, to the same stopping rule."""
    base = replace(PLAIN, robust=RobustConfig(kernel, 1.5))
    assert_twins(drive(3), base=base)


@pytest.mark.parametrize("past_states", [0, 1, 3, 40])
def test_horizon_zero_is_the_filter_with_past_states_too(past_states):
    """Late evidence is used as far back as states are kept, by a copy in one and by elimination
    that waits in the other: none, some, more than the oldest evidence needs, all of the run."""
    base = remembering(past_states)
    steps = promoted(drive(1))
    skipped = []
    for name in ("ekf", "isam2"):
        backend = configured(name, 0.0, base=base)
        for step in steps:
            backend.add(step)
        skipped.append(sum(backend.skipped.values()))
    late = sum(a.late for step in steps for a in step.associations)
    assert late > 4
    assert skipped == [{0: late, 1: skipped[0]}.get(past_states, 0)] * 2
    assert past_states != 1 or 0 < skipped[0] < late
    assert_twins(steps, base=base)


def test_final_estimate_of_horizon_zero_is_its_causal_one_and_the_twins():
    found, twin = (run(drive(1), name, 0.0) for name in ("isam2", "ekf"))
    for robot in "ab":
        states, causal = found.estimate.states[robot], found.causal[robot]
        np.testing.assert_array_equal(states.poses, causal.poses)
        np.testing.assert_allclose(states.covs, causal.covs, rtol=1e-9, atol=1e-15)
        twins = twin.estimate.states[robot].covs
        np.testing.assert_allclose(states.covs, twins, rtol=1e-6, atol=1e-12)
    assert found.estimate.dof == twin.estimate.dof
    assert found.estimate.error == pytest.approx(twin.estimate.error, rel=1e-6)


def test_body_and_world_filters_differ():
    """So that the agreement above is one of definitions, and not of a problem too easy to tell."""
    body, world = (run(drive(0), "ekf", error=error) for error in ("body", "world"))
    apart = normalised(
        world.causal["b"].poses[-1], body.causal["b"].poses[-1], body.causal["b"].covs[-1]
    )
    assert apart.max() > 1e-2


def test_what_a_filter_has_no_use_for_is_skipped_and_counted_alike():
    """Late evidence, an observation from a past state, a closure to one; and one that is usable."""
    steps = drive(2, steps=4)
    point = MODELS["point"].predict(np.array([4.0, 0.0, 1.5]), LANDMARKS[0][1])
    seen = Association("a", 1 * S, 0, "point", point, noise_cov("point", point))
    closure = {"delta": np.zeros(3), "cov": np.eye(3)}
    steps.append(
        Step(
            4 * S,
            associations=(seen, replace(seen, time_ns=4 * S, late=True)),
            closures=(
                Closure("a", 4 * S, "a", 0, **closure),
                Closure("a", 4 * S, "b", 4 * S, **closure),
            ),
        )
    )
    base = remembering(0)
    backends = [configured("ekf", base=base), configured("isam2", 0.0, base=base)]
    backends.append(configured("isam2", 2.0))
    for backend in backends:
        for step in steps:
            backend.add(step)
    expected = {
        "late evidence": 1,
        "observation from a past state": 1,
        "closure to a past state": 1,
    }
    assert dict(backends[0].skipped) == dict(backends[1].skipped) == expected
    # the window still has the last two seconds, and uses late evidence about them
    del expected["late evidence"]
    assert dict(backends[2].skipped) == expected
    assert dict(configured("isam2").skipped) == {}
    assert_twins(steps, base=base)
    assert_twins(steps)  # and with past states, which know what to do with all of it


# ------------------------------------------------------------ a linear problem


#: rad: headings are held so tightly that they never turn anything: at lever arms of 8 m and
#: residuals of 0.3 m they move by less than 1e-6 of a position's sigma
HELD = 1e-5


def straight(seed, steps=12):
    """Nobody turns: positions only, which makes the problem linear. Segments, a line along x, and a
    robot seen by the other."""
    rng = np.random.default_rng(seed)
    position = np.diag([4e-2, 1e-2, 0.0])
    cov = position + np.diag([0, 0, HELD**2])
    where = {"a": np.zeros(3), "b": np.array([2.0, 1.0, 0.0])}
    places = {
        0: ("segment", np.array([5.0, 3.0, 0.0])),
        1: ("segment", np.array([1.0, -4.0, 0.0])),
        2: ("line", np.array([2.0, 6.0, 0.0])),
    }

    def noisy(value):
        return value + rng.multivariate_normal(np.zeros(3), position)

    made = [Step(0, {r: Start(noisy(x), cov) for r, x in where.items()})]
    for k in range(1, steps + 1):
        delta = np.array([0.5, 0.1, 0.0])
        where = {r: x + delta for r, x in where.items()}
        motions = {
            r: Motion((k - 1) * S, k * S, noisy(delta), cov, np.zeros((3, 0)), 0.5) for r in where
        }
        seen = [
            Association(r, k * S, i, model, noisy(t - x), cov)
            for r, x in where.items()
            for i, (model, t) in places.items()
            if (k + i) % 2
        ]
        if k % 4 == 0:
            z = noisy(where["b"] - where["a"])
            seen.append(Association("a", k * S, "b", "robot-pose", z, cov))
        made.append(Step(k * S, {}, motions, tuple(seen)))
    return made


def closed_form(steps, gauge_m):
    """Positions and their covariances, by one solution of the normal equations: {name: (2,)} and
    {name: (2, 2)}, for states (robot, time) and landmarks. ``gauge_m`` ties a line along itself."""
    place, rows = {}, []

    def at(name):
        return place.setdefault(name, 2 * len(place))

    gauged = set()
    for step in steps:
        for robot, start in step.starts.items():
            rows.append((None, (robot, step.time_ns), start.pose, start.cov, (0, 1)))
        for robot, moved in step.motions.items():
            ends = (robot, moved.start_ns), (robot, moved.end_ns)
            rows.append((*ends, moved.delta, moved.cov, (0, 1)))
        for seen in step.associations:
            target = (seen.target, step.time_ns) if isinstance(seen.target, str) else seen.target
            axes = (1,) if seen.model == "line" else (0, 1)
            rows.append(((seen.robot, seen.time_ns), target, seen.z, seen.cov, axes))
            if seen.model == "line" and target not in gauged:
                gauged.add(target)
                gauge = gauge_m**2 * np.eye(2)
                rows.append(((seen.robot, seen.time_ns), target, seen.z, gauge, (0,)))
    for source, target, *_ in rows:
        if source is not None:
            at(source)
        at(target)
    info, eta = np.zeros((2 * len(place),) * 2), np.zeros(2 * len(place))
    for source, target, z, cov, axes in rows:
        for axis in axes:
            h = np.zeros(len(eta))
            h[at(target) + axis] = 1.0
            if source is not None:
                h[at(source) + axis] = -1.0
            info += np.outer(h, h) / cov[axis, axis]
            eta += h * z[axis] / cov[axis, axis]
    cov = np.linalg.inv(info)
    mean = cov @ eta
    blocks = {name: slice(i, i + 2) for name, i in place.items()}
    return {n: mean[b] for n, b in blocks.items()}, {n: cov[b, b] for n, b in blocks.items()}


def assert_closed_form(found, cov, expected, expected_cov):
    """Position and its covariance within 1e-5 of its sigma; see `HELD`."""
    sigmas = np.sqrt(np.diag(expected_cov))
    assert np.max(np.abs(found[:2] - expected) / sigmas) < 1e-5
    assert np.max(np.abs(cov[:2, :2] - expected_cov) / np.outer(sigmas, sigmas)) < 1e-5


def gauge_of(name, horizon_s):
    """Wide for what linearises everything anew; see `factors.LINE_GAUGE_SIGMA_M`."""
    whole = name == "batch" or (name == "isam2" and math.isinf(horizon_s))
    return factors.LINE_GAUGE_SIGMA_M if whole else factors.FILTER_GAUGE_SIGMA_M


RUNGS = [
    ("ekf", 0.0, "body"),
    ("ekf", 0.0, "world"),
    *(("isam2", horizon, "body") for horizon in HORIZONS_S),
    ("batch", math.inf, "body"),
]


def assert_closed_form_throughout(steps, name, horizon_s, error):
    """What the back end has at every time, and of landmarks at the end, is least squares."""
    found = run(steps, name, horizon_s, error)
    for k in range(len(steps)):
        means, covs = closed_form(steps[: k + 1], gauge_of(name, horizon_s))
        for robot in "ab":
            causal = found.causal[robot]
            assert_closed_form(
                causal.poses[k], causal.covs[k], means[robot, k * S], covs[robot, k * S]
            )
    for landmark, (mean, cov) in found.estimate.landmarks.items():
        assert_closed_form(mean, cov, means[landmark], covs[landmark])


@pytest.mark.parametrize(("name", "horizon_s", "error"), RUNGS)
def test_linear_problem_has_the_closed_form_on_every_rung(name, horizon_s, error):
    """Marginalising loses nothing where all is linear: every rung's estimate, at every time, is
    least squares over all data up to then; at the end that of landmarks as well."""
    steps = straight(5)
    assert_closed_form_throughout(steps, name, horizon_s, error)


@pytest.mark.parametrize(("name", "horizon_s", "error"), RUNGS)
def test_late_evidence_of_a_linear_problem_counts_as_if_it_were_not_late(name, horizon_s, error):
    """On every rung, filters included, the estimate has all that was seen so far, whenever it was
    handed in: the closed form takes no notice of when."""
    steps = promoted(straight(5))
    assert sum(a.late for step in steps for a in step.associations) >= 4
    assert_closed_form_throughout(steps, name, horizon_s, error)


@pytest.mark.parametrize(("name", "error"), [("ekf", "world"), ("ekf", "body"), ("isam2", "body")])
def test_a_filter_without_past_states_lacks_late_evidence(name, error):
    """So that the closed form above is one that a filter can miss: without past states it has what
    least squares over the evidence in time has, which is less."""
    steps = promoted(straight(5))
    in_time = [
        replace(s, associations=tuple(a for a in s.associations if not a.late)) for s in steps
    ]
    found = run(steps, name, 0.0, error, base=remembering(0)).causal["a"]
    means, covs = closed_form(in_time, gauge_of(name, 0.0))
    last = "a", (len(steps) - 1) * S
    assert_closed_form(found.poses[-1], found.covs[-1], means[last], covs[last])
    whole = closed_form(steps, gauge_of(name, 0.0))[1][last]
    assert np.trace(whole) < 0.9 * np.trace(found.covs[-1][:2, :2])


@pytest.mark.parametrize(("name", "horizon_s"), [("isam2", 2.0), ("isam2", math.inf), ("batch", 0)])
def test_final_states_of_a_linear_problem_know_what_came_within_the_horizon(name, horizon_s):
    """A state that has left has the estimate of its last moment in the window: horizon 2 s and one
    state a second, so of the step three later, in which it is optimised and leaves."""
    steps = straight(6)
    states = run(steps, name, horizon_s).estimate.states["b"]
    for k in range(len(steps)):
        last = len(steps) if name == "batch" or math.isinf(horizon_s) else k + 3 + 1
        means, covs = closed_form(steps[:last], gauge_of(name, horizon_s))
        assert_closed_form(states.poses[k], states.covs[k], means["b", k * S], covs["b", k * S])


# ------------------------------------------------------------ the filter in front of iSAM2


@pytest.mark.parametrize("kernel", ["none", "cauchy"])
@pytest.mark.parametrize("late", [False, True])
def test_the_filter_in_front_of_the_tree_says_what_the_tree_says(kernel, late):
    """While nothing is linearised anew both are one algebra, lines and meetings included: after
    each step, means and joint covariance of a robot and all landmarks agree to what iSAM2's
    back-substitution leaves out (it stops below 1e-3). Jacobians of now instead of the tree's would
    be 0.5 sigma off, by what a line leaves open."""
    once = replace(PLAIN.backend, relinearize_every=1000)
    config = Config(robust=RobustConfig(kernel=kernel), backend=once)
    tree, filtered = isam2.Isam2Backend(config), compressed.CompressedBackend(config)
    taken = []
    update = filtered._update
    filtered._update = lambda parts, anew: taken.append(len(parts)) or update(parts, anew)
    steps = drive(5, horizon_of_sight_m=15.0)
    if late:  # every landmark's first sighting enters two steps later
        steps = promoted_late(steps, 2)
    for step in steps:
        tree.add(step)
        filtered.add(step)
        for robot in ("a", "b"):
            landmarks = sorted(tree.builder.landmark_dims)
            expected, found = (b.joint(robot, landmarks) for b in (tree, filtered))
            sigma = np.sqrt(np.diag(expected.cov))
            apart = np.concatenate([found.pose, *found.landmarks])
            apart -= np.concatenate([expected.pose, *expected.landmarks])
            headings = [2, *(s.stop - 1 for s in expected.slices if s.stop - s.start == 3)]
            apart[headings] = wrap(apart[headings])
            assert np.max(np.abs(apart) / sigma) < 1e-3
            off = (found.cov - expected.cov) / np.outer(sigma, sigma)
            assert np.max(np.abs(off)) < 1e-4
    # the tree was asked for each new landmark, and not once more
    assert len(taken) <= 1 + len(LANDMARKS) * (1 + late)
    ends = [b.finish().states["a"].poses for b in (tree, filtered)]
    np.testing.assert_allclose(*ends, atol=1e-6)


@pytest.mark.parametrize("why", ["not in use", "not positive definite"])
def test_what_the_filter_cannot_take_goes_into_the_tree_at_once(why, monkeypatch):
    """A closure to a state that is no longer in use, or arithmetic that breaks down: the estimate
    follows the closure in the same step, as the tree's does (to 0.1 mm: back-substitution stops
    below 1 mm)."""
    if why != "not in use":

        def breaks(*_):
            raise np.linalg.LinAlgError

        monkeypatch.setattr(compressed.LocalFilter, "add", breaks)
        monkeypatch.setattr(compressed.LocalFilter, "has_variables_of", lambda *_: True)
    once = replace(PLAIN.backend, relinearize_every=1000)
    config = Config(robust=PLAIN.robust, backend=once)
    both = isam2.Isam2Backend(config), compressed.CompressedBackend(config)
    *steps, last = drive(6)
    start = steps[0].starts["a"].pose
    closure = Closure("a", last.time_ns, "a", 0, start, 1e-4 * np.eye(3))
    poses = []
    for backend in both:
        for step in steps:
            backend.add(step)
            backend.joint("a", [])
        before = backend.state_mean("a")
        backend.add(replace(last, closures=(closure,)))
        poses.append(backend.state_mean("a"))
        assert np.abs(poses[-1] - before).max() > 0.5
    np.testing.assert_allclose(*poses, atol=1e-4)


def test_the_tree_is_linearised_anew_by_what_has_moved_with_the_filter():
    """Every 20 steps of 40, what has moved by 0.01: causally, at the end, the filter is as near to
    batch as the tree that took in each step, mean of twelve drives (0.9 times). Had the tree looked
    for what moved before it took in the stretch, it would be 1.5 times as far."""
    backend = replace(PLAIN.backend, relinearize_every=20, relinearize_threshold=0.01)
    config = Config(robust=PLAIN.robust, backend=backend)

    def apart(make, seed):
        """Of the robots' last poses from batch's, in sigmas."""
        found, best = make(config), BACKENDS["batch"](config)
        for step in drive(seed, steps=40):
            for each in (found, best):
                each.add(step)
            found.joint("a", [])
        last = best.finish().states
        miss = np.array([found.state_mean(r) - last[r].poses[-1] for r in ("a", "b")])
        miss[:, 2] = wrap(miss[:, 2])
        sigma = [np.sqrt(np.diag(last[r].covs[-1])) for r in ("a", "b")]
        return np.abs(miss / sigma).mean()

    tree, filtered = (
        np.mean([apart(make, seed) for seed in range(12)])
        for make in (isam2.Isam2Backend, compressed.CompressedBackend)
    )
    assert filtered < 1.15 * tree


# ------------------------------------------------------------ iSAM2 is batch


def test_isam2_with_everything_relinearised_is_batch_after_empty_updates(monkeypatch):
    """Without wildfire threshold and relinearisation threshold an empty update is one round of
    Gauss-Newton: when it moves nothing any more the optimum of the same graph is reached. Before
    the empty updates it is not, or they would prove nothing."""
    parameters = isam2.isam2_parameters

    def exact(config, factorization):
        found = parameters(config, factorization)
        found.setOptimizationParams(gtsam.ISAM2GaussNewtonParams(0.0))
        return found

    monkeypatch.setattr(isam2, "isam2_parameters", exact)
    backend = configured(
        "isam2", relinearize_threshold=0.0, relinearize_every=1, optimise_at_end=False
    )
    for step in drive(4):
        backend.add(step)
    graph = backend.builder.graph
    best = isam2.optimise(graph, backend._isam.calculateBestEstimate(), PLAIN.robust)
    covs = gtsam.Marginals(graph, best)

    def distance():
        """Of every variable, in its own sigmas, along its own axes."""
        apart = best.localCoordinates(backend._isam.calculateBestEstimate())
        return max(
            np.max(np.abs(apart.at(key)) / np.sqrt(np.diag(covs.marginalCovariance(key))))
            for key in best.keys()  # noqa: SIM118 (no mapping)
        )

    assert distance() > 1e-5
    nothing = gtsam.NonlinearFactorGraph(), gtsam.Values(), [], None, None, None, True
    for _ in range(30):
        backend._isam.update(*nothing)
        if backend._isam.getDelta().norm() < 1e-9:
            break
    # batch stops when an error of some 100 falls by less than 1e-10 of itself: 1e-4 sigmas
    assert distance() < 1e-4


# ------------------------------------------------------------ towards batch


def final_distance(found, batch):
    """RMS distance of the robots' last positions and of landmarks from batch's, m: of a line its
    offset only, since its place along itself is a gauge."""
    apart = [found.states[r].poses[-1, :2] - batch.states[r].poses[-1, :2] for r in batch.states]
    for i, (mean, _) in batch.landmarks.items():
        if LANDMARKS[i][0] == "line":
            apart.append(between(mean, found.landmarks[i][0])[1:2])
        else:
            apart.append(found.landmarks[i][0][:2] - mean[:2])
    return float(np.sqrt(np.mean(np.concatenate(apart) ** 2)))


#: all sigmas times this
SCALES = (1.0, 0.3, 0.1, 0.03, 0.01)


def gaps(monkeypatch, name, error, seeds=range(3)):
    """Distance of the filter's final estimate from batch's for every noise scale, over seeds.

    The gauge of a line is one of the sigmas, if of no measurement: at 1 m beside noise of
    millimetres, what little a line's factor knows along the line would be of first order.
    """
    out = []
    for scale in SCALES:
        found = []
        monkeypatch.setattr(factors, "LINE_GAUGE_SIGMA_M", scale)
        for seed in seeds:
            steps = drive(seed, 0.5 * scale, steps=15)
            batch = run(steps, "batch").estimate
            found.append(final_distance(run(steps, name, 0.0, error).estimate, batch))
        out.append(np.mean(found))
    return np.array(out)


def assert_quadratic(distances):
    """Falling with the square of the noise: slope 2 in logarithms. 0.2 leaves room for the third
    order at full noise; a first-order mistake has slope 1."""
    slope = np.polyfit(np.log(SCALES), np.log(distances), 1)[0]
    assert slope == pytest.approx(2.0, abs=0.2)


@pytest.mark.parametrize(("name", "error"), [("ekf", "world"), ("ekf", "body"), ("isam2", "body")])
def test_filter_approaches_batch_with_the_square_of_the_noise(monkeypatch, name, error):
    """To first order a filter and least squares are the same; what the filter linearised too early
    is second order."""
    assert_quadratic(gaps(monkeypatch, name, error))


def test_distance_to_batch_falls_as_the_horizon_grows():
    """Mean over 10 seeds, horizons of 0 to 10 of 30 s and all. Each is the mean of as many runs
    whose spread is as large as the mean, so one may exceed the one before by the standard error
    of their difference over the same seeds. From 0 to the shortest window is a jump: a filter
    linearises each factor where the estimate happens to be, a window keeps one place per variable
    and so never thinks that it knows how the whole map is turned."""
    horizons = (0.0, 0.5, 2.0, 10.0, math.inf)
    apart = np.empty((10, len(horizons)))
    for seed in range(len(apart)):
        steps = drive(seed, 0.5, steps=30)
        batch = run(steps, "batch").estimate
        for k, horizon in enumerate(horizons):
            apart[seed, k] = final_distance(run(steps, "isam2", horizon).estimate, batch)
    mean, change = apart.mean(axis=0), np.diff(apart, axis=1)
    error = change.std(axis=0) / np.sqrt(len(apart))
    assert np.all(change.mean(axis=0) < error)
    assert mean[1] < 0.1 * mean[0]  # the jump: measured 0.032 to 0.0009 m
    assert mean[-2] < 0.5 * mean[1]
    assert mean[-1] == pytest.approx(0.0, abs=1e-9)


def test_a_horizon_longer_than_the_run_is_batch():
    """Nothing has left, so nothing but the stopping rule is between: 1e-6 of the error a step. And
    lines are faced anew by batch alone, so they are left out."""
    steps = [
        replace(s, associations=tuple(a for a in s.associations if a.model != "line"))
        for s in drive(7)
    ]
    found, batch = run(steps, "isam2", 1000.0).estimate, run(steps, "batch").estimate
    for robot, states in batch.states.items():
        for pose, mine, cov in zip(
            states.poses, found.states[robot].poses, states.covs, strict=True
        ):
            assert normalised(mine, pose, cov).max() < 1e-2
    assert found.error == pytest.approx(batch.error, rel=1e-6)
    assert found.dof == batch.dof


def window_sizes(horizon_s, steps):
    """What each step solves: variables, factors and rows of residuals, (steps, 3). Counted, not
    timed: a step's cost is that of linearising and eliminating these, in six rounds at most."""
    backend, sizes = configured("isam2", horizon_s), []
    for step in steps:
        backend.add(step)
        window = backend._window
        linear = [each.factor.linearize(window.values) for each in window.factors]
        rows = [len(factor.jacobian()[1]) for factor in linear]
        sizes.append((len(window.dims), len(rows), sum(rows) + len(window.prior.b)))
    return np.array(sizes)


@pytest.mark.parametrize("horizon_s", [2.0, 5.0])
def test_a_finite_horizon_bounds_the_cost_of_a_step(horizon_s):
    """Three rounds on the circles, all landmarks seen in the first: no later step solves more than
    the largest one of the first round, but for the few sightings that robots out of step have more
    or less. Keeping all, or a prior per state that left, the third round would have three times as
    much."""
    sizes = window_sizes(horizon_s, drive(1, steps=126))  # robot `b` takes 42 steps a round
    assert np.all(sizes[42:].max(axis=0) <= 1.1 * sizes[:42].max(axis=0))
    # states a second of two robots, the latest included, those at the window's edge, and the map
    assert sizes[-1, 0] == 2 * (horizon_s + 1) + len(LANDMARKS)


def test_all_of_the_past_costs_more_and_more():
    """So that the bound above is one that can be missed."""
    sizes = window_sizes(1e6, drive(1, steps=40))
    assert np.all(sizes[-1] > 1.7 * sizes[20])


@pytest.mark.parametrize("horizon_s", HORIZONS_S)
def test_no_landmark_ever_leaves(horizon_s):
    """Every landmark seen so far has a mean and a joint with the robot after every step, however
    long ago it was last seen, and is not less sure than it was."""
    seen, before = set(), {}
    backend = configured("isam2", horizon_s)
    for step in drive(8, horizon_of_sight_m=5.0):
        backend.add(step)
        seen |= {a.target for a in step.associations if isinstance(a.target, int)}
        joint = backend.joint("a", sorted(seen))
        assert len(backend.landmark_means(sorted(seen))) == len(seen)
        for landmark, block in zip(sorted(seen), joint.slices, strict=True):
            size = np.linalg.det(joint.cov[block, block])
            # sure within what a linearisation anew changes
            assert 0 < size < 1.5 * before.get(landmark, np.inf)
            before[landmark] = size
    assert set(backend.finish().landmarks) == seen


def test_a_window_does_not_settle_at_once_where_a_landmark_is():
    """A point whose first range is 2 m off, then seen from all round: 10 s later the filter still
    suffers from the line of sight that it took for the true one. A window of 3 s takes Jacobians
    anew until the first state that saw the point leaves, and residuals always."""
    place, x = np.array([0.0, 5.0]), np.array([0.0, 0.0, 0.0])
    steps = [Step(0, {"a": Start(x, np.diag([1e-6, 1e-6, 1e-6]))})]
    for k in range(1, 13):
        delta = np.array([1.0, 0.0, 0.35])
        x = compose(x, delta)
        z = MODELS["point"].predict(x, place) + ([0.05, 2.0] if k == 1 else [0.0, 0.0])
        cov = np.diag([1e-4, 4.0])
        moved = Motion((k - 1) * S, k * S, delta, np.diag([1e-5] * 3), np.zeros((3, 0)), 1.0)
        seen = Association("a", k * S, 0, "point", z, cov)
        steps.append(Step(k * S, {}, {"a": moved}, (seen,)))
    batch = run(steps, "batch").estimate.landmarks[0][0]
    off = [
        np.linalg.norm(run(steps, "isam2", horizon).estimate.landmarks[0][0] - batch)
        for horizon in (0.0, 3.0)
    ]
    assert off[1] < 0.2 * off[0]


# ------------------------------------------------------------ a mistake breaks it


class Mistaken:
    """A model one of whose Jacobians has one entry wrong by 5 %."""

    def __init__(self, model, method, which, entry):
        self._model, self._method, self._which, self._entry = model, method, which, entry

    def __getattr__(self, name):
        return getattr(self._model, name)

    def _spoiled(self, method, *arguments):
        found = [np.array(J) for J in getattr(self._model, method)(*arguments)]
        if method == self._method:
            found[self._which][self._entry] *= 1.05
        return tuple(found)

    def jacobians(self, z, x, t):
        return self._spoiled("jacobians", z, x, t)

    def invert_jacobians(self, z, x):
        return self._spoiled("invert_jacobians", z, x)


MISTAKES = [
    ("point", "jacobians", 0, (0, 2)),
    ("point", "jacobians", 1, (1, 0)),
    ("point", "invert_jacobians", 0, (1, 2)),
    ("segment", "jacobians", 0, (0, 0)),
    ("segment", "jacobians", 1, (2, 2)),
    ("segment", "invert_jacobians", 1, (0, 1)),
    ("line", "jacobians", 0, (0, 2)),
    ("line", "jacobians", 1, (1, 2)),
    ("robot-pose", "jacobians", 0, (1, 2)),
    ("robot-point", "jacobians", 1, (0, 1)),
]


def spoil(monkeypatch, model, method, which, entry):
    """Only `ekf` takes Jacobians from the table; factors have GTSAM's."""
    monkeypatch.setitem(MODELS, model, Mistaken(MODELS[model], method, which, entry))


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistaken_jacobian_breaks_the_twins(monkeypatch, mistake):
    steps = drive(0)
    spoil(monkeypatch, *mistake)
    with pytest.raises(AssertionError):
        assert_twins(steps, tolerance=1e-4)  # a hundred times what the right one is held to


def test_a_model_that_is_wrapped_and_right_passes(monkeypatch):
    """So that it is the 5 % which breaks the ladder above and not the wrapping."""
    steps = drive(0)
    for model in MODELS:
        spoil(monkeypatch, model, "none", 0, (0, 0))
    assert_twins(steps)


@pytest.mark.parametrize(
    "mistake",
    [
        ("point", "jacobians", 0, (0, 2)),
        ("segment", "jacobians", 0, (2, 2)),
        ("line", "jacobians", 0, (1, 2)),
    ],
)
def test_a_mistaken_jacobian_breaks_the_square_law(monkeypatch, mistake):
    """It is a mistake of first order, which outlives the second at small noise."""
    spoil(monkeypatch, *mistake)
    with pytest.raises(AssertionError):
        assert_quadratic(gaps(monkeypatch, "ekf", "body"))


def test_a_mistaken_motion_breaks_the_twins(monkeypatch):
    compose_jacobians = ekf.compose_jacobians

    def mistaken(a, b):
        F, W = compose_jacobians(a, b)
        F[1, 2] *= 1.05
        return F, W

    steps = drive(0)
    monkeypatch.setattr(ekf, "compose_jacobians", mistaken)
    with pytest.raises(AssertionError):
        assert_twins(steps, tolerance=1e-4)
