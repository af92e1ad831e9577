"""Wheels whose angles begin again after each turn, as encoders of one turn give them: made whole.

From the end of a turn to its beginning the angle jumps by a turn, which is no motion.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from operator import itemgetter

import numpy as np

from graphslam.core.geometry import Array, wrap
from graphslam.core.record import replace
from graphslam.core.records import Message, WheelAngles
from graphslam.logs.decoders import TopicContext
from graphslam.logs.findings import Finding
from graphslam.logs.gyroscopes import odometry_readings
from graphslam.logs.recording import Recording
from graphslam.logs.topics import Topic

#: under which messages are counted at which an angle began again
BEGUN_AGAIN = "joints: angle begins again after a turn"

_TURN = 2 * np.pi
#: rad: what rounding adds to a turn
_ROUNDING = 1e-5
#: share of the steps between two messages that are below the usual longest one. It must be less
#: than a quarter of a turn: with longer ones it is not known which way a wheel turned
_SHARE = 0.99
#: at so many of the jumps the wheel has gone on by no more than so many usual longest steps
_SHORT_SHARE, _SHORT = 0.9, 2.0


def find_wrapped_wheels(
    files: Sequence[Recording], topics: Iterable[Topic], contexts: Mapping[str, TopicContext]
) -> tuple[frozenset[str], list[Finding]]:
    """Robots whose wheels' angles begin again after each turn, and a finding for each.

    Args:
        files: the recordings.
        topics: those that are used.
        contexts: of the topics.
    """
    robots, findings = set(), []
    for topic in topics:
        if topic.record is not WheelAngles:
            continue
        jumps = jumps_of(_angles(files, topic, contexts[topic.name]))
        if jumps:
            robots.add(topic.robot)
            text = f"angles begin again after each turn, {jumps} times; the turns are counted"
            remedy = "a wheel must not turn by more than half a turn between two messages"
            findings.append(Finding("note", "wheels", topic.name, text, remedy))
    return frozenset(robots), findings


def jumps_of(angles: Array) -> int:
    """How often angles (n, 2), rad, of the wheels begin again after a turn; 0: they go on.

    All must lie within one turn. Less whole turns, the wheel has moved at a jump as in other steps:
    so it came near both ends of the turn, where angles that were reset are anywhere.
    """
    if len(angles) < 2 or (np.ptp(angles, axis=0) > _TURN + _ROUNDING).any():
        return 0
    steps = np.diff(angles, axis=0)
    jumps, moved = np.abs(steps) > np.pi, np.abs(wrap(steps))
    count, others = int(np.count_nonzero(jumps)), moved[~jumps & (moved > 0)]
    if not (count and len(others)):
        return 0
    usual = np.quantile(others, _SHARE)
    short = np.count_nonzero(moved[jumps] <= _SHORT * usual)
    return count if usual < _TURN / 4 and short >= _SHORT_SHARE * count else 0


def with_whole_turns(
    messages: Iterable[Message], robots: frozenset[str], counts: Counter[str]
) -> Iterator[Message]:
    """Messages in time order; angles of the wheels of ``robots`` go on after a turn.

    ``counts`` gets the messages at which one began again.
    """
    last: dict[str, tuple[Array, Array]] = {}
    for message in messages:
        if not isinstance(message, WheelAngles) or message.robot not in robots:
            yield message
            continue
        angles = np.array([message.left_rad, message.right_rad])
        before, turns = last.get(message.robot, (angles, np.zeros(2)))
        begun = np.rint((before - angles) / _TURN)
        if begun.any():
            counts[BEGUN_AGAIN] += 1
            turns = turns + begun
        last[message.robot] = angles, turns
        left, right = (angles + _TURN * turns).tolist()
        yield replace(message, left_rad=left, right_rad=right)


def _angles(files: Sequence[Recording], topic: Topic, context: TopicContext) -> Array:
    """Angles (n, 2) by time; none if they go on, which the first turns tell."""
    found: list[tuple[int, Array]] = []
    least, most = np.full(2, np.inf), np.full(2, -np.inf)
    for time_ns, angles in odometry_readings(files, topic, context):
        least, most = np.minimum(least, angles), np.maximum(most, angles)
        if (most - least > _TURN + _ROUNDING).any():
            return np.zeros((0, 2))
        found.append((time_ns, angles))
    found.sort(key=itemgetter(0))
    return np.array([angles for _, angles in found]).reshape(-1, 2)
