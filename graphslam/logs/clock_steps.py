"""Clocks that were set while a recording ran: stamps of another day than most.

A computer without a battery for its clock starts in 1970 until the network tells it the time, and
what a node sends before it knows the time of a simulation is stamped zero. Such messages cannot be
placed among the others. They are left out and counted.
"""

from collections import Counter
from collections.abc import Iterable, Mapping

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.logs.decoders import TopicContext, decode_messages
from graphslam.logs.recording import Recording, sample_messages
from graphslam.logs.topics import Topic

_NO_END = np.iinfo(np.int64).max
#: topic -> first and last time, ns, that its messages in a recording may have
Spans = Mapping[str, tuple[int, int]]

#: ns: stamps of one recording are not farther from the next than that, thirty days. Blocks of one
#: that lasts for less than four times as long are never farther apart
LONGEST_PAUSE_NS = 30 * 86_400_000_000_000
#: blocks of a recording that are looked at, and messages of a topic in each
BLOCKS, PER_BLOCK = 4, 4
#: what such messages are counted as
OTHER_CLOCK = "stamped more than a month from most others: the clock was set"


def spans_of_stamps(
    file: Recording, topics: Iterable[Topic], contexts: Mapping[str, TopicContext]
) -> Spans:
    """What the times of messages in a recording have to be.

    Stamps between which no pause is longer than `LONGEST_PAUSE_NS` belong together. Used are those
    of which there are most in a sample of all topics, of equally many the later ones, and what is
    as near to them. Single later ones are left to the sorter, which knows what was recorded around
    them. Topics without any of them, as those of another clock, are not in the result.
    """
    stamps: dict[str, IntArray] = {}
    for topic in topics:
        if contexts[topic.name].by_log_time:
            continue
        data = list(sample_messages(file, topic.name, BLOCKS, PER_BLOCK))
        found = decode_messages(topic.schema, data, contexts[topic.name], Counter()) if data else []
        stamps[topic.name] = np.array([m.stamp_ns for m in found if m is not None], dtype=np.int64)
    every = np.sort(np.concatenate([np.zeros(0, np.int64), *stamps.values()]))
    if not len(every):
        return {}
    groups = np.split(every, np.flatnonzero(np.diff(every) > LONGEST_PAUSE_NS) + 1)
    most = max(groups, key=lambda group: (len(group), group[0]))
    first, last = int(most[0]) - LONGEST_PAUSE_NS, int(most[-1]) + LONGEST_PAUSE_NS
    if np.count_nonzero(every > last) < 2:
        last = _NO_END
    return {
        name: (first, last)
        for name, own in stamps.items()
        if ((own >= first) & (own <= last)).any()
    }
