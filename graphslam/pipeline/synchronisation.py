"""Messages in time order, each released once its robot's odometry reaches it."""

from collections import Counter, deque
from collections.abc import Iterable, Iterator, Mapping, Sequence

from graphslam.core.records import (
    Message,
    OdometryIncrement,
    OdometryPose,
    Scan,
    Sighting,
    TrueLandmark,
    Truth,
    WheelAngles,
)
from graphslam.odometry.preintegration import Track
from graphslam.odometry.sweep_motion import sweep_end_ns
from graphslam.perception.sightings import is_unnamed_robot

ODOMETRY = (OdometryPose, OdometryIncrement, WheelAngles)


def _robots(message: Message) -> tuple[str, ...]:
    """Robots that get a state at the message's time."""
    if isinstance(message, Sighting) and message.seen_robot is not None:
        return message.robot, message.seen_robot
    return (message.robot,)


def synchronise(
    messages: Iterable[Message],
    tracks: Mapping[str, Track],
    max_gap_s: float,
    dropped: Counter[str],
    watched: Sequence[str] = (),
) -> Iterator[Message]:
    """Feed odometry into the tracks and hold everything else until the track covers its time.

    A scan stamped between two odometry readings needs the later one. The order of time is kept over
    all robots, so one robot without odometry may delay the others, by ``max_gap_s`` at most.
    Messages farther than that from any odometry of their robot are dropped and counted, and so are
    sightings of robots without a track. At the end of the log robots are taken to stand still after
    their last reading. Scans may show the robots ``watched``, so they wait for their odometry too,
    and so do sightings of robots without a name for that of all robots.
    """
    waiting: deque[Message] = deque()
    max_gap_ns = round(max_gap_s * 1e9)
    now_ns = 0

    def has_to_wait(head: Message, needed: Sequence[Track | None]) -> bool:
        if now_ns - head.time_ns > max_gap_ns:
            return False
        shown: Sequence[Track] = ()
        if isinstance(head, Scan):
            shown = [tracks[robot] for robot in watched]
        elif isinstance(head, Sighting) and is_unnamed_robot(head):
            shown = [*tracks.values()]
        # a scan is put together from where its first beam and its last one were measured
        last_ns = sweep_end_ns(head) if isinstance(head, Scan) else head.time_ns
        return not all(track and track.reaches(last_ns) for track in (*needed, *shown))

    def ready(final: bool) -> Iterator[Message]:
        """Takes out the messages in front that need not wait any longer."""
        while waiting:
            head = waiting[0]
            needed: Sequence[Track | None] = ()
            if not isinstance(head, ODOMETRY):
                needed = [tracks.get(robot) for robot in _robots(head)]
                if not final and has_to_wait(head, needed):
                    return
            waiting.popleft()
            for track in needed:
                if not (track and track.covers(head.time_ns, max_gap_ns)):
                    dropped[f"{type(head).__name__.lower()}: no odometry near it"] += 1
                    break
            else:
                yield head

    for message in messages:
        if isinstance(message, ODOMETRY):
            tracks[message.robot].add(message)
            if not waiting:  # nothing else is in front of it
                now_ns = max(now_ns, message.time_ns)
                yield message
                continue
        elif isinstance(message, (Truth, TrueLandmark)):
            continue
        elif isinstance(message, Sighting) and message.seen_robot not in (None, *tracks):
            dropped[f"sighting: robot {message.seen_robot} is not in the log"] += 1
            continue
        now_ns = max(now_ns, message.time_ns)
        waiting.append(message)
        yield from ready(final=False)
    yield from ready(final=True)
