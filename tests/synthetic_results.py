"""Results made without an estimator: what results, evaluation and report are tested on.

`room` is one robot with a laser in a room with a box, line landmarks; `orchard` two robots without
scans among point landmarks that also see each other. Errors are drawn from the covariances that
the result states, so its consistency is known.
"""

import itertools

import numpy as np
from walls import cast, rectangles

from graphslam.core.config import Config
from graphslam.core.geometry import between, compose, exp, wrap
from graphslam.core.records import (
    Association,
    Estimate,
    KeyframeScan,
    Landmark,
    Motion,
    Result,
    RobotResult,
    Start,
    Step,
    Trajectory,
)

START_NS = 976_052_857_337_284_123
CONFIG_SHA = "c0ffee" * 10 + "beef"


WALLS = rectangles((-8, -5, 8, 5), (-3, -1.5, 4, 1.5), (5, 3.5, 6.5, 5))
ROOM_PATH = (6.0, 3.0)


def loop_path(n, laps, a, b, phase=0.0):
    """Poses on a rounded rectangle with half axes a, b."""
    s = phase + np.linspace(0, 2 * np.pi * laps, n)
    x = a * np.sign(np.cos(s)) * np.abs(np.cos(s)) ** 0.6
    y = b * np.sign(np.sin(s)) * np.abs(np.sin(s)) ** 0.6
    xy = np.column_stack([x, y])
    ahead = np.gradient(xy, axis=0)
    return np.column_stack([xy, np.arctan2(ahead[:, 1], ahead[:, 0])])


def drift(poses, rng, scale, turn):
    """Dead reckoning of a path: increments with a scale error and a turning drift."""
    found = [poses[0]]
    for a, b in itertools.pairwise(poses):
        u = between(a, b) * np.array([scale, scale, 1.0])
        u[2] += turn * np.hypot(u[0], u[1]) + rng.normal(0, 0.002)
        found.append(compose(found[-1], u))
    return np.array(found)


def estimated(stamps, truth, rng, sigma, heading_sigma):
    """A trajectory with independent errors drawn from its stated covariance."""
    n = len(truth)
    sigmas = np.column_stack(
        [sigma * np.ones(n), 0.7 * sigma * np.ones(n), heading_sigma * np.ones(n)]
    )
    covs = np.zeros((n, 3, 3))
    covs[:, [0, 1, 2], [0, 1, 2]] = sigmas**2
    covs[:, 0, 1] = covs[:, 1, 0] = 0.3 * sigmas[:, 0] * sigmas[:, 1]
    noise = np.einsum("nij,nj->ni", np.linalg.cholesky(covs), rng.normal(size=(n, 3)))
    poses = truth + noise
    poses[:, 2] = wrap(poses[:, 2])
    return Trajectory(stamps, poses, covs)


def motions(robot, trajectory, rng):
    found = []
    for i in range(1, len(trajectory)):
        delta = between(trajectory.poses[i - 1], trajectory.poses[i])
        delta = compose(delta, exp(rng.normal(0, [0.01, 0.01, 0.005])))
        cov = np.diag([1e-4, 2e-4, 3e-5])
        cov[0, 1] = cov[1, 0] = 5e-5
        stamps = trajectory.stamps_ns[i - 1 : i + 1].tolist()
        found.append(
            (robot, Motion(*stamps, delta, cov, np.zeros((3, 0)), float(np.hypot(*delta[:2]))))
        )
    return found


def summary(messages, scans, keyframes, observations, landmarks, warnings, **more):
    return {
        "format": "graphslam-result-1",
        "versions": {"graphslam": "0.1.0", "gtsam": "4.3.0", "python": "3.12.3"},
        "logs": [
            {
                "path": "logs/made_up.mcap",
                "sha256": "0123456789abcdef" * 4,
                "messages": messages,
                "lost": 0,
            }
        ],
        "config_sha256": CONFIG_SHA,
        "stages": {"read": 0.4, "odometry": 0.1, "lines": 0.7, "estimate": 1.9, "polish": 0.6},
        "scans_per_s": 410.5 if scans else None,
        "real_time_factor": 43.21,
        "peak_memory_mb": 312.4,
        "counts": {
            "messages": messages,
            "scans": scans,
            "keyframes": keyframes,
            "observations": observations,
            "landmarks": landmarks,
            "loop_closures": 0,
        },
        "rejected": {"beyond the gate": 121, "between the two thresholds": 37, "no overlap": 16},
        "dropped": {"range above maximum": 2913, "no odometry around the scan": 4},
        "graph": {"error": 512.3, "dof": 1180},
        "calibration": {},
        "warnings": warnings,
        **more,
    }


def nis(rng, model_dof, n, span_s, scale=1.0):
    t = np.sort(rng.uniform(0, span_s, n))
    return np.column_stack([t, scale * rng.chisquare(model_dof, n) / model_dof])


def wall_landmark(number, wall, rng):
    a, b = wall
    direction = b - a
    phi = float(np.arctan2(direction[1], direction[0]))
    middle = wall.mean(axis=0)
    normal = phi + np.pi / 2
    n, t = np.array([np.cos(normal), np.sin(normal)]), np.array([np.cos(phi), np.sin(phi)])
    # offset = n . middle and dn/dnormal = -t: a direction error has the lever arm -t . middle
    C = np.diag([0.004**2, 0.02**2])
    turn, shift = rng.normal(0, [0.004, 0.02])
    J = np.array([[1.0, 0.0], [-float(t @ middle), 1.0]])
    line_cov = J @ C @ J.T
    found_middle = middle + shift * n
    normal += turn
    n = np.array([np.cos(normal), np.sin(normal)])
    t = np.array([n[1], -n[0]])
    half = 0.48 * np.hypot(*direction)
    extent = np.stack([found_middle - half * t, found_middle + half * t])
    R = np.column_stack([t, n])
    cov = np.zeros((3, 3))
    cov[:2, :2] = R @ np.diag([1.0, 0.02**2]) @ R.T
    cov[2, 2] = 0.004**2
    line = (float(wrap(normal)), float(n @ found_middle), line_cov)
    position = np.array([*found_middle, float(wrap(normal - np.pi / 2))])
    return Landmark(
        number,
        "line",
        position,
        cov,
        extent,
        line,
        40 + 7 * number,
        START_NS,
        START_NS + 10**11,
        None,
    )


def room_walls():
    """The walls (12, 2, 2) in the world frame, whose origin is the first pose."""
    # every sampling of the path starts at the same place in the same direction
    first = np.array([ROOM_PATH[0], 0.0, np.pi / 2])
    ends = np.concatenate([WALLS, np.zeros((*WALLS.shape[:2], 1))], axis=-1)
    return between(first, ends)[..., :2]


def room(keyframes=300, beams=181, seed=3):
    """One robot, laser, 12 line landmarks. Returns the result and the true trajectory."""
    rng = np.random.default_rng(seed)
    path = loop_path(keyframes, 2.1, *ROOM_PATH)
    path[0, 2] = np.pi / 2  # the tangent; finite differences give the chord
    origin, truth = path[0], between(path[0], path)
    stamps = START_NS + (np.arange(keyframes) * 0.4e9).astype(np.int64)
    covs_growth = 1 + 0.8 * np.sin(np.linspace(0, 6 * np.pi, keyframes)) ** 2
    final = estimated(stamps, truth, rng, 0.015 * covs_growth, 0.004 * covs_growth)
    causal = estimated(
        stamps, truth, rng, 0.03 + 0.001 * np.arange(keyframes), 0.01 * np.ones(keyframes)
    )
    dead = Trajectory(stamps, drift(truth, rng, 1.03, 0.02), np.zeros((keyframes, 3, 3)))
    mount = np.array([0.1, 0.0, 0.0])
    scan_final = Trajectory(stamps, compose(final.poses, mount), final.covs)
    scan_causal = Trajectory(stamps, compose(causal.poses, mount), causal.covs)
    angles = np.linspace(-np.pi / 2, np.pi / 2, beams)
    keyframe_scans = []
    for stamp, pose in zip(stamps.tolist(), truth, strict=True):
        laser = compose(compose(origin, pose), mount)
        ranges = cast(WALLS, angles, laser, 30.0) + rng.normal(0, 0.02, beams)
        ok = np.isfinite(ranges)
        points = np.column_stack([ranges * np.cos(angles), ranges * np.sin(angles)])[ok] + mount[:2]
        keyframe_scans.append(KeyframeScan("robot", stamp, points))
    walls = room_walls()
    landmarks = tuple(wall_landmark(i, wall, rng) for i, wall in enumerate(walls))
    start = Start(final.poses[0], np.diag([1e-6, 1e-6, 1e-6]))
    steps = [Step(stamps[0].item(), starts={"robot": start})]
    for i, (robot, motion) in enumerate(motions("robot", final, rng), start=1):
        landmark = landmarks[i % len(landmarks)]
        z = between(final.poses[i], landmark.position)
        z = compose(z, np.array([rng.normal(0, 0.5), 0.0, 0.0]))
        c, s = np.cos(z[2]), np.sin(z[2])
        R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        cov = R @ np.diag([4.0, 4e-4, 2.5e-5]) @ R.T
        seen = Association(robot, motion.end_ns, landmark.id, "line", z, cov)
        steps.append(Step(motion.end_ns, motions={robot: motion}, associations=(seen,)))
    span = float(stamps[-1] - stamps[0]) / 1e9
    estimate = Estimate(
        {"robot": final}, {m.id: (m.position, m.cov) for m in landmarks}, 512.3, 1180
    )
    result = Result(
        robots={"robot": RobotResult(final, causal, scan_final, scan_causal, dead)},
        landmarks=landmarks,
        estimate=estimate,
        steps=tuple(steps),
        keyframe_scans=tuple(keyframe_scans),
        innovations={"line": nis(rng, 2, 2200, span), "segment": nis(rng, 3, 900, span, 1.4)},
        step_ms=rng.gamma(3, 1.2, keyframes) + np.linspace(0.5, 5, keyframes),
        summary=summary(
            27341,
            13631,
            keyframes,
            3120,
            len(landmarks),
            ["logs/made_up.mcap: 631 scans are stamped earlier than the one before <scan & odom>"],
            calibration={
                "robot.translation_scale": {"value": 0.98, "sigma": 0.004, "observable": True},
                "robot.axle_m": {"value": 0.4, "sigma": 0.2, "observable": False},
            },
        ),
        config=Config(),
    )
    return result, Trajectory(stamps, truth, np.zeros((keyframes, 3, 3)))


def orchard(keyframes=400, trees=60, seed=5):
    """Two robots without scans, point landmarks. Returns the result and the true trajectories."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform([-60, -35], [60, 35], (trees, 2))
    stamps = START_NS + (np.arange(keyframes) * 1e9).astype(np.int64)
    truths = {
        "robot1": loop_path(keyframes, 1.6, 50, 25),
        "robot2": loop_path(keyframes, 1.4, 35, 14, phase=2.0),
    }
    robots, estimates = {}, {}
    growth = 1 + np.abs(np.sin(np.linspace(0, 7, keyframes)))
    for name, truth in truths.items():
        truth[:, 2] = wrap(truth[:, 2])
        final = estimated(stamps, truth, rng, 0.12 * growth, 0.01 * growth)
        causal = estimated(stamps, truth, rng, 0.3 * growth, 0.02 * growth)
        dead = Trajectory(stamps, drift(truth, rng, 1.02, 0.002), np.zeros((keyframes, 3, 3)))
        robots[name], estimates[name] = RobotResult(final, causal, None, None, dead), final
    landmarks, sightings = [], rng.integers(3, 200, trees)
    for i in range(trees):
        a = rng.normal(0, 0.1, (2, 2))
        cov = a @ a.T + 0.01 * np.eye(2)
        p = xy[i] + np.linalg.cholesky(cov) @ rng.normal(size=2)
        extent = np.stack([p, p])
        position = np.array([*p, np.nan])
        first, last = stamps[3].item(), stamps[-3].item()
        landmarks.append(
            Landmark(
                i, "point", position, cov, extent, None, int(sightings[i]), first, last, f"{i}"
            )
        )
    steps = [
        Step(
            stamps[0].item(), {n: Start(e.poses[0], np.eye(3) * 1e-4) for n, e in estimates.items()}
        )
    ]
    moves = {n: motions(n, e, rng) for n, e in estimates.items()}
    for i in range(1, keyframes):
        t = stamps[i].item()
        tree = landmarks[i % trees]
        delta = between(estimates["robot1"].poses[i], np.array([*tree.position[:2], 0.0]))
        z = np.array([np.arctan2(delta[1], delta[0]), np.hypot(*delta[:2])])
        other = between(estimates["robot1"].poses[i], estimates["robot2"].poses[i])
        seen = np.array([np.arctan2(other[1], other[0]), np.hypot(*other[:2])])
        cov = np.diag([1e-4, 1e-2])
        found = (
            Association("robot1", t, tree.id, "point", z, cov),
            Association("robot1", t, "robot2", "robot-point", seen, cov),
            Association(
                "robot2",
                t,
                "robot1",
                "robot-pose",
                between(*(estimates[n].poses[i] for n in ("robot2", "robot1"))),
                np.diag([0.01, 0.02, 0.001]),
            ),
        )
        steps.append(
            Step(t, motions={n: m[i - 1][1] for n, m in moves.items()}, associations=found)
        )
    result = Result(
        robots=robots,
        landmarks=tuple(landmarks),
        estimate=Estimate(
            estimates, {m.id: (m.position[:2], m.cov) for m in landmarks}, 300.0, 700
        ),
        steps=tuple(steps),
        keyframe_scans=(),
        innovations={
            "point": nis(rng, 2, 1500, keyframes, 1.2),
            "robot-point": nis(rng, 2, 300, keyframes),
        },
        step_ms=rng.gamma(2, 1.0, keyframes),
        summary=summary(10608, 0, 2 * keyframes, 3640, trees, []),
        config=Config(),
    )
    return (
        result,
        {n: Trajectory(stamps, p, np.zeros((keyframes, 3, 3))) for n, p in truths.items()},
        xy,
    )
