"""Logs opened together: their robots, topics and messages sorted by time."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from graphslam.core import records
from graphslam.core.config import Config
from graphslam.core.errors import LogError
from graphslam.core.geometry import Array
from graphslam.core.records import Message
from graphslam.core.worker import Prefetch
from graphslam.logs import time_order
from graphslam.logs.clock_check import check_clocks
from graphslam.logs.clock_steps import OTHER_CLOCK, Spans, spans_of_stamps
from graphslam.logs.decoders import TopicContext, decode_messages
from graphslam.logs.file_reader import NO_SPANS, FileReader, stamp_warnings
from graphslam.logs.findings import Finding
from graphslam.logs.gyroscopes import find_gyroscopes
from graphslam.logs.imu_turning import Turning, with_turning
from graphslam.logs.laser_noise import BeamNoise
from graphslam.logs.lasers import further_lasers
from graphslam.logs.recording import Recording, sample_messages
from graphslam.logs.robots import robots_and_topics
from graphslam.logs.separate_times import check_separate_times
from graphslam.logs.sessions import open_recordings
from graphslam.logs.stated_noise import StatedNoise, stated_noise
from graphslam.logs.topic_context import topic_contexts
from graphslam.logs.topics import MOTION_KINDS, ODOMETRY_KINDS, Topic, choose_topics
from graphslam.logs.wheel_turns import find_wrapped_wheels, with_whole_turns

Odometry = records.OdometryIncrement | records.OdometryPose | records.WheelAngles

#: fewer messages are read faster without a second process
WORKER_MIN_MESSAGES = 10_000
#: messages that are held in memory at most, some 400 bytes each
KEPT_MESSAGES = 250_000


@dataclass(frozen=True, slots=True)
class LogFile:
    """One file of a `LogSet`: number of readable and of lost ``messages`` (None: unknown)."""

    path: Path
    sha256: str
    messages: int
    lost: int | None


@dataclass
class LogSet:
    """Logs that belong together.

    Attributes:
        robots: names of the robots with odometry or scans, sorted.
        files: the files and their message counts.
        topics: the topics that are used.
        notes: the metadata record `graphslam` of the files, for example that stamps are invented.
        warnings: assumptions and defects, one line each; `messages` adds to it when exhausted.
        dropped: number of dropped messages (of dropped beams, where the reason begins with
            ``range:``) by reason; filled when `messages` is exhausted.
        repaired: the same for messages that are used in spite of a defect.
        gyroscopes: robot -> its turning by a gyroscope, which its odometry in `messages` has.
        wrapped: robots whose wheels' angles begin again after each turn; in `messages` they go on.
        opened: the indexed recordings, in the order of ``files``.
        config: the settings that the logs were opened with.
        further_lasers: topics of lasers besides those in ``topics``, see `graphslam.logs.lasers`.
    """

    robots: tuple[str, ...]
    files: tuple[LogFile, ...]
    topics: tuple[Topic, ...]
    notes: Mapping[str, str]
    warnings: list[str]
    dropped: Counter[str]
    repaired: Counter[str]
    opened: Sequence[Recording] = field(repr=False)
    _contexts: Mapping[str, TopicContext] = field(repr=False)
    config: Config = field(repr=False)
    gyroscopes: Mapping[str, Turning] = field(repr=False, default_factory=dict)
    further_lasers: tuple[Topic, ...] = ()
    wrapped: frozenset[str] = frozenset()
    _spans: Mapping[Path, Spans] = field(repr=False, default_factory=dict)

    def __post_init__(self) -> None:
        self._opening_warnings = len(self.warnings)
        self._kept: dict[tuple[str, ...], list[Message | ReadReport]] = {}
        self._ahead: dict[tuple[str, ...], Iterator[Message | ReadReport]] = {}
        self._stated: dict[str, StatedNoise | None] = {}

    def has_scans(self, robot: str) -> bool:
        """Whether the logs hold laser scans of ``robot``."""
        return any(t.robot == robot and t.record is records.Scan for t in self.topics)

    @property
    def without_odometry(self) -> tuple[str, ...]:
        """Robots with scans and no odometry, which is made of the scans."""
        having = {t.robot for t in self.topics if t.record in ODOMETRY_KINDS}
        return tuple(robot for robot in self.robots if robot not in having)

    @property
    def bridged(self) -> tuple[str, ...]:
        """Robots whose scans tell how they moved where their odometry, of poses, is silent."""
        having = {t.robot for t in self.topics if t.record is records.OdometryPose}
        return tuple(robot for robot in self.robots if robot in having and self.has_scans(robot))

    def sensors(self, robot: str) -> dict[str, str]:
        """Topics of the lasers of a robot and their names, see `records.Scan.sensor`."""
        own = [t.name for t in (*self.topics, *self.further_lasers) if t.record is records.Scan]
        contexts = {name: self._contexts[name] for name in own}
        return {name: c.sensor for name, c in contexts.items() if c.robot == robot}

    def without_lasers(self, wrong: Mapping[str, float]) -> "LogSet":
        """The logs without some of the further lasers, which is said.

        ``wrong``: name -> share of its motions that its scans contradict.
        """
        lines, kept = [], []
        for topic in self.further_lasers:
            name = self._contexts[topic.name].sensor
            if name in wrong:
                lines.append(
                    f"{topic.robot}: {topic.name} is not used: its scans contradict the mount in "
                    f"{100 * wrong[name]:.0f} % of its motions; check its transform, or --set "
                    f"'robots.{topic.robot}.lasers.{name}=[X, Y, YAW]' (m, m, rad)"
                )
            else:
                kept.append(topic)
        opening = self.warnings[: self._opening_warnings]
        return replace(self, warnings=[*opening, *lines], further_lasers=tuple(kept))

    def recordings_of(self, robot: str) -> list[Recording]:
        """The recordings that have topics of a robot."""
        own = {topic.name for topic in self.topics if topic.robot == robot}
        return [f for f in self.opened if not own.isdisjoint(topic.name for topic in f.topics)]

    def of_robot(self, robot: str) -> "LogSet":
        """The logs as if one robot were alone in them."""
        return replace(
            self,
            robots=(robot,),
            topics=tuple(t for t in self.topics if t.robot == robot),
            further_lasers=tuple(t for t in self.further_lasers if t.robot == robot),
            opened=self.recordings_of(robot),
            gyroscopes={name: own for name, own in self.gyroscopes.items() if name == robot},
            warnings=self.warnings[: self._opening_warnings],
            dropped=Counter(),
            repaired=Counter(),
        )

    @property
    def contexts(self) -> Mapping[str, TopicContext]:
        """What is needed to decode each topic."""
        return self._contexts

    def mount(self, topic: str) -> Array:
        """Pose (3,) of a laser in the base frame by the log; of its first frame."""
        return next(iter(self._contexts[topic].mounts.values()), np.zeros(3))

    def no_return_m(self, topic: str) -> float:
        """Smallest range, m, that means no return in ``topic``; inf if none was detected."""
        return self._contexts[topic].no_return_m

    def range_noise(self, topic: str) -> BeamNoise | None:
        """White noise of the ranges of a laser by its own scans; None if it is not known."""
        return self._contexts[topic].range_noise

    def stated_noise(self, robot: str) -> StatedNoise | None:
        """What the nav_msgs/Odometry of ``robot`` says about its noise; see `stated_noise`."""
        if robot not in self._stated:
            kind = records.OdometryPose
            own = [t for t in self.topics if t.robot == robot and t.record is kind]
            self._stated[robot] = stated_noise(self.opened, own[0]) if own else None
        return self._stated[robot]

    def sample_scans(self, robot: str, number: int) -> list[records.Scan]:
        """About ``number`` scans of ``robot`` from the whole log, sorted by stamp."""
        found: list[records.Scan] = []
        for topic in self.topics:
            if topic.robot != robot or topic.record is not records.Scan:
                continue
            for file in self.opened:
                data = list(sample_messages(file, topic.name, number // 10, 10))
                if data:
                    context = self._contexts[topic.name]
                    decoded = decode_messages(topic.schema, data, context, Counter())
                    found += [scan for scan in decoded if isinstance(scan, records.Scan)]
        return sorted(found, key=lambda scan: scan.stamp_ns)

    def count(self, exclude: tuple[type[Message], ...] = ()) -> int:
        """Number of messages in all used topics except those of the records ``exclude``."""
        return sum(topic.count for topic in self.topics if topic.record not in exclude)

    def messages(
        self,
        exclude: tuple[type[Message], ...] = (),
        *,
        prefetch: bool = False,
        keep: bool = False,
        all_lasers: bool = False,
    ) -> Iterator[Message]:
        """All messages sorted by ``time_ns``; at equal times odometry comes first.

        Topics of the records ``exclude`` are skipped without decoding. Memory holds the messages of
        ``logs.reorder_s`` and a hundred more, not the log. Every call starts at the beginning.
        ``prefetch``: allows a second process to read ahead, which pays if the caller takes all and
        works on each. ``keep``: a log without scans, if not longer than `KEPT_MESSAGES`, is held in
        memory from then on, so that it is decoded once however often it is read. ``all_lasers``:
        with the scans of further lasers.
        """
        topics = self._topics_without(exclude, all_lasers)
        self.update(ReadReport())
        names, count = tuple(topics), self.count(exclude)
        kept, ahead = self._kept.get(names), self._ahead.pop(names, None)
        if kept is not None:
            items: Iterable[Message | ReadReport] = kept
        elif ahead is not None:
            items = ahead
        elif prefetch and count >= WORKER_MIN_MESSAGES:
            items = Prefetch(lambda: self._read(topics, self._contexts))
        else:
            items = self._read(topics, self._contexts)
        keep &= kept is None and count <= KEPT_MESSAGES
        keep &= not any(topic.record is records.Scan for topic in topics.values())
        taken: list[Message | ReadReport] = []
        for item in items:
            if keep:
                taken.append(item)
            if isinstance(item, ReadReport):
                self.update(item)
            else:
                yield item
        if keep:
            self._kept[names] = taken

    def reading(self, exclude: tuple[type[Message], ...] = ()) -> Iterator["Message | ReadReport"]:
        """What `messages` is made of: they, and last what was found out about them."""
        return self._read(self._topics_without(exclude), self._contexts)

    def expect(
        self, reading: Iterator["Message | ReadReport"], exclude: tuple[type[Message], ...] = ()
    ) -> None:
        """Let the next `messages` with the same ``exclude`` take a `reading` that has begun."""
        self._ahead[tuple(self._topics_without(exclude))] = reading

    def _topics_without(
        self, exclude: tuple[type[Message], ...], all_lasers: bool = False
    ) -> dict[str, Topic]:
        topics = self.topics + (self.further_lasers if all_lasers else ())
        return {topic.name: topic for topic in topics if topic.record not in exclude}

    def odometry(self, exclude: tuple[type[Message], ...] = ()) -> Iterator[Odometry]:
        """The odometry among `messages` with the same ``exclude``, at the same times.

        Much faster, since the ranges of scans are not looked at. When they were taken has to be
        known: late stamps are repaired by the order in which all topics were recorded.
        """
        topics = self._topics_without(exclude)
        contexts = {
            name: replace(context, without_ranges=True) for name, context in self._contexts.items()
        }
        for item in self._read(topics, contexts):
            if isinstance(item, Odometry):
                yield item

    def _read(
        self, topics: Mapping[str, Topic], contexts: Mapping[str, TopicContext]
    ) -> Iterator["Message | ReadReport"]:
        """Messages of ``topics`` and, last, the report about all of them."""
        spans = self._spans
        readers = [FileReader(f, self.config, spans.get(f.path, NO_SPANS)) for f in self.opened]
        streams = [reader.sorted(reader.recorded(topics, contexts)) for reader in readers]
        report, merged = ReadReport(), time_order.merge(streams)
        if self.wrapped:
            merged = with_whole_turns(merged, self.wrapped, report.repaired)
        yield from with_turning(merged, self.gyroscopes) if self.gyroscopes else merged
        for reader in readers:
            report.dropped.update(reader.dropped)
            if reader.dropped[OTHER_CLOCK]:
                report.warnings.append(
                    f"{reader.file.path}: {reader.dropped[OTHER_CLOCK]} messages are {OTHER_CLOCK} "
                    "meanwhile; they are left out. To use them, cut the recording there"
                )
            for topic, counts in sorted(reader.sorter.counts.items()):
                report.warnings.extend(stamp_warnings(reader, topic, counts))
                for kind in time_order.DROPPED:
                    report.dropped[kind] += counts.pop(kind, 0)
                report.repaired.update(counts)
        yield report

    def report(self) -> "ReadReport":
        """What the last reading of all messages told about the log."""
        warnings = self.warnings[self._opening_warnings :]
        return ReadReport(Counter(self.dropped), Counter(self.repaired), warnings)

    def update(self, report: "ReadReport") -> None:
        """Take over what a reading of all messages told, maybe in another process."""
        for counter, counts in ((self.dropped, report.dropped), (self.repaired, report.repaired)):
            counter.clear()
            counter.update(+counts)  # without zeros
        self.warnings[self._opening_warnings :] = report.warnings


@dataclass(frozen=True, slots=True)
class ReadReport:
    """What is known after all messages were read; see `LogSet`."""

    dropped: Counter[str] = field(default_factory=Counter)
    repaired: Counter[str] = field(default_factory=Counter)
    warnings: list[str] = field(default_factory=list)


def open_logs(paths: Sequence[Path], config: Config) -> LogSet:
    """Open ``paths`` (see `open_recording`) as one log and determine its robots and topics.

    Raises:
        LogError: a file is missing, of no known container or empty; no topic is usable; all usable
            topics are empty; a robot has sightings but neither odometry nor scans; a laser is
            tilted too far, or its stamps are of another clock. The message names file and topic.
    """
    if not paths:
        raise LogError("no log given; name at least one file or folder")
    files, config = open_recordings(paths, config)
    for n, file in enumerate(files):
        if file.sha256 in {other.sha256 for other in files[:n]}:
            raise LogError(f"{file.path}: is given twice; name each log once")
    return log_set_of(files, config)


def log_set_of(files: Sequence[Recording], config: Config) -> LogSet:
    """Recordings as one log, see `open_logs`."""
    files, found, derived = robots_and_topics(files, config)
    topics, choices = choose_topics(files, found, config)
    contexts, assumed = topic_contexts(files, topics, config)
    for finding in assumed:
        if finding.severity == "unusable":
            raise LogError(f"{', '.join(str(file.path) for file in files)}: {finding.line}")
    check_separate_times(files, topics, contexts)
    lasers = further_lasers(files, found, topics, config)
    contexts |= lasers.contexts
    check_clocks(files, (*topics, *lasers.topics), contexts, config.odometry.max_gap_s)
    wrapped, turns = find_wrapped_wheels(files, topics, contexts)
    gyroscopes, by_gyroscope = find_gyroscopes(files, topics, contexts, config, wrapped)
    found_by = (*derived, *choices, *lasers.findings, *assumed, *turns, *by_gyroscope)
    return LogSet(
        robots=tuple(sorted({t.robot for t in topics if t.record in MOTION_KINDS})),
        files=tuple(LogFile(f.path, f.sha256, f.messages, f.lost) for f in files),
        topics=tuple(topics),
        notes=merged_notes(files),
        warnings=[*config.warnings, *(said.line for said in (*damage(files), *found_by))],
        dropped=Counter(),
        repaired=Counter(),
        opened=files,
        _contexts=contexts,
        config=config,
        gyroscopes=gyroscopes,
        further_lasers=tuple(lasers.topics),
        wrapped=wrapped,
        _spans={f.path: spans_of_stamps(f, (*topics, *lasers.topics), contexts) for f in files},
    )


def merged_notes(files: Iterable[Recording]) -> dict[str, str]:
    """The notes of all files; of notes with the same key that of the last file."""
    return {key: note for file in files for key, note in file.notes.items()}


#: the damage of a file in which nothing else is wrong
_MISSING = "it says that it has more than can be found"


def damage(files: Iterable[Recording]) -> list[Finding]:
    """The losses in each damaged file."""
    return [
        Finding(
            "doubt",
            "damage",
            str(f.path),
            f"damaged, {'an unknown number of' if f.lost is None else f.lost} messages are "
            f"lost, {f.messages} are read: {f.damage or _MISSING}",
        )
        for f in files
        if f.damage or f.lost
    ]
