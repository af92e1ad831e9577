"""Duplicates: what is one is tied, what differs is not, and the steps say the same afterwards."""

from dataclasses import replace

import numpy as np
import pytest
from backend_cases import PLAIN, two_robots
from finite_differences import jacobian

from graphslam.core.geometry import between, compose
from graphslam.core.records import Association, Estimate, Step, Trajectory
from graphslam.estimation.backend import JointMarginal, block_slices
from graphslam.estimation.backends import BACKENDS
from graphslam.estimation.isam2 import Reoptimiser
from graphslam.mapping.duplicate_landmarks import (
    _compare,
    _Map,
    _relative,
    duplicates,
    find_duplicates,
    merge_entries,
    merge_targets,
    merged_steps,
    seen_together,
)
from graphslam.mapping.landmark_map import Entry, LandmarkMap
from graphslam.mapping.reassociation import reassociate

WALLS = np.array([[0.0, 0.0, 0.0], [4.0, 2.0, 1.6], [0.0, 5.0, 3.1], [9.0, 1.0, -1.5]])
EXTENT = np.array([-1.5, 1.5])


def entry(number, kind="line", extent=EXTENT):
    return Entry(number, kind, np.zeros(3), np.zeros((3, 3)), extent.copy(), number, number, None)


def joint_of(means, cov):
    dims = [3] * len(means)
    whole = np.zeros((3 + 3 * len(means),) * 2)
    whole[:3, :3] = 1e-6 * np.eye(3)
    whole[3:, 3:] = cov
    return JointMarginal(np.zeros(3), tuple(means), whole, block_slices(dims))


def two_visits(shift, sigma, own=0.005):
    """Walls 0-3, and the same walls seen again as 4-7 from a place that is off by ``shift`` (3,).

    The covariance knows that all of the second visit may be off together by ``sigma`` (3,).
    """
    again = compose(np.asarray(shift, float), WALLS)
    G = np.zeros((12, 3))
    for k, wall in enumerate(again):
        G[3 * k : 3 * k + 3] = [[1, 0, -wall[1]], [0, 1, wall[0]], [0, 0, 1]]
    cov = own**2 * np.eye(24)
    cov[12:, 12:] += G @ np.diag(np.square(sigma)) @ G.T
    return [*WALLS, *again], cov


def ties(means, cov, kinds=None, extents=None, together=()):
    n = len(means)
    kinds, extents = kinds or ["line"] * n, extents or [EXTENT] * n
    entries = [entry(k, kinds[k], extents[k]) for k in range(n)]
    return duplicates(entries, joint_of(means, cov), [frozenset(pair) for pair in together])


def test_walls_seen_twice_are_tied_all_of_them():
    """Off by half a metre together, known to be uncertain by that much."""
    assert sorted(ties(*two_visits([0.4, -0.3, 0.03], [0.4, 0.4, 0.03]))) == [
        (k, k + 4) for k in range(4)
    ]


def test_nothing_is_tied_beyond_what_the_covariance_allows():
    assert ties(*two_visits([0.4, -0.3, 0.03], [0.02, 0.02, 0.002])) == []


def test_one_that_moved_differently_is_left_alone():
    """Each alone is within its covariance; after the first ties the joint knows better."""
    means, cov = two_visits([0.3, -0.2, 0.0], [0.4, 0.4, 0.03])
    means[7] = means[7] + [0.6, 0.0, 0.0]  # a door that was opened
    found = ties(means, cov)
    assert (3, 7) not in found and sorted(found) == [(0, 4), (1, 5), (2, 6)]


def test_what_one_image_shows_side_by_side_is_never_tied():
    means, cov = two_visits([0.0, 0.0, 0.0], [0.1, 0.1, 0.01])
    assert (1, 5) in ties(means, cov)
    assert (1, 5) not in ties(means, cov, together=[(1, 5)])
    # nor through a third: 5 is 1's neighbour, and 8 is the same as either
    means.append(means[1])
    wider = np.zeros((27, 27))
    wider[:24, :24], wider[24:, 24:] = cov, 0.01 * np.eye(3)
    found = ties(means, wider, together=[(1, 5)])
    assert not ({(1, 8), (5, 8)} <= set(found))


def test_walls_of_one_line_that_do_not_lie_beside_each_other_stay_two():
    """The two sides of a doorway."""
    means = [np.array([0.0, 0, 0]), np.array([4.0, 0, 0])]
    assert ties(means, 1e-4 * np.eye(6)) == []
    assert ties([means[0], np.array([1.0, 0, 0])], 1e-4 * np.eye(6)) == [(0, 1)]


def test_the_two_sides_of_a_thin_wall_stay_two():
    """Seen from opposite sides their directions are opposite."""
    means = [np.array([0.0, 0, 0]), np.array([0.0, 0.02, np.pi])]
    assert ties(means, 1e-4 * np.eye(6)) == []


def test_whole_segments_must_agree_along_the_wall_too():
    """Two equal doors side by side; as lines of unknown ends nothing tells them apart."""
    means, cov = [np.zeros(3), np.array([0.7, 0.0, 0.0])], 1e-4 * np.eye(6)
    assert ties(means, cov) == [(0, 1)]
    assert ties(means, cov, kinds=["segment", "segment"]) == []
    assert ties(means, cov, kinds=["line", "segment"]) == [(0, 1)]


def test_a_doubtful_tie_waits():
    """A wall between two parallel ones that are known to differ, as near to either: not decided."""
    means = [np.zeros(3), np.array([0.0, 0.3, 0.0]), np.array([0.0, 0.15, 0.0])]
    cov = np.diag([1e-4] * 6 + [0.04, 0.04, 1e-4])
    assert ties(means, cov, together=[(0, 1)]) == []
    means[2] = np.array([0.0, 0.01, 0.0])
    cov[6:8, 6:8] = 1e-3 * np.eye(2)  # 9 sigma from the other one
    assert ties(means, cov, together=[(0, 1)]) == [(0, 2)]


def two_visits_to_trees(shift, sigma, own=0.005):
    """As `two_visits`, of points."""
    means, cov = two_visits(shift, sigma, own)
    use = [3 * k + axis for k in range(8) for axis in (0, 1)]
    return [mean[:2] for mean in means], cov[np.ix_(use, use)]


def tied_trees(means, cov, names=(None,) * 8, together=()):
    entries = [replace(entry(k, "point"), identity=name) for k, name in enumerate(names)]
    whole = np.zeros((19, 19))
    whole[3:, 3:] = cov
    joint = JointMarginal(np.zeros(3), tuple(means), whole, block_slices([2] * 8))
    return sorted(duplicates(entries, joint, [frozenset(pair) for pair in together]))


def test_trees_seen_twice_are_tied_all_of_them():
    """Breaks if points are left out, or if the first ties do not help the others."""
    assert tied_trees(*two_visits_to_trees([0.4, -0.3, 0.03], [0.4, 0.4, 0.03])) == [
        (k, k + 4) for k in range(4)
    ]
    assert tied_trees(*two_visits_to_trees([0.4, -0.3, 0.03], [0.02, 0.02, 0.002])) == []


def test_trees_of_two_names_and_of_one_image_stay_two():
    visits = two_visits_to_trees([0.0, 0.0, 0.0], [0.1, 0.1, 0.01])
    names = ("a", "b", None, None, "a", "c", "d", None)
    assert tied_trees(*visits, names=names, together=[(3, 7)]) == [(0, 4), (2, 6)]


def test_a_name_stays_with_what_an_older_unnamed_landmark_becomes():
    landmarks = LandmarkMap()
    landmarks.entries = {1: entry(1, "point"), 2: replace(entry(2, "point"), identity="oak")}
    landmarks.by_identity = {"oak": 2}
    merge_entries(landmarks, {2: 1})
    assert landmarks.entries[1].identity == "oak"
    assert landmarks.by_identity == {"oak": 1}


def test_a_point_is_no_wall():
    entries = [entry(0), entry(1, "point")]
    joint = joint_of([np.zeros(3), np.zeros(3)], 1e-2 * np.eye(6))
    assert duplicates(entries, joint, []) == []


@pytest.mark.parametrize("seed", range(5))
def test_jacobians_of_the_comparison(seed):
    """Against central differences, good to 1e-10 here."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(2, 3)) * [3, 3, 1]
    x[1, 2] = x[0, 2] + 0.2 * rng.normal()
    i, j = np.array([0]), np.array([1])
    # extents so wide that the overlap is all of the second one: where it lies moves with it
    extents = np.array([[-50.0, 50.0], [-50.0, 50.0]])

    def walls(pair):
        flags = np.zeros((2, 2), bool)
        whole, point = np.ones(2, bool), np.zeros(2, bool)
        return _Map(pair, np.eye(6), extents, whole, point, np.arange(2), flags)

    _, H_i, H_j, _ = _compare(walls(x), i, j)
    # where the comparison is made is held: it is no part of the residual's dependence
    middle = _relative(x, extents, i, j)[3][0]

    def residual(flat):
        relative = between(flat[:3], flat[3:])
        return np.array(
            [relative[1] + (middle - relative[0]) * relative[2], relative[2], relative[0]]
        )

    H = jacobian(residual, x.ravel())
    np.testing.assert_allclose(np.hstack([H_i[0], H_j[0]]), H, atol=1e-8)


@pytest.mark.parametrize("n", [20, 80, 320])
def test_joint_covariances_grow_with_the_map(n):
    """Rooms far apart, with every wall seen three times; the middle sighting differs from the other
    two by half of what is allowed, so that only all three together are one. Breaks if those that
    may be one are separated, or if covariances are asked for of all landmarks at once."""
    entries, asked = [], []
    for k in range(n):
        for shift in (0.0, 0.04, 0.08):
            number = len(entries)
            entries.append(replace(entry(number), mean=np.array([20.0 * k, shift, 0.0])))

    def joint(numbers):
        asked.append(len(numbers))
        means = [entries[k].mean for k in numbers]
        return joint_of(means, 0.02**2 * np.eye(3 * len(numbers)))

    found = find_duplicates(entries, [frozenset((0, 1))], joint)
    elsewhere = {gone: kept for gone, kept in found.items() if gone > 2}
    assert elsewhere == {3 * k + j: 3 * k for k in range(1, n) for j in (1, 2)}
    assert found.get(1) != 0  # seen together with 0
    assert max(asked) <= 100 and sum(asked) <= 3 * n


def test_survivors_are_the_oldest_of_all_that_are_one():
    assert merge_targets([(2, 5), (5, 7), (1, 2), (3, 4)]) == {5: 1, 7: 1, 2: 1, 4: 3}


def split(steps, landmark, since_ns, renamed):
    """The same steps with a landmark that has another number from some time on."""
    return [
        replace(
            step,
            associations=tuple(
                replace(a, target=renamed)
                if a.target == landmark and step.time_ns >= since_ns
                else a
                for a in step.associations
            ),
        )
        for step in steps
    ]


@pytest.mark.parametrize("landmark", [1, 2])
def test_merged_steps_give_the_estimate_that_never_knew_of_two(landmark):
    steps, _ = two_robots(np.random.default_rng(4))
    whole = BACKENDS["batch"](PLAIN)
    twice = BACKENDS["batch"](PLAIN)
    for step in steps:
        whole.add(step)
    for step in split(steps, landmark, 4, 7):
        twice.add(step)
    expected, before = whole.finish(), twice.finish()
    kinds = {1: "line", 2: "segment", 7: "line" if landmark == 1 else "segment"}
    after = Reoptimiser(
        PLAIN, merged_steps(split(steps, landmark, 4, 7), {7: landmark}, kinds), before
    ).solve()
    assert sorted(after.landmarks) == [0, 1, 2]
    for robot, states in expected.states.items():
        # both stop when a step of Levenberg-Marquardt moves nothing any more
        np.testing.assert_allclose(after.states[robot].poses, states.poses, atol=1e-5)
    assert after.error == pytest.approx(expected.error, rel=1e-6)


def test_a_segment_that_becomes_part_of_a_line_is_seen_as_one():
    steps, _ = two_robots()
    renamed = merged_steps(steps, {2: 1}, {1: "line", 2: "segment"})
    assert {a.model for step in renamed for a in step.associations if a.target == 1} == {"line"}


def test_seen_together_is_about_one_robot_at_one_state():
    steps, _ = two_robots()
    assert seen_together(steps) == {frozenset(pair) for pair in ((0, 1), (0, 2), (1, 2))}
    only = [replace(step, associations=step.associations[:1]) for step in steps]
    assert seen_together(only) == set()


def test_the_map_keeps_the_extent_of_both():
    landmarks = LandmarkMap()
    for number in (1, 2):
        landmarks.entries[number] = entry(number)
        landmarks.entries[number].sightings = number
    landmarks.entries[1].move(np.array([3.0, 2.0, 0.7]))
    landmarks.entries[1].extent = EXTENT
    landmarks.entries[2].move(compose(np.array([3.0, 2.0, 0.7]), np.array([1.0, 0.0, np.pi])))
    landmarks.entries[2].extent = np.array([-3.0, 0.0])  # it points the other way
    merge_entries(landmarks, {2: 1})
    (kept,) = landmarks.entries.values()
    np.testing.assert_allclose(kept.extent, [-1.5, 4.0])
    assert kept.sightings == 3


def test_an_extent_stays_where_it_is_when_the_origin_slides():
    wall = entry(1)
    wall.mean[:] = [1.0, 2.0, 0.5]
    before = compose(wall.mean, np.array([wall.extent[0], 0.0, 0.0]))
    wall.move(compose(wall.mean, np.array([3.0, 0.01, 0.0])))
    after = compose(wall.mean, np.array([wall.extent[0], 0.0, 0.0]))
    np.testing.assert_allclose(between(before, after), [0.0, 0.01, 0.0], atol=1e-12)


def seen_along(map_moved, slid):
    """A wall seen in five pieces of 1 m from states 1 m apart, each facing it, in a map that was
    moved along the wall; and the wall's origin ``slid`` beyond that. Its steps and the estimate."""
    poses = np.column_stack([np.arange(5.0) + map_moved, np.zeros(5), np.zeros(5)])
    z, cov = np.array([0.0, 2.0, np.pi]), np.eye(3)
    half = np.array([-0.5, 0.5])
    steps = [
        Step(k, {}, {}, (Association("r", k, 0, "line", z, cov, extent=half),)) for k in range(5)
    ]
    mean = np.array([0.4 + map_moved + slid, 2.0, np.pi])
    states = {"r": Trajectory(np.arange(5), poses, np.zeros((5, 3, 3)))}
    return steps, Estimate(states, {0: (mean, np.eye(3))}, 0.0, 1)


@pytest.mark.parametrize("slid", [0.0, 1.7])
@pytest.mark.parametrize("map_moved", [0.0, 4.0])
def test_a_line_ends_where_its_observations_end(map_moved, slid):
    """Breaks if ends stay where they were when a loop was closed and the map went elsewhere, or go
    with an origin that slides along the wall; what is seen of it then lies beyond its ends, and
    belongs to no wall. The wall's axis points against the states'."""
    landmarks = LandmarkMap()
    landmarks.entries[0] = replace(entry(0), kind="line", mean=np.array([0.4, 2.0, np.pi]))
    steps, estimate = seen_along(map_moved, slid)
    landmarks.update_from(steps, estimate)
    wall = landmarks.entries[0]
    ends = [compose(wall.mean, np.array([end, 0.0, 0.0]))[0] for end in wall.extent]
    np.testing.assert_allclose(ends, [4.5 + map_moved, -0.5 + map_moved], atol=1e-12)
    assert not reassociate(steps, estimate, landmarks.entries, 0.1, 0.1, 0.3).dropped


def test_a_segment_brings_its_ends_along():
    """Breaks if a segment, whose origin means something, is treated as a line that slides."""
    wall = replace(entry(1), kind="segment", mean=np.array([1.0, 2.0, 0.5]))
    wall.move(np.array([3.0, 2.5, 0.6]))
    np.testing.assert_array_equal(wall.extent, EXTENT)


@pytest.mark.parametrize(
    ("second", "two"),
    [
        ((2.5, 1.0, 0.0), False),
        ((2.5, 1.01, np.pi), False),
        ((2.5, 1.12, 0.0), True),
        ((2.5, 1.0, 0.1), True),
    ],
    ids=["behind a door", "the other way round", "a niche", "turned"],
)
def test_lines_of_one_image_are_two_things_unless_in_line(second, two):
    """A wall seen on both sides of a door is one wall. Breaks if what one image shows is taken for
    different things whatever it is, or for one wall although it stands back by 12 cm."""
    cov = np.diag([1.0, 0.01, 0.005]) ** 2
    seen = [
        Association("r", 7, number, "line", np.array(z), cov)
        for number, z in enumerate([(0.5, 1.0, 0.0), second])
    ]
    expected = {frozenset((0, 1))} if two else set()
    assert seen_together([Step(7, {}, {}, tuple(seen))]) == expected


@pytest.mark.parametrize(("out_of_line", "two"), [(1, False), (4, False), (6, True), (10, True)])
def test_what_most_images_have_in_line_is_not_two_things(out_of_line, two):
    """Ten images of two parts of a wall. Breaks if a single noisy image of many makes them two."""
    cov = np.diag([1.0, 0.01, 0.005]) ** 2
    steps = []
    for k in range(10):
        turn = 0.1 if k < out_of_line else 0.0
        seen = [
            Association("r", k, number, "line", np.array(z), cov)
            for number, z in enumerate([(0.5, 1.0, 0.0), (2.5, 1.0, turn)])
        ]
        steps.append(Step(k, {}, {}, tuple(seen)))
    assert seen_together(steps) == ({frozenset((0, 1))} if two else set())
    # what has been seen from end to end is another thing in whatever image
    ends = [replace(a, model="segment") for a in steps[-1].associations]
    whole = [*steps[:-1], replace(steps[-1], associations=tuple(ends))]
    assert seen_together(whole) == {frozenset((0, 1))}
