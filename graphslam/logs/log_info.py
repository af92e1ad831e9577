"""Contents and defects of logs, as printed by `graphslam info`."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graphslam.core import records
from graphslam.core.config import Config, RobotConfig
from graphslam.core.errors import LogError
from graphslam.core.geometry import Array, between
from graphslam.logs import schemas, time_order
from graphslam.logs.clock_steps import Spans, spans_of_stamps
from graphslam.logs.decoders import TopicContext
from graphslam.logs.file_reader import FileReader
from graphslam.logs.findings import Finding
from graphslam.logs.future_stamps import Recorded
from graphslam.logs.gyroscopes import find_gyroscopes
from graphslam.logs.lasers import FurtherLasers, further_lasers
from graphslam.logs.log_checks import CheckedLog, by_severity, check_log
from graphslam.logs.log_set import LogFile, damage, merged_notes
from graphslam.logs.recording import Recording, raw_messages
from graphslam.logs.robots import robots_and_topics
from graphslam.logs.separate_times import check_separate_times
from graphslam.logs.sessions import open_recordings
from graphslam.logs.tf_tree import static_topics
from graphslam.logs.topic_context import scan_shape, topic_contexts
from graphslam.logs.topic_info import Gap, RobotInfo, TopicInfo
from graphslam.logs.topics import (
    ODOMETRY_KINDS,
    Topic,
    choose_topics,
    find_topics,
)
from graphslam.logs.wheel_turns import find_wrapped_wheels

_GAP_PERIODS, _GAP_S = 10, 1.0  # a gap is longer than both: 10 periods of the topic and 1 s
_FIRST_JOINTS = 1000  # messages of which the names of joints are listed
_REVERSING_M = 1e-3  # smallest backward step; larger than the noise of a robot at rest


@dataclass(frozen=True, slots=True)
class LogInfo:
    """Result of `inspect_logs`; ``problem`` says why the logs cannot be smoothed, if so.

    ``findings`` are all that is to be said, ``warnings`` those of them that are no more than notes
    left out, as lines.
    """

    files: tuple[LogFile, ...]
    topics: tuple[TopicInfo, ...]
    robots: tuple[RobotInfo, ...]
    notes: Mapping[str, str]
    dropped: Mapping[str, int]
    warnings: tuple[str, ...]
    problem: str
    findings: tuple[Finding, ...] = ()

    @property
    def usable(self) -> bool:
        """Whether the logs can be smoothed."""
        return not any(finding.severity == "unusable" for finding in self.findings)

    @property
    def doubtful(self) -> bool:
        """Whether there is a reason to expect worse results than the sensors can give."""
        return any(finding.severity == "doubt" for finding in self.findings)

    def to_dict(self) -> dict[str, Any]:
        """Plain lists, dicts, strings and numbers, ready for JSON."""
        tree = asdict(self) | {"usable": self.usable, "doubtful": self.doubtful}
        for file in tree["files"]:
            file["path"] = str(file["path"])
        return tree


def inspect_logs(paths: Sequence[Path], config: Config) -> LogInfo:
    """Read everything in ``paths`` that can be decoded and describe it.

    A reason why the logs cannot be smoothed is reported in ``problem``, not raised.

    Raises:
        LogError: a file is missing, of no known container or without a message.
    """
    files, config = open_recordings(paths, config)
    findings = damage(files)
    topics: list[Topic] = []
    chosen: list[Topic] = []
    lasers = FurtherLasers()
    problem = ""
    try:
        topics = find_topics(files, config)
        files, topics, derived = robots_and_topics(files, config)
        findings += derived
        chosen, choices = choose_topics(files, topics, config)
        lasers = further_lasers(files, topics, chosen, config)
        findings += [*choices, *lasers.findings]
    except LogError as error:
        problem = str(error)
    contexts, assumed = topic_contexts(files, topics, config)
    contexts |= lasers.contexts
    if not problem:
        try:
            check_separate_times(files, chosen, contexts)
        except LogError as error:
            problem = str(error)
    dropped: Counter[str] = Counter()
    spans = {file.path: spans_of_stamps(file, topics, contexts) for file in files}
    readings = {
        topic.name: _read_topic(files, topic, contexts, config, spans, dropped)
        for topic in topics
        if topic.count
    }
    wrapped, turns = find_wrapped_wheels(files, chosen, contexts)
    findings += turns
    for topic in chosen:
        if topic.record is records.WheelAngles and topic.robot in wrapped:
            own = readings[topic.name]
            own.motion = list(np.unwrap(np.array(own.motion), axis=0))
    used = {topic.name for topic in (*chosen, *lasers.topics)}
    infos = [
        _topic_info(files, topic, topic.name in used, readings.get(topic.name), contexts)
        for topic in topics
    ]
    infos += _other_topics(files, {topic.name for topic in topics})
    robots = [
        _robot_info(name, topics, chosen, readings, config.robot(name))
        for name in sorted({t.robot for t in topics if t.record is not records.TrueLandmark})
    ]
    infos.sort(key=lambda info: info.name)
    names = {topic.name for topic in chosen}
    # how a sensor is mounted that is not used does not matter
    findings += [f for f in assumed if problem or f.topic.partition(": ")[0] in names]
    if not problem:
        gyroscopes, by_gyroscope = find_gyroscopes(files, chosen, contexts, config, wrapped)
        findings += by_gyroscope
        names = {turning.topic for turning in gyroscopes.values()}
        infos = [replace(info, used=info.used or info.name in names) for info in infos]
    said = [*config.warnings, *(finding.line for finding in findings)]
    known = CheckedLog(infos, robots, problem, config, merged_notes(files), len(files))
    told = {finding.topic for finding in findings if finding.check == "gyroscope"}
    more = [f for f in check_log(known) if f.check != "unused" or f.topic not in told]
    said += [finding.line for finding in more if finding.severity == "doubt"]
    return LogInfo(
        files=tuple(LogFile(f.path, f.sha256, f.messages, f.lost) for f in files),
        topics=tuple(infos),
        robots=tuple(robots),
        notes=merged_notes(files),
        dropped=dict(dropped),
        warnings=tuple(said),
        problem=problem,
        findings=tuple(sorted([*findings, *more], key=by_severity)),
    )


# ---------------------------------------------------------------- one topic


@dataclass(slots=True)
class _Reading:
    """Data kept from one pass over a topic."""

    stamps_ns: list[int] = field(default_factory=list)  # in the order of recording
    delays_ns: list[int] = field(default_factory=list)  # of recording after the stamp
    times_ns: list[int] = field(default_factory=list)  # sorted
    motion: list[Array] = field(default_factory=list)  # poses, increments or wheel angles
    beams: int = 0
    empty_beams: int = 0
    counts: Counter[str] = field(default_factory=Counter)
    late_s: float = 0.0  # by how much a message came too late, at most

    def add_recorded(self, recorded: Iterable[Recorded]) -> Iterator[Recorded]:
        """Count stamps and beams of messages in the order of recording, and pass them on."""
        for topic, message, log_time_ns in recorded:
            self.stamps_ns.append(message.stamp_ns)
            self.delays_ns.append(log_time_ns - message.stamp_ns)
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
    spans: Mapping[Path, Spans],
    dropped: Counter[str],
) -> _Reading:
    reading = _Reading()
    for file in files:
        reader = FileReader(file, config, spans[file.path])
        recorded = reader.recorded({topic.name: topic}, contexts)
        for message in reader.sorted(reading.add_recorded(recorded)):
            reading.add_sorted(message)
        reading.counts += reader.sorter.counts.get(topic.name, Counter())
        reading.late_s = max(reading.late_s, reader.sorter.late_s(topic.name))
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
        joints = _joints(files, topic) if topic.record is records.WheelAngles else ()
        return TopicInfo(topic.name, topic.schema, topic.robot, used, topic.count, joints=joints)
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
        duplicates=reading.counts[time_order.DUPLICATE] + reading.counts[time_order.REPEATED],
        glitches=reading.counts[time_order.GLITCH],
        too_late=reading.counts[time_order.TOO_LATE],
        latest_s=reading.late_s,
        scan=scan_shape(files, topic) if is_scan else None,
        no_return_m=float(no_return) if is_scan and np.isfinite(no_return) else None,
        dropouts=reading.empty_beams / reading.beams if reading.beams else None,
        range_noise=contexts[topic.name].range_noise,
        recorded_after_s=float(np.median(reading.delays_ns)) * 1e-9,
        by_log_time=contexts[topic.name].by_log_time,
    )


def _joints(files: Sequence[Recording], topic: Topic) -> tuple[str, ...]:
    """The names of joints in the first messages, sorted; all of these: publishers may alternate."""
    names: set[str] = set()
    for file in files:
        data = (raw.data for raw in islice(raw_messages(file, (topic.name,)), _FIRST_JOINTS))
        for message in schemas.decode_all(topic.schema, data):
            names.update(map(str, message.name))
    return tuple(sorted(names))


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
