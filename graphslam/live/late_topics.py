"""Topics of a recording that begin after it was decided what is followed."""

from collections import Counter
from collections.abc import Collection, Iterable, Mapping

from graphslam.core.records import TRUE_RECORDS, TrueAssociations
from graphslam.logs.decoders import DECODERS
from graphslam.logs.recording import RawMessage, RawTopic

#: what is never followed
_TRUE = (*TRUE_RECORDS, TrueAssociations)


class LateTopics:
    """Counts the messages of robots and sensors that are not followed since they came too late.

    Attributes:
        counts: number of messages of each such topic that could have been used.
    """

    def __init__(self, there: Iterable[RawTopic], wanted: Collection[str]) -> None:
        """Nothing is late yet.

        Args:
            there: topics when it was decided; those without messages can still be late.
            wanted: the only ones that can be used, see ``logs.topics``; empty: any.
        """
        self.counts: Counter[str] = Counter()
        self._ignored = {topic.name for topic in there if topic.count}
        self._wanted = wanted

    def note(self, messages: Iterable[RawMessage], kinds: Mapping[str, tuple[str, str]]) -> bool:
        """Count those that are late; whether a topic is among them for the first time.

        ``kinds``: schema and encoding of every topic, see `RawTopic`.
        """
        before = len(self.counts)
        for raw in messages:
            name = raw.topic
            if name in self._ignored:
                continue
            if name not in self.counts and not self._is_usable(name, kinds):
                self._ignored.add(name)
                continue
            self.counts[name] += 1
        return len(self.counts) > before

    def _is_usable(self, name: str, kinds: Mapping[str, tuple[str, str]]) -> bool:
        schema, encoding = kinds[name]
        known = schema in DECODERS and encoding == "cdr" and DECODERS[schema].record not in _TRUE
        return known and (not self._wanted or name in self._wanted)
