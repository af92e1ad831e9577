"""Follow a recording while it is written: estimates, and a folder that is kept current."""

import math
import os
import signal
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from graphslam.core.config import Config
from graphslam.core.config_io import chosen_config
from graphslam.core.errors import GraphSlamError, LogError
from graphslam.core.output_folder import Identity, identity
from graphslam.core.records import Landmark, Message
from graphslam.core.suggestions import start_option
from graphslam.core.worker import Future
from graphslam.live.history import History
from graphslam.live.late_topics import LateTopics
from graphslam.live.live_folder import write_live_folder
from graphslam.live.live_pass import LiveEstimate
from graphslam.live.session import INTRODUCTION_S, LATE, Session, dropped_by, live_config
from graphslam.logs import LogSet
from graphslam.logs.file_reader import FileReader, decoded
from graphslam.logs.future_stamps import Recorded
from graphslam.logs.growing_mcap import GrowingMcap, open_growing
from graphslam.logs.log_set import damage, log_set_of
from graphslam.logs.recording import Recording, deriver
from graphslam.logs.time_order import DROPPED, MessageSorter
from graphslam.logs.topics import ODOMETRY_KINDS
from graphslam.logs.wheel_turns import with_whole_turns
from graphslam.results.target_folder import check_target

#: s between two versions of the folder, at least; and how many times as long as writing one takes
WRITE_INTERVAL_S, WRITE_SHARE = 5.0, 5.0
#: observations from which it is told that fewer than this share of them are of the known map
ENOUGH_SEEN, FAMILIAR_SHARE = 100, 0.4
#: messages that come too late, and how many for each scan, from which on there is a warning; and
#: readings of odometry in a row, from which on there is one however many there are in all
LEAST_LATE, LATE_SHARE, LATE_IN_A_ROW = 20, 0.1, 3
#: reason why messages of a topic were left out
BEGAN_LATE = "began later than what is followed"
#: s between two looks at what the beginning of a recording holds, while robots are waited for
LOOK_S = 1.0


def follow(
    recording: str | os.PathLike[str],
    output: str | os.PathLike[str],
    *,
    config: Config | str | os.PathLike[str] | None = None,
    force: bool = False,
    each: Callable[[LiveEstimate], None] = lambda _estimate: None,
    announce: Callable[[str], None] = lambda _text: None,
    warn: Callable[[str], None] = lambda _text: None,
    **settings: Any,
) -> dict[str, Any]:
    """Estimate a recording while it is written, until it ends or stops growing.

    ``output`` is a result folder of what is known now; it is replaced as a whole every few seconds,
    beside the estimation. Its trajectories are causal: by the data up to each pose. Ctrl-C ends the
    following, and the folder has what was estimated until then.

    Robots and sensors are those of the first `INTRODUCTION_S` of the recording. A robot that the
    settings name is waited for, up to ``live.wait_s``; what begins later still is not followed.

    Args:
        recording: an MCAP file, which need not exist yet.
        output: the folder.
        config: settings, or a TOML file.
        force: replace a result folder that stands there.
        each: called with every estimate as soon as it is made.
        announce: called with a line on what goes on.
        warn: called with a line on what is not followed, as soon as that is known.
        settings: as of `graphslam.smooth`.

    Returns:
        The content of summary.json.

    Raises:
        LogError: it is no MCAP file, does not begin, has nothing usable, lacks a robot that the
            settings name, or was cut or replaced; the folder then has what was estimated until
            then.
        EstimationError: the estimate is indeterminate; as before.
        ConfigError: a setting is wrong, or needs the whole log.
        OutputError: the folder exists and may not be replaced, or cannot be written.
    """
    chosen = live_config(chosen_config(config, **settings))
    path, target = Path(recording), Path(output)
    before = check_target(target, force=force, known_map=chosen.known_map.directory)
    with open_growing(path, chosen.limits, chosen.live.wait_s) as growing:
        log, file = _opened(growing, chosen, announce)
        session = Session(chosen, log=log)
        folder = _Folder(target, before, session, log, LateTopics(file.topics, chosen.logs.topics))
        state = "stopped"
        try:
            logs = replace(chosen.logs, reorder_s=chosen.live.reorder_s)
            reader = FileReader(file, replace(chosen, logs=logs))
            messages = _messages(growing, log, reader, chosen, folder, warn)
            for estimate in session.process_sorted(messages, reader.sorter.ready):
                folder.history.add(estimate)
                each(estimate)
                folder.write_if_due()
            state = "ended" if growing.ended else f"has not grown for {chosen.live.wait_s:g} s"
        except KeyboardInterrupt:
            state = "interrupted"
        except GraphSlamError as error:
            folder.warnings.append(str(error))
            raise
        finally:
            if state == "stopped" and len(folder.history):  # what was estimated is kept
                folder.write(state)
        if not len(folder.history):
            raise LogError(f"{path}: {state}, and nothing could be estimated; see `graphslam info`")
        return folder.write(state, growing.recording(is_over=True))


def _opened(
    growing: GrowingMcap, config: Config, announce: Callable[[str], None]
) -> tuple[LogSet, Recording]:
    """The log, once its beginning tells what is in it.

    Raises:
        LogError: nothing usable comes.
    """
    announce("waiting for odometry and observations")
    reason: LogError | None = None
    named = {*config.start.poses, *config.robots} - {"default"}
    missing: set[str] = set()
    grown, looked, introduced = time.monotonic(), -math.inf, math.inf
    while True:
        now = time.monotonic()
        if growing.poll() or growing.ended:
            grown = now
        # a look reads the whole file
        if growing.ended or (grown > looked and (not missing or now - looked >= LOOK_S)):
            looked = now
            file = growing.recording()
            try:
                log = log_set_of([file], config)
                blocks = file.pieces[0].blocks
                seconds = 1e-9 * (max(b.end_ns for b in blocks) - min(b.start_ns for b in blocks))
                if seconds >= INTRODUCTION_S or growing.ended:
                    if named <= set(log.robots) or growing.ended:
                        announce(f"following {', '.join(log.robots)}")
                        # of a gyroscope the whole log tells whether it can be used
                        return replace(log, gyroscopes={}), file
                    if not missing:
                        announce(f"waiting for {', '.join(sorted(named - set(log.robots)))}")
                    missing, introduced = named - set(log.robots), min(introduced, now)
            except LogError as error:
                reason = error
        if growing.ended or now - min(grown, introduced) > config.live.wait_s:
            break
        time.sleep(0.05)
    if missing:
        raise LogError(
            f"{growing.path}: nothing usable of {', '.join(sorted(missing))} came within "
            f"{config.live.wait_s:g} s, only of {', '.join(log.robots)}; check the names in "
            "--start and robots.*, follow once all robots record, or raise live.wait_s"
        )
    waited = f"{growing.path}: has not grown for {config.live.wait_s:g} s, and holds too little"
    raise reason or LogError(f"{waited}; start the recorder before, or raise live.wait_s")


def _messages(
    growing: GrowingMcap,
    log: LogSet,
    reader: FileReader,
    config: Config,
    folder: "_Folder",
    warn: Callable[[str], None],
) -> Iterator[Message]:
    """The messages of the recording, sorted by time, as they come."""
    topics = {topic.name: topic for topic in log.topics}
    contexts = {
        name: replace(context, beams=folder.dropped) for name, context in log.contexts.items()
    }
    derived = [one for one in log.opened[0].derived if one.name in topics]
    used = deriver(derived, topics)

    def recorded() -> Iterator[Recorded]:
        for batch in growing.batches(config.live.wait_s, folder.write_if_due):
            if folder.late.note(batch, growing.kinds()):
                warn(*_not_followed(folder.late.counts))
            raws = [raw for message in batch for raw in used(message)]
            yield from decoded(raws, topics, contexts, folder.dropped)

    folder.sorter = reader.sorter
    yield from with_whole_turns(reader.sorted(recorded()), log.wrapped, folder.repaired)
    for counts in reader.sorter.counts.values():
        folder.repaired.update({kind: n for kind, n in counts.items() if kind not in DROPPED})


class _Folder:
    """The folder of a drive: written beside the estimation, in a second process."""

    def __init__(
        self, target: Path, before: Identity, session: Session, log: LogSet, late: LateTopics
    ) -> None:
        self.late = late
        self.history, self.warnings = History(), list(log.warnings)
        self.dropped: Counter[str] = Counter()
        self.repaired: Counter[str] = Counter()
        #: whose counts are added to the others
        self.sorter: MessageSorter | None = None
        self._target, self._before, self._session, self._log = target, before, session, log
        self._writing: Future[Identity] | None = None
        self._written_s, self._began_s, self._took_s = time.monotonic(), 0.0, 0.0
        self._estimates = 0

    def write_if_due(self) -> None:
        """Begin to write the folder, where that was long ago and something came since."""
        now = time.monotonic()
        if self._writing is not None and self._writing.is_ready():
            self._finish()
        due = now - self._written_s > max(WRITE_INTERVAL_S, WRITE_SHARE * self._took_s)
        if self._writing is None and due and len(self.history) > self._estimates:
            self._begin("following", None)

    def write(self, state: str, recording: Recording | None = None) -> dict[str, Any]:
        """Write the folder a last time; its summary.

        ``recording``: as it is at the end, if it can be read.
        """
        if self._writing is not None:
            self._finish()
        if recording is not None:
            self.warnings += [finding.line for finding in damage([recording])]
        summary = self._begin(state, recording)
        self._finish()
        return summary

    def _begin(self, state: str, recording: Recording | None) -> dict[str, Any]:
        landmarks = self._session.landmarks
        summary = self._summary(state, recording, landmarks)
        write = partial(
            write_live_folder,
            self._target,
            self._before,
            self._session.config,
            self.history,
            landmarks,
            summary,
        )
        self._began_s, self._estimates = time.monotonic(), len(self.history)
        here = os.getpid()

        def written() -> Identity:
            if os.getpid() != here:  # Ctrl-C, which every process gets, ends the following alone
                signal.signal(signal.SIGINT, signal.SIG_IGN)
            write()
            return identity(self._target)

        self._writing = Future(written)
        return summary

    def _finish(self) -> None:
        assert self._writing is not None
        writing, self._writing = self._writing, None
        self._before = writing.result()
        self._written_s = time.monotonic()
        self._took_s = self._written_s - self._began_s

    def _summary(
        self, state: str, recording: Recording | None, landmarks: tuple[Landmark, ...]
    ) -> dict[str, Any]:
        log, history, session = self._log, self.history, self._session
        counts, known_map = session.counts, session.known_map
        dropped = self.dropped + session.dropped
        most_late = 0
        if self.sorter is not None:
            dropped += dropped_by(self.sorter)
            moving = (topic.name for topic in log.topics if topic.record in ODOMETRY_KINDS)
            most_late = max((self.sorter.late_in_a_row[name] for name in moving), default=0)
        dropped += Counter({f"{name}: {BEGAN_LATE}": n for name, n in self.late.counts.items()})
        return {
            "logs": [
                {
                    "path": str(log.files[0].path.resolve()),
                    "sha256": recording and recording.sha256,
                    "messages": recording and recording.messages,
                    "lost": recording and recording.lost,
                }
            ],
            "notes": dict(log.notes),
            "counts": {
                "scans": counts.get("scans", 0),
                "keyframes": counts.get("keyframes", 0),
                "observations": counts.get("observations", 0),
                "loop_closures": counts.get("loop_closures", 0),
                "landmarks": len(landmarks),
            },
            **({"known_map": dict(known_map)} if known_map else {}),
            "world": session.world,
            "frames": session.frames,
            "dropped": {key: number for key, number in sorted(dropped.items()) if number},
            "repaired": dict(sorted(self.repaired.items())),
            "warnings": [
                *self.warnings,
                *_unplaced(session),
                *_astray(known_map),
                *_too_late(dropped[LATE], counts.get("scans", 0), most_late),
                *_not_followed(self.late.counts),
            ],
            "live": {
                "state": state,
                "estimates": len(history),
                "last_ns": history.last_ns,
                "recorded_s": round(session.seconds, 3),
                "largest_jump_m": round(history.largest_jump_m, 4),
            },
        }


def _not_followed(late: Mapping[str, int]) -> list[str]:
    """A line where robots or sensors began too late to be followed."""
    if not late:
        return []
    return [
        f"{', '.join(sorted(late))}: began later than what is followed, the robots and sensors of "
        f"the first {INTRODUCTION_S:g} s, so {sum(late.values())} messages so far are left out; "
        "`graphslam smooth` of the recording uses them"
    ]


def _too_late(messages: int, scans: int, in_a_row: int) -> list[str]:
    """A line where many messages were left out since they came too late by their stamps.

    Or ``in_a_row`` of some odometry: a clock that is set back by a second takes the motion of most
    of it. A single one that is late does no harm.
    """
    many = messages >= LEAST_LATE and messages >= LATE_SHARE * scans
    if not many and in_a_row < LATE_IN_A_ROW:
        return []
    return [
        f"{messages} messages were left out: they are stamped more than live.reorder_s before "
        "others that came earlier; a clock was set back, or live.reorder_s is too short"
    ]


def _astray(known_map: Mapping[str, Any] | None) -> list[str]:
    """Lines where a known map is doubtful itself, or hardly anything that is seen is in it."""
    if known_map is None:
        return []
    name, verdict = known_map["name"], known_map["verdict"]
    lines = [] if verdict == "good" else [f"the map {name} is {verdict} itself: see its report"]
    own, others = (known_map[f"observations_of_{of}"] for of in ("it", "others"))
    if own + others < ENOUGH_SEEN or own > FAMILIAR_SHARE * (own + others):
        return lines
    return [
        *lines,
        f"{own} of {own + others} observations are of landmarks of the map {name}: "
        "it is another place, or the start that was given is wrong, or this part is not in the map",
    ]


def _unplaced(session: Session) -> list[str]:
    """A line for each robot that nothing relates to the first one."""
    return [
        f"{robot}: its start is not known, so it has a frame of its own; "
        f"give {start_option(robot)} (m, rad)"
        for robot, frame in session.frames.items()
        if frame != session.world
    ]
