"""Whether recordings that have the same topics were made one after the other.

Parts of a drive, or a drive and the next one, are one robot's. Different messages of one topic at
the same time are not: they are of two robots that call their topics alike, or the clock of one
recording is wrong. Read as one robot, their scans and odometry would alternate.
"""

from collections.abc import Sequence
from itertools import combinations

from graphslam.core.errors import LogError
from graphslam.core.records import Sighting
from graphslam.logs.recording import Recording, messages_between
from graphslam.logs.topics import MOTION_KINDS, Topic

#: what only one robot can have said
_OF_ONE_ROBOT = (*MOTION_KINDS, Sighting)
#: s: parts of a recording may overlap by so much, where a recorder goes on in a new file
_OVERLAP_S = 2.0
#: s in the middle of an overlap that are compared
_COMPARED_S = 10.0
#: share of equal messages from which on both recordings are of one robot, recorded twice
_SAME = 0.5


def check_separate_times(files: Sequence[Recording], topics: Sequence[Topic]) -> None:
    """Refuse recordings in which one topic says two things at the same time.

    Spans of time are compared for each two recordings; messages are read for two that overlap only,
    those of 10 s.

    Raises:
        LogError: two recordings are of two robots, or their clocks are wrong; it says what to do.
    """
    wanted = {topic.name for topic in topics if topic.count and topic.record in _OF_ONE_ROBOT}
    spans = [{name: file.span_ns(name) for name in wanted & names_in(file)} for file in files]
    for (a, in_a), (b, in_b) in combinations(zip(files, spans, strict=True), 2):
        for name in sorted(in_a.keys() & in_b.keys()):
            begin, end = max(in_a[name][0], in_b[name][0]), min(in_a[name][1], in_b[name][1])
            if end - begin <= 1e9 * _OVERLAP_S or _is_the_same(a, b, name, begin, end):
                continue
            raise LogError(
                f"{a.path} and {b.path}: both have {name} during the same "
                f"{1e-9 * (end - begin):.0f} s, with different messages: two robots whose topics "
                "have the same names, or a wrong clock; --same-place takes each recording for "
                "itself, or smooth them one by one"
            )


def names_in(file: Recording) -> set[str]:
    """Topics of a recording that have messages."""
    return {topic.name for topic in file.topics if topic.count}


def _is_the_same(a: Recording, b: Recording, topic: str, begin_ns: int, end_ns: int) -> bool:
    """Whether two recordings have the same messages of a topic, as far as is looked at."""
    middle = (begin_ns + end_ns) // 2
    half = min(round(1e9 * _COMPARED_S), end_ns - begin_ns) // 2
    first, second = (
        [raw.data for raw in messages_between(file, topic, middle - half, middle + half)]
        for file in (a, b)
    )
    fewest = min(len(first), len(second))
    return len(set(first) & set(second)) >= _SAME * fewest
