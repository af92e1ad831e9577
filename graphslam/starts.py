"""Where the robots start: the prior of each robot's first state."""

import numpy as np

from graphslam.config import Config
from graphslam.errors import EstimationError
from graphslam.logs import LogSet
from graphslam.records import Start, Truth


def start_poses(log: LogSet, config: Config) -> dict[str, Start]:
    """Where each robot starts: as given, from one truth sample, or the origin for the first.

    Raises:
        EstimationError: truth was asked for and a robot has none, or a given pose is malformed.
    """
    start = config.start
    given = np.diag([start.given_sigma_m**2] * 2 + [start.given_sigma_rad**2])
    starts: dict[str, Start] = {}
    if start.from_truth:
        for message in log.messages():
            if isinstance(message, Truth) and message.robot not in starts:
                starts[message.robot] = Start(message.pose, given)
            if len(starts) >= len(log.robots):
                break
        missing = [robot for robot in log.robots if robot not in starts]
        if missing:
            raise EstimationError(f"--start truth: the log has no truth for {', '.join(missing)}")
    for robot, pose in start.poses.items():
        if len(pose) != 3 or robot not in log.robots:
            raise EstimationError(
                f"--start {robot}: needs x,y,phi of one of the robots {', '.join(log.robots)}"
            )
        starts[robot] = Start(np.array(pose), given)
    if log.robots and log.robots[0] not in starts and not starts:
        origin = np.diag([start.origin_sigma_m**2] * 2 + [start.origin_sigma_rad**2])
        starts[log.robots[0]] = Start(np.zeros(3), origin)
    return starts
