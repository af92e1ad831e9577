"""Reading that begins before there is anything to work with: in the second process.

It reads the keyframes of an open log, or else its messages, while this process imports what it
needs besides. What both need is imported before the fork: its time and memory are spent once.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from itertools import islice
from typing import TYPE_CHECKING, TypeAlias

from graphslam.core.companion import Exchange
from graphslam.core.config import Config
from graphslam.core.record import Packed, packed, unpacked
from graphslam.core.records import TRUE_RECORDS, Message
from graphslam.logs import LogSet
from graphslam.logs.log_set import ReadReport
from graphslam.pipeline.log_kind import is_scan_log

if TYPE_CHECKING:
    from graphslam.odometry.online_calibration import Learnt
    from graphslam.scan_smoothing.scan_keyframes import ReadItem

#: keyframes or messages; what is sent is the calibration and noise
Reading: TypeAlias = Exchange["Learnt", "ReadItem | Packed"]

#: blocks of keyframes that are read before anything is known of the calibration
UNCALIBRATED_BLOCKS = 2
#: messages that are read while nobody waits for them, and that are sent together then; scans are
#: too large to be held like that
READ_AHEAD, BATCH, BATCHES_AHEAD = 20_000, 256, 2
#: batches that are asked for ahead: a pipe holds some thousand of such requests
MOST_AHEAD = 1000


def read_ahead(log: LogSet, config: Config) -> Reading:
    """Keyframes of a log if `is_scan_log` holds for it, else its messages.

    The log takes these, without `TRUE_RECORDS`, when it is asked for them.
    """
    if is_scan_log(log, config):
        return read_keyframes_ahead(log, config)

    def batches() -> Generator[Packed, object, None]:
        items = log.reading(TRUE_RECORDS)
        size = BATCH if any(map(log.has_scans, log.robots)) else READ_AHEAD
        while batch := list(islice(items, size)):
            yield packed(batch)
            size = BATCH

    reading: Reading = Exchange(batches, BATCHES_AHEAD * (None,))
    log.expect(_received(reading, log.count(TRUE_RECORDS) // BATCH), TRUE_RECORDS)
    return reading


def read_keyframes_ahead(log: LogSet, config: Config, known: Learnt | None = None) -> Reading:
    """Keyframes of a log for which `is_scan_log` holds; ``known``: see `read_keyframes`."""
    from graphslam.scan_smoothing.scan_keyframes import read_keyframes  # noqa: PLC0415 (of scans)

    return Exchange(
        lambda: read_keyframes(log, config, UNCALIBRATED_BLOCKS, known),
        UNCALIBRATED_BLOCKS * (None,),
    )


def _received(reading: Reading, batches: int) -> Iterator[Message | ReadReport]:
    """The messages of about so many batches; they need not be asked for one by one."""
    asked = min(batches, MOST_AHEAD)
    for _ in range(asked):
        reading.send(None)
    while (batch := reading.receive()) is not None:
        assert isinstance(batch, Packed)
        if asked < batches:
            reading.send(None)
            asked += 1
        yield from unpacked(batch)
