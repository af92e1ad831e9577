"""Points that are in a solved map twice, and sightings under the wrong one."""

import numpy as np
import pytest

from graphslam.core.observation_models import MODELS
from graphslam.core.records import Association, Estimate, Step, Trajectory
from graphslam.mapping.point_reassociation import PointSightings, reassociated

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


def numbers(steps, estimate):
    """The point that each sighting is of in the end."""
    seen = PointSightings.of(steps, estimate, estimate.landmarks)
    return reassociated(seen, {i: mean for i, (mean, _) in estimate.landmarks.items()})


POINTS = np.array([[2.0, 2.0], [1.0, -2.0], [4.0, 1.0]])


def test_a_point_in_the_map_many_times_is_one():
    """Its sightings shared by distance keep the parts apart by many times their own sigmas."""

    def part(k, i):
        return 10 + k % 5 if i == 0 else i

    right = log(POINTS, lambda _k, i: i)
    split = []
    for step in log(POINTS, part):
        named = []
        for a in step.associations:
            at = MODELS["point"].invert(a.z, STATES[len(split)]) - POINTS[0]
            quarter = 10 + int(at[0] > 0) + 2 * int(at[1] > 0)
            target = a.target if a.target < 10 else quarter
            named.append(Association(a.robot, a.time_ns, target, a.model, a.z, a.cov))
        split.append(Step(step.time_ns, {}, {}, tuple(named)))
    estimate = solved(split)
    assert min(np.hypot(*(estimate.landmarks[10][0] - estimate.landmarks[13][0])), 1.0) > 0.03
    kept = {a.target for step in right for a in step.associations} - {0} | {10}
    assert set(numbers(split, estimate).tolist()) == kept


@pytest.mark.parametrize("stray", [0, 1])
def test_points_that_images_show_side_by_side_stay_two(stray):
    """Closer together than a sighting can tell. A few wrong associations are no such images."""
    close = np.array([[2.0, 2.0], [2.03, 2.02], [1.0, -2.0]])
    side_by_side = log(close, lambda _k, i: i)
    assert set(numbers(side_by_side, solved(side_by_side)).tolist()) == {0, 1, 2}
    in_turn = log(close, lambda _k, i: i, visible=lambda k, i: i == 2 or i == k % 2 or k < stray)
    assert np.count_nonzero(numbers(in_turn, solved(in_turn)) == 1) <= stray


def test_parts_of_points_side_by_side_make_as_many_as_images_show():
    """Two points near each other are in the map three times each: any two parts are seen beside
    each other, but the image could as well show others."""
    close = np.array([[2.0, 2.0], [2.1, 2.03]])
    steps = log(close, lambda k, i: 3 * i + k % 3)
    mixed = log(close, lambda k, i: 3 * ((i + (k % 4 == 0)) % 2) + k % 3)
    for some in (steps, mixed):
        found = numbers(some, solved(some)).reshape(-1, 2)
        assert len(np.unique(found)) == 2
        assert np.all(found[:, 0] != found[:, 1])


def test_points_far_apart_are_never_one():
    steps = log(POINTS, lambda _k, i: i, visible=lambda k, i: i == k % 3)
    assert set(numbers(steps, solved(steps)).tolist()) == {0, 1, 2}


def test_uncertain_states_make_points_one_that_exact_ones_tell_apart():
    """A point seen on two visits, the second 0.2 m off, five times the noise of a sighting."""
    again = np.vstack([POINTS, POINTS[0] + np.array([0.2, 0.0])])
    steps = log(again, lambda _k, i: i, visible=lambda k, i: i in (1, 2) or (i == 0) == (k < 30))
    estimate = solved(steps)
    assert set(numbers(steps, estimate).tolist()) == {0, 1, 2, 3}
    rough = np.broadcast_to(np.diag([0.15**2, 0.15**2, 0.0]), (60, 3, 3))
    states = {"r": Trajectory(TIMES, STATES, rough)}
    unsure = Estimate(states, estimate.landmarks, 0.0, 0)
    assert set(numbers(steps, unsure).tolist()) == {0, 1, 2}


def test_a_sighting_under_the_wrong_number_goes_to_the_point_that_it_fits():
    """One that fits none stays, also where another of its image fits the same better."""
    right = log(POINTS, lambda _k, i: i)
    wrong = log(
        POINTS, lambda k, i: 1 if (k, i) == (5, 0) else i, visible=lambda k, i: k != 5 or i == 0
    )
    found = numbers(wrong, solved(right))
    assert found[15] == 0
    assert np.array_equal(np.delete(found, 15).reshape(-1, 3), np.tile([0, 1, 2], (59, 1)))
    twice = log(np.vstack([POINTS, POINTS[:1]]), lambda _k, i: min(i, 2))
    estimate = Estimate(solved(right).states, solved(right).landmarks, 0.0, 0)
    assert np.array_equal(numbers(twice, estimate).reshape(-1, 4)[:, 1:3], [[1, 2]] * 60)
