"""What may keep a log from being used well: one row of `CHECKS` per thing that is looked at.

Every check reads the description of a log and tells what it found, with what mends it. `info` and
`smooth --plan` print them.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from shlex import quote

from graphslam.core.config import Config, RobotConfig
from graphslam.logs.clock_check import apart
from graphslam.logs.findings import Finding, Severity
from graphslam.logs.schemas import (
    JOINT_STATE,
    LASER_SCAN,
    ODOMETRY,
    ODOMETRY_INCREMENT,
    POINT_CLOUD,
    SIGHTING,
)
from graphslam.logs.time_order import late_remedy
from graphslam.logs.topic_info import RobotInfo, TopicInfo

#: odometry that never reverses on a longer path is reported
_UNSIGNED_PATH_M = 50.0
#: a robot that moved less, m and rad, tells neither its calibration nor a map
_STANDING_M, _STANDING_RAD = 0.1, 0.1
#: m/s that no robot drives in the mean: odometry in other units
_FASTEST_M_S = 30.0
#: s between messages, beyond which the motion in between is guessed; between scans, see too little
_SLOW_ODOMETRY_S, _SLOW_SCANS_S = 0.5, 1.5
#: share of the beams without a range, above which a laser sees next to nothing
_BLIND = 0.95
#: s by which the delays of two topics may differ before their clocks do
_SAME_CLOCK_S = 0.5
#: names of joints that are listed
_MOST_NAMES = 12

_MOVING = (ODOMETRY, ODOMETRY_INCREMENT, JOINT_STATE)
_SCANS = (LASER_SCAN, POINT_CLOUD)
_SENSING = (*_SCANS, SIGHTING)

#: schemas that tell about motion or surroundings and are not read, and what is read in their place
_NOT_READ = {
    "sensor_msgs/msg/PointCloud": "record the laser as sensor_msgs/LaserScan",
    "sensor_msgs/msg/Imu": "",
    "sensor_msgs/msg/Range": "",
    "sensor_msgs/msg/Image": "",
    "sensor_msgs/msg/CompressedImage": "",
    "sensor_msgs/msg/NavSatFix": "",
    "geometry_msgs/msg/Twist": "",
    "geometry_msgs/msg/TwistStamped": "",
    "geometry_msgs/msg/PoseStamped": "",
    "geometry_msgs/msg/PoseWithCovarianceStamped": "",
    "nav_msgs/msg/OccupancyGrid": "",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class CheckedLog:
    """The description of a log: ``problem`` why it cannot be opened, ``notes`` of its writer.

    ``recordings``: of how many it is made.
    """

    topics: Sequence[TopicInfo]
    robots: Sequence[RobotInfo]
    problem: str
    config: Config
    notes: Mapping[str, str]
    recordings: int

    @property
    def used(self) -> Iterator[TopicInfo]:
        """Used topics with messages that say how a robot moves or what is around it."""
        for topic in self.topics:
            if topic.used and topic.first_ns is not None and topic.schema in _MOVING + _SENSING:
                yield topic

    @property
    def invented(self) -> bool:
        """Whether stamps are those of an order, not of clocks."""
        return self.notes.get("stamps", "").startswith("invented")


def _problem(log: CheckedLog) -> Iterable[Finding]:
    if log.problem:
        yield Finding("unusable", "problem", "", log.problem)


def _unused_schemas(log: CheckedLog) -> Iterable[Finding]:
    for topic in log.topics:
        if not topic.used and topic.count and topic.schema in _NOT_READ:
            text = f"{topic.schema} is not read"
            yield Finding("note", "unused", topic.name, text, _NOT_READ[topic.schema])


def _unreadable(log: CheckedLog) -> Iterable[Finding]:
    moving = {topic.robot for topic in log.used if topic.schema in _MOVING}
    scanned = {topic.robot for topic in log.used if topic.schema in _SCANS}
    for topic in log.topics:
        # without any other odometry such a one would be used
        is_wanted = topic.used or (topic.schema in _MOVING and topic.robot not in moving)
        if is_wanted and topic.robot is not None and topic.count and topic.first_ns is None:
            text = f"none of its {topic.count} messages can be used; see what was dropped"
            others = topic.robot in scanned or any(
                other.robot == topic.robot and other.first_ns is not None
                for other in log.used
                if other.schema in _MOVING
            )
            how: Severity = "doubt" if others or topic.schema not in _MOVING else "unusable"
            remedy = _name_wheels(topic, log.config.robot(topic.robot)) if topic.joints else ""
            if remedy:
                text += f"; its joints are {_listed(topic.joints)}"
            remedy = remedy or "check what publishes it"
            yield Finding(how, "messages", topic.name, text, remedy)


def _name_wheels(topic: TopicInfo, settings: RobotConfig) -> str:
    """The options that name the wheels among joints; empty if it is known which these are."""
    options, known = [], []
    for side, set_to in (("left", settings.left_joint), ("right", settings.right_joint)):
        named = [joint for joint in topic.joints if side in joint.lower()]
        known.append(set_to in topic.joints if set_to else len(named) == 1)
        joint = named[0] if named else "NAME"
        options.append("--set " + quote(f"robots.{topic.robot}.{side}_joint={joint}"))
    if all(known):
        return ""
    return f"name a wheel of each side: {' '.join(options)}"


def _listed(names: Sequence[str]) -> str:
    """The first of some names, and how many more there are."""
    more = len(names) - _MOST_NAMES
    return ", ".join(names[:_MOST_NAMES]) + (f" and {more} more" if more > 0 else "")


def _stamps(log: CheckedLog) -> Iterable[Finding]:
    for topic in log.topics:
        if topic.jumps_back:
            text = (
                f"{topic.jumps_back} messages are stamped earlier than the one recorded before; "
                f"{topic.glitches} stamps are replaced"
            )
            yield Finding("doubt", "stamps", topic.name, text)
        if topic.duplicates:
            text = f"{topic.duplicates} messages repeat a stamp"
            yield Finding("doubt", "stamps", topic.name, text)
        if topic.too_late:
            text = (
                f"{topic.too_late} messages come up to {topic.latest_s:.1f} s late and are dropped"
            )
            remedy = late_remedy(topic.latest_s)
            yield Finding("doubt", "stamps", topic.name, text, remedy)


def _clocks(log: CheckedLog) -> Iterable[Finding]:
    """Topics whose stamps are not of one clock, or that were recorded one after the other."""
    for robot in log.robots:
        own = [topic for topic in log.used if topic.robot == robot.name]
        moving = next((topic for topic in own if topic.schema in _MOVING), None)
        for topic in own:
            if moving is None or topic is moving:
                continue
            span = topic.first_ns or 0, topic.last_ns or 0
            moved = moving.first_ns or 0, moving.last_ns or 0
            max_gap_s = log.config.odometry.max_gap_s
            if found := apart(topic.name, span, moving.name, moved, max_gap_s):
                yield found
            elif topic.recorded_after_s is not None and moving.recorded_after_s is not None:
                off = moving.recorded_after_s - topic.recorded_after_s
                if abs(off) > _SAME_CLOCK_S:
                    which = "later" if off > 0 else "earlier"
                    text = f"its stamps are {abs(off):.1f} s {which} than those of {moving.name}, "
                    text += "by the times of recording"
                    yield Finding(
                        "doubt", "clocks", topic.name, text, "let both be stamped by one clock"
                    )


def _gaps(log: CheckedLog) -> Iterable[Finding]:
    for topic in log.topics:
        if not topic.gaps or topic.schema == SIGHTING:  # there is not always a target in view
            continue
        longest = max(gap.duration_s for gap in topic.gaps)
        text = f"{len(topic.gaps)} gaps, the longest {longest:.1f} s"
        remedy = ""
        if topic.schema in _MOVING and longest > log.config.odometry.max_gap_s:
            if _is_scanned(log, topic, longest):
                remedy = "scans bridge it, which is less sure: record odometry throughout"
            else:
                remedy = "scans and sightings in gaps longer than odometry.max_gap_s are dropped: "
                remedy += f"--set odometry.max_gap_s={longest + 0.1:.1f}"
            if log.recordings > 1:
                remedy += "; recordings that are drives of their own: smooth --same-place"
        yield Finding("doubt" if topic.used else "note", "gaps", topic.name, text, remedy)


def _is_scanned(log: CheckedLog, moving: TopicInfo, gap_s: float) -> bool:
    """Whether a laser of the robot went on while odometry ``moving`` was missing for so long."""
    scans = [t for t in log.used if t.schema in _SCANS and t.robot == moving.robot]
    return any(max((gap.duration_s for gap in t.gaps), default=0.0) < gap_s / 2 for t in scans)


def _rates(log: CheckedLog) -> Iterable[Finding]:
    for topic in log.used:
        period = topic.median_period_s
        if period is None or log.invented or topic.schema == SIGHTING:
            continue
        slow = _SLOW_SCANS_S if topic.schema in _SCANS else _SLOW_ODOMETRY_S
        if topic.schema != ODOMETRY_INCREMENT and period > slow:
            text = f"a message every {period:.1f} s only; what is in between is guessed"
            yield Finding("doubt", "rate", topic.name, text, "record it at 10 Hz or more")


def _ranges(log: CheckedLog) -> Iterable[Finding]:
    for topic in log.topics:
        if topic.no_return_m is not None:
            text = f"{topic.no_return_m:g} m and more means no return"
            yield Finding("note", "ranges", topic.name, text)
        if topic.dropouts is not None and topic.dropouts > _BLIND:
            text = f"{100 * topic.dropouts:.0f} % of the beams have no range"
            remedy = "check range_min and range_max, and what covers the laser"
            yield Finding("doubt", "ranges", topic.name, text, remedy)


def _motion(log: CheckedLog) -> Iterable[Finding]:
    for robot in log.robots:
        where = f"robot {robot.name}"
        if robot.problem:
            yield Finding("doubt", "odometry", where, robot.problem)
        elif (robot.speed_m_s or 0) > _FASTEST_M_S:
            text = f"odometry says {robot.speed_m_s:.0f} m/s in the mean; is it in metres?"
            yield Finding("doubt", "odometry", where, text, "check the units of what publishes it")
        elif robot.reverses is False and (robot.path_m or 0) > _UNSIGNED_PATH_M:
            text = f"odometry never reverses in {robot.path_m:.0f} m; it may be unsigned"
            yield Finding("doubt", "odometry", where, text, "check its sign while driving back")
        elif _stands(robot):
            text = "does not move by its odometry"
            remedy = "record while it drives, or check what its odometry publishes"
            yield Finding("doubt", "odometry", where, text, remedy)


def _stands(robot: RobotInfo) -> bool:
    if robot.path_m is None or robot.turning_rad is None:
        return False
    return robot.path_m < _STANDING_M and robot.turning_rad < _STANDING_RAD


def _odometry_only(log: CheckedLog) -> Iterable[Finding]:
    for robot in log.robots:
        own = [t for t in log.topics if t.robot == robot.name and t.used and t.count]
        kinds = {t.schema for t in own}
        if log.problem or not kinds & {*_MOVING} or kinds & {*_SENSING}:
            continue
        if any(t.schema.endswith("RelativePose") for t in log.topics):
            continue  # a pose graph
        text = "has odometry only: its trajectory will be dead reckoning"
        yield Finding(
            "doubt", "sensors", f"robot {robot.name}", text, "record sensor_msgs/LaserScan too"
        )


def _wheels(log: CheckedLog) -> Iterable[Finding]:
    default = RobotConfig()
    names = ("wheel_radius_left_m", "wheel_radius_right_m", "axle_m")
    for topic in log.used:
        if topic.schema != JOINT_STATE or topic.robot is None:
            continue
        settings = log.config.robot(topic.robot)
        noted = any(key.startswith(f"robots.{topic.robot}.wheel_") for key in log.notes)
        if not noted and all(getattr(settings, n) == getattr(default, n) for n in names):
            values = f"wheels of {default.wheel_radius_left_m:g} m radius, {default.axle_m:g} m "
            text = f"the wheels' geometry is not known; {values}apart are assumed"
            remedy = " ".join(
                "--set " + quote(f"robots.{topic.robot}.{name}={getattr(default, name):g}")
                for name in names
            )
            yield Finding("doubt", "wheels", topic.name, text, f"give what it is: {remedy}")


#: what is looked at, in the order in which it is told
CHECKS: tuple[Callable[[CheckedLog], Iterable[Finding]], ...] = (
    _problem,
    _clocks,
    _unreadable,
    _stamps,
    _gaps,
    _rates,
    _ranges,
    _motion,
    _odometry_only,
    _wheels,
    _unused_schemas,
)

_ORDER = ("note", "doubt", "unusable")


def check_log(log: CheckedLog) -> list[Finding]:
    """What all `CHECKS` find."""
    return [finding for check in CHECKS for finding in check(log)]


def by_severity(finding: Finding) -> int:
    """The place of a finding in a list of which the end is read first."""
    return _ORDER.index(finding.severity)
