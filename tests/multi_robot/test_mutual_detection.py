"""Robots of unknown start in others' scans: found by their motion, without false detections."""

from dataclasses import replace

import numpy as np
import pytest

from graphslam.core.config import OdometryConfig, RobotConfig
from graphslam.core.config_io import load_config
from graphslam.core.frame_forest import PRIOR_INFLATION
from graphslam.core.geometry import compose, compose_jacobians, exp, wrap
from graphslam.core.records import OdometryPose, Scan, Trajectory
from graphslam.evaluation.metrics import evaluate
from graphslam.logs import open_logs, read_truth
from graphslam.multi_robot.mutual_detection import ScanBuffer
from graphslam.multi_robot.relative_frames import RobotEstimate
from graphslam.multi_robot.track_registration import odometry_cross_covariance
from graphslam.odometry.preintegration import Track
from graphslam.simulation import scenario as sim
from graphslam.simulation import simulate
from graphslam.simulation.robot_shapes import corners
from graphslam.slam.smooth import initialise, smooth

S = 1_000_000_000
SHAPE = sim.Body(length_m=0.45, width_m=0.38, rear_m=0.22)
OUTLINE = corners(SHAPE).tolist()
LASER = sim.Laser(
    period_s=0.25, step_deg=0.5, range_max_m=32.0, mount_m=(0.15, 0.0), dropout_share=0.005,
    mixed_share=0.5,
)  # fmt: skip
ENCODERS = sim.Encoders(
    wheel_radius_m=0.08, axle_m=0.33, radius_error_left=0.004, radius_error_right=-0.004,
    slip_m=0.006,
)  # fmt: skip
#: furniture of the robot's size among other, in a hall; beside it another room, not quite as large,
#: or nothing could tell them apart
HALL = sim.StaticObjects(
    walls=(
        sim.Wall("hall", ((-8.0, -6.0), (8.0, -6.0), (8.0, 6.0), (-8.0, 6.0)), True),
        sim.Wall("room", ((12.0, -7.0), (30.0, -7.0), (30.0, 6.0), (12.0, 6.0)), True),
    ),
    boxes=(
        sim.Box("desk", (-5.5, 4.5), (1.6, 0.8)),
        sim.Box("crate", (6.0, -3.0), (0.5, 0.4), 20.0),
        sim.Box("stool", (-2.5, -4.5), (0.4, 0.4), 10.0),
    ),
    cylinders=(sim.Cylinder("post 1", (3.0, 3.5), 0.2), sim.Cylinder("post 2", (-3.0, -3.0), 0.2)),
)
WAY = ((2.0, -2.0), (4.5, -1.0), (5.5, 2.0), (3.5, 2.3), (1.5, 3.5), (-1.5, 3.0), (-4.0, 1.5))
AROUND = ((5.0, 4.5), (3.0, 5.0), (-4.0, 3.8), (-6.5, 2.0), (-6.5, -3.5))


def robot(start, *way, deg=0.0, body=SHAPE, **more):
    drive = (sim.Leg(tuple(way)),) if way else ()
    sensors = {"encoders": ENCODERS, "laser": LASER}
    return sim.Robot(start, body, start_deg=deg, drive=drive, **sensors | more)


A = robot((-6.0, -1.0), (-4.0, -1.0), (-1.0, 0.5), (1.5, 0.0), (1.5, -2.0), speed_m_s=0.2)
B = robot((0.5, -3.0), *WAY, deg=45.0)
#: the same drive where nobody sees it
AWAY = replace(B, start_m=(20.5, -3.0), drive=(sim.Leg(tuple((x + 20.0, y) for x, y in WAY)),))
WALKER = robot(
    (6.5, 4.5), *AROUND, deg=180.0, body=sim.Body(radius_m=0.25), laser=None, speed_m_s=0.4
)  # fmt: skip


def start_of(one):
    return np.array([*one.start_m, np.radians(one.start_deg)])


def settings(robots, known, outlined, draw=None):
    """Starts of ``known`` are given, ``draw`` off; outlines of ``outlined``."""
    lines = [f"robots.{name}.outline={OUTLINE}" for name in outlined]
    for name in known:
        at = start_of(robots[name]) + (0.0 if draw is None else draw)
        lines.append(f"start.poses.{name}={at.tolist()}")
    return load_config(overrides=lines)


def recorded(folder, robots, seed=0):
    log = folder / "log.mcap"
    simulate(sim.Scenario(robots=robots, world=HALL, name="hall"), log, seed=seed)
    return log


def joined(folder, robots, known=("a",), outlined=("b",), seed=0, draw=None):
    log = recorded(folder, robots, seed)
    config = settings(robots, known, outlined, draw)
    return initialise(open_logs([log], config), config).frame_assignment


def off(found, name, robots):
    """By how much a found start is off, and its covariance."""
    e = found.starts[name].pose - start_of(robots[name])
    e[2] = wrap(e[2])
    return e, found.starts[name].cov / PRIOR_INFLATION**2


def fits(found, name, robots):
    """The error is within the 99.9 % ellipse of a covariance that is small."""
    e, P = off(found, name, robots)
    assert e @ np.linalg.solve(P, e) < 16.3
    assert np.sqrt(P[0, 0] + P[1, 1]) < 0.6
    assert np.sqrt(P[2, 2]) < 0.1


# ------------------------------------------------------------ found


def test_a_robot_is_found_as_well_as_stated(tmp_path):
    """Over seeds, with and without a laser of its own, its clock right or off by 0.4 s.

    The start that is given is drawn from its prior. 99.9 % of chi-square with 3 degrees of freedom
    per seed, both sides. Breaks when the drift of odometry between sightings is not in the
    covariance, or the clocks are taken to agree."""
    cases = [(0.0, LASER), (0.4, LASER), (-0.4, LASER), (0.0, None), (0.4, None), (-0.4, None)]
    config, d2 = load_config().start, []
    sigmas = np.array([config.given_sigma_m, config.given_sigma_m, config.given_sigma_rad])
    for seed, (ahead_s, laser) in enumerate(cases):
        robots = {"a": A, "b": replace(B, laser=laser, clock=sim.RobotClock(offset_s=ahead_s))}
        draw = sigmas * np.random.default_rng(seed).normal(size=3)
        found = joined(tmp_path, robots, seed=seed, draw=draw)
        assert found.frames == {"a": "a", "b": "a"}, seed
        e, P = off(found, "b", robots)
        d2.append(float(e @ np.linalg.solve(P, e)))
        # the given start's heading at 7 m is 0.2 m of it
        assert np.sqrt(P[2, 2]) < 0.1
    assert 4.9 < sum(d2) < 42.3  # chi-square, 18 degrees of freedom


@pytest.mark.slow
def test_a_found_start_costs_nothing_against_a_known_one(tmp_path):
    """Clocks 0.4 s apart, as the map is aligned: within a tenth. Seeds differ by a hundredth."""
    few = replace(LASER, period_s=0.5, step_deg=1.0)
    robots = {
        "a": replace(A, laser=few),
        "b": replace(B, laser=few, clock=sim.RobotClock(offset_s=0.4)),
    }
    log = recorded(tmp_path, robots)
    truth = read_truth([log], load_config()).trajectories
    errors = []
    for known in (("a", "b"), ("a",)):
        config = settings(robots, known, ["b"])
        result = smooth(open_logs([log], config), config)
        errors.append(evaluate(result, truth)["joint"]["final"]["ate_aligned_rmse_m"])
        clock = result.summary["clocks"]["b"]
        assert abs(clock["offset_s"] - 0.4) < 4 * clock["offset_sigma_s"] < 0.1
    assert set(result.summary["starts_found"]) == {"b"}
    assert not [w for w in result.summary["warnings"] if "separate frame" in w]
    assert errors[1] < 1.1 * errors[0]


def test_the_observer_may_be_the_one_to_be_found(tmp_path):
    robots = {"a": A, "b": B}
    found = joined(tmp_path, robots, known=("b",))
    assert found.frames == {"a": "b", "b": "b"}
    fits(found, "a", robots)


def test_two_robots_that_see_the_same_robot_are_related_by_it(tmp_path):
    """c is seen by nobody: where it is follows from where it sees b."""
    robots = {"a": A, "b": B, "c": robot((-6.5, -5.0), deg=30.0)}
    found = joined(tmp_path, robots)
    assert found.frames == {"a": "a", "b": "a", "c": "a"}
    assert found.found["c"].other == "b"
    for name in "bc":
        fits(found, name, robots)


def test_robots_of_one_shape_are_distinguished_by_their_paths(tmp_path):
    other = robot(
        (-1.0, 4.2), (-3.0, 3.6), (-4.5, 1.0), (-3.0, -1.8), (-0.5, -2.5), (2.5, -3.5), deg=200.0
    )
    robots = {"a": A, "b": B, "c": other}
    found = joined(tmp_path, robots, outlined=("b", "c"))
    assert found.frames == {"a": "a", "b": "a", "c": "a"}
    for name in "bc":
        fits(found, name, robots)


# ------------------------------------------------------------ not taken for it


OTHERS = {
    "a person": WALKER,
    "one of its shape on another way": replace(WALKER, body=SHAPE),
    "one of its shape at another speed": replace(B, laser=None, speed_m_s=0.3),
}


@pytest.mark.parametrize("what", OTHERS)
@pytest.mark.parametrize("seen", [False, True], ids=["alone", "beside the robot"])
def test_nothing_else_that_moves_is_the_robot(tmp_path, what, seen):
    """Whatever walks about, the robot is found where it is, and if it is elsewhere nowhere."""
    other = OTHERS[what]
    if seen and other.start_m == B.start_m:
        pytest.skip("they would drive into each other")
    robots = {"a": A, "b": B if seen else AWAY, "w": other}
    found = joined(tmp_path, robots)
    assert found.frames["b"] == ("a" if seen else "b")
    if seen:
        fits(found, "b", robots)


def test_a_straight_path_is_not_accepted(tmp_path):
    """One of its shape goes as far as fast elsewhere: nothing tells them apart."""
    away = robot((14.0, -2.0), (20.0, -2.0))
    other = robot((-2.0, 2.5), (4.0, 2.5), laser=None)
    found = joined(tmp_path, {"a": A, "b": away, "w": other})
    assert found.frames["b"] == "b"
    assert "moved too simply" in found.undecided["b"]


def test_robots_that_drive_alike_are_not_distinguished(tmp_path):
    """Both visible: undecided, though one start is known. One visible: it may be either."""
    few = replace(LASER, period_s=0.5, step_deg=1.0)
    standing = robot((-7.0, -5.0))
    behind = robot((-1.2, -3.0), *((x - 1.7, y) for x, y in WAY), deg=45.0, laser=few)
    room = {"a": standing, "b": replace(B, laser=few), "c": behind}
    found = joined(tmp_path, room, outlined=("b", "c"))
    assert found.frames == {"a": "a", "b": "b", "c": "b"}
    assert "in two ways" in found.undecided["b"]
    room = {"a": A, "b": replace(AWAY, laser=None), "c": replace(B, laser=None)}
    found = joined(tmp_path, room, outlined=("b", "c"))
    assert found.frames == {"a": "a", "b": "b", "c": "c"}
    assert "may be b or c" in found.undecided["b"]
    # that c is where it was seen is known beforehand: then it was c
    found = joined(tmp_path, room, ("a", "c"), ("b", "c"))
    assert found.frames == {"a": "a", "b": "b", "c": "a"}


def test_a_robot_that_nobody_sees_keeps_a_frame_of_its_own(tmp_path):
    robots = {"a": A, "b": AWAY}
    log = recorded(tmp_path, robots)
    config = settings(robots, ["a"], ["b"])
    result = smooth(open_logs([log], config), config)
    assert result.summary["frames"] == {"a": "a", "b": "b"}
    (told,) = [w for w in result.summary["warnings"] if "separate frame" in w]
    assert told.startswith("b: nothing in the log tells its start pose")


def test_sightings_of_robots_may_be_ignored(tmp_path):
    log = recorded(tmp_path, {"a": A, "b": B})
    config = settings({"a": A}, ["a"], ["b"])
    config = replace(config, association=replace(config.association, robot_sightings="ignore"))
    found = initialise(open_logs([log], config), config).frame_assignment
    assert found.frames == {"a": "a", "b": "b"}


# ------------------------------------------------------------ parts


@pytest.mark.parametrize("exact", [1.0, 1e-6])
def test_the_joint_covariance_of_a_path_is_positive_definite(exact):
    """Positive definite, also where odometry adds nearly nothing to the floor of each motion."""
    config = OdometryConfig()
    tiny = {k: exact * getattr(config, k) for k in ("k_x_m", "k_y_m", "k_phi_m", "k_phi_rad")}
    track = driven(30, replace(config, **tiny))
    times = np.arange(1, 30) * S
    one = Trajectory(times[:1], np.zeros((1, 3)), np.zeros((1, 3, 3)))
    C = (
        odometry_cross_covariance(RobotEstimate(one, track, {}), times)
        .transpose(0, 2, 1, 3)
        .reshape(87, 87)
    )
    assert np.linalg.eigvalsh((C + C.T) / 2).min() > -1e-9
    np.testing.assert_allclose(C, C.T, atol=1e-12)


NO_FLOOR = OdometryConfig(floor_sigma_m=1e-9, floor_sigma_rad=1e-9)


def driven(seconds, config=NO_FLOOR):
    """A track of 10 Hz: 0.3 m/s in a bend, standing after ``seconds``."""
    step = np.array([0.03, 0.0, 0.02])
    track, pose = Track(config, RobotConfig()), np.zeros(3)
    for k in range(301):
        track.add(OdometryPose("b", k * S // 10, k * S // 10, pose))
        pose = compose(pose, exp(step)) if k < 10 * seconds else pose
    return track


def test_only_scans_between_which_a_robot_drove_are_kept():
    """One for every 0.1 m of 3 m, none of where it stands."""
    kept = ScanBuffer({"a": driven(0), "b": driven(10)}, {"b": np.array(OUTLINE)}, 0.1)
    for k in range(300):
        kept.add(Scan("a", k * S // 10, k * S // 10, np.ones(3), 0.0, 0.1, np.zeros(3)))
    assert 24 <= len(kept.scans) <= 31
    assert kept.scans[-1].time_ns <= 10 * S


def test_the_joint_covariance_of_a_path_agrees_with_that_of_its_parts():
    """What the error at one time does not explain of that at a later one is the error of the motion
    in between. Breaks when the lever of the heading or the shared calibration is forgotten."""
    track = driven(30)
    times = np.array([0, 4, 9, 15, 24]) * S
    one = Trajectory(times[:1], np.zeros((1, 3)), np.zeros((1, 3, 3)))
    C = odometry_cross_covariance(RobotEstimate(one, track, {}), times)
    moved = track.motions(np.zeros_like(times), times)
    np.testing.assert_allclose(C[range(5), range(5)], moved.cov, atol=1e-12)
    for k in range(1, 5):
        for n in range(k + 1, 5):
            part = track.motion(int(times[k]), int(times[n]))
            F, W = compose_jacobians(moved.delta[k], part.delta)
            rest = C[n, n] - F @ C[k, n] - C[n, k] @ F.T + F @ C[k, k] @ F.T
            # noise of increments goes by their sums in one way, by each in the other
            np.testing.assert_allclose(rest, W @ part.cov @ W.T, rtol=0.01, atol=1e-6)
