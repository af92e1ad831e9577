"""Reading that begins before there is anything to work with: in the second process.

It opens a log and goes on with its keyframes, or else its messages, while this process imports what
it needs. So what is imported here, and by the second process, is only what reading needs.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
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

#: keyframes or messages, in front of them maybe the log; what is sent is the calibration and noise
Reading: TypeAlias = Exchange["Learnt", "LogSet | ReadItem | Packed"]

#: blocks of keyframes that are read before anything is known of the calibration
UNCALIBRATED_BLOCKS = 2
#: messages that are read while nobody waits for them, and that are sent together then; scans are
#: too large to be held like that
READ_AHEAD, BATCH = 20_000, 256


def read_ahead(log: LogSet, config: Config, known: Learnt | None = None) -> Reading:
    """Keyframes of a log for which `is_scan_log` holds; ``known``: see `read_keyframes`."""
    return Exchange(lambda: _keyframes(log, config, known), UNCALIBRATED_BLOCKS * (None,))


def open_ahead(open_log: Callable[[], LogSet], config: Config) -> Reading:
    """First the log itself; then its keyframes if `is_scan_log` holds for it, else its messages."""

    def opened() -> Generator[LogSet | ReadItem | Packed, Learnt | None, None]:
        log = open_log()
        yield log
        if is_scan_log(log, config):
            yield from _keyframes(log, config)
        else:
            items = log.reading(TRUE_RECORDS)
            size = BATCH if any(map(log.has_scans, log.robots)) else READ_AHEAD
            while batch := list(islice(items, size)):
                yield packed(batch)
                size = BATCH

    return Exchange(opened, (1 + UNCALIBRATED_BLOCKS) * (None,))


def receive_log(reading: Reading, config: Config) -> LogSet:
    """The log that was opened; if ``reading`` goes on with its messages, it takes these from there.

    They are what `LogSet.messages` gives without `TRUE_RECORDS`.
    """
    log = reading.receive()
    assert isinstance(log, LogSet)
    if any(map(log.has_scans, log.robots)):
        # association needs it, and it is slow to import: the first scans are still being read
        import scipy.optimize  # noqa: F401, PLC0415

    if not is_scan_log(log, config):
        log.expect(_received(reading, log.count(TRUE_RECORDS) // BATCH), TRUE_RECORDS)
    return log


def _received(reading: Reading, batches: int) -> Iterator[Message | ReadReport]:
    """The messages of about so many batches; they need not be asked for one by one."""
    for _ in range(batches):
        reading.send(None)
    while (batch := reading.receive()) is not None:
        assert isinstance(batch, Packed)
        yield from unpacked(batch)


def _keyframes(
    log: LogSet, config: Config, known: Learnt | None = None
) -> Generator[LogSet | ReadItem, Learnt | None, None]:
    from graphslam.scan_smoothing.scan_keyframes import read_keyframes  # noqa: PLC0415 (see above)

    return read_keyframes(log, config, UNCALIBRATED_BLOCKS, known)
