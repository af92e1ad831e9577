"""Start priors: the prior of each robot's first state."""

import numpy as np

from graphslam.core.config import Config
from graphslam.core.errors import EstimationError
from graphslam.core.geometry import Array, between, compose, inverse
from graphslam.core.records import OdometryIncrement, Scan, Sighting, Start, Truth
from graphslam.core.suggestions import start_option
from graphslam.logs import LogSet
from graphslam.odometry.preintegration import Track
from graphslam.pipeline.robot_settings import robot_settings
from graphslam.pipeline.synchronisation import ODOMETRY

#: ns: a truth sample this near to a robot's first odometry tells where it starts
MAX_TRUTH_LAG_NS = 500_000_000


def start_poses(log: LogSet, config: Config) -> dict[str, Start]:
    """Start poses as given or from one truth sample; without any the first robot is at the origin.

    Of sessions that is the one of the first recording that was given.

    Raises:
        EstimationError: truth was asked for and a robot has none, or a given pose is malformed.
    """
    start = config.start
    given = _cov(start.given_sigma_m, start.given_sigma_rad)
    starts: dict[str, Start] = {}
    if start.from_truth:
        truth = _cov(start.truth_sigma_m, start.truth_sigma_rad)
        starts = {robot: Start(pose, truth) for robot, pose in first_truth(log, config).items()}
    for robot, pose in start.poses.items():
        if len(pose) != 3 or robot not in log.robots:
            raise EstimationError(
                f"--start {robot}: needs x,y,phi of one of the robots {', '.join(log.robots)}"
            )
        starts[robot] = Start(np.array(pose), given)
    if log.robots and not starts:
        starts[_leader(log, config)] = origin(config)
    return starts


def _leader(log: LogSet, config: Config) -> str:
    """The robot at the origin: the first by name; of sessions that of the first recording."""
    first = log.opened[:1] if config.logs.same_place else ()
    there = {topic.name for file in first for topic in file.topics}
    own = {topic.robot for topic in log.topics if topic.name in there}
    return min(own & set(log.robots), default=log.robots[0])


def origin(config: Config) -> Start:
    """Start prior of a robot whose first pose is the origin of a frame."""
    sigmas = config.start.origin_sigma_m, config.start.origin_sigma_rad
    return Start(np.zeros(3), _cov(*sigmas))


def _cov(sigma_m: float, sigma_rad: float) -> Array:
    return np.diag([sigma_m**2, sigma_m**2, sigma_rad**2])


def first_truth(log: LogSet, config: Config | None = None) -> dict[str, Array]:
    """The true pose (3,) of each robot when its odometry or, without one, its scans begin.

    The sample nearest to that time is moved there by the odometry. ``config``: settings of the
    robots; the default ones if None.

    Raises:
        EstimationError: a robot has no truth within `MAX_TRUTH_LAG_NS` of its first odometry.
    """
    config = config or Config()
    begins: dict[str, int] = {}
    samples: dict[str, list[Truth]] = {name: [] for name in log.robots}
    tracks = {
        name: Track(config.odometry, robot_settings(name, config, log.notes)) for name in log.robots
    }
    by_scans = log.without_odometry
    for message in log.messages((Sighting,) if by_scans else (Scan, Sighting)):
        if isinstance(message, ODOMETRY):
            # of an increment the time is its end
            if isinstance(message, OdometryIncrement):
                begins.setdefault(message.robot, message.start_ns)
            begins.setdefault(message.robot, message.time_ns)
            tracks[message.robot].add(message)
        elif isinstance(message, Scan) and message.robot in by_scans:
            begins.setdefault(message.robot, message.time_ns)
        elif isinstance(message, Truth) and message.robot in samples:
            samples[message.robot].append(message)
        if all(
            robot in begins
            and message.time_ns > begins[robot] + MAX_TRUTH_LAG_NS
            and (robot in by_scans or track.reaches(begins[robot] + MAX_TRUTH_LAG_NS))
            for robot, track in tracks.items()
        ):
            break
    poses = {}
    for robot, known in samples.items():
        if not known:
            raise EstimationError(f"--start truth: the log has no truth for {robot} at its start")
        begin = begins.get(robot, known[-1].time_ns)
        truth = known[int(np.argmin([abs(sample.time_ns - begin) for sample in known]))]
        if abs(truth.time_ns - begin) > MAX_TRUTH_LAG_NS:
            raise EstimationError(
                f"--start truth: {robot} starts at {begin} ns and its truth nearest to that is of "
                f"{truth.time_ns} ns; give {start_option(robot)}"
            )
        poses[robot] = _moved(truth, begin, tracks[robot])
    return poses


def _moved(truth: Truth, begin_ns: int, track: Track) -> Array:
    """A true pose (3,) at the time when the odometry begins, before which its speed was the same.

    ``track``: the odometry; empty of a robot without.
    """
    apart_ns = truth.time_ns - begin_ns
    if not len(track) or not apart_ns:
        return truth.pose
    moved = between(track.pose(begin_ns), track.pose(begin_ns + abs(apart_ns)))
    return compose(truth.pose, moved if apart_ns < 0 else inverse(moved))
