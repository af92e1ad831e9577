"""A simulated log of one robot with a laser that drives once round the box in a room."""

import numpy as np
from walls import cast, rectangles

from graphslam.core.geometry import between, compose
from graphslam.logs import LogWriter

S = 1_000_000_000
START_NS = 1_700_000_000 * S + 123_456_789
BEAMS = np.radians(np.arange(-90, 91.0))
SCAN = {"angle_min_rad": float(BEAMS[0]), "angle_step_rad": np.radians(1), "range_max_m": 20.0}
MOUNT = np.array([0.2, 0.0, 0.0])
REAR = np.array([-0.2, 0.05, np.pi])
ROOM = rectangles((0, 0, 10, 8), (4, 3.5, 6, 4.5))
SECONDS, SCANS = 30, 60


def true_pose(seconds, phase=0.0):
    """Once round the box in the room, on an ellipse; ``phase``: where it begins, in rounds."""
    a = 2 * np.pi * (seconds / SECONDS + phase) - np.pi / 2
    return np.array(
        [5 + 3 * np.cos(a), 4 + 2.3 * np.sin(a), np.arctan2(2.3 * np.cos(a), -3 * np.sin(a))]
    )


def drive(
    path,
    *,
    seconds=SECONDS,
    robot="robot",
    ranges=lambda found, _k: found,
    truth=True,
    rear=False,
    phase=0.0,
    room=ROOM,
    seed=7,
    odometry_from=0.0,
):
    """A log of the room with two scans a second; odometry errs by 3 % and drifts by 0.02 rad/m.

    ``ranges`` may spoil scan number k. ``rear``: with a second laser, at `REAR`.
    ``phase``: see `true_pose`. ``odometry_from``: s after which there is any.
    """
    rng = np.random.default_rng(seed)
    odometry = np.zeros(3)
    with LogWriter(path) as log:
        log.mount(robot, START_NS, MOUNT)
        if rear:
            log.mount(robot, START_NS, REAR, "rear")
        for k in range(seconds * 10 + 1):
            stamp, pose = START_NS + k * S // 10, true_pose(k / 10, phase)
            if k:
                moved = between(true_pose((k - 1) / 10, phase), pose)
                path_m = np.hypot(*moved[:2])
                moved = moved * [1.03, 1.0, 1.0] + [0, 0, 0.02 * path_m]
                odometry = compose(odometry, moved + rng.normal(0, 2e-4, 3))
            if k / 10 >= odometry_from:
                log.odometry(robot, stamp, odometry)
            if truth:
                log.truth(robot, stamp, pose)
            if k % 5 == 0:
                found = cast(room, BEAMS, compose(pose, MOUNT), 30.0) + rng.normal(
                    0, 0.01, len(BEAMS)
                )
                log.scan(robot, stamp + 7, ranges(found, k // 5), **SCAN)
            if rear and k % 6 == 2:
                found = cast(room, BEAMS, compose(pose, REAR), 30.0)
                found += rng.normal(0, 0.01, len(BEAMS))
                log.scan(robot, stamp, found, sensor="rear", **SCAN)
    return path
