"""Robots of known outline in scans: found with consistent covariance, no false detections."""

from dataclasses import replace

import numpy as np
import pytest

from graphslam.core.config_io import load_config
from graphslam.core.errors import ConfigError
from graphslam.core.geometry import between, compose, wrap
from graphslam.core.records import Scan
from graphslam.logs import open_logs
from graphslam.multi_robot.robot_detection import ExpectedPose, detect_robots, without_returns
from graphslam.perception.dynamic_objects import dynamic_returns
from graphslam.perception.ordered_scan import make_sweep
from graphslam.perception.robot_outlines import outline_of
from graphslam.simulation import load_scenario, simulate
from graphslam.simulation.laser import beam_fan, laser_mount, noise_free_scans, noisy_ranges
from graphslam.simulation.robot_shapes import corners
from graphslam.simulation.scenario import (
    Body,
    Box,
    Cylinder,
    Laser,
    Leg,
    Robot,
    Scenario,
    StaticObjects,
    Wall,
)
from graphslam.simulation.world import make_world, outlines_of
from graphslam.slam.smooth import smooth

CONFIG = load_config().front_end
LASER = Laser(
    step_deg=0.5, range_max_m=32.0, mount_m=(0.3, 0.1), mount_deg=5.0, dropout_share=0.005,
    mixed_share=0.5,
)  # fmt: skip
BODIES = {"box": Body(length_m=0.7, width_m=0.5, rear_m=0.2), "round": Body(radius_m=0.25)}
HALL = StaticObjects(
    walls=(Wall("hall", ((-15.0, -15.0), (15.0, -15.0), (15.0, 15.0), (-15.0, 15.0)), True),)
)


def outline(body):
    return outline_of([[body.radius_m]] if body.radius_m else corners(body).tolist())


def scans(poses, things, others, rng, laser=LASER):
    """Scans from bases at ``poses`` (n, 3); ``others``: name -> (body, poses)."""
    world = make_world(tuple(outlines_of(things)))
    hits = noise_free_scans(poses, laser, world, others)
    biases = laser.bias_sigma_m * rng.normal(size=len(world.names) + len(others))
    fan = beam_fan(laser)
    return [
        Scan("a", k, k, np.where(np.isfinite(r), r, np.nan), fan.start_rad, fan.step_rad,
             laser_mount(laser))
        for k, r in enumerate(noisy_ranges(hits, biases, laser, rng))
    ]  # fmt: skip


def one_robot(body, distance_m, seed, laser=LASER):
    """A scan of a robot somewhere at a distance, where it truly is, and what was expected."""
    rng = np.random.default_rng(seed)
    bearing, heading = rng.uniform(-1.3, 1.3), rng.uniform(-np.pi, np.pi)
    truth = compose(
        laser_mount(LASER),
        np.array([distance_m * np.cos(bearing), distance_m * np.sin(bearing), heading]),
    )
    sigmas = np.array([0.15, 0.15, 0.08])
    expected = ExpectedPose(truth + sigmas * rng.normal(size=3), np.diag(sigmas**2))
    (scan,) = scans(np.zeros((1, 3)), HALL, {"b": (body, truth[None])}, rng, laser)
    return scan, truth, expected


def error(sighting, truth):
    """How far a sighting is off, in its own size, and its covariance."""
    there = between(sighting.mount, truth)
    h = np.array([np.arctan2(there[1], there[0]), np.hypot(*there[:2]), there[2]])
    e = sighting.z - h[: len(sighting.z)]
    e[0] = wrap(e[0])
    if len(e) == 3:
        e[2] = wrap(e[2])
    return e, sighting.cov


@pytest.mark.parametrize("name", BODIES)
@pytest.mark.parametrize("distance_m", [2.0, 5.0, 9.0])
def test_a_detected_pose_has_a_consistent_covariance(name, distance_m):
    """NEES per degree of freedom over 100 seeds: never above 1.3 (chi-square of 200 and more
    degrees of freedom is below 1.26 with 99.5 %), and not so cautious that the sighting is wasted.
    Breaks when the edges, the laser's mount or the lever arm of the direction are wrong."""
    body = BODIES[name]
    d2, found, dof = [], 0, 0
    for seed in range(100):
        scan, truth, expected = one_robot(body, distance_m, seed)
        seen = detect_robots(scan, {"b": expected}, {"b": outline(body)}, CONFIG)
        for sighting in seen.sightings:
            e, P = error(sighting, truth)
            # a direction taken for that of another face is what robust kernels are for
            d2.append(min(float(e @ np.linalg.solve(P, e)), 20.0))
            dof += len(e)
            found += 1
            assert sighting.seen_robot == "b"
    assert found >= 95
    assert 0.2 < sum(d2) / dof < 1.3


def test_a_heading_is_measured_only_where_it_is_visible():
    """A round robot has none; a few beams do not show that of a box."""
    sizes = {}
    for name, step_deg in (("round", 0.5), ("box", 0.5), ("box", 2.0)):
        scan, _, expected = one_robot(BODIES[name], 5.0, 1, replace(LASER, step_deg=step_deg))
        (seen,) = detect_robots(
            scan, {"b": expected}, {"b": outline(BODIES[name])}, CONFIG
        ).sightings
        sizes[name, step_deg] = len(seen.z)
    assert sizes == {("round", 0.5): 2, ("box", 0.5): 3, ("box", 2.0): 2}


@pytest.mark.parametrize("name", BODIES)
def test_the_returns_of_a_robot_are_removed_and_no_others(name):
    for seed in range(30):
        scan, truth, expected = one_robot(BODIES[name], 4.0, seed)
        left = detect_robots(scan, {"b": expected}, {"b": outline(BODIES[name])}, CONFIG).scan
        gone = np.isfinite(scan.ranges) & ~np.isfinite(left.ranges)
        x = scan.ranges * np.cos(scan.angles), scan.ranges * np.sin(scan.angles)
        away = np.hypot(*(np.array(x) - between(scan.mount, truth)[:2, None]))
        assert gone[away < 0.4].all()
        assert not gone[away > 1.0].any()


@pytest.mark.parametrize("step", [1, -1])
def test_the_right_beams_of_a_deskewed_scan_are_removed(step):
    """Its bearings are not equally spaced: beam numbers from the nominal step would be others."""
    even = np.linspace(-np.pi, np.pi, 360, endpoint=False)
    bearings = (even + 0.05 * np.sin(3 * even))[::step]
    scan = Scan("a", 0, 0, np.full(360, 5.0), bearings[0], step * np.deg2rad(1.0),
                np.zeros(3), bearings=bearings)  # fmt: skip
    scan.ranges[100:130] = 2.0
    sweep = make_sweep(scan, 30.0)
    left = without_returns(scan, sweep, np.hypot(*sweep.points.T) < 3.0)
    assert np.flatnonzero(np.isnan(left.ranges)).tolist() == list(range(100, 130))


def test_no_robot_is_found_where_there_is_none():
    """Among a crate, a post and a pillar of other sizes, expected anywhere near them."""
    things = replace(
        HALL,
        boxes=(Box("crate", (4.0, 3.0), (1.6, 1.4), 20.0),),
        cylinders=(Cylinder("post", (3.0, 0.0), 0.1), Cylinder("pillar", (6.0, -1.5), 0.6)),
    )
    rng = np.random.default_rng(5)
    found = 0
    P = np.diag([0.5, 0.5, 0.3]) ** 2
    for scan in scans(np.zeros((50, 3)), things, {}, rng):
        for where in ((4.0, 3.0), (3.0, 0.0), (6.0, -1.5), (8.0, 8.0)):
            pose = np.array([*where, rng.uniform(-3, 3)]) + 0.3 * rng.normal(size=3)
            for body in BODIES.values():
                known = {"b": ExpectedPose(pose, P)}, {"b": outline(body)}
                found += len(detect_robots(scan, *known, CONFIG).sightings)
    assert found <= 2  # of 400


def test_what_was_there_while_the_robot_was_elsewhere_is_not_the_robot():
    """A chest of the robot's shape, where the robot might be."""
    body = BODIES["box"]
    chest = Box("chest", (5.0, 1.0), (body.length_m, body.width_m), 30.0)
    rng = np.random.default_rng(6)
    here = np.array([[0.0, 0.0, 0.0], [0.4, 0.1, 0.1]])
    before, now = scans(here, replace(HALL, boxes=(chest,)), {}, rng)
    lasers = [compose(pose, now.mount) for pose in here]
    base = np.array([5.0, 1.0, np.radians(30.0)])
    base[:2] += (body.rear_m - body.length_m / 2) * np.array([np.cos(base[2]), np.sin(base[2])])
    known = {"b": ExpectedPose(between(here[1], base), np.diag([0.2, 0.2, 0.1]) ** 2)}
    outlines = {"b": outline(body)}
    view = make_sweep(before, 30.0), between(lasers[0], lasers[1])
    assert len(detect_robots(now, known, outlines, CONFIG).sightings) == 1  # it looks like one
    assert not detect_robots(now, known, outlines, CONFIG, {"b": [view]}).sightings


def test_two_robots_of_one_shape_side_by_side_are_not_distinguished():
    """Expected between them: either may be it, so no sighting; both are removed from the scan."""
    body, rng = BODIES["round"], np.random.default_rng(2)
    at = {name: np.array([[4.0, y, 0.0]]) for name, y in (("b", 0.5), ("c", -0.5))}
    (scan,) = scans(np.zeros((1, 3)), HALL, {n: (body, p) for n, p in at.items()}, rng)
    expected = ExpectedPose(np.array([4.0, 0.0, 0.0]), np.diag([0.3, 0.3, 0.1]) ** 2)
    seen = detect_robots(scan, {"b": expected}, {"b": outline(body)}, CONFIG)
    assert not seen.sightings
    # no more than a mixed pixel beside each edge is left
    assert np.count_nonzero(seen.scan.ranges < 10) <= 4


@pytest.mark.parametrize("name", BODIES)
@pytest.mark.parametrize(
    "aside_m, sigma_m, seen", [(0, 0.1, []), (0.4, 0.1, ["b"]), (0.5, 2, ["b"])]
)
def test_one_cluster_is_at_most_one_robot(name, aside_m, sigma_m, seen):
    """Of two robots of one shape one is 4 m ahead, the other is hidden. Expected at one place,
    nothing tells which one it is: neither is seen. If c is expected 4 of its sigmas aside, or
    anywhere within metres, b is more than exp(4.5) times as likely, and it is seen alone."""
    body, at = BODIES[name], np.array([4.0, 0.0, 0.3])
    (scan,) = scans(np.zeros((1, 3)), HALL, {"b": (body, at[None])}, np.random.default_rng(2))
    there = at + np.array([0.0, aside_m, 0.0])
    known = {
        "c": ExpectedPose(there, np.diag([sigma_m, sigma_m, 0.05]) ** 2),
        "b": ExpectedPose(at, np.diag([0.1, 0.1, 0.05]) ** 2),
    }
    found = detect_robots(scan, known, dict.fromkeys("bc", outline(body)), CONFIG)
    assert [one.seen_robot for one in found.sightings] == seen
    # whoever it is, it is no wall
    assert np.count_nonzero(found.scan.ranges < 10) <= 4


# ------------------------------------------------------------ things that move


def test_what_stands_where_an_earlier_scan_looked_through_is_moving():
    rng = np.random.default_rng(3)
    things = replace(HALL, cylinders=(Cylinder("post", (5.0, 2.0), 0.2),))
    walker = (Body(radius_m=0.25), np.array([[6.0, -2.0, 0.0], [6.0, -1.0, 0.0]]))
    robot = np.array([[0.0, 0.0, 0.0], [0.3, 0.1, 0.1]])
    before, now = scans(robot, things, {"someone": walker}, rng)
    laser = [compose(pose, before.mount) for pose in robot]
    sweeps = [make_sweep(scan, 30.0) for scan in (before, now)]
    gone = dynamic_returns(sweeps[1], [(sweeps[0], between(laser[0], laser[1]))])
    place = between(laser[1], np.array([6.0, -1.0, 0.0]))[:2]
    near = np.hypot(*(sweeps[1].points - place).T) < 0.4
    assert gone[near].mean() > 0.9
    assert not gone[~near].any()  # nor the post, nor the walls


def test_nothing_of_a_building_is_moving():
    """All of the lab, between scans of its drive: furniture comes into view from behind other
    furniture all the time, where nothing was seen before."""
    actor = load_scenario("lab")
    rng = np.random.default_rng(4)
    poses = np.column_stack(
        [np.linspace(1.5, 4.0, 40), np.linspace(1.5, 3.0, 40), np.linspace(0, 2, 40)]
    )
    taken = scans(poses, actor.world, {}, rng)
    sweeps = [make_sweep(scan, 30.0) for scan in taken]
    lasers = [compose(pose, taken[0].mount) for pose in poses]
    returns = flagged = 0
    for k in range(4, 40):
        for j in range(k - 4, k):
            gone = dynamic_returns(sweeps[k], [(sweeps[j], between(lasers[j], lasers[k]))])
            flagged, returns = flagged + int(gone.sum()), returns + len(gone)
    assert flagged < 0.002 * returns


# ------------------------------------------------------------ the map


TABLE = Body(length_m=1.2, width_m=0.9, rear_m=0.3)


def beside(start, end, speed_m_s):
    """A robot with a laser drives along a hall; another one, like a table, from start to end."""
    laser = replace(LASER, mount_m=(0.0, 0.0), mount_deg=0.0)
    slow = (Leg((end,), speed_m_s=speed_m_s),)
    return Scenario(
        robots={
            "a": Robot((0.0, 0.0), Body(radius_m=0.25), drive=(Leg(((9.0, 0.0),)),), laser=laser),
            "b": Robot(start, TABLE, drive=slow, start_deg=90.0 if start[0] == end[0] else 0.0),
        },
        world=HALL,
        name="beside",
    )


def inside(tmp_path, scenario, *settings):
    """Number of landmarks inside the hall, where only the other robot has been; the summary."""
    log = tmp_path / "log.mcap"
    if not log.exists():
        simulate(scenario, log)
    config = load_config(overrides=["start.from_truth=true", *settings])
    result = smooth(open_logs([log], config), config)
    found = [m for m in result.landmarks if np.abs(m.position[:2]).max() < 13]
    return len(found), result.summary


def test_no_landmark_is_made_of_a_robot(tmp_path):
    """One that creeps along is walls of the map, unless its outline is known."""
    scenario = beside((4.0, 2.0), (6.5, 2.0), 0.1)
    unknown, _ = inside(tmp_path, scenario)
    known, summary = inside(tmp_path, scenario, f"robots.b.outline={corners(TABLE).tolist()}")
    assert unknown > 0
    assert known == 0
    assert summary["dropped"]["range: of a robot"] > 100


def test_dynamic_objects_are_removed_from_the_scans(tmp_path):
    """Nobody knows its outline, but where it is now the laser looked through before."""
    scenario = beside((7.0, -6.0), (7.0, 2.0), 0.5)
    kept, told = inside(tmp_path, scenario, "front_end.dynamic_objects=keep")
    found, summary = inside(tmp_path, scenario)
    assert found <= kept
    assert not [reason for reason in told["dropped"] if "moves" in reason]
    assert summary["dropped"]["range: of a thing that moves"] > 100


@pytest.mark.parametrize("bad", ["[[0, 0], [1, 0]]", "[[0, 0], [1, 0], [1]]", "[[-0.2]]", "[[]]"])
def test_a_bad_outline_is_an_error_that_names_its_key(bad):
    with pytest.raises(ConfigError, match="outline: needs three corners"):
        load_config(overrides=[f"robots.b.outline={bad}"])
