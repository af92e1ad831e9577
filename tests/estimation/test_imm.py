"""Interacting multiple models: a mixture as in the textbook, whichever robot moves."""

from dataclasses import replace

import numpy as np
import pytest
from backend_cases import MOTION_COV, PLAIN, drive, motion, run, see, two_robots
from scipy.stats import multivariate_normal

from graphslam.core.config import ImmConfig, RobustConfig
from graphslam.core.errors import ConfigError
from graphslam.core.gaussian import JointGaussian
from graphslam.core.records import Association, Start, Step
from graphslam.estimation.imm import mixture
from graphslam.evaluation.monte_carlo_campaign import Job, run_job
from graphslam.evaluation.monte_carlo_definition import load_definition

#: rad²: of headings that are held, so that nothing turns anything and all is linear
HELD = 1e-14


def slipping(slip=0.1, grip=0.9, scale=10.0, kernel="none"):
    return replace(PLAIN, robust=RobustConfig(kernel), imm=ImmConfig(slip, grip, scale))


def places(backend, landmarks=(), others=()):
    joint = backend.joint("a", landmarks, others)
    return np.concatenate([joint.pose, *joint.landmarks, *joint.others]), joint.cov


@pytest.mark.parametrize("kernel", ["none", "cauchy"])
def test_modes_that_are_equal_are_the_kalman_filter(kernel):
    """All kinds of landmarks, meetings, late evidence, a closure: nothing is used twice or left out
    in one of the modes, and an error counts once."""
    steps, _ = two_robots(np.random.default_rng(5))
    found, twin = (run(n, steps, slipping(scale=1.0, kernel=kernel)) for n in ("imm", "ekf"))
    of = [0, 1, 2], ["b"]
    for mine, its in zip(places(found, *of), places(twin, *of), strict=True):
        # observations of one step come in another order, robot by robot: second order
        np.testing.assert_allclose(mine, its, atol=2e-3)
    ends = [backend.finish() for backend in (found, twin)]
    assert ends[0].dof == ends[1].dof
    assert ends[0].error == pytest.approx(ends[1].error, rel=0.02)
    assert found.skipped == twin.skipped
    # the probabilities stay those of the chain where the modes say the same
    assert found.slipping("a") == pytest.approx(0.1, rel=1e-9)


def test_one_robot_with_equal_modes_is_the_kalman_filter_to_rounding():
    steps = [
        replace(s, associations=tuple(a for a in s.associations if "b" not in (a.robot, a.target)))
        for s in drive(np.random.default_rng(2), 0.3)[0]
    ]
    steps = [
        Step(s.time_ns, {r: x for r, x in s.starts.items() if r == "a"},
             {r: x for r, x in s.motions.items() if r == "a"}, s.associations)
        for s in steps
    ]  # fmt: skip
    found, twin = (run(n, steps, slipping(scale=1.0)) for n in ("imm", "ekf"))
    for mine, its in zip(places(found, [0, 1, 2]), places(twin, [0, 1, 2]), strict=True):
        np.testing.assert_allclose(mine, its, atol=1e-12)


def watched(rng, config, count=12):
    """Robot `b` stands and sees `a`, which drives straight and slips in two steps: the steps."""
    cov, R = np.diag([4e-2, 1e-2, HELD]), np.diag([2e-2, 3e-2, 1.0])  # headings say nothing
    far = Start(np.array([0.0, -1.0, 0.0]), HELD * np.eye(3))
    steps = [Step(0, {"a": Start(np.zeros(3), np.diag([0.1, 0.2, HELD])), "b": far})]
    x = np.zeros(3)
    for k in range(1, count + 1):
        wider = config.imm.slip_scale if k in (4, 5) else 1.0
        delta = np.array([1.0, 0.0, 0.0])
        x = x + delta
        off = wider * rng.multivariate_normal(np.zeros(3), cov)
        z = x - far.pose + rng.multivariate_normal(np.zeros(3), R)
        moved = motion(k - 1, k, delta + off * [1, 1, 0], cov)
        z[2] = 0.0
        steps.append(Step(k, {}, {"a": moved}, (Association("b", 0, "a", "robot-pose", z, R),)))
    return steps


@pytest.mark.parametrize(("slip", "grip"), [(0.1, 0.9), (0.05, 0.3)])
def test_a_linear_problem_is_the_textbooks_recursion(slip, grip):
    """Mixing, prediction, update and combination, in plain matrices on the position of the robot:
    the filter must have all four, in this order, after every step. What is left is the heading's
    variance, 1e-14 rad² times tens of metres, and the standing robot's 1e-14 m²."""
    config = slipping(slip, grip)
    steps = watched(np.random.default_rng(8), config)
    T = np.array([[1 - slip, slip], [grip, 1 - grip]])
    mu = np.array([grip, slip]) / (slip + grip)
    x = [np.zeros(2), np.zeros(2)]
    P = [np.diag([0.1, 0.2])] * 2
    backend = run("imm", steps[:1], config)
    most = 0.0
    for step in steps[1:]:
        moved, (seen,) = step.motions["a"], step.associations
        c = mu @ T
        w = T * mu[:, None] / c
        mixed = [sum(w[i, j] * x[i] for i in (0, 1)) for j in (0, 1)]
        spread = [
            sum(w[i, j] * (P[i] + np.outer(x[i] - mixed[j], x[i] - mixed[j])) for i in (0, 1))
            for j in (0, 1)
        ]
        likelihood = np.zeros(2)
        for j, factor in enumerate((1.0, 100.0)):
            mean = mixed[j] + moved.delta[:2]
            cov = spread[j] + factor * moved.cov[:2, :2]
            S = cov + seen.cov[:2, :2]
            v = seen.z[:2] - np.array([0.0, 1.0]) - mean
            K = cov @ np.linalg.inv(S)
            x[j], P[j] = mean + K @ v, cov - K @ S @ K.T
            likelihood[j] = multivariate_normal.pdf(v, cov=S)
        mu = c * likelihood / (c @ likelihood)
        mean = mu[0] * x[0] + mu[1] * x[1]
        cov = sum(m * (V + np.outer(y - mean, y - mean)) for m, y, V in zip(mu, x, P, strict=True))
        backend.add(step)
        found = backend.joint("a", [])
        np.testing.assert_allclose(found.pose[:2], mean, atol=1e-9)
        np.testing.assert_allclose(found.cov[:2, :2], cov, atol=1e-9)
        assert backend.slipping("a") == pytest.approx(mu[1], abs=1e-7)
        most = max(most, mu[1])
    assert most > 0.9  # else it never slipped, and one of the modes was not used


def test_robots_that_never_meet_are_filtered_as_if_alone():
    """With a chain without memory the modes of a robot need not be kept while another one moves, so
    nothing is lost by one robot at a time. Observations that came after all motions, to a mode of
    the wrong robot, would break it."""
    config, rng = slipping(0.2, 0.8), np.random.default_rng(3)
    cov = np.diag([4e-2, 1e-2, HELD])
    start = Start(np.zeros(3), np.diag([0.1, 0.1, HELD]))
    steps = [Step(0, {"a": start, "c": start})]
    alone = {robot: [Step(0, {robot: start})] for robot in "ac"}
    R = np.diag([2e-2, 3e-2, HELD])
    for k in range(1, 10):
        motions, seen = {}, []
        for n, robot in enumerate(alone):
            wider = 10.0 if (k + n) % 4 == 1 else 1.0
            off = wider * rng.multivariate_normal(np.zeros(3), cov) * [1, 1, 0]
            motions[robot] = motion(k - 1, k, np.array([1.0, 0.0, 0.0]) + off, cov)
            z = np.array([4.0 - k, n, 0.0]) + rng.multivariate_normal(np.zeros(3), R) * [1, 1, 0]
            seen.append(Association(robot, k, n, "segment", z, R))
        # in an order that is not that of the motions
        steps.append(Step(k, {}, motions, tuple(reversed(seen))))
        for n, robot in enumerate(alone):
            alone[robot].append(Step(k, {}, {robot: motions[robot]}, (seen[n],)))
    both = run("imm", steps, config)
    probabilities = []
    for n, robot in enumerate(alone):
        own = run("imm", alone[robot], config)
        mine, its = own.joint(robot, [n]), both.joint(robot, [n])
        np.testing.assert_allclose(its.pose, mine.pose, atol=1e-9)
        np.testing.assert_allclose(its.cov, mine.cov, atol=1e-9)
        assert both.slipping(robot) == pytest.approx(own.slipping(robot), abs=1e-9)
        probabilities.append(own.slipping(robot))
    assert abs(probabilities[0] - probabilities[1]) > 0.1  # else they could be exchanged


def test_a_robot_seen_before_it_moves_is_seen_where_it_comes_to():
    """`a` moves first and sees `b`, which moves in the same step: the sighting waits for that."""
    start = {r: Start(np.array([x, 0.0, 0.0]), 1e-6 * np.eye(3)) for r, x in (("a", 0), ("b", 3))}
    moved = {r: motion(0, 1, [1.0 + n, 0.0, 0.0], MOTION_COV) for n, r in enumerate("ab")}
    seen = see("a", 1, "b", "robot-pose", np.array([1.0, 0, 0]), np.array([5.0, 0, 0]))
    backend = run("imm", [Step(0, start), Step(1, {}, moved, (seen,))], slipping())
    assert backend.finish().error == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(backend.state_mean("b"), [5.0, 0.0, 0.0], atol=1e-9)


def test_a_mixture_has_its_mean_and_covariance_across_the_cut_of_angles():
    """A heading of 3.1 rad and one of -3.1 are 0.083 apart, not 6.2."""
    modes = []
    for heading in (3.1, -3.1):
        one = JointGaussian()
        one.add("r", np.array([1.0, 2.0, heading]), 1e-4 * np.eye(3))
        modes.append(one)
    found = mixture(modes, np.array([0.25, 0.75]))
    apart = 2 * np.pi - 6.2
    assert found.x[2] == pytest.approx(-3.1 - 0.25 * apart)
    assert found.P[2, 2] == pytest.approx(1e-4 + 0.25 * 0.75 * apart**2)
    assert modes[0].x[2] == 3.1  # of which it is no view


def test_a_landmark_is_deleted_from_every_mode():
    steps, _ = two_robots(np.random.default_rng(5))
    backend = run("imm", [*steps, Step(7, deleted=(0,))], slipping())
    kept = run("imm", steps, slipping())
    np.testing.assert_allclose(backend.joint("a", [1]).cov, kept.joint("a", [1]).cov, atol=1e-12)
    assert set(backend.finish().landmarks) == {1, 2}
    more = {"a": motion(6, 8, [0.1, 0.0, 0.0], MOTION_COV)}
    backend.add(Step(8, {}, more))  # the modes again, of equal members
    assert set(backend.finish().landmarks) == {1, 2}


@pytest.mark.parametrize("wrong", [{"slip": 0.0}, {"grip": 1.0}, {"scale": 0.0}])
def test_a_chain_that_never_changes_is_refused(wrong):
    with pytest.raises(ConfigError, match=r"imm\."):
        run("imm", [], slipping(**wrong))


def test_where_wheels_slip_it_is_honest_and_better_than_the_filter_that_does_not_know():
    """Twelve runs of the experiment `slip` at 30 % of the noise, 34 dof each: the mean NEES of 408
    dof is within 0.75 and 1.3, far beyond the bounds at 99.9 %, that of the EKF is not."""
    definition = load_definition("slip")
    nees, errors = {}, {}
    for variant in ("ekf", "imm"):
        rows = [run_job(definition, Job("", "", 0.3, variant, n)) for n in range(12)]
        nees[variant] = np.mean([row["nees"] / row["dof"] for row in rows])
        errors[variant] = np.mean([np.mean(row["causal"]["position_m2"]) for row in rows])
    assert 0.75 < nees["imm"] < 1.3 < nees["ekf"]
    assert errors["imm"] < 0.8 * errors["ekf"]
