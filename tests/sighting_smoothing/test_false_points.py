"""A point that images hardly ever show where they should is none; hidden or moved ones stay."""

import numpy as np
import pytest

import graphslam
from graphslam.core.geometry import wrap
from graphslam.mapping import points_in_sight
from graphslam.sighting_smoothing.false_points import FEW, FOR_A_WHILE, _are_false
from graphslam.sighting_smoothing.unnamed_sightings import HARDLY_EVER_SEEN
from graphslam.simulation import load_scenario, simulate

#: points around a robot that drives to and fro between them, all within the field of view
POINTS = np.array([(x, y) for x in (-6.0, -2.0, 2.0, 6.0) for y in (-4.0, 4.0)])
IMAGES = 400
#: the same at another place, where the robot may be too
ALL = 2 * len(POINTS) * [False]


class Drive:
    """Sightings of points from ``IMAGES`` poses: each image shows all points, in any direction."""

    def __init__(self, more=(), *, here=IMAGES, robots=1):
        """``more`` points in question; images ``here``, the others are of another place."""
        self.places = np.concatenate(
            [POINTS, POINTS + np.array([100.0, 0.0]), np.reshape(more, (-1, 2))]
        )
        x = 1.5 * np.sin(np.linspace(0, 12 * np.pi, IMAGES))
        there = np.arange(IMAGES) >= here
        self.poses = np.column_stack([x + 100.0 * there, np.zeros(IMAGES), np.zeros(IMAGES)])
        self.shown = np.zeros((IMAGES, len(self.places)), dtype=bool)
        self.shown[~there, : len(POINTS)] = self.shown[there, len(POINTS) : len(ALL)] = True
        self.poses = np.concatenate(robots * [self.poses])
        self.shown = np.concatenate(robots * [self.shown])
        self.robot = np.repeat(np.arange(robots), IMAGES)

    def false(self):
        image, point = np.nonzero(self.shown)
        away = self.places[point] - self.poses[image, :2]
        bearing = wrap(np.arctan2(away[:, 1], away[:, 0]) - self.poses[image, 2])
        z = np.column_stack([bearing, np.hypot(*away.T)])
        return _are_false(self.places, self.poses, self.robot, image, point, z).tolist()


def test_points_that_are_always_seen_are_points():
    assert Drive().false() == ALL


@pytest.mark.parametrize("at", [[10, 11, 12], [10, 150, 390]])
def test_a_point_that_three_images_show_of_hundreds_is_none(at):
    drive = Drive([(0.0, 2.0)])
    drive.shown[at, -1] = True
    assert drive.false() == [*ALL, True]


def test_a_point_that_is_out_of_sight_stays():
    """Behind all others: whether images should show it is not known."""
    drive = Drive([(0.0, 20.0)])
    drive.shown[[10, 11, 12], -1] = True
    assert drive.false() == [*ALL, False]


def test_a_point_that_was_there_for_a_while_stays():
    drive = Drive([(0.0, 2.0)])
    drive.shown[100 : 100 + FOR_A_WHILE, -1] = True
    assert FOR_A_WHILE < FEW * IMAGES  # it is not its number of sightings
    assert drive.false() == [*ALL, False]


def test_a_point_that_two_robots_saw_for_a_while_stays():
    """Images are numbered robot by robot: between the first and the last are those of later."""
    drive = Drive([(0.0, 2.0)], robots=2)
    for begin in (100, 100 + IMAGES):
        drive.shown[begin : begin + 8, -1] = True
    assert FEW * 2 * IMAGES > 16
    assert drive.false() == [*ALL, False]


def test_a_point_that_is_seen_whenever_one_place_is_passed_stays():
    drive = Drive([(0.0, 2.0)])
    drive.shown[100:108, -1] = drive.shown[300:308, -1] = True
    assert drive.false() == [*ALL, False]


def test_a_point_that_is_seen_now_and_then_is_none():
    """More often than `FOR_A_WHILE`, but never in a row."""
    drive = Drive([(0.0, 2.0)])
    drive.shown[5::36, -1] = True
    assert FOR_A_WHILE < drive.shown[:, -1].sum() < FEW * IMAGES
    assert drive.false() == [*ALL, True]


def test_a_point_at_the_edge_of_what_was_seen_is_judged_by_the_images_that_could_show_it():
    """One of sixteen is too little to tell, though others are seen four hundred times."""
    drive = Drive([(0.0, 2.0)], here=16)
    drive.shown[5, -1] = True
    assert drive.false() == [*ALL, False]


def test_a_point_seen_as_seldom_as_all_others_stays():
    """An image shows one in four of the points around it; that in question, where the robot is at
    last, is in one of twenty. One in four of a quarter is not less."""
    drive = Drive([(100.0, 2.0)], robots=20)
    last = len(drive.poses) - 200
    drive.poses[last:, 0] += 100.0
    rng = np.random.default_rng(0)
    drive.shown = rng.random(drive.shown.shape) < 0.25
    drive.shown[:last, len(POINTS) :] = drive.shown[last:, : len(POINTS)] = False
    drive.shown[:, -1] = False
    drive.shown[last::20, -1] = True
    assert drive.shown[:, -1].sum() < FEW * drive.shown[:, 0].sum()
    assert not drive.false()[-1]


def test_a_point_that_is_hidden_from_most_places_stays():
    """It is seen by one in ten of the images, at places that are passed again and again."""
    drive = Drive([(0.0, 2.0)])
    drive.shown[::10, -1] = True
    assert drive.false() == [*ALL, False]


def test_where_sensors_miss_most_points_seldom_is_usual():
    """Every point is seen in one of fifty images; so is that in question."""
    drive = Drive([(0.0, 2.0)])
    drive.shown = np.random.default_rng(0).random(drive.shown.shape) < 0.02
    drive.shown[::50] = True
    assert not any(drive.false())


def test_few_images_tell_nothing():
    drive = Drive([(0.0, 2.0)])
    drive.shown[12:] = False
    drive.shown[[3, 5], -1] = True
    assert drive.false() == [*ALL, False]


FIELD = """
[world]
cylinders = [
  { name = "a", center_m = [-4, -3], radius_m = 0.1 },
  { name = "b", center_m = [0, -4], radius_m = 0.1 },
  { name = "c", center_m = [4, -3], radius_m = 0.1 },
  { name = "d", center_m = [5, 1], radius_m = 0.1 },
  { name = "e", center_m = [3, 4], radius_m = 0.1 },
  { name = "f", center_m = [-1, 4.5], radius_m = 0.1 },
  { name = "g", center_m = [-5, 3], radius_m = 0.1 },
  { name = "h", center_m = [-6, 0], radius_m = 0.1 },
]
[robots.vehicle]
start_m = [-2, -1.5]
body = { radius_m = 0.3 }
drive = [
  { through_m = [[2, -1.5], [2, 1.5], [-2, 1.5], [-2, -1.5]], speed_m_s = 0.4 },
  { through_m = [[2, -1.5], [2, 1.5], [-2, 1.5], [-2, -1.5]], speed_m_s = 0.4 },
]
encoders = { period_s = 0.1 }
[[robots.vehicle.sightings]]
of = "landmarks"
period_s = 0.2
field_deg = 220
range_max_m = 9
identified = false
false_share = 0.15
"""


def test_a_map_of_unnamed_points_has_as_many_as_there_are(tmp_path):
    """One false detection for seven true ones: without the check the map has 18 points for 8."""
    scenario = tmp_path / "field.toml"
    scenario.write_text(FIELD)
    log = tmp_path / "log.mcap"
    simulate(load_scenario(scenario), log, 0)
    result = graphslam.smooth(log, start={"from_truth": True})
    assert len(result.landmarks) == 8
    assert result.summary["consolidated"]["landmarks_removed"] > 0
    assert result.summary["rejected"][HARDLY_EVER_SEEN] > 0
    assert result.summary["verdict"]["verdict"] == "good"


def test_images_are_compared_block_by_block(monkeypatch):
    """As many at a time as memory has room for; also where a block shows nothing."""
    drive = Drive([(0.0, 2.0)], here=300)
    drive.shown[20:30] = False
    image, point = np.nonzero(drive.shown)
    away = drive.places[point] - drive.poses[image, :2]
    z = np.column_stack([np.arctan2(*away.T[::-1]), np.hypot(*away.T)])
    at_once = points_in_sight.points_in_sight(drive.places, drive.poses, image, z)
    monkeypatch.setattr(points_in_sight, "BLOCK", 7)
    np.testing.assert_array_equal(
        points_in_sight.points_in_sight(drive.places, drive.poses, image, z), at_once
    )
    assert len(at_once) > IMAGES
