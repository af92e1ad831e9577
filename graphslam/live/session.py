"""A session: messages in, as they come; out comes where the robots are."""

import math
import os
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from numbers import Integral
from typing import Any

from graphslam.core.config import Config
from graphslam.core.config_io import chosen_config
from graphslam.core.errors import ConfigError, EstimationError, LogError
from graphslam.core.records import TRUE_RECORDS, Landmark, Message, Scan, Sighting
from graphslam.core.suggestions import start_option
from graphslam.live.live_pass import LiveEstimate, LivePass
from graphslam.live.repeated_messages import without_repeated
from graphslam.logs import LogSet
from graphslam.logs.decoders import TopicContext
from graphslam.logs.record_checks import UnusableMessageError, checked
from graphslam.logs.time_order import DROPPED, TOO_LATE, MessageSorter
from graphslam.logs.topics import MOTION_KINDS, ODOMETRY_KINDS, Topic
from graphslam.multi_robot.frame_tree import FrameAssignment
from graphslam.pipeline.log_pass import PriorKnowledge
from graphslam.pipeline.recorded_closures import RecordedClosures
from graphslam.pipeline.robot_settings import check_robots
from graphslam.pipeline.start_priors import origin, start_poses
from graphslam.results.known_map_file import known_map_of

#: s of messages by which the robots and their sensors are known, if nobody tells them
INTRODUCTION_S = 2.0
#: ns: a single stamp that is so much later than all before is wrong, and a first one so far off
LEAP_NS = 10_000_000_000
LEAP = "stamp: far later than those before and after"
#: in place of `TOO_LATE`: the window is that of another setting
LATE = "stamp: older than live.reorder_s allows"
FIRST_LEAP = "stamp: far from all others at the beginning"


class Session:
    """One drive, estimated while it takes place.

    ::

        session = graphslam.Session()
        for estimate in session.process(messages):
            print(estimate.robot, estimate.stamp_ns, estimate.pose, estimate.cov)

    ``messages`` are records of `graphslam.core.records` in the order in which they come; one that
    is up to ``live.reorder_s`` late by its stamp is sorted in. There is an estimate for every scan,
    and for every set of sightings, by the data until then; a later message does not change it.
    Memory and time per message are bounded by the horizon and the map.

    A robot whose start is not given in ``start.poses`` has a frame of its own, but the first one,
    which begins at the origin. Clocks of several robots have to agree.

    Attributes:
        config: the settings, those of docs/configuration.md.
    """

    def __init__(
        self,
        config: Config | str | os.PathLike[str] | None = None,
        *,
        robots: Mapping[str, Sequence[type[Message]]] | None = None,
        log: LogSet | None = None,
        **settings: Any,
    ) -> None:
        """Nothing is estimated yet.

        Args:
            config: settings, or a TOML file.
            robots: the records that each robot sends; by default those that come in the first
                `INTRODUCTION_S`.
            log: a recording, of which more is to come, that says the same.
            settings: as of `graphslam.smooth`.

        Raises:
            ConfigError: a setting is wrong, or needs the whole log.
        """
        self.config = live_config(chosen_config(config, **settings))
        self._unused: Counter[str] = Counter()
        self._sorter: MessageSorter | None = None
        self._log = log
        self._announced = robots is not None  # not found out
        if robots is not None and not _names_records(robots):
            raise ConfigError(
                "Session(robots=...): needs a dict of what each sends, such as "
                "{'robot': [OdometryPose, Scan]}"
            )
        if robots is not None:
            self._log = expected_log(robots, self.config)
        self._pass: LivePass | None = None

    @property
    def dropped(self) -> Counter[str]:
        """Number of messages so far that were not used, by reason."""
        found = self._unused.copy()
        if self._sorter is not None:
            found += dropped_by(self._sorter)
        return found if self._pass is None else found + self._pass.dropped

    @property
    def robots(self) -> tuple[str, ...]:
        """Names of the robots; empty until they are known."""
        return self._log.robots if self._log is not None else ()

    @property
    def landmarks(self) -> tuple[Landmark, ...]:
        """The map as it is known now, with covariances."""
        return () if self._pass is None else self._pass.landmark_map()

    @property
    def world(self) -> str:
        """The frame of the first robot, and of those whose start in it was told."""
        return "" if self._pass is None else self._pass.frames.world

    @property
    def frames(self) -> Mapping[str, str]:
        """Robot -> its frame, named after the robot that begins at its origin."""
        return {} if self._pass is None else dict(sorted(self._pass.frames.of.items()))

    @property
    def seconds(self) -> float:
        """How long the drive is so far, s."""
        if self._pass is None or not self._pass.last_ns:
            return 0.0
        return 1e-9 * (self._pass.last_ns - self._pass.first_ns)

    @property
    def known_map(self) -> Mapping[str, Any] | None:
        """What was seen of a known map, see docs/live.md; None without one."""
        return None if self._pass is None else self._pass.known_map_summary()

    @property
    def counts(self) -> Mapping[str, int]:
        """Numbers of keyframes, scans, observations and so on that were used."""
        if self._pass is None:
            return {}
        closures = self._pass.associator.closures
        return {**self._pass.counts, "loop_closures": closures}

    def process(self, messages: Iterable[Message]) -> Iterator[LiveEstimate]:
        """Take in messages as they come, and give each estimate as soon as it can be made.

        Raises:
            LogError: no robot has both odometry and observations.
            ConfigError: it was called before: there is one drive, which begins once.
            EstimationError: the estimate is indeterminate.
        """
        rest = self._records(messages)
        if self._log is None:
            # a wrong stamp must neither end the introduction nor keep it from ending
            rest = without_leaps(rest, self._unused)
            first, kinds = introduced(rest)
            self._log = expected_log(kinds, self.config)
            rest = self._expected(chain(first, rest))
        else:
            rest = without_leaps(self._expected(rest), self._unused)
        # messages come in any order, and what comes late says nothing of the stamps of the others
        sorter = MessageSorter(round(1e9 * self.config.live.reorder_s), repair=False)
        self._sorter = sorter
        in_order = _sorted(rest, sorter)
        yield from self.process_sorted(in_order, sorter.ready)

    def process_sorted(
        self, messages: Iterable[Message], ready: Collection[Message] = ()
    ) -> Iterator[LiveEstimate]:
        """As `process`, for messages of robots that are known.

        Args:
            messages: sorted by ``time_ns``.
            ready: those that come next without any waiting, at each time.

        Raises:
            LogError, ConfigError, EstimationError: as `process`.
        """
        assert self._log is not None
        if self._pass is not None:
            raise ConfigError(
                "Session.process: was called before, and a drive begins once; give it one iterable "
                "of all messages, such as a generator that waits for a queue"
            )
        check_robots(self._log, self.config)
        self._pass = LivePass(self._log, self.config, known_starts(self._log, self.config))
        yield from self._pass.estimates(without_repeated(messages, self._unused), ready)

    def _records(self, messages: Iterable[Message]) -> Iterator[Message]:
        """What is a message at all, but for the truth, which may have a clock of its own."""
        for message in messages:
            if not isinstance(message, Message):
                self._unused[f"{type(message).__name__}: is no record of graphslam"] += 1
            elif not (isinstance(message.robot, str) and isinstance(message.time_ns, Integral)):
                what = type(message).__name__
                self._unused[f"{what}: robot must be a text, time_ns a whole number"] += 1
            elif not isinstance(message, TRUE_RECORDS):
                yield message

    def _expected(self, messages: Iterable[Message]) -> Iterator[Message]:
        """The messages that can be used."""
        assert self._log is not None
        kinds = {(topic.robot, topic.record) for topic in self._log.topics}
        moving = {robot for robot, kind in kinds if kind in ODOMETRY_KINDS}
        for message in messages:
            if (message.robot, type(message)) not in kinds:
                what = type(message).__name__.lower()
                why = f"{message.robot} was not to send any, by Session(robots=...)"
                if not self._announced:
                    why = f"{message.robot} did not send any in the first {INTRODUCTION_S:g} s"
                if isinstance(message, ODOMETRY_KINDS) and message.robot in moving:
                    why = f"not used, as {message.robot} has another kind of odometry"
                self._unused[f"{what}: {why}"] += 1
                continue
            try:
                usable = checked(message)
            except UnusableMessageError as reason:
                self._unused[str(reason)] += 1
            else:
                yield usable


def _sorted(messages: Iterable[Message], sorter: MessageSorter) -> Iterator[Message]:
    for message in messages:
        yield from sorter.push(f"{message.robot} {type(message).__name__}", message)
    yield from sorter.finish()


def dropped_by(sorter: MessageSorter) -> Counter[str]:
    """What a sorter with the window ``live.reorder_s`` left out so far, by reason."""
    found: Counter[str] = Counter()
    for counts in sorter.counts.values():
        for kind in DROPPED:
            found[LATE if kind == TOO_LATE else kind] += counts[kind]
    return +found


def _names_records(robots: object) -> bool:
    """Whether it is a mapping of robots to the records that each sends."""
    return isinstance(robots, Mapping) and all(
        isinstance(kind, type) and issubclass(kind, Message)
        for own in robots.values()
        for kind in (own if isinstance(own, Sequence) and not isinstance(own, str) else [None])
    )


def without_leaps(messages: Iterable[Message], dropped: Counter[str]) -> Iterator[Message]:
    """The messages without those that are stamped far later than the ones before and after them.

    Sorted by time, all that comes after one would be too late. Where two stamps in a row are far
    later, time did go on. So is a first stamp left out that is far from the two after it.
    """
    latest_ns: int | None = None
    leapt: list[Message] = []  # of one stamp
    for message in _without_first_leap(iter(messages), dropped):
        leaps = latest_ns is not None and message.time_ns > latest_ns + LEAP_NS
        if leaps and (not leapt or message.time_ns == leapt[0].time_ns):
            leapt.append(message)
            continue
        if leaps:
            yield from leapt
        elif leapt:
            dropped[LEAP] += len(leapt)
        leapt = []
        latest_ns = message.time_ns if latest_ns is None else max(latest_ns, message.time_ns)
        yield message
    if leapt:
        dropped[LEAP] += len(leapt)


def _without_first_leap(messages: Iterator[Message], dropped: Counter[str]) -> Iterator[Message]:
    """The messages without those at the beginning whose stamps are far from all others there.

    Of the first two stamps that are far from each other the third one tells which is wrong.
    """
    groups: list[list[Message]] = []  # of equal stamps
    for message in messages:
        if groups and message.time_ns == groups[-1][0].time_ns:
            groups[-1].append(message)
            continue
        groups.append([message])
        if len(groups) == 3 or (len(groups) == 2 and _are_near(*groups)):
            break
    wrong: list[Message] | None = None
    if len(groups) == 3:
        first, second, third = groups
        wrong = first if _are_near(second, third) else second if _are_near(first, third) else None
        dropped[FIRST_LEAP] += len(wrong or ())
    begin = [message for group in groups if group is not wrong for message in group]
    yield from begin
    for message in messages:  # sorted by time, one far before the first would be the beginning
        if message.time_ns < begin[0].time_ns - LEAP_NS:
            dropped[FIRST_LEAP] += 1
            continue
        yield message
        if message.time_ns > begin[0].time_ns + 1e9 * INTRODUCTION_S:
            break
    yield from messages


def _are_near(a: list[Message], b: list[Message]) -> bool:
    """Whether two groups of equal stamps may follow each other."""
    return abs(a[0].time_ns - b[0].time_ns) <= LEAP_NS


def live_config(config: Config) -> Config:
    """The settings with a finite horizon.

    Raises:
        ConfigError: a setting needs the whole log.
    """
    backend = config.backend
    if backend.name not in ("batch", "isam2") or backend.horizon_s == 0:
        raise ConfigError(
            "backend.name: live estimates are those of isam2 with a horizon above 0 s; leave it out"
        )
    if config.start.from_truth:
        raise ConfigError(
            "start.from_truth: needs a whole log; give start.poses for live estimates"
        )
    if config.known_map.update:
        raise ConfigError("known_map.update: needs a whole log; smooth the recording with --update")
    horizon = backend.horizon_s if math.isfinite(backend.horizon_s) else config.live.horizon_s
    if horizon <= 0:
        raise ConfigError("live.horizon_s: live estimates need a horizon above 0 s")
    if config.live.max_states < 2:
        raise ConfigError("live.max_states: at least two states are needed, of which one is new")
    return replace(config, backend=replace(backend, name="isam2", horizon_s=horizon))


def introduced(
    messages: Iterator[Message],
) -> tuple[list[Message], dict[str, list[type[Message]]]]:
    """The first messages, and the records that each robot sent in them.

    They end when one kind of a robot's messages has come for `INTRODUCTION_S`. A clock that is set
    meanwhile, and clocks that disagree, do not end them.
    """
    first: list[Message] = []
    kinds: dict[str, list[type[Message]]] = {}
    latest_ns: dict[tuple[str, type[Message]], int] = {}
    lasted_ns: Counter[tuple[str, type[Message]]] = Counter()
    for message in messages:
        first.append(message)
        key, now_ns = (message.robot, type(message)), message.time_ns
        if key not in latest_ns:
            kinds.setdefault(message.robot, []).append(type(message))
            latest_ns[key] = now_ns
        step_ns = now_ns - latest_ns[key]
        lasted_ns[key] += step_ns if 0 < step_ns <= LEAP_NS else 0
        if lasted_ns[key] > 1e9 * INTRODUCTION_S:
            break
        if step_ns > 0 or step_ns < -LEAP_NS:
            latest_ns[key] = now_ns
    return first, kinds


def expected_log(kinds: Mapping[str, Sequence[type[Message]]], config: Config) -> LogSet:
    """A log whose messages are still to come: the robots, and the records that they send.

    Raises:
        LogError: there is no odometry, or nothing is observed.
    """
    topics = tuple(
        Topic(f"/{robot}/{kind.__name__.lower()}", "", robot, kind, 1)
        for robot, own in sorted(kinds.items())
        for kind in own
        if kind not in TRUE_RECORDS and kind not in _further_odometry(own)
    )
    records = {topic.record for topic in topics}
    if not records & {Scan, Sighting} or not records & {*MOTION_KINDS}:
        there = ", ".join(sorted(record.__name__ for record in records)) or "nothing"
        raise LogError(
            f"the session: needs odometry and scans or sightings, and {there} came in the first "
            f"{INTRODUCTION_S:g} s; name what is to come in Session(robots=...)"
        )
    return LogSet(
        robots=tuple(sorted({t.robot for t in topics if t.record in MOTION_KINDS})),
        files=(),
        topics=topics,
        notes={},
        warnings=[],
        dropped=Counter(),
        repaired=Counter(),
        opened=(),
        _contexts={topic.name: TopicContext(topic.robot) for topic in topics},
        config=config,
    )


def _further_odometry(kinds: Sequence[type[Message]]) -> list[type[Message]]:
    """All kinds of odometry of a robot but the one that is used, see `choose_topics`."""
    return [kind for kind in ODOMETRY_KINDS if kind in kinds][1:]


def known_starts(log: LogSet, config: Config) -> PriorKnowledge:
    """The starts that were told; a robot without one is alone in its frame, and the known map.

    Raises:
        EstimationError: there is a known map, and it was not told where in it a robot starts.
        OutputError: the map cannot be read.
    """
    starts = start_poses(log, config)
    known_map = known_map_of(config)
    missing = [robot for robot in log.robots if robot not in config.start.poses]
    if known_map is not None and missing:
        raise EstimationError(
            f"robot {missing[0]}: live estimates in the map {known_map.name} need its start; give "
            f"{start_option(missing[0])} (m, rad), or smooth the recording, which finds it"
        )
    world = min(starts)
    frames = {robot: world if robot in starts else robot for robot in log.robots}
    every = {robot: starts.get(robot, origin(config)) for robot in log.robots}
    assignment = FrameAssignment(every, frames, world)
    recorded = RecordedClosures(every, frames, frozenset(), {})
    return PriorKnowledge(assignment, recorded, known_map=known_map)
