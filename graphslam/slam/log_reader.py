"""Reading that begins before there is anything to work with: in the second process.

It opens a log and goes on with its keyframes, while this process imports what it needs. So what is
imported here, and by the second process, is only what reading needs.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from typing import TYPE_CHECKING, TypeAlias

from graphslam.core.companion import Exchange
from graphslam.core.config import Config
from graphslam.core.records import RelativePose, Sighting
from graphslam.logs import LogSet

if TYPE_CHECKING:
    from graphslam.core.motion_models import Calibration
    from graphslam.slam.scan_keyframes import ReadItem

#: keyframes, in front of them maybe the log; what is sent is the calibration
Reading: TypeAlias = Exchange["Calibration", "LogSet | ReadItem"]

#: blocks of keyframes that are read before anything is known of the calibration
UNCALIBRATED_BLOCKS = 2


def is_scan_log(log: LogSet, config: Config) -> bool:
    """Whether a log is tracked and solved as one batch: scans and odometry of one robot.

    Several robots are estimated together while the log is read: they find each other in scans.
    """
    records = {topic.record for topic in log.topics}
    return (
        config.backend.name == "batch"
        and config.backend.reoptimise
        and config.keyframe.mode != "all"
        and config.front_end.name != "none"
        and not records & {Sighting, RelativePose}
        and len(log.robots) == 1
        and log.has_scans(log.robots[0])
    )


def read_ahead(log: LogSet, config: Config) -> Reading:
    """Keyframes of a log for which `is_scan_log` holds."""
    return Exchange(lambda: _keyframes(log, config), UNCALIBRATED_BLOCKS * (None,))


def open_ahead(open_log: Callable[[], LogSet], config: Config) -> Reading:
    """First the log itself; if `is_scan_log` holds for it, then its keyframes."""

    def opened() -> Generator[LogSet | ReadItem, Calibration | None, None]:
        log = open_log()
        yield log
        if is_scan_log(log, config):
            yield from _keyframes(log, config)

    return Exchange(opened, (1 + UNCALIBRATED_BLOCKS) * (None,))


def _keyframes(
    log: LogSet, config: Config
) -> Generator[LogSet | ReadItem, Calibration | None, None]:
    from graphslam.slam.scan_keyframes import read_keyframes  # noqa: PLC0415 (see above)

    return read_keyframes(log, config, UNCALIBRATED_BLOCKS)
