"""The estimators: one contract for all, and covariances checked against algebra by hand."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from backend_cases import (
    MODEL_OF,
    MOTION_COV,
    PLAIN,
    WORLD,
    assert_covariance,
    make,
    motion,
    run,
    see,
    two_robots,
    without_lines,
)

from graphslam.core.config import BackendConfig, Config, ImmConfig, RobustConfig
from graphslam.core.errors import EstimationError
from graphslam.core.geometry import (
    between,
    compose,
    compose_cov,
    compose_jacobians,
    rotate_cov,
    wrap,
)
from graphslam.core.observation_models import MODELS
from graphslam.core.records import Association, Start, Step
from graphslam.estimation.backend import StateTable, block_slices
from graphslam.estimation.backends import BACKENDS
from graphslam.estimation.factors import landmark_key
from graphslam.estimation.isam2 import Reoptimiser

SMOOTHERS = ["batch", "isam2"]
#: isam2 with a horizon in seconds: the filter, a window of two states (they are ns apart), all
HORIZONS = ["isam2:0", "isam2:2e-9", "isam2:1"]
EVERY = [*sorted(BACKENDS), *HORIZONS]


@pytest.fixture
def scenario():
    return two_robots(np.random.default_rng(21))


# ------------------------------------------------------------ the contract


@pytest.mark.parametrize("name", EVERY)
class TestContract:
    """What the pipeline may expect of every row of `BACKENDS`."""

    def test_joint_has_pose_landmarks_and_one_covariance(self, name, scenario):
        backend = run(name, scenario[0])
        for ids in ([], [0], [2, 0, 1], [1]):
            joint = backend.joint("b", ids)
            dims = [MODELS[MODEL_OF[i]].dim for i in ids]
            assert joint.pose.shape == (3,)
            assert [len(mean) for mean in joint.landmarks] == dims
            assert [s.stop - s.start for s in joint.slices] == dims
            assert joint.cov.shape == (3 + sum(dims),) * 2
            assert_covariance(joint.cov)
            # the order asked for is the order given: same block whatever else is asked
            for place, landmark in zip(joint.slices, ids, strict=True):
                alone = backend.joint("b", [landmark])
                expected = alone.cov[alone.slices[0], alone.slices[0]]
                np.testing.assert_allclose(joint.cov[place, place], expected, rtol=1e-6, atol=1e-12)

    def test_landmark_means_are_those_of_the_joint(self, name, scenario):
        backend = run(name, scenario[0])
        ids = [1, 0, 2]
        for a, b in zip(
            backend.landmark_means(ids), backend.joint("a", ids).landmarks, strict=True
        ):
            np.testing.assert_array_equal(a, b)
        assert backend.landmark_means([]) == []

    def test_joint_may_be_asked_after_every_step(self, name, scenario):
        """And speaks of the latest state of the robot it is asked for."""
        backend, last = make(name), None
        for step in scenario[0]:
            backend.add(step)
            joint = backend.joint("a", [])
            assert_covariance(joint.cov)
            assert last is None or not np.array_equal(joint.pose, last)
            last = joint.pose

    def test_finish_gives_every_state_and_every_landmark(self, name, scenario):
        estimate = run(name, scenario[0]).finish()
        assert list(estimate.states) == ["a", "b"]
        for trajectory in estimate.states.values():
            assert trajectory.stamps_ns.dtype == np.int64
            np.testing.assert_array_equal(trajectory.stamps_ns, range(7))
            assert trajectory.poses.shape == (7, 3)
            assert_covariance(trajectory.covs)
        assert set(estimate.landmarks) == {0, 1, 2}
        for landmark, (mean, cov) in estimate.landmarks.items():
            dim = MODELS[MODEL_OF[landmark]].dim
            assert (mean.shape, cov.shape) == ((dim,), (dim, dim))
            assert_covariance(cov)
        assert np.isfinite(estimate.error)

    def test_result_is_near_the_truth(self, name, scenario):
        """Within five of its own sigmas: signs and frames, not fine statistics. A line's position
        along itself is a gauge and is left out."""
        steps, where = scenario
        estimate = run(name, steps).finish()
        for robot, truth in where.items():
            states = estimate.states[robot]
            miss = states.poses[-1] - truth
            miss[2] = wrap(miss[2])
            assert np.all(np.abs(miss) < 5 * np.sqrt(np.diag(states.covs[-1])))
        for landmark in (0, 2):
            mean, cov = estimate.landmarks[landmark]
            miss = (mean - WORLD[landmark])[:2]
            assert np.all(np.abs(miss) < 5 * np.sqrt(np.diag(cov)[:2]))

    @pytest.mark.parametrize(
        "step",
        [
            Step(5, motions={"ghost": motion(0, 5, [1, 0, 0], np.eye(3))}),
            Step(0, associations=(Association("ghost", 0, 0, "point", np.ones(2), np.eye(2)),)),
        ],
    )
    def test_a_robot_without_a_start_is_named_with_the_time(self, name, step, scenario):
        backend = run(name, scenario[0])
        needed = f"robot ghost has no start, needed at {step.time_ns} ns"
        with pytest.raises(EstimationError, match=needed):
            backend.add(step)

    def test_asking_for_an_unknown_robot_is_an_error_that_names_it(self, name):
        with pytest.raises(EstimationError, match="robot ghost"):
            make(name).joint("ghost", [])

    def test_reference_to_a_state_that_was_never_made_names_robot_and_time(self, name, scenario):
        backend = run(name, scenario[0])
        seen = Association("a", 12345, 9, "point", np.ones(2), np.eye(2))
        with pytest.raises(EstimationError, match="robot a has no state at 12345 ns"):
            backend.add(Step(7, associations=(seen,)))

    def test_steps_are_left_as_they_were_and_give_the_same_again(self, name, scenario):
        """Recorded steps are replayed: an estimator that scribbled on them would spoil the next."""
        first = run(name, scenario[0]).finish()
        again = run(name, scenario[0]).finish()
        for robot in first.states:
            np.testing.assert_array_equal(first.states[robot].poses, again.states[robot].poses)
            np.testing.assert_array_equal(first.states[robot].covs, again.states[robot].covs)

    def test_robot_may_start_late(self, name):
        """A second robot that wakes up in the middle of the run."""
        backend = run(name, [Step(0, {"z": Start(np.zeros(3), 1e-4 * np.eye(3))})])
        backend.add(Step(4, motions={"z": motion(0, 4, [1, 0, 0], MOTION_COV)}))
        backend.add(Step(5, {"a": Start(np.array([1.0, 2.0, 3.0]), 1e-4 * np.eye(3))}))
        estimate = backend.finish()
        np.testing.assert_array_equal(estimate.states["a"].stamps_ns, [5])
        np.testing.assert_allclose(estimate.states["a"].poses, [[1, 2, 3]], atol=1e-12)


# ------------------------------------------------------------ the smoothers


@pytest.mark.parametrize("name", SMOOTHERS)
def test_observations_help(name, scenario):
    """Against dead reckoning, every final pose is better known."""
    estimate, blind = run(name, scenario[0]).finish(), run("dead-reckoning", scenario[0]).finish()
    for robot in ("a", "b"):
        better = np.diag(estimate.states[robot].covs[-1])
        assert np.all(better < np.diag(blind.states[robot].covs[-1]))


def test_isam2_converges_to_batch(scenario):
    """Incremental smoothing with every variable relinearised, made to converge without a final
    optimisation, is batch: 1e-6 m or rad is where convergence is declared, for all variables
    together."""
    steps = without_lines(scenario[0])
    batch = run("batch", steps).finish()
    exact = BackendConfig(optimise_at_end=False, relinearize_threshold=0.0, relinearize_every=1)
    estimate = run("isam2", steps, Config(robust=PLAIN.robust, backend=exact)).finish()
    for robot in ("a", "b"):
        np.testing.assert_allclose(
            estimate.states[robot].poses, batch.states[robot].poses, atol=1e-5
        )
        np.testing.assert_allclose(
            estimate.states[robot].covs, batch.states[robot].covs, rtol=1e-4, atol=1e-9
        )
    assert estimate.error == pytest.approx(batch.error, rel=1e-6)


def test_isam2_ends_where_a_batch_from_odometry_ends(scenario):
    """Lines included, with the default settings: the optimum does not depend on what the tree
    decided on the way. Odometry, where the other one begins, is centimetres off."""
    steps, _ = scenario
    estimate = run("isam2", steps).finish()
    start = run("dead-reckoning", steps).finish()
    whole = Reoptimiser(PLAIN, steps, start).solve()
    far = 0.0
    for robot, found in estimate.states.items():
        np.testing.assert_allclose(found.poses, whole.states[robot].poses, rtol=0, atol=1e-6)
        far = max(far, np.abs(found.poses - start.states[robot].poses)[:, :2].max())
    assert far > 0.05
    assert estimate.error == pytest.approx(whole.error, rel=1e-6)


def test_isam2_goes_on_from_a_solution_as_from_its_own(scenario):
    """Restarted in the middle at the minimum of the steps so far, it ends where it ends without,
    and what it says on the way is that of the restarted steps alone: within 1e-6 m or rad, where
    optimisation is declared to have converged."""
    steps = without_lines(scenario[0])
    half = len(steps) // 2
    restarted = run("isam2", steps)
    solved = run("batch", steps[:half]).finish()
    restarted.restart(steps[:half], solved)
    for robot in ("a", "b"):
        np.testing.assert_allclose(
            restarted.state_mean(robot), solved.states[robot].poses[-1], rtol=0, atol=1e-6
        )
        cov = restarted.joint(robot, []).cov
        np.testing.assert_allclose(cov, solved.states[robot].covs[-1], rtol=1e-4, atol=1e-9)
    for step in steps[half:]:
        restarted.add(step)
    found, expected = restarted.finish(), run("isam2", steps).finish()
    for robot in ("a", "b"):
        np.testing.assert_allclose(
            found.states[robot].poses, expected.states[robot].poses, rtol=0, atol=1e-6
        )
    assert found.error == pytest.approx(expected.error, rel=1e-6)


def test_isam2_with_default_thresholds_is_near_batch(scenario):
    """Lines included: converged within 2 % of its sigma (variables that move less than 0.02 m or
    rad are not linearised anew), and causally, before convergence, within a tenth."""
    steps, _ = scenario
    batch = run("batch", steps).finish()
    backend = run(
        "isam2", steps, Config(robust=PLAIN.robust, backend=BackendConfig(optimise_at_end=False))
    )
    causal, estimate = backend.joint("b", []), backend.finish()
    for robot in ("a", "b"):
        sigmas = np.sqrt(np.diagonal(batch.states[robot].covs, axis1=1, axis2=2))
        miss = np.abs(estimate.states[robot].poses - batch.states[robot].poses)
        assert np.all(miss < 0.02 * sigmas)
    assert np.all(np.abs(causal.pose - batch.states["b"].poses[-1]) < 0.1 * sigmas[-1])


def test_steps_recorded_from_one_run_replay_into_another_back_end(scenario):
    """A comparison of back ends is one of estimation only: the same steps, added while one is asked
    for joints all along and not at all in the other, end in the same place."""
    steps, _ = scenario
    asked, recorded = BACKENDS["isam2"](PLAIN), []
    for step in steps:
        asked.add(step)
        recorded.append(step)
        asked.joint("a", [])
    expected, replayed = asked.finish(), run("batch", recorded).finish()
    for robot in ("a", "b"):
        np.testing.assert_allclose(
            replayed.states[robot].poses, expected.states[robot].poses, atol=1e-6
        )
    for landmark, (mean, _) in expected.landmarks.items():
        np.testing.assert_allclose(replayed.landmarks[landmark][0], mean, atol=1e-5)
    assert replayed.dof == expected.dof


def test_degrees_of_freedom_count_only_rows_with_information(scenario):
    """A line has two rows and its gauge one, whatever GTSAM's factors count: error over dof decides
    whether a run's noise model is believed."""
    steps, _ = scenario
    rows, seen = 0, set()
    for step in steps:
        rows += 3 * (len(step.starts) + len(step.motions) + len(step.closures))
        for association in step.associations:
            rows += MODELS[association.model].rows
            if association.model == "line" and association.target not in seen:
                rows += 1
            seen.add(association.target)
    estimate = run("batch", steps).finish()
    assert estimate.dof == rows - (2 * 7 * 3 + 2 + 3 + 3)


def test_twice_the_error_follows_chi_square():
    """Noise as claimed in a linear enough problem: the mean of 2 error over 30 runs is the number
    of degrees of freedom, 57, within four sigmas of sqrt(2 dof / 30)."""
    values, dof = [], 0
    for seed in range(30):
        rng = np.random.default_rng(seed)
        start = Start(np.zeros(3), np.diag([1e-4, 1e-4, 1e-4]))
        true = rng.multivariate_normal(start.pose, start.cov)
        cov = np.diag([1e-4, 1e-4, 1e-4])
        steps = [Step(0, {"r": start})]
        for k in range(1, 11):
            delta = np.array([0.5, 0.0, 0.1])
            true = compose(true, delta + rng.multivariate_normal(np.zeros(3), cov))
            seen = []
            for landmark, model in MODEL_OF.items():
                z = MODELS[model].predict(true, WORLD[landmark])
                R = np.diag([1e-4, 1e-4, 1e-4])[: len(z), : len(z)]
                z = z + rng.multivariate_normal(np.zeros(len(z)), R)
                seen.append(Association("r", k, landmark, model, z, R))
            steps.append(Step(k, {}, {"r": motion(k - 1, k, delta, cov)}, tuple(seen)))
        estimate = run("batch", steps).finish()
        values.append(2 * estimate.error)
        dof = estimate.dof
    assert dof == 3 + 30 + 10 * (2 + 2 + 3) + 1 - (33 + 8)
    assert abs(np.mean(values) - dof) < 4 * np.sqrt(2 * dof / 30)


@pytest.mark.parametrize("name", EVERY)
def test_covariance_of_odometry_alone_by_hand(name):
    """Facing north, 1 m forward with 0.2 m along and 0.1 m across: across is world x. And 0.1 rad
    of heading at the start is 0.1 m across at the end. Of motions that may slip, the noise is that
    of the mixture of both: one in eleven after any motion, with a hundred times the variance."""
    start = Start(np.array([5.0, 6.0, np.pi / 2]), np.diag([1e-8, 1e-8, 1e-2]))
    step = motion(0, 1, [1, 0, 0], np.diag([4e-2, 1e-2, 1e-8]))
    slip = ImmConfig(slip_probability=0.08, grip_probability=0.8, slip_scale=10.0)
    config = replace(PLAIN, imm=slip)
    backend = run(name, [Step(0, {"r": start}), Step(1, motions={"r": step})], config)
    wider = 10 / 11 + 100 / 11 if name == "imm" else 1.0
    expected = [[1e-2 + wider * 1e-2, 0, -1e-2], [0, wider * 4e-2, 0], [-1e-2, 0, 1e-2]]
    for cov in (backend.joint("r", []).cov, backend.finish().states["r"].covs[-1]):
        np.testing.assert_allclose(cov, expected, atol=2e-7)  # the 1e-8 left in


@pytest.mark.parametrize("name", [*SMOOTHERS, *HORIZONS, "ekf"])
def test_covariance_of_one_update_by_hand(name):
    """A Kalman update on paper: heading known, so position only. The robot faces north, prior 3 m²
    in world x and 1 m² in y; a landmark known to 1e-4 m (seen at the start, when the pose was) is
    seen again with 1 m² along the robot's x (world y) and 1 m² across (world x): 3/4 and 1/2."""
    steps = [Step(0, {"r": Start(np.array([0.0, 0.0, np.pi / 2]), np.diag([1e-8, 1e-8, 1e-12]))})]
    place = np.array([2.0, 3.0, 0.4])
    sure = np.diag([1e-8, 1e-8, 1e-12])
    z = between(steps[0].starts["r"].pose, place)
    steps.append(Step(0, associations=(Association("r", 0, 0, "segment", z, sure),)))
    cov = np.diag([1.0, 3.0, 1e-12])  # along the start frame: x is north
    moved = motion(0, 1, [1.0, 0.0, 0.0], cov)
    z = between(np.array([0.0, 1.0, np.pi / 2]), place)
    seen = Association("r", 1, 0, "segment", z, np.diag([1.0, 1.0, 1e-8]))
    steps.append(Step(1, motions={"r": moved}, associations=(seen,)))
    backend = run(name, steps)
    for cov in (backend.joint("r", []).cov, backend.finish().states["r"].covs[-1]):
        np.testing.assert_allclose(cov[:2, :2], np.diag([0.75, 0.5]), atol=1e-6)
    assert backend.joint("r", [0]).cov[3, 3] == pytest.approx(2e-8, rel=1e-3)


def world_information(steps, estimate):
    """Information matrix of all states and landmarks, in additive world-axis errors, by our own
    models' Jacobians at the estimate. GTSAM appears nowhere."""
    place, size = {}, 0
    for robot, trajectory in estimate.states.items():
        for time in trajectory.stamps_ns:
            place[robot, int(time)] = slice(size, size + 3)
            size += 3
    for landmark, (mean, _) in estimate.landmarks.items():
        place[landmark] = slice(size, size + len(mean))
        size += len(mean)
    value = {
        (robot, int(t)): pose
        for robot, states in estimate.states.items()
        for t, pose in zip(states.stamps_ns, states.poses, strict=True)
    } | {landmark: mean for landmark, (mean, _) in estimate.landmarks.items()}
    info = np.zeros((size, size))

    def add(blocks, cov):
        H = np.zeros((len(cov), size))
        for key, J in blocks:
            H[:, place[key]] += J
        info[:] += H.T @ np.linalg.solve(cov, H)

    def relative(first, second, delta, cov):
        """As a segment seen: the same error as a between factor's."""
        model, x, t = MODELS["segment"], value[first], value[second]
        H_x, H_t = model.jacobians(delta, x, t)
        add([(first, H_x), (second, H_t)], model.noise(delta, cov, x, t))

    gauged = set()
    for step in steps:
        for robot, start in step.starts.items():
            add([((robot, step.time_ns), np.eye(3))], start.cov)
        for robot, moved in step.motions.items():
            ends = (robot, moved.start_ns), (robot, moved.end_ns)
            relative(*ends, moved.delta, moved.cov)
        for c in step.closures:
            relative((c.other, c.other_time_ns), (c.robot, c.time_ns), c.delta, c.cov)
        for seen in step.associations:
            model, source = MODELS[seen.model], (seen.robot, seen.time_ns)
            target = (seen.target, step.time_ns) if isinstance(seen.target, str) else seen.target
            x, t = value[source], value[target]
            H_x, H_t = model.jacobians(seen.z, x, t)
            add([(source, H_x), (target, H_t)], model.noise(seen.z, seen.cov, x, t))
            if seen.model == "line" and target not in gauged:
                gauged.add(target)
                J_x, J_t = MODELS["segment"].jacobians(seen.z, x, t)
                add([(source, J_x[:1]), (target, J_t[:1])], np.eye(1))
    return info, place


@pytest.mark.parametrize("name", SMOOTHERS)
def test_world_covariances_equal_gauss_newton_of_our_own_models(name):
    """All of it at once: every factor's frame conversion, every marginal's conversion to world
    axes, cross terms included. Without noise everything is linearised at the truth, so what is left
    is the conditioning of the information matrix, whose sigmas span 1e-2 to 1: 1e-9."""
    steps, where = two_robots()
    backend = run(name, steps)
    estimate = backend.finish()
    np.testing.assert_allclose(estimate.states["a"].poses[-1], where["a"], atol=1e-9)
    info, place = world_information(steps, estimate)
    cov = np.linalg.inv(info)
    for robot, states in estimate.states.items():
        for time, found in zip(states.stamps_ns, states.covs, strict=True):
            block = place[robot, int(time)]
            np.testing.assert_allclose(found, cov[block, block], atol=1e-9)
    for landmark, (_, found) in estimate.landmarks.items():
        block = place[landmark]
        np.testing.assert_allclose(found, cov[block, block], atol=1e-9)
    joint = backend.joint("b", [2, 0, 1])
    keys = [("b", 6), 2, 0, 1]
    index = np.concatenate([np.arange(place[key].start, place[key].stop) for key in keys])
    np.testing.assert_allclose(joint.cov, cov[np.ix_(index, index)], atol=1e-9)


# ------------------------------------------------------------ meetings, late evidence, a gauge


@pytest.mark.parametrize("name", SMOOTHERS)
@pytest.mark.parametrize("model", ["robot-pose", "robot-point"])
def test_a_sighting_at_equal_stamps_ties_two_robots(name, model):
    """Robot a is well placed and sees b, whose start is off by 0.5 m and known to 1 m only: b gets
    a's certainty and the sighting's on top. The heading comes with a pose, not with a point."""
    true_b = np.array([3.0, 1.0, 2.0])
    starts = {
        "a": Start(np.array([0.0, 0.0, 0.5]), np.diag([1e-4, 1e-4, 1e-6])),
        "b": Start(true_b + np.array([0.5, -0.3, 0.2]), np.diag([1.0, 1.0, 0.25])),
    }
    seen = see("a", 3, "b", model, compose(starts["a"].pose, np.array([0.5, 0, 0])), true_b)
    motions = {
        "a": motion(0, 3, [0.5, 0, 0], 1e-6 * np.eye(3)),
        "b": motion(0, 3, [0, 0, 0], 1e-6 * np.eye(3)),
    }
    backend = run(name, [Step(0, starts), Step(3, {}, motions, (seen,))])
    b = backend.finish().states["b"]
    # prior 1 m against a sighting of sigma below 0.06 m: what remains of 0.5 m is below 2 mm
    # (a pose's along-axis sigma is 0.55 m in `noise_cov`, so only its sure axis is held to that)
    if model == "robot-point":
        np.testing.assert_allclose(b.poses[-1, :2], true_b[:2], atol=0.02)
        assert np.linalg.eigvalsh(b.covs[-1][:2, :2]).max() < 0.08**2
        # the prior is a normal of the logarithm, where 0.2 rad off couples heading and place a bit
        assert b.covs[-1][2, 2] == pytest.approx(0.25, rel=0.05)
    else:
        off = between(true_b, b.poses[-1])
        assert abs(off[1]) < 0.02 and abs(off[2]) < 0.005
        assert np.sqrt(np.linalg.eigvalsh(b.covs[-1][:2, :2]).min()) < 0.04
        assert np.sqrt(b.covs[-1][2, 2]) < 0.02
    # the tie works backwards in time as well: b's start is corrected through its motion
    assert abs(between(true_b, b.poses[0])[1]) < 0.02 or model == "robot-point"


def test_a_sighting_needs_the_other_robots_state_at_its_stamp():
    starts = {r: Start(np.zeros(3), np.eye(3)) for r in "ab"}
    seen = see("a", 3, "b", "robot-point", np.zeros(3), np.ones(3))
    alone = Step(3, {}, {"a": motion(0, 3, [0, 0, 0], np.eye(3))}, (seen,))
    with pytest.raises(EstimationError, match="robot b has no state at 3 ns"):
        run("isam2", [Step(0, starts), alone])


@pytest.mark.parametrize("name", SMOOTHERS)
def test_late_evidence_enters_at_the_state_it_was_seen_from(name):
    """Three sightings of one point, entered when the third was made: the result equals that of
    sightings entered at once, and is better than the last alone."""
    x = [np.array([0.5 * k, 0.0, 0.0]) for k in range(4)]
    steps = [Step(0, {"r": Start(x[0], 1e-4 * np.eye(3))})]
    steps += [
        Step(k, motions={"r": motion(k - 1, k, [0.5, 0, 0], 1e-2 * np.eye(3))}) for k in (1, 2, 3)
    ]
    seen = [see("r", k, 0, "point", x[k], WORLD[0], np.random.default_rng(k)) for k in (1, 2, 3)]
    late = [Association(*(getattr(s, f) for f in s.__slots__[:6]), True) for s in seen[:2]]

    def ends(extra):
        return run(name, [*steps[:-1], *extra]).finish()

    last = steps[-1].motions
    together = ends([Step(3, {}, last, (*late, seen[2]))])
    alone = ends([Step(3, {}, last, (seen[2],))])
    at_once = run(
        name,
        [steps[0], *(Step(k, {}, steps[k].motions, (seen[k - 1],)) for k in (1, 2, 3))],
    ).finish()
    for a, b in zip(together.landmarks[0], at_once.landmarks[0], strict=True):
        np.testing.assert_allclose(a, b, atol=1e-7)
    np.testing.assert_allclose(together.states["r"].poses, at_once.states["r"].poses, atol=1e-7)
    assert np.trace(together.landmarks[0][1]) < 0.7 * np.trace(alone.landmarks[0][1])
    # seen from three places, the motions between them are better known, too
    assert np.trace(together.states["r"].covs[3]) < 0.8 * np.trace(alone.states["r"].covs[3])


def with_gauges(monkeypatch, steps):
    """The batch estimates with the gauge's sigma at 1 m and at 10 m."""
    from graphslam.estimation import factors

    results = []
    for sigma in (1.0, 10.0):
        monkeypatch.setattr(factors, "LINE_GAUGE_SIGMA_M", sigma)
        results.append(run("batch", steps).finish())
    return results


def along_sigma(estimate):
    """Sigma of the line landmark's place along itself, m."""
    mean, cov = estimate.landmarks[1]
    return np.sqrt(rotate_cov(cov, -mean[2])[0, 0])


def test_where_a_line_begins_is_a_gauge(monkeypatch):
    """Ten times the gauge's sigma changes the line's own place along itself and nothing else.
    Without noise, so exactly."""
    a, b = with_gauges(monkeypatch, two_robots()[0])
    for robot in ("a", "b"):
        np.testing.assert_allclose(a.states[robot].poses, b.states[robot].poses, atol=1e-8)
        np.testing.assert_allclose(a.states[robot].covs, b.states[robot].covs, atol=1e-8)
    assert along_sigma(a) == pytest.approx(1.0, rel=0.02)  # and the 0.1 m of the state it hangs on
    assert along_sigma(b) == pytest.approx(10.0, rel=0.001)


def test_the_gauge_matters_little_with_noise(monkeypatch, scenario):
    """A direction's residual times how far the origin slid is information along the line that is
    none: second order, measured 5 % of a sigma here. More of it would be the naive treatment's."""
    a, b = with_gauges(monkeypatch, scenario[0])
    for robot in ("a", "b"):
        sigmas = np.sqrt(np.diagonal(a.states[robot].covs, axis1=1, axis2=2))
        others = np.sqrt(np.diagonal(b.states[robot].covs, axis1=1, axis2=2))
        assert np.all(np.abs(a.states[robot].poses - b.states[robot].poses) < 0.1 * sigmas)
        np.testing.assert_allclose(sigmas, others, rtol=0.02)
    assert along_sigma(b) > 4.0


# ------------------------------------------------------------ when it goes wrong


@pytest.mark.parametrize("name", EVERY)
@pytest.mark.parametrize("when", ["joint", "finish"])
def test_indeterminate_landmark_is_named(name, when):
    """A point at range zero has no bearing: QR answers NaN without a word. One line in terms of the
    log, never GTSAM's."""
    backend = run(name, [Step(0, {"r": Start(np.zeros(3), 1e-4 * np.eye(3))})])
    point = Association("r", 0, 7, "point", np.zeros(2), 1e-4 * np.eye(2))
    with pytest.raises(EstimationError, match="at landmark 7, seen from robot r") as error:
        backend.add(Step(0, associations=(point,)))
        backend.joint("r", [7]) if when == "joint" else backend.finish()
    assert "Symbol" not in str(error.value)


@pytest.mark.parametrize("key", ["b", 2])
def test_what_gtsam_complains_about_is_said_in_terms_of_the_log(scenario, key):
    """A state of the second robot, of whose key GTSAM prints only the first digits; a landmark."""
    builder = run("batch", scenario[0]).builder
    at = builder.state_key("b", 3) if key == "b" else landmark_key(2)
    unknown, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    nothing = gtsam.noiseModel.Gaussian.SqrtInformation(np.zeros((3, 3)), False)
    unknown.add(gtsam.PriorFactorPose2(at, gtsam.Pose2(), nothing))
    values.insert(at, gtsam.Pose2())
    with pytest.raises(RuntimeError, match="Symbol") as error:
        gtsam.Marginals(unknown, values).marginalCovariance(at)
    said = {"b": "at robot b at 3 ns", 2: "at landmark 2, seen from robot a at 1 ns"}
    assert said[key] in str(builder.explain(error.value))
    assert "some variable" in str(builder.explain(RuntimeError("out of memory")))


@pytest.mark.parametrize("name", [*SMOOTHERS, *HORIZONS])
def test_motion_without_a_valid_covariance_is_refused(name):
    backend = run(name, [Step(0, {"r": Start(np.zeros(3), np.eye(3))})])
    with pytest.raises(EstimationError, match="positive definite"):
        backend.add(Step(1, motions={"r": motion(0, 1, [1, 0, 0], np.zeros((3, 3)))}))


@pytest.mark.parametrize("name", EVERY)
@pytest.mark.parametrize("what", ["start", "motion", "sighting"])
def test_infinite_variance_is_named_by_robot_landmark_and_time(name, what):
    """Infinity in a covariance is no weak knowledge but a mistake; one line, before it spreads."""
    endless = np.diag([1e-4, np.inf, 1e-4])
    start = Start(np.zeros(3), endless if what == "start" else 1e-4 * np.eye(3))
    moved = motion(0, 8, [1, 0, 0], endless if what == "motion" else MOTION_COV)
    seen = Association("r", 8, 7, "point", np.array([0.1, 3.0]), endless[:2, :2])
    named = {"start": "robot r at 0 ns", "motion": "robot r to 8 ns"}
    pattern = named.get(what, "landmark 7.* robot r at 8 ns")
    with pytest.raises(EstimationError, match=pattern) as error:
        run(name, [Step(0, {"r": start}), Step(8, {}, {"r": moved}, (seen,))])
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", [*SMOOTHERS, *HORIZONS, "ekf", "invariant-ekf"])
def test_a_good_graph_with_a_wide_spread_of_information_is_solved(name):
    """Sigmas from 1e-6 to 1e4: Cholesky calls it indeterminate, QR does not. The landmark's
    covariance is that of the motion, carried along."""
    steps = [
        Step(0, {"r": Start(np.zeros(3), 1e-12 * np.eye(3))}),
        Step(1, motions={"r": motion(0, 1, [1, 0, 0], 1e8 * np.eye(3))}),
        Step(
            1,
            associations=(
                Association("r", 1, 7, "point", np.array([0.0, 4.0]), 1e-12 * np.eye(2)),
            ),
        ),
    ]
    estimate = run(name, steps).finish()
    np.testing.assert_allclose(estimate.states["r"].covs[-1], 1e8 * np.eye(3), rtol=1e-3, atol=1e3)
    np.testing.assert_allclose(estimate.landmarks[7][1], np.diag([1e8, 1.7e9]), rtol=1e-3, atol=1e5)


@pytest.mark.parametrize("kernel", ["huber", "cauchy", "geman-mcclure"])
def test_robust_kernel_ignores_a_gross_outlier(kernel):
    """One of ten sightings of a point is 3 m off: without a kernel the landmark moves by 0.3 m."""

    def place(config):
        backend = run("batch", [Step(0, {"r": Start(np.zeros(3), 1e-8 * np.eye(3))})], config)
        rng = np.random.default_rng(1)
        for k in range(10):
            seen = see("r", 0, 0, "point", np.zeros(3), WORLD[0], rng)
            if k == 5:
                seen = Association("r", 0, 0, "point", seen.z + np.array([0.0, 3.0]), seen.cov)
            backend.add(Step(0, associations=(seen,)))
        return np.linalg.norm(backend.finish().landmarks[0][0] - WORLD[0])

    assert place(PLAIN) > 0.25
    assert place(Config(robust=RobustConfig(kernel, 2.0))) < 0.05


# ------------------------------------------------------------ dead reckoning, bookkeeping


@pytest.mark.parametrize(("kernel", "low", "high"), [("none", 0.05, 1.0), ("cauchy", 0.0, 0.005)])
def test_a_kernel_of_motions_gives_up_the_one_that_slipped(kernel, low, high):
    """One of ten motions is 1 m too long, 16 sigmas; points are seen from every state. Without the
    kernel the states around it are far off; with it the points decide."""
    config = replace(PLAIN, robust=RobustConfig("none", motions=kernel))
    x, steps = np.zeros(3), [Step(0, {"r": Start(np.zeros(3), 1e-6 * np.eye(3))})]
    truth = [x]
    points = [np.array([3.0, 2.0]), np.array([6.0, -2.0]), np.array([2.0, -3.0])]
    for k in range(1, 11):
        delta = np.array([0.5, 0.0, 0.1])
        x = compose(x, delta)
        slipped = np.array([float(k == 5), 0.0, 0.0])
        moved = motion(k - 1, k, delta + slipped, MOTION_COV)
        seen = tuple(see("r", k, n, "point", x, point) for n, point in enumerate(points))
        steps.append(Step(k, {}, {"r": moved}, seen))
        truth.append(x)
    found = run("batch", steps, config).finish()
    off = found.states["r"].poses - np.array(truth)
    assert low <= np.hypot(off[:, 0], off[:, 1]).max() <= high
    assert (found.error > 50) == (kernel == "none")


def test_dead_reckoning_is_composition_and_nothing_else(scenario):
    steps, _ = scenario
    estimate = run("dead-reckoning", steps).finish()
    for robot in ("a", "b"):
        pose, cov = steps[0].starts[robot].pose, steps[0].starts[robot].cov
        for step in steps[1:]:
            moved = step.motions[robot]
            cov = compose_cov(pose, cov, moved.delta, moved.cov)
            pose = compose(pose, moved.delta)
        np.testing.assert_allclose(estimate.states[robot].poses[-1], pose, atol=1e-14)
        np.testing.assert_allclose(estimate.states[robot].covs[-1], cov, atol=1e-16)


def test_dead_reckoning_leaves_landmarks_where_they_were_first_seen():
    """4.24-4.28: mean and covariance of the first sighting, whatever follows."""
    start = Start(np.array([1.0, 2.0, 0.5]), np.diag([1e-2, 1e-2, 1e-3]))
    steps = [Step(0, {"r": start}), Step(1, motions={"r": motion(0, 1, [1, 0, 0], MOTION_COV)})]
    z = np.array([0.3, 4.0])
    cov = np.diag([1e-4, 1e-2])
    first = Association("r", 0, 0, "point", z, cov)
    second = Association("r", 1, 0, "point", z + 0.5, cov)
    estimate = run("dead-reckoning", [steps[0], Step(0, associations=(first,)), steps[1],
                                      Step(1, associations=(second,))]).finish()  # fmt: skip
    mean, found = estimate.landmarks[0]
    model = MODELS["point"]
    G_x, G_z = model.invert_jacobians(z, start.pose)
    np.testing.assert_allclose(mean, model.invert(z, start.pose), atol=1e-15)
    np.testing.assert_allclose(found, G_x @ start.cov @ G_x.T + G_z @ cov @ G_z.T, atol=1e-16)


def test_state_table_numbers_states_per_robot_and_time():
    table = StateTable()
    assert [table.append("a", 5), table.append("b", 5), table.append("a", 9)] == [0, 0, 1]
    assert (table.number("a", 9), table.latest("a"), table.latest("b")) == (1, 1, 0)
    np.testing.assert_array_equal(table.stamps("a"), [5, 9])


def test_block_slices_follow_the_pose():
    assert block_slices([2, 3]) == (slice(3, 5), slice(5, 8))
    assert block_slices([]) == ()


def test_compose_jacobians_are_what_the_backends_share():
    """`compose_cov` is F P Fᵀ + W Q Wᵀ with these; named here since two back ends rely on it."""
    a, b = np.array([1.0, 2.0, 0.3]), np.array([0.5, 0.1, 0.2])
    F, W = compose_jacobians(a, b)
    P, Q = np.diag([1.0, 2.0, 3.0]), MOTION_COV
    np.testing.assert_allclose(compose_cov(a, P, b, Q), F @ P @ F.T + W @ Q @ W.T, atol=1e-15)
