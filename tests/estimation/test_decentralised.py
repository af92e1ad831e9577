"""A graph per robot and messages between them: nothing is lost to first order, or counted twice."""

from dataclasses import replace

import numpy as np
import pytest
from backend_cases import MOTION_COV, PLAIN, assert_covariance, motion, see, two_robots

from graphslam.core.config import NetworkConfig
from graphslam.core.config_io import load_config
from graphslam.core.geometry import compose
from graphslam.core.records import Association, Start, Step
from graphslam.estimation.backends import BACKENDS
from graphslam.estimation.message_link import Inbox, Network, Outbox, Packet
from graphslam.estimation.replay import replay
from graphslam.evaluation.compare_backends import compare
from graphslam.evaluation.compare_variants import parse_variants
from graphslam.evaluation.recorded_steps import record_steps
from graphslam.evaluation.timed_replay import timed_replay
from graphslam.logs import LogWriter, open_logs

S = 1_000_000_000


def config(exchange_s):
    return replace(PLAIN, backend=replace(PLAIN.backend, exchange_s=exchange_s))


def run(name, steps, exchange_s=30.0):
    backend = BACKENDS[name](config(exchange_s))
    for step in steps:
        backend.add(step)
    return backend


def wandering(noise=0.0, seed=0, states=18, marks=2):
    """Robots `a` and `b` see all points from all states, 1 s apart; every eighth is a meeting.

    So there is something to condense. Measurements are off by ``noise`` of their sigmas.
    """
    rng = np.random.default_rng(seed)
    where = {"a": np.array([0.0, 0.0, 0.3]), "b": np.array([3.0, -1.0, 2.0])}
    points = rng.uniform(-4, 6, (marks, 2))
    steps = [Step(0, {r: Start(x, 1e-3 * np.eye(3)) for r, x in where.items()})]
    for k in range(1, states):
        motions, seen = {}, []
        for robot, moved in (("a", [0.5, 0.0, 0.25]), ("b", [0.4, 0.0, -0.3])):
            where[robot] = compose(where[robot], np.array(moved))
            off = noise * rng.multivariate_normal(np.zeros(3), MOTION_COV)
            motions[robot] = motion((k - 1) * S, k * S, np.array(moved) + off, MOTION_COV)
        for robot, x in where.items():
            for n, at in enumerate(points):
                found = see(robot, k * S, n, "point", x, at)
                z = found.z + noise * rng.multivariate_normal(np.zeros(2), found.cov)
                seen.append(replace(found, z=z))
        if k % 8 == 0:
            found = see("a", k * S, "b", "robot-point", where["a"], where["b"])
            z = found.z + noise * rng.multivariate_normal(np.zeros(2), found.cov)
            seen.append(replace(found, z=z))
        steps.append(Step(k * S, {}, motions, tuple(seen)))
    return steps


def all_of(estimate):
    """Means (n,) of everything, and sigmas; covariances of states."""
    covs = np.concatenate([t.covs for t in estimate.states.values()])
    means = [t.poses.ravel() for t in estimate.states.values()]
    sigmas = [np.sqrt(np.diagonal(covs, axis1=1, axis2=2)).ravel()]
    for mean, cov in (estimate.landmarks[n] for n in sorted(estimate.landmarks)):
        means.append(mean)
        sigmas.append(np.sqrt(np.diag(cov)))
    return np.concatenate(means), np.concatenate(sigmas), covs


@pytest.mark.parametrize("exchange_s", [5.0, 8.0, 100.0])
def test_without_noise_the_exchange_loses_and_adds_nothing(exchange_s):
    """Linearised at the truth all messages are exact: means and covariances are those of one graph
    of everything, however often was told. Information left out or told twice breaks it."""
    steps = wandering()
    expected = all_of(run("batch", steps).finish())
    backend = run("decentralised", steps, exchange_s)
    found = all_of(backend.finish())
    # else nothing was condensed, and there is nothing to see here
    numbers = 8 * backend.messages
    assert sum(backend.sent.values()) - numbers < 0.9 * sum(backend.measured.values())
    np.testing.assert_allclose(found[0], expected[0], atol=1e-6)
    np.testing.assert_allclose(found[1], expected[1], rtol=1e-4)


def test_the_loss_is_that_of_the_linearisation():
    """A tenth of the noise, a hundredth of the distance from the centralised estimate, per sigma a
    tenth: so nothing of first order is lost."""
    off = []
    for noise in (1.0, 0.1):
        steps = wandering(noise, seed=3)
        mean, sigma, _ = all_of(run("batch", steps).finish())
        found, _, _ = all_of(run("decentralised", steps, 6.0).finish())
        off.append(np.abs((found - mean) / sigma).max())
    assert off[0] < 0.5
    assert off[1] < 0.05 * off[0]


def assert_knows_no_more(own, central, robot):
    """A robot's covariance by itself is at least that of the centralised estimate."""
    all_, mine = (backend.joint(robot, []).cov for backend in (central, own))
    assert_covariance(mine)
    sigma = np.sqrt(np.diag(all_))
    more = np.linalg.eigvalsh((mine - all_) / np.outer(sigma, sigma))
    # 2 %: at a fifth of the noise places of linearisation differ that little; what comes twice
    # shows with a third and more
    assert more.min() > -0.02


@pytest.mark.parametrize("seed", range(5))
def test_nobody_claims_to_know_more_than_all_of_them_together(seed):
    """At any time: covariances of each robot's own estimate are at least those of the centralised
    one. Anything that came twice would be believed twice."""
    steps = wandering(0.2, seed)
    central, own = (BACKENDS[name](config(3.0)) for name in ("batch", "decentralised"))
    for step in steps:
        central.add(step)
        own.add(step)
        for robot in "ab":
            assert_knows_no_more(own, central, robot)


def test_normalised_errors_are_honest():
    """NEES of the last states over 60 runs, 3 dof each for two robots: as of the centralised one,
    inside of the bounds of 360 dof at 99.9 %."""
    total = {"batch": 0.0, "decentralised": 0.0}
    for seed in range(60):
        rng = np.random.default_rng(1000 + seed)
        steps = wandering(1.0, seed)
        truth = wandering(0.0, seed)
        starts = {}
        for robot, start in steps[0].starts.items():
            off = rng.multivariate_normal(np.zeros(3), start.cov)
            starts[robot] = Start(start.pose + off, start.cov)
        steps[0] = replace(steps[0], starts=starts)
        for name in total:
            found = run(name, steps, 6.0).finish()
            for robot in "ab":
                where = truth[0].starts[robot].pose
                for step in truth[1:]:
                    where = compose(where, step.motions[robot].delta)
                off = found.states[robot].poses[-1] - where
                off[2] = np.arctan2(np.sin(off[2]), np.cos(off[2]))
                total[name] += off @ np.linalg.solve(found.states[robot].covs[-1], off)
    for value in total.values():
        assert 0.77 < value / 360 < 1.26
    assert total["decentralised"] == pytest.approx(total["batch"], rel=0.05)


def test_bytes_of_a_tiny_example():
    """Counted by hand: names and numbers have eight bytes.

    Robot a moves ten times, sees a point at the first and the last state and b at the last; b
    stands where it started. Of a's ten motions nine states are nobody's business: what is left
    ties first state, last state and the point, 8 dimensions.
    """
    start = Start(np.zeros(3), 1e-4 * np.eye(3))
    steps = [Step(0, {"a": start, "b": Start(np.array([3.0, 1.0, 0.0]), start.cov)})]
    where, point = np.zeros(3), np.array([4.0, 2.0])
    for k in range(1, 11):
        where = compose(where, np.array([0.2, 0.0, 0.05]))
        motions = {"a": motion((k - 1) * S, k * S, [0.2, 0.0, 0.05], MOTION_COV)}
        seen = [see("a", k * S, 0, "point", where, point)] if k in (1, 10) else []
        if k == 10:
            motions["b"] = motion(0, k * S, [0.0, 0.0, 0.0], MOTION_COV)
            seen.append(see("a", k * S, "b", "robot-point", where, np.array([3.0, 1.0, 0.0])))
        steps.append(Step(k * S, {}, motions, tuple(seen)))
    backend = run("decentralised", steps)
    backend.finish()
    prior, moved, sighting = 8 + 8 * 9, 16 + 8 * 9, 16 + 8 * 5
    assert backend.measured == {"a": prior + 10 * moved + 3 * sighting, "b": prior + moved}
    ends_and_point = 8 * 8 + 3 * 8 + 8 * (8 * 9 // 2 + 8)
    # what nothing is eliminated from goes as it is: the prior, the last look at point and robot;
    # and the number of the message
    assert backend.sent == {
        "a": 8 + prior + ends_and_point + 2 * sighting,
        "b": 8 + prior + moved,
    }


def test_lines_and_late_evidence_are_taken():
    """All kinds of landmarks; what is about a state before the last message stays with its robot,
    counted."""
    steps, where = two_robots(np.random.default_rng(4))
    backend = run("decentralised", steps, 2e-9)
    estimate = backend.finish()
    assert sum(backend.skipped.values()) > 0
    for robot, truth in where.items():
        states = estimate.states[robot]
        miss = states.poses[-1] - truth
        assert np.all(np.abs(miss) < 5 * np.sqrt(np.diag(states.covs[-1])))


def test_a_meeting_helps_the_one_that_was_seen():
    """Not before the message, at once after it."""
    start = Start(np.zeros(3), 1e-4 * np.eye(3))
    lost = Start(np.array([3.0, 1.0, 0.0]), np.diag([1.0, 1.0, 1e-4]))
    seen = Association(
        "a", 0, "b", "robot-point", np.array([np.arctan2(1, 3), 10**0.5]), MOTION_COV[:2, :2]
    )
    backend = run("decentralised", [Step(0, {"a": start, "b": lost}, {}, (seen,))], 1.0)
    before = backend.joint("b", []).cov
    np.testing.assert_allclose(before, lost.cov, rtol=1e-6)
    backend.add(Step(2 * S, {}, {"b": motion(0, 2 * S, [0.0, 0.0, 0.0], MOTION_COV)}))
    assert np.trace(backend.joint("b", []).cov[:2, :2]) < 0.1 * np.trace(before[:2, :2])


# ------------------------------------------------------------ messages lost and late


def lossy(loss=0.0, delay_s=0.0, exchange_s=3.0, seed=0):
    return replace(config(exchange_s), network=NetworkConfig(loss, delay_s, seed))


@pytest.mark.parametrize(("loss", "delay_s"), [(0.0, 7.0), (0.4, 0.0), (0.4, 7.0)])
def test_when_all_have_met_it_does_not_matter_what_was_lost_or_late(loss, delay_s):
    """Without noise messages are exact, so means and covariances are those of one graph: nothing
    lost is missing, nothing repeated is counted twice, and sightings of others that came before the
    state in which the other was have been kept."""
    steps = wandering(states=26)
    expected = all_of(run("batch", steps).finish())
    backend = BACKENDS["decentralised"](lossy(loss, delay_s, 3.0, 5))
    for step in steps:
        backend.add(step)
    found = all_of(backend.finish())
    np.testing.assert_allclose(found[0], expected[0], atol=1e-6)
    np.testing.assert_allclose(found[1], expected[1], rtol=1e-4)


@pytest.mark.parametrize("seed", range(3))
def test_with_messages_lost_and_late_nobody_claims_to_know_more_than_all_together(seed):
    """At any time, as above; a repeated message that came after all must not count twice."""
    steps = wandering(0.2, seed, states=26)
    central = BACKENDS["batch"](config(3.0))
    own = BACKENDS["decentralised"](lossy(0.4, 5.0, 2.0, seed))
    for step in steps:
        central.add(step)
        own.add(step)
        for robot in "ab":
            assert_knows_no_more(own, central, robot)


def led(states):
    """Robot `a` sees a point from all states, and `b` from every second; b itself sees nothing."""
    start = {"a": np.zeros(3), "b": np.array([3.0, 1.0, 0.0])}
    where, point = dict(start), np.array([4.0, 2.0])
    steps = [Step(0, {r: Start(x, 1e-4 * np.eye(3)) for r, x in start.items()})]
    for k in range(1, states):
        motions = {}
        for robot, x in list(where.items()):
            where[robot] = compose(x, np.array([0.1, 0.0, 0.05]))
            motions[robot] = motion((k - 1) * S, k * S, [0.1, 0.0, 0.05], MOTION_COV)
        seen = [see("a", k * S, 0, "point", where["a"], point)]
        if k % 2 == 0:
            seen.append(see("a", k * S, "b", "robot-pose", where["a"], where["b"]))
        steps.append(Step(k * S, {}, motions, tuple(seen)))
    return steps


def uncertainty(loss=0.0, delay_s=0.0, exchange_s=4.0):
    """Area of b's position's covariance by its own estimator at each of 40 states, m⁴."""
    backend, areas = BACKENDS["decentralised"](lossy(loss, delay_s, exchange_s, 1)), []
    for step in led(40):
        backend.add(step)
        areas.append(np.linalg.det(backend.joint("b", []).cov[:2, :2]))
    return np.array(areas), backend


def test_lost_messages_are_repeated_while_robots_are_under_way():
    """A third of the messages are lost. b is less sure of where it is than with all of them, yet
    much surer than alone, as most of them are used by the end: without repetition the first one
    that is lost, here before the sixth, would stop all that come after it."""
    all_, none = uncertainty(exchange_s=1.0)[0], uncertainty(exchange_s=1e9)[0]
    some, backend = uncertainty(loss=0.33, exchange_s=1.0)
    a, b = backend.robots
    assert min(a.outbox.repeated) < 6
    assert b.inboxes["a"].following > 0.8 * len(a.outbox.contents)
    assert np.all(some >= all_ * (1 - 1e-6))
    assert 1.2 * all_.mean() < some.mean() < 0.3 * none.mean()


def test_late_messages_are_taken_in_when_they_come():
    """Up to 6 s late: the areas are between those with messages in time and those without any."""
    in_time, late, none = (
        uncertainty(delay_s=delay_s, exchange_s=exchange_s)[0][8:]
        for delay_s, exchange_s in ((0.0, 4.0), (6.0, 4.0), (0.0, 1e9))
    )
    assert np.all(in_time <= late * (1 + 1e-6))
    assert np.all(late <= none * (1 + 1e-6))
    assert 1.2 * in_time.mean() < late.mean() < 0.8 * none.mean()
    # messages are sent at multiples of 10 s, and come at other times
    falls = np.flatnonzero(np.diff(uncertainty(delay_s=6.0, exchange_s=10.0)[0]) < 0) + 1
    assert len(falls) and np.any(falls % 10 != 0)


def test_what_the_robots_tell_each_other_when_they_meet_is_paid_for():
    """All is lost on the way, so all is sent again at the end."""
    sent = []
    for loss in (0.0, 1.0):
        backend = BACKENDS["decentralised"](lossy(loss))
        for step in wandering():
            backend.add(step)
        backend.finish()
        sent.append(backend.sent)
    assert sent[1] == {robot: 2 * size for robot, size in sent[0].items()}


def test_messages_of_a_link_come_in_order_and_once():
    inbox = Inbox()
    assert inbox.accept([(1, "b")]) == []
    assert inbox.lacking() == {0}
    assert inbox.accept([(3, "d"), (1, "again")]) == []
    assert inbox.lacking() == {0, 2}
    assert inbox.accept([(0, "a")]) == ["a", "b"]
    assert inbox.accept([(0, "a"), (1, "b")]) == []
    assert inbox.lacking() == {2}
    assert inbox.accept([(2, "c")]) == ["c", "d"]
    assert inbox.lacking() == set()


def test_a_message_is_repeated_once_for_every_time_it_was_missed():
    """Two receivers ask for the same one: one repetition. Who asks before that has been sent may
    have it by now, so it is not sent again; who asks after it is."""
    outbox = Outbox()
    assert outbox.send("a", 0) == [(0, "a")]
    assert outbox.send("b", 10) == [(1, "b")]
    outbox.ask({0}, 12)
    outbox.ask({0}, 13)
    assert outbox.send("c", 20) == [(0, "a"), (2, "c")]
    outbox.ask({0}, 15)
    assert outbox.send("d", 30) == [(3, "d")]
    outbox.ask({0}, 25)
    assert outbox.send("e", 40) == [(0, "a"), (4, "e")]


def test_the_network_loses_and_delays_as_it_is_told():
    """Each receiver by itself: 4000 packets to two, a quarter lost within four sigmas of 0.7 %,
    delays uniform up to 2 s."""
    network, delays, got = Network(NetworkConfig(0.25, 2.0)), [], []
    for k in range(4000):
        network.send(Packet("a", k * 10 * S, [(k, None)], {}), ["b", "c"])
        for now in range(k * 10 * S, (k * 10 + 3) * S, S // 100):
            here = [(name, packet.messages[0][0]) for name, packet in network.arrived(now)]
            got += here
            delays += [now - k * 10 * S for _ in here]
            if len(here) == 2:
                break
    assert len(got) == len(set(got))
    for name in "bc":
        assert sum(who == name for who, _ in got) / 4000 == pytest.approx(0.75, abs=0.028)
    both = len({k for who, k in got if who == "b"} & {k for who, k in got if who == "c"})
    assert both / 4000 == pytest.approx(0.75**2, abs=0.032)
    assert np.mean(delays) / S == pytest.approx(1.0, abs=0.05)
    assert max(delays) <= 2.01 * S


def test_it_is_a_row_of_a_comparison(tmp_path):
    """With its bytes; final as good as batch, causal worse, as messages come late."""
    rng = np.random.default_rng(0)
    marks = {"1": (2.0, 1.0), "2": (-1.0, 3.0), "3": (4.0, -2.0)}
    where = {"a": np.zeros(3), "b": np.array([3.0, 2.0, 2.0])}
    with LogWriter(tmp_path / "log.mcap") as log:
        for k in range(200):
            for robot, x in where.items():
                log.odometry(robot, k * S // 5, x)
                log.truth(robot, k * S // 5, x)
                for name, at in marks.items():
                    z = see(robot, 0, 0, "point", x, np.array(at)).z
                    z = z + [0.01, 0.05] * rng.normal(size=2)
                    if k % 3 == 0:
                        log.sighting(robot, k * S // 5, z, np.diag([1e-4, 25e-4]), identity=name)
                where[robot] = compose(x, np.array([0.05, 0.0, 0.02]))
    settings = load_config(overrides=["start.from_truth=true"])
    opened = open_logs([tmp_path / "log.mcap"], settings)
    rows = parse_variants(["batch", "decentralised+backend.exchange_s=5"], settings)
    found = compare(opened, settings, rows, run=timed_replay).summary["rows"]
    assert [row["error"] for row in found] == [None, None]
    assert "exchanged" not in found[0]
    for told in found[1]["exchanged"].values():
        # three landmarks seen again and again: condensed is much less
        assert 0 < told["sent_bytes"] < 0.8 * told["measured_bytes"]
    assert found[1]["difference"]["final"]["rmse_m"] < 0.005
    steps = record_steps(opened, settings).steps
    done = replay(steps, BACKENDS["decentralised"](settings))
    assert set(done.estimate.states) == {"a", "b"}
