"""Points that are in a solved map twice, and sightings under the wrong one."""

import numpy as np
import pytest

from graphslam.core.observation_models import MODELS
from graphslam.core.records import Association, Estimate, Step, Trajectory
from graphslam.mapping.point_reassociation import indistinguishable_points, reassociate_points

SIGMAS = np.array([0.02, 0.04])
STATES = np.column_stack([np.linspace(0, 3, 60), np.zeros(60), np.linspace(-0.3, 0.3, 60)])
TIMES = np.arange(60) * 100_000_000


def log(points, labels, seed=1, visible=None):
    """Steps from known states; ``labels(k, i)`` is the landmark that sighting i at k is called."""
    rng = np.random.default_rng(seed)
    steps = []
    for k, x in enumerate(STATES):
        seen = []
        for i, point in enumerate(points):
            if visible is not None and not visible(k, i):
                continue
            z = MODELS["point"].predict(x, point) + SIGMAS * rng.normal(size=2)
            time_ns = int(TIMES[k])
            seen.append(Association("r", time_ns, labels(k, i), "point", z, np.diag(SIGMAS**2)))
        steps.append(Step(int(TIMES[k]), {}, {}, tuple(seen)))
    return tuple(steps)


def solved(steps):
    """The estimate: each landmark in the middle of its sightings."""
    found = {}
    for k, step in enumerate(steps):
        for a in step.associations:
            found.setdefault(a.target, []).append(MODELS["point"].invert(a.z, STATES[k]))
    landmarks = {i: (np.mean(where, axis=0), 1e-4 * np.eye(2)) for i, where in found.items()}
    states = {"r": Trajectory(TIMES, STATES, np.zeros((60, 3, 3)))}
    return Estimate(states, landmarks, 0.0, 0)


POINTS = np.array([[2.0, 2.0], [1.0, -2.0], [4.0, 1.0]])


def test_a_point_in_the_map_twice_is_one():
    """Its sightings shared by distance keep the two apart by twenty times their own sigmas."""
    middle = MODELS["point"]

    def nearer(k, i):
        return i

    steps = log(POINTS, nearer)
    split = []
    for k, step in enumerate(steps):
        named = []
        for a in step.associations:
            far = middle.invert(a.z, STATES[k])[0] > POINTS[0, 0]
            named.append(
                a if a.target or far else Association(a.robot, a.time_ns, 9, a.model, a.z, a.cov)
            )
        split.append(Step(step.time_ns, {}, {}, tuple(named)))
    estimate = solved(split)
    apart = np.hypot(*(estimate.landmarks[0][0] - estimate.landmarks[9][0]))
    assert apart > 0.04
    assert indistinguishable_points(split, estimate) == {9: 0}


@pytest.mark.parametrize("stray", [0, 1])
def test_points_that_images_show_side_by_side_stay_two(stray):
    """Closer together than a sighting can tell. A few wrong associations are no such images."""
    close = np.array([[2.0, 2.0], [2.03, 2.02], [1.0, -2.0]])
    side_by_side = log(close, lambda _k, i: i)
    assert indistinguishable_points(side_by_side, solved(side_by_side)) == {}
    in_turn = log(close, lambda _k, i: i, visible=lambda k, i: i == 2 or i == k % 2 or k < stray)
    assert indistinguishable_points(in_turn, solved(in_turn)) == {1: 0}


def test_points_far_apart_are_never_one():
    steps = log(POINTS, lambda _k, i: i, visible=lambda k, i: i == k % 3)
    assert indistinguishable_points(steps, solved(steps)) == {}


def test_a_sighting_under_the_wrong_number_goes_to_the_point_that_it_fits():
    """Two of an image that would both be of one point stay; so does what is right."""
    right = log(POINTS, lambda _k, i: i)
    wrong = log(
        POINTS, lambda k, i: 1 if (k, i) == (5, 0) else i, visible=lambda k, i: k != 5 or i == 0
    )
    made, moved = reassociate_points(wrong, solved(right))
    assert moved == 1
    assert [a.target for a in made[5].associations] == [0]
    again, none = reassociate_points(right, solved(right))
    assert none == 0
    assert [[a.target for a in s.associations] for s in again] == [[0, 1, 2]] * len(STATES)
    twice = log(np.vstack([POINTS, POINTS[:1]]), lambda _k, i: min(i, 2))
    assert reassociate_points(twice, solved(right))[1] == 0
