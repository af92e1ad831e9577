"""The simulator's parts against closed forms: ray casting, paths, speed, collisions."""

from math import pi

import numpy as np
import pytest

from graphslam.core.geometry import between, log
from graphslam.simulation.drive import TrapezoidalProfile, plan_drive
from graphslam.simulation.path import round_corners
from graphslam.simulation.raycast import NO_SURFACE, BeamFan, cast_beams
from graphslam.simulation.robot_shapes import contacts, encloses, outline_shapes
from graphslam.simulation.scenario import Body, Leg, Move, Robot, ScenarioError
from graphslam.simulation.world import Shapes, displacement

HALF_DEG = BeamFan(-pi / 2, pi / 360, 361)
FULL = BeamFan(-pi, pi / 180, 361)
NO_CIRCLES, NO_SEGMENTS = np.zeros((0, 3)), np.zeros((0, 2, 2))
WIDTH, DEPTH = 7.3, 4.1
CORNERS = np.array([[0, 0], [WIDTH, 0], [WIDTH, DEPTH], [0, DEPTH]])
ROOM = Shapes(np.stack([CORNERS, np.roll(CORNERS, -1, axis=0)], axis=1), NO_CIRCLES)


def room_ranges(pose, angles):
    """Ranges in the room in closed form, without intersecting anything."""
    c, s = np.cos(pose[2] + angles), np.sin(pose[2] + angles)
    with np.errstate(divide="ignore"):
        to_x = np.where(c > 0, (WIDTH - pose[0]) / c, -pose[0] / c)
        to_y = np.where(s > 0, (DEPTH - pose[1]) / s, -pose[1] / s)
    return np.minimum(to_x, to_y)


def random_poses(rng, n, low=(0.1, 0.1), high=(WIDTH - 0.1, DEPTH - 0.1)):
    return rng.uniform([*low, -pi], [*high, pi], (n, 3))


# ------------------------------------------------------------ ray casting


@pytest.mark.parametrize("fan", [HALF_DEG, FULL, BeamFan(-0.87, 0.0043, 401)])
def test_ranges_in_a_room_are_those_of_the_closed_form(fan):
    """Breaks with a beam lost at a corner, at the seam of the circle or at a culled sector."""
    poses = random_poses(np.random.default_rng(3), 300)
    hits = cast_beams(poses, fan, ROOM, 20.0)
    expected = np.array([room_ranges(pose, fan.angles) for pose in poses])
    np.testing.assert_allclose(hits.ranges, expected, rtol=0, atol=1e-12)
    assert (hits.surfaces >= 0).all()


def test_beams_into_corners_do_not_leak():
    """Where two walls meet, rounding must not let a beam through."""
    pose = np.array([2.0, 1.0, 0.0])
    for corner in CORNERS:
        angle = np.arctan2(*(corner - pose[:2])[::-1])
        hits = cast_beams(pose[None], BeamFan(angle, 1e-3, 1), ROOM, 20.0)
        assert hits.ranges[0, 0] == pytest.approx(np.hypot(*(corner - pose[:2])), abs=1e-12)


def brute_force(poses, fan, shapes):
    """Every beam against every surface, one by one; circles by the quadratic equation."""
    out = np.full((len(poses), fan.count), np.inf)
    for i, (x, y, phi) in enumerate(poses):
        p = np.array([x, y])
        for j, angle in enumerate(fan.angles):
            d = np.array([np.cos(phi + angle), np.sin(phi + angle)])
            for a, b in shapes.segments:
                M = np.column_stack([d, a - b])
                if abs(np.linalg.det(M)) > 1e-12:
                    r, u = np.linalg.solve(M, a - p)
                    if r > 0 and 0 <= u <= 1:
                        out[i, j] = min(out[i, j], r)
            for cx, cy, radius in shapes.circles:
                q = p - [cx, cy]
                roots = np.roots([1.0, 2 * q @ d, q @ q - radius**2])
                if np.isreal(roots).all() and roots.real.min() > 0:
                    out[i, j] = min(out[i, j], roots.real.min())
    return out


def test_ranges_are_those_of_brute_force():
    """Faces and circles that hide each other, looked at from everywhere."""
    rng = np.random.default_rng(8)
    starts = rng.uniform(-6, 6, (12, 2))
    segments = np.stack([starts, starts + rng.uniform(-3, 3, (12, 2))], axis=1)
    circles = np.column_stack([rng.uniform(-6, 6, (9, 2)), rng.uniform(0.05, 0.6, 9)])
    shapes = Shapes(segments, circles)
    poses = random_poses(rng, 40, (-6, -6), (6, 6))
    apart = np.linalg.norm(poses[:, None, :2] - circles[:, :2], axis=2)
    poses = poses[(apart > circles[:, 2]).all(axis=1)]
    fan = BeamFan(-2.0, 0.05, 81)
    hits = cast_beams(poses, fan, shapes, 100.0)
    expected = brute_force(poses, fan, shapes)
    np.testing.assert_allclose(hits.ranges, expected, rtol=0, atol=1e-9)
    assert ((hits.surfaces == NO_SURFACE) == np.isinf(expected)).all()


def test_the_surface_is_the_one_that_was_met():
    wall = np.array([[[3.0, -1.0], [3.0, 1.0]]])
    hits = cast_beams(
        np.zeros((1, 3)), BeamFan(-0.5, 0.5, 3), Shapes(wall, np.array([[2, 0, 0.25]])), 9
    )
    assert hits.surfaces.tolist() == [[NO_SURFACE, 1, NO_SURFACE]]
    hits = cast_beams(
        np.zeros((1, 3)), BeamFan(-0.2, 0.2, 3), Shapes(wall, np.array([[2, 0, 0.25]])), 9
    )
    assert hits.surfaces.tolist() == [[0, 1, 0]]


def test_shapes_that_move_are_met_where_they_are():
    """Another robot has a pose of its own at every scan."""
    others = np.array([[2.0, 0.0, 0.3], [4.0, 0.0, 0.0]])
    shapes = outline_shapes(Body(radius_m=0.5), others)
    hits = cast_beams(np.zeros((2, 3)), BeamFan(0.0, 1.0, 1), shapes, 10.0)
    np.testing.assert_allclose(hits.ranges[:, 0], [1.5, 3.5], atol=1e-12)
    shapes = outline_shapes(Body(length_m=1.0, width_m=0.4, rear_m=0.25), others[1:])
    hits = cast_beams(np.zeros((1, 3)), BeamFan(0.0, 1.0, 1), shapes, 10.0)
    assert hits.ranges[0, 0] == pytest.approx(3.75, abs=1e-12)


def test_an_empty_world_gives_no_ranges():
    hits = cast_beams(np.zeros((3, 3)), HALF_DEG, Shapes(NO_SEGMENTS, NO_CIRCLES), 8.0)
    assert np.isinf(hits.ranges).all()


# ------------------------------------------------------------ paths and speed


def test_a_curve_is_as_long_as_it_says_and_bends_without_a_jump():
    curve = round_corners([[0, 0], [5, 0], [5, 4], [1, 6]], 1.2)
    s = np.linspace(0, curve.length_m, 40_001)
    position, heading = curve.at(s)
    step = np.hypot(*np.diff(position, axis=0).T)
    assert step.sum() == pytest.approx(curve.length_m, rel=1e-7)
    np.testing.assert_allclose(position[-1], [1, 6], atol=1e-12)
    tangent = np.unwrap(np.arctan2(*np.diff(position, axis=0).T[::-1]))
    np.testing.assert_allclose(tangent, (heading[:-1] + heading[1:]) / 2, atol=1e-6)
    assert np.abs(np.diff(heading, 2)).max() < 2e-6  # a jump of the curvature would be 2e-4


def test_corners_are_cut_by_no_more_than_is_asked():
    curve = round_corners([[0, 0], [5, 0], [5, 5]], 1.0)
    position, _ = curve.at(np.linspace(0, curve.length_m, 2001))
    on_lines = (np.abs(position[:, 1]) < 1e-9) | (np.abs(position[:, 0] - 5) < 1e-9)
    assert position[~on_lines].min(axis=0) == pytest.approx([4, 0], abs=0.01)


def test_a_corner_that_turns_back_is_refused():
    with pytest.raises(ScenarioError, match=r"turns back at \(5, 0\)"):
        round_corners([[0, 0], [5, 0], [0.1, 0.1]], 1.0)
    with pytest.raises(ScenarioError, match="coincide"):
        round_corners([[0, 0], [0, 0]], 1.0)


@pytest.mark.parametrize("distance", [0.05, 10.0])  # a triangle, a trapezoid
def test_the_speed_is_a_trapezoid(distance):
    profile = TrapezoidalProfile(distance, 0.5, 0.25)
    t = np.linspace(0, profile.duration_s, 10_001)
    s = profile.at(t)
    assert s[0] == 0
    assert s[-1] == pytest.approx(distance, abs=1e-12)
    speed = np.gradient(s, t)
    assert speed.max() <= 0.5 + 1e-9
    assert np.abs(np.gradient(speed, t)).max() <= 0.25 + 1e-6


def test_wheels_are_carried_by_what_the_poses_say():
    """``travel`` and ``turned`` are the twists of the poses added up, forwards and backwards."""
    legs = (
        Leg(through_m=((3.0, 0.0), (3.0, 2.0))),
        Leg(wait_s=1.0),
        Leg(through_m=((3.0, 0.5),), reverse=True),
        Leg(turn_deg=-200.0),
        Leg(through_m=((6.0, 1.0),), speed_m_s=0.8),
    )
    drive = plan_drive(np.zeros(3), legs, Robot((0.0, 0.0), Body(radius_m=0.2), drive=legs))
    states = drive.at(np.arange(0, drive.duration_s + 1, 0.01))
    twists = log(between(states.poses[:-1], states.poses[1:]))
    np.testing.assert_allclose(np.diff(states.travel), twists[:, 0], atol=1e-7)
    np.testing.assert_allclose(np.diff(states.turned), twists[:, 2], atol=1e-12)
    assert np.abs(twists[:, 1]).max() < 1e-4  # no wheel is dragged sideways
    assert drive.path_m == pytest.approx(np.abs(np.diff(states.travel)).sum(), abs=1e-6)
    assert states.poses[-1, :2] == pytest.approx([6.0, 1.0])
    assert np.hypot(*np.diff(states.poses[:, :2], axis=0).T).max() <= 0.8 * 0.01 + 1e-9


# ------------------------------------------------------------ bodies


def test_a_rectangle_touches_what_reaches_into_it():
    body = Body(length_m=2.0, width_m=1.0, rear_m=0.5)  # x -0.5..1.5, y -0.5..0.5
    segments = np.array(
        [
            [[1.4, -2], [1.4, 2]],  # through
            [[1.6, -2], [1.6, 2]],  # before the front
            [[0.0, 0.1], [0.2, 0.1]],  # all inside
            [[-2.0, 0.51], [2.0, 0.51]],  # beside
            [[1.4, 2.0], [3.0, 0.0]],  # past the corner
        ]
    )
    circles = np.array([[1.8, 0.0, 0.31], [1.8, 0.0, 0.29], [0.2, 0.2, 0.1]])
    met = contacts(body, np.zeros((1, 3)), Shapes(segments, circles))
    assert met.tolist() == [[True, False, True, False, False, True, False, True]]
    turned = contacts(body, np.array([[0.0, 0.0, pi]]), Shapes(segments, circles))
    assert turned[0, :2].tolist() == [False, False]


def test_a_disc_touches_what_is_nearer_than_its_radius():
    segments = np.array([[[0.3, -1], [0.3, 1]], [[0.5, -1], [0.5, 1]], [[0.2, 0.5], [2, 0.5]]])
    met = contacts(Body(radius_m=0.4), np.zeros((1, 3)), Shapes(segments, NO_CIRCLES))
    assert met.tolist() == [[True, False, False]]


def test_inside_of_a_polygon():
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    assert encloses(square, np.array([[0.5, 0.5], [1.5, 0.5], [-0.1, 0.2]])).tolist() == [
        True,
        False,
        False,
    ]


def test_a_move_turns_about_its_point():
    motion = displacement(Move("table", turn_deg=90.0, about_m=(2.0, 1.0), shift_m=(0.0, 0.5)))
    c, s = np.cos(motion[2]), np.sin(motion[2])
    moved = motion[:2] + np.array([[c, -s], [s, c]]) @ [3.0, 1.0]
    assert moved == pytest.approx([2.0, 2.5])
