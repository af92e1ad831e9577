"""Contents and defects of logs, as printed by `graphslam info`."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graphslam.core import records
from graphslam.core.config import Config, RobotConfig
from graphslam.core.errors import LogError
from graphslam.core.geometry import Array, between
from graphslam.logs import time_order
from graphslam.logs.containers import open_recording
from graphslam.logs.decoders import TopicContext
from graphslam.logs.future_stamps import Recorded
from graphslam.logs.log_set import FileReader, LogFile, damage, merged_notes
from graphslam.logs.recording import Recording
from graphslam.logs.robots import robots_and_topics
from graphslam.logs.schemas import SIGHTING
from graphslam.logs.tf_tree import static_topics
from graphslam.logs.topic_context import ScanShape, scan_shape, topic_contexts
from graphslam.logs.topics import (
    ODOMETRY_KINDS,
    Topic,
    choose_topics,
    find_topics,
)

_GAP_PERIODS, _GAP_S = 10, 1.0  # a gap is longer than both: 10 periods of the topic and 1 s
_REVERSING_M = 1e-3  # smallest backward step; larger than the noise of a robot at rest
_UNSIGNED_PATH_M = 50.0  # odometry that never reverses on a longer path is reported


@dataclass(frozen=True, slots=True)
class Gap:
    """An interval without messages of a topic."""

    start_ns: int
    duration_s: float


@dataclass(frozen=True, slots=True)
class TopicInfo:
    """A topic of the logs. Fields after ``count`` are None or empty if nothing can be decoded.

    ``robot`` is None for a topic of unknown schema; ``used``: whether smoothing reads the topic.
    ``rate_hz`` is the mean over the log; ``median_period_s`` is shorter than its inverse if
    messages come in bursts. ``jumps_back`` counts messages stamped earlier than the one recorded
    before, ``glitches`` those whose stamp is replaced. ``no_return_m`` is the detected range that
    means no return, ``dropouts`` the share of beams without a usable range.
    """

    name: str
    schema: str
    robot: str | None
    used: bool
    count: int
    first_ns: int | None = None
    last_ns: int | None = None
    rate_hz: float | None = None
    median_period_s: float | None = None
    gaps: tuple[Gap, ...] = ()
    jumps_back: int = 0
    duplicates: int = 0
    glitches: int = 0
    too_late: int = 0
    scan: ScanShape | None = None
    no_return_m: float | None = None
    dropouts: float | None = None


@dataclass(frozen=True, slots=True)
class RobotInfo:
    """A robot of the logs; ``problem`` says why it is not usable, empty if it is.

    ``speed_m_s`` is the mean over the log, ``top_speed_m_s`` the largest mean over one second,
    because odometry in bursts has no speed between two messages. ``reverses``: whether odometry
    ever goes backwards. ``odometry`` is a topic, or says that scans are matched: then nothing more
    is known.
    """

    name: str
    problem: str
    odometry: str | None = None
    path_m: float | None = None
    turning_rad: float | None = None
    speed_m_s: float | None = None
    top_speed_m_s: float | None = None
    reverses: bool | None = None


@dataclass(frozen=True, slots=True)
class LogInfo:
    """Result of `inspect_logs`; ``problem`` says why the logs cannot be smoothed, if so."""

    files: tuple[LogFile, ...]
    topics: tuple[TopicInfo, ...]
    robots: tuple[RobotInfo, ...]
    notes: Mapping[str, str]
    dropped: Mapping[str, int]
    warnings: tuple[str, ...]
    problem: str

    def to_dict(self) -> dict[str, Any]:
        """Plain lists, dicts, strings and numbers, ready for JSON."""
        tree = asdict(self)
        for file in tree["files"]:
            file["path"] = str(file["path"])
        return tree


def inspect_logs(paths: Sequence[Path], config: Config) -> LogInfo:
    """Read everything in ``paths`` that can be decoded and describe it.

    A reason why the logs cannot be smoothed is reported in ``problem``, not raised.

    Raises:
        LogError: a file is missing, of no known container or without a message.
    """
    files = [open_recording(Path(path)) for path in paths]
    warnings = [*config.warnings, *damage(files)]
    topics: list[Topic] = []
    chosen: list[Topic] = []
    problem = ""
    try:
        topics = find_topics(files, config)
        files, topics, derived = robots_and_topics(files, config)
        warnings += derived
        chosen, choices = choose_topics(files, topics)
        warnings += choices
    except LogError as error:
        problem = str(error)
    contexts, assumed = topic_contexts(files, topics, config)
    dropped: Counter[str] = Counter()
    readings = {
        topic.name: _read_topic(files, topic, contexts, config, dropped)
        for topic in topics
        if topic.count
    }
    used = {topic.name for topic in chosen}
    infos = [
        _topic_info(files, topic, topic.name in used, readings.get(topic.name), contexts)
        for topic in topics
    ]
    infos += _other_topics(files, {topic.name for topic in topics})
    robots = [
        _robot_info(name, topics, chosen, readings, config.robot(name))
        for name in sorted({t.robot for t in topics if t.record is not records.TrueLandmark})
    ]
    return LogInfo(
        files=tuple(LogFile(f.path, f.sha256, f.messages, f.lost) for f in files),
        topics=tuple(sorted(infos, key=lambda info: info.name)),
        robots=tuple(robots),
        notes=merged_notes(files),
        dropped=dict(dropped),
        warnings=tuple(warnings + assumed + _defects(infos, robots)),
        problem=problem,
    )


# ---------------------------------------------------------------- one topic


@dataclass(slots=True)
class _Reading:
    """Data kept from one pass over a topic."""

    stamps_ns: list[int] = field(default_factory=list)  # in the order of recording
    times_ns: list[int] = field(default_factory=list)  # sorted
    motion: list[Array] = field(default_factory=list)  # poses, increments or wheel angles
    beams: int = 0
    empty_beams: int = 0
    counts: Counter[str] = field(default_factory=Counter)

    def add_recorded(self, recorded: Iterable[Recorded]) -> Iterator[Recorded]:
        """Count stamps and beams of messages in the order of recording, and pass them on."""
        for topic, message, log_time_ns in recorded:
            self.stamps_ns.append(message.stamp_ns)
            if isinstance(message, records.Scan):
                self.beams += len(message.ranges)
                self.empty_beams += int(np.isnan(message.ranges).sum())
            yield topic, message, log_time_ns

    def add_sorted(self, message: records.Message) -> None:
        """Keep time and motion of the next message in the order of time."""
        self.times_ns.append(message.time_ns)
        if isinstance(message, records.OdometryPose):
            self.motion.append(message.pose)
        elif isinstance(message, records.OdometryIncrement):
            self.motion.append(message.delta)
        elif isinstance(message, records.WheelAngles):
            self.motion.append(np.array([message.left_rad, message.right_rad]))


def _read_topic(
    files: Sequence[Recording],
    topic: Topic,
    contexts: Mapping[str, TopicContext],
    config: Config,
    dropped: Counter[str],
) -> _Reading:
    reading = _Reading()
    for file in files:
        reader = FileReader(file, config)
        recorded = reader.recorded({topic.name: topic}, contexts)
        for message in reader.sorted(reading.add_recorded(recorded)):
            reading.add_sorted(message)
        reading.counts += reader.sorter.counts.get(topic.name, Counter())
        dropped.update(reader.dropped)
    return reading


def _topic_info(
    files: Sequence[Recording],
    topic: Topic,
    used: bool,
    reading: _Reading | None,
    contexts: Mapping[str, TopicContext],
) -> TopicInfo:
    if reading is None or not reading.times_ns:
        return TopicInfo(topic.name, topic.schema, topic.robot, used, topic.count)
    times = np.sort(np.array(reading.times_ns, dtype=np.int64))
    span_s, period_s = float(times[-1] - times[0]) * 1e-9, _median_period_s(times)
    no_return = contexts[topic.name].no_return_m
    is_scan = topic.record is records.Scan
    return TopicInfo(
        name=topic.name,
        schema=topic.schema,
        robot=topic.robot,
        used=used,
        count=topic.count,
        first_ns=int(times[0]),
        last_ns=int(times[-1]),
        rate_hz=(len(times) - 1) / span_s if span_s > 0 else None,
        median_period_s=period_s or None,
        gaps=_gaps(times, period_s),
        jumps_back=int(np.count_nonzero(np.diff(np.array(reading.stamps_ns)) < 0)),
        duplicates=reading.counts[time_order.DUPLICATE],
        glitches=reading.counts[time_order.GLITCH],
        too_late=reading.counts[time_order.TOO_LATE],
        scan=scan_shape(files, topic) if is_scan else None,
        no_return_m=float(no_return) if is_scan and np.isfinite(no_return) else None,
        dropouts=reading.empty_beams / reading.beams if reading.beams else None,
    )


def _median_period_s(times_ns: NDArray[np.int64]) -> float:
    """Median time between different stamps, s; 0 where there are none."""
    steps = np.diff(times_ns)
    steps = steps[steps > 0]
    return float(np.median(steps)) * 1e-9 if len(steps) else 0.0


def _gaps(times_ns: NDArray[np.int64], period_s: float) -> tuple[Gap, ...]:
    steps_s = np.diff(times_ns) * 1e-9
    found = np.flatnonzero((steps_s > _GAP_PERIODS * period_s) & (steps_s > _GAP_S))
    return tuple(Gap(int(times_ns[i]), float(steps_s[i])) for i in found)


def _other_topics(files: Sequence[Recording], known: set[str]) -> list[TopicInfo]:
    counts: Counter[tuple[str, str]] = Counter()
    for raw in (raw for file in files for raw in file.topics if raw.name not in known):
        counts[raw.name, raw.schema] += raw.count
    used = {name for file in files for name in static_topics(file)}
    used |= {derived.source for file in files for derived in file.derived}
    return [TopicInfo(name, schema, None, name in used, n) for (name, schema), n in counts.items()]


# ---------------------------------------------------------------- one robot


def _robot_info(
    name: str,
    topics: Sequence[Topic],
    chosen: Sequence[Topic],
    readings: Mapping[str, _Reading],
    settings: RobotConfig,
) -> RobotInfo:
    filled = [t for t in topics if t.robot == name and t.count]
    own = [t for t in filled if t.record in ODOMETRY_KINDS]
    own.sort(key=lambda t: (t not in chosen, ODOMETRY_KINDS.index(t.record), -t.count))
    if not own:
        lasers = [t.name for t in filled if t.record is records.Scan and t in chosen]
        if lasers:
            return RobotInfo(name, "", f"scan matching of {lasers[0]}")
        return RobotInfo(name, "has no odometry")
    reading = readings[own[0].name]
    if len(reading.motion) < 2:
        return RobotInfo(name, f"{own[0].name} has fewer than two usable messages")
    forward, turning, path = _steps(own[0], np.array(reading.motion), settings)
    times_s = (np.array(reading.times_ns) - reading.times_ns[0]) * 1e-9
    # n increments have n steps, the first up to its own stamp; n poses have n - 1
    driven = np.cumsum(np.concatenate([np.zeros(len(times_s) - len(path)), path]))
    seconds = np.interp(np.arange(0.0, times_s[-1]), times_s, driven)
    return RobotInfo(
        name=name,
        problem="",
        odometry=own[0].name,
        path_m=float(path.sum()),
        turning_rad=float(np.abs(turning).sum()),
        speed_m_s=float(path.sum() / times_s[-1]) if times_s[-1] > 0 else None,
        top_speed_m_s=float(np.diff(seconds).max()) if len(seconds) > 1 else None,
        reverses=bool((forward < -_REVERSING_M).any()),
    )


def _steps(topic: Topic, motion: Array, settings: RobotConfig) -> tuple[Array, Array, Array]:
    """Per step: forward m, turning rad, path m; from poses, increments or wheel angles (n, ...)."""
    if topic.record is records.WheelAngles:
        left, right = np.diff(motion, axis=0).T
        left, right = settings.wheel_radius_left_m * left, settings.wheel_radius_right_m * right
        forward = (left + right) / 2
        return forward, (right - left) / settings.axle_m, np.abs(forward)
    if topic.record is records.OdometryPose:
        motion = between(motion[:-1], motion[1:])
    return motion[:, 0], motion[:, 2], np.hypot(motion[:, 0], motion[:, 1])


def _defects(topics: Sequence[TopicInfo], robots: Sequence[RobotInfo]) -> list[str]:
    """One line per defect of the topics and robots."""
    lines = []
    for topic in topics:
        if topic.jumps_back:
            lines.append(
                f"{topic.name}: {topic.jumps_back} messages are stamped earlier than the one "
                f"recorded before; {topic.glitches} stamps are replaced"
            )
        if topic.duplicates:
            lines.append(f"{topic.name}: {topic.duplicates} messages repeat a stamp")
        if topic.too_late:
            lines.append(
                f"{topic.name}: {topic.too_late} messages come too late; see logs.reorder_s"
            )
        if topic.gaps and topic.schema != SIGHTING:  # there is not always a target in view
            longest = max(gap.duration_s for gap in topic.gaps)
            lines.append(f"{topic.name}: {len(topic.gaps)} gaps, the longest {longest:.1f} s")
        if topic.no_return_m is not None:
            lines.append(f"{topic.name}: {topic.no_return_m:g} m and more means no return")
    for robot in robots:
        if robot.problem:
            lines.append(f"robot {robot.name}: {robot.problem}")
        elif robot.reverses is False and (robot.path_m or 0) > _UNSIGNED_PATH_M:
            lines.append(
                f"robot {robot.name}: odometry never reverses in {robot.path_m:.0f} m; "
                "it may be unsigned"
            )
    return lines
