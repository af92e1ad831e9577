"""Landmarks that two robots named differently: tied if beyond doubt, else kept apart."""

from dataclasses import replace

import numpy as np
import pytest
from backend_cases import PLAIN, two_robots
from test_decentralised import all_of, run, wandering

from graphslam.core.config import AssociationConfig
from graphslam.core.geometry import compose
from graphslam.core.records import Start
from graphslam.estimation.backends import BACKENDS
from graphslam.estimation.decentralised import landmark_ties
from graphslam.estimation.landmark_ties import Named, surest_tie, tied

SETTINGS = AssociationConfig(floor_m=0.0, floor_rad=0.0)
A, B, C = (frozenset([n]) for n in range(3))


def named(*landmarks, cov=None):
    """Landmarks by owners, mean and sigma, independent unless ``cov`` is given; keys count on."""
    owners, means, sigmas = zip(*landmarks, strict=True)
    spread = [np.full(len(m), s) for m, s in zip(means, sigmas, strict=True)]
    cov = np.diag(np.square(np.concatenate(spread))) if cov is None else cov
    return Named(range(len(landmarks)), owners, [np.array(m, float) for m in means], cov)


def test_two_names_of_one_point_are_tied_and_the_likelier_pair_first():
    found = named((A, (0, 0), 0.1), (A, (5, 5), 0.1), (B, (0.2, 0), 0.1), (B, (5.05, 5), 0.1))
    assert surest_tie(found, SETTINGS) == (1, 3)


@pytest.mark.parametrize(("off", "same"), [(0.4, True), (0.5, False), (0.7, False)])
def test_the_gate_is_that_of_association(off, same):
    """Sigma of the difference 0.141: 3.03 sigmas, within 99 % of two rows, are 0.429."""
    found = named((A, (0, 0), 0.1), (B, (off, 0), 0.1))
    assert (surest_tie(found, SETTINGS) is not None) == same


@pytest.mark.parametrize(("other", "waits"), [(0.55, True), (0.7, False)])
def test_a_pair_waits_while_another_is_within_the_higher_quantile(other, waits):
    """99.99 % are 4.29 sigmas, 0.607 m: the other one need not be within the gate itself."""
    found = named((A, (0, 0), 0.1), (B, (0.1, 0), 0.1), (B, (-other, 0), 0.1))
    assert (surest_tie(found, SETTINGS) is None) == waits
    mirrored = named((A, (0.1, 0), 0.1), (A, (-other, 0), 0.1), (B, (0, 0), 0.1))
    assert (surest_tie(mirrored, SETTINGS) is None) == waits


def test_a_third_robots_name_for_the_same_landmark_is_no_doubt():
    """It excludes nothing: one landmark may have a name of each robot."""
    found = named((A, (0, 0), 0.1), (B, (0.1, 0), 0.1), (C, (0.02, 0.01), 0.1))
    assert surest_tie(found, SETTINGS) == (0, 2)
    rest = named((A | C, (0, 0), 0.1), (B, (0.1, 0), 0.1))
    assert surest_tie(rest, SETTINGS) == (0, 1)


def test_what_one_robot_knows_as_two_is_two():
    assert surest_tie(named((A, (0, 0), 0.1), (A, (0.01, 0), 0.1)), SETTINGS) is None
    assert surest_tie(named((A | B, (0, 0), 0.1), (B | C, (0, 0), 0.1)), SETTINGS) is None


def test_points_are_no_walls_and_walls_are_compared_across():
    """4 m apart along them and 5 cm across: one wall. Turned by half a turn: its other side."""
    wall = (2.0, 1.0, 0.3)
    along = compose(np.array(wall), np.array([4.0, 0.05, 0.02]))
    assert surest_tie(named((A, wall[:2], 0.1), (B, wall, 0.1)), SETTINGS) is None
    sure = replace(SETTINGS, max_distance_m=0.5)
    assert surest_tie(named((A, wall, 0.1), (B, along, 0.1)), sure) == (0, 1)
    across = compose(np.array(wall), np.array([0.0, 0.6, 0.0]))
    assert surest_tie(named((A, wall, 1.0), (B, across, 1.0)), sure) is None
    back = np.array([*wall[:2], wall[2] + np.pi])
    assert surest_tie(named((A, wall, 0.1), (B, back, 0.1)), sure) is None


def test_a_walls_direction_makes_its_place_far_along_uncertain():
    """0.4 m off at 4 m along, where a direction of 0.1 rad leaves 0.4 m; not at 0.2 m along. The
    wall is not along the world's axes, and nothing is known along it."""
    wall = np.array([1.0, 2.0, 0.8])
    cov = np.diag(np.square([5.0, 0.05, 0.1, 5.0, 0.05, 0.1]))
    for along, same in ((4.0, True), (0.2, False)):
        other = compose(wall, np.array([along, 0.4, 0.0]))
        found = named((A, wall, 1.0), (B, other, 1.0), cov=cov)
        assert (surest_tie(found, SETTINGS) is not None) == same


def test_what_is_too_far_off_to_be_tied_may_be_a_doubt():
    """2 m off with a sigma of 1.4 m: not to be tied itself, but it may be the other's partner."""
    found = named((A, (0, 0), 1.0), (B, (0.1, 0), 1.0), (B, (2.0, 0), 1.0))
    assert surest_tie(found, SETTINGS) is None
    assert surest_tie(named((A, (0, 0), 1.0), (B, (2.0, 0), 1.0)), SETTINGS) is None


def test_an_error_that_both_share_is_no_doubt():
    """The relative pose is known and the place of both is not: the joint covariance decides."""
    shared = np.kron(np.ones((2, 2)), np.eye(2)) + 1e-4 * np.eye(4)
    near = named((A, (0, 0), 1.0), (B, (0.5, 0), 1.0), cov=shared)
    assert surest_tie(near, SETTINGS) is None
    alone = named((A, (0, 0), 1.0), (B, (0.5, 0), 1.0))
    assert surest_tie(alone, SETTINGS) == (0, 1)


def test_model_errors_widen_the_gate():
    found = named((A, (0, 0), 1e-4), (B, (0.05, 0), 1e-4))
    assert surest_tie(found, SETTINGS) is None
    assert surest_tie(found, replace(SETTINGS, floor_m=0.03)) == (0, 1)


def test_ties_of_ties_are_one_landmark():
    owners = {1: 0, 2: 0, 11: 1, 12: 1, 21: 2}
    assert tied(owners, [(11, 21), (1, 11)]) == {1: frozenset({0, 1, 2}), 2: A, 12: B}
    assert tied(owners, []) == {key: frozenset([owner]) for key, owner in owners.items()}


# ------------------------------------------------------------ in the estimator


def own_names(exchange_s=5.0, loss=0.0):
    network = replace(PLAIN.network, landmarks="own", loss_ratio=loss)
    return replace(PLAIN, backend=replace(PLAIN.backend, exchange_s=exchange_s), network=network)


def smoothed(steps, config):
    backend = BACKENDS["decentralised"](config)
    for step in steps:
        backend.add(step)
    return backend, backend.finish()


@pytest.mark.parametrize("loss", [0.0, 0.4])
def test_robots_that_find_out_for_themselves_end_where_common_names_do(loss):
    """Without noise: all points are tied rightly by both robots, means and covariances are those of
    one graph, but for what a tie leaves open (1 mm). What is not tied has twice the variance."""
    steps = wandering(marks=4)
    expected = all_of(run("batch", steps).finish())
    backend, estimate = smoothed(steps, own_names(loss=loss))
    assert landmark_ties(backend) == {"right": 8, "wrong": 0, "missed": 0}
    found = all_of(estimate)
    np.testing.assert_allclose(found[0], expected[0], atol=1e-5)
    np.testing.assert_allclose(found[1], expected[1], rtol=5e-3)


def test_walls_are_tied_too():
    """Points, lines and segments: each robot ties what both have seen, and ends near the truth. The
    place of every origin along its line is fixed by who saw it first, in its messages too."""
    steps, where = two_robots(np.random.default_rng(4))
    backend, estimate = smoothed(steps, own_names(2e-9))
    assert landmark_ties(backend) == {"right": 6, "wrong": 0, "missed": 0}
    for robot, truth in where.items():
        states = estimate.states[robot]
        miss = states.poses[-1] - truth
        assert np.all(np.abs(miss) < 5 * np.sqrt(np.diag(states.covs[-1])))
    for one in backend.robots:
        for key, dim in one.dims.items():
            cov = one.isam.marginalCovariance(key)
            assert cov.shape == (dim, dim)
            assert np.isfinite(cov).all() and np.all(np.diag(cov) < 5.0)


def test_robots_that_do_not_know_where_the_other_is_wait():
    """b's start is known to 2 m and 1 rad and nobody sees it: nothing is beyond doubt, nothing is
    tied, and nothing is claimed of it."""
    steps = wandering(marks=4)
    steps = [
        replace(s, associations=tuple(a for a in s.associations if isinstance(a.target, int)))
        for s in steps
    ]
    lost = Start(steps[0].starts["b"].pose, np.diag([4.0, 4.0, 1.0]))
    steps[0] = replace(steps[0], starts={**steps[0].starts, "b": lost})
    backend, estimate = smoothed(steps, own_names())
    assert landmark_ties(backend) == {"right": 0, "wrong": 0, "missed": 8}
    assert estimate.states["b"].covs[-1][0, 0] > 3.0


def test_common_names_have_no_ties():
    backend = run("decentralised", wandering(), 5.0)
    assert landmark_ties(backend) is None
    assert landmark_ties(run("batch", wandering())) is None
