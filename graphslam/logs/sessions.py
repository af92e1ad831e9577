"""Recordings of one place at different times: each is a session with a trajectory of its own.

A session is to the estimator what a robot is: it has its own odometry, starts anywhere, and shares
the map. So the topics of a recording get its name as namespace. Where a session starts in the
others' frame is found like the start of a robot (`graphslam.multi_robot.place_recognition`).
"""

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from itertools import chain, count
from pathlib import Path

from graphslam.core.config import Config
from graphslam.core.errors import LogError
from graphslam.core.output_folder import RECORDING_SUFFIXES
from graphslam.core.records import Sighting
from graphslam.logs.containers import open_recording
from graphslam.logs.recording import Piece, Recording
from graphslam.logs.robots import robots_and_topics
from graphslam.logs.schemas import DEFAULT_ROBOT
from graphslam.logs.tf_tree import namespace_of
from graphslam.logs.topics import MOTION_KINDS

#: what only a robot has
_OF_ROBOTS = (*MOTION_KINDS, Sighting)
#: notes about a robot begin with this
_NOTED = "robots."
#: topics of all robots of a recording
_SHARED = ("/tf", "/tf_static")


def open_recordings(paths: Sequence[Path], config: Config) -> tuple[list[Recording], Config]:
    """Open recordings (see `open_recording`), as sessions if `logs.same_place` says so.

    Returns:
        The recordings, and the settings by the names that their topics have now.

    Raises:
        LogError: one is missing, of no known container or empty; or there is just one session.
    """
    files = [open_recording(Path(path), config.limits) for path in paths]
    if not config.logs.same_place:
        return files, config
    if len(files) < 2:
        raise LogError(f"{files[0].path}: is one session; --same-place joins two or more logs")
    sessions = session_names([file.path for file in files])
    topics: dict[str, str] = {}
    wanted = config.logs.topics
    unknown = set(wanted)
    found = []
    for file, session in zip(files, sessions, strict=True):
        names = {topic: _own_name(topic, file, session) for topic in wanted}
        chosen = {
            name: wanted[topic].removeprefix(f"{session}.") for topic, name in names.items() if name
        }
        if wanted and not chosen:
            raise LogError(f"{file.path}: has none of the topics that logs.topics names")
        unknown -= {topic for topic, name in names.items() if name}
        own = replace(config, logs=replace(config.logs, topics=chosen))
        used = robots_and_topics([file], own)[1]
        robots = {topic.robot for topic in used if topic.count and topic.record in _OF_ROBOTS}
        owners = {topic.name: topic.robot for topic in used}
        renamed = _Renamed(session, robots if len(robots) > 1 else (), owners)
        found.append(renamed.recording(file))
        for topic, robot in chosen.items():
            topics[renamed.topic(topic)] = renamed.robot(robot)
    if unknown:
        raise LogError(
            f"logs.topics names {min(unknown)}, which is a topic of none of the recordings"
        )
    return found, replace(config, logs=replace(config.logs, topics=topics))


def _own_name(topic: str, file: Recording, session: str) -> str | None:
    """What a recording calls a topic, named as it does or as in the log of all sessions."""
    there = {one.name for one in file.topics}
    inner = re.fullmatch(rf"/{re.escape(session)}(?:\.([^/]+))?(/.+)", topic)
    names = [topic, *((inner[2], f"/{inner[1]}{inner[2]}") if inner else ())]
    return next((name for name in names if name in there), None)


def session_names(paths: Sequence[Path]) -> list[str]:
    """A name for each recording: that of its file, and a number where several have the same."""
    names: list[str] = []
    for path in paths:
        stem = path
        while stem.suffix in RECORDING_SUFFIXES:
            stem = stem.with_suffix("")
        name = re.sub(r"[^\w-]+", "_", stem.name).strip("_") or "session"
        candidates = chain([name], (f"{name}-{number}" for number in count(2)))
        names.append(next(one for one in candidates if one not in names))
    return names


class _Renamed:
    """Names in a session: of its topics, and of its ``robots``, if it has more than one.

    ``owners``: topic -> robot, of topics that are not in its namespace too.
    """

    def __init__(self, session: str, robots: Collection[str], owners: Mapping[str, str]) -> None:
        self._session, self._robots, self._owners = session, robots, owners

    def robot(self, name: str) -> str:
        """The session's robot, or one of several."""
        return f"{self._session}.{name}" if self._robots else self._session

    def topic(self, name: str) -> str:
        """The topic in the namespace of its robot; what several robots share keeps its name."""
        if not self._robots:
            return f"/{self._session}/{name.lstrip('/')}"
        robot = self._owners.get(name, namespace_of(name))
        if robot not in self._robots or name in _SHARED:
            return name
        rest = name.strip("/").removeprefix(f"{robot}/") if robot != DEFAULT_ROBOT else name
        return f"/{self.robot(robot)}/{rest.lstrip('/')}"

    def recording(self, file: Recording) -> Recording:
        """The recording with these names."""
        return replace(file, pieces=tuple(map(self._piece, file.pieces)))

    def _piece(self, piece: Piece) -> Piece:
        channels = {
            number: channel._replace(topic=self.topic(channel.topic))
            for number, channel in piece.channels.items()
        }
        return replace(piece, channels=channels, notes=self._notes(piece.notes))

    def _notes(self, notes: Mapping[str, str]) -> dict[str, str]:
        made = {}
        for key, note in notes.items():
            robot, dot, rest = key.removeprefix(_NOTED).partition(".")
            own = key.startswith(_NOTED) and bool(dot)
            made[f"{_NOTED}{self.robot(robot)}.{rest}" if own else key] = note
        return made
