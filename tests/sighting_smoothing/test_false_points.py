"""A point that images hardly ever show where they should is none; hidden or moved ones stay."""

import numpy as np
import pytest

import graphslam
from graphslam.core.geometry import wrap
from graphslam.sighting_smoothing.false_points import FEW, FOR_A_WHILE, _are_false
from graphslam.sighting_smoothing.unnamed_sightings import HARDLY_EVER_SEEN
from graphslam.simulation import load_scenario, simulate

#: points around a robot that drives to and fro between them, all within the field of view
POINTS = np.array([(x, y) for x in (-6.0, -2.0, 2.0, 6.0) for y in (-4.0, 4.0)])
IMAGES = 400


class Drive:
    """Sightings of points from ``IMAGES`` poses: each image shows all points, in any direction."""

    def __init__(self, more=()):
        self.places = np.concatenate([POINTS, np.reshape(more, (-1, 2))])
        x = 1.5 * np.sin(np.linspace(0, 12 * np.pi, IMAGES))
        self.poses = np.column_stack([x, np.zeros(IMAGES), np.zeros(IMAGES)])
        self.shown = np.zeros((IMAGES, len(self.places)), dtype=bool)
        self.shown[:, : len(POINTS)] = True

    def false(self):
        image, point = np.nonzero(self.shown)
        away = self.places[point] - self.poses[image, :2]
        bearing = wrap(np.arctan2(away[:, 1], away[:, 0]) - self.poses[image, 2])
        z = np.column_stack([bearing, np.hypot(*away.T)])
        return _are_false(self.places, self.poses, image, point, z).tolist()


ALL = len(POINTS) * [False]


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
