"""A recording as the public functions take it: paths, or logs that are open already."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, cast

from graphslam.core.config import Config
from graphslam.core.config_io import chosen_config
from graphslam.core.errors import ConfigError
from graphslam.logs import LogSet, open_logs

if TYPE_CHECKING:
    from graphslam.scan_smoothing.log_reader import Reading

PathLike: TypeAlias = "str | os.PathLike[str]"
Recording: TypeAlias = "PathLike | Sequence[PathLike] | LogSet"


def paths_of(paths: PathLike | Sequence[PathLike]) -> list[Path]:
    """One path or several."""
    single = isinstance(paths, str | os.PathLike)
    return [Path(path) for path in cast("Sequence[PathLike]", [paths] if single else paths)]


def settle(
    recording: Recording, config: Config | PathLike | None, settings: Mapping[str, Any]
) -> Config:
    """The configuration; logs that are open already bring theirs.

    Raises:
        ConfigError: a setting is wrong, or is about the reading of logs that are open already.
    """
    if not isinstance(recording, LogSet):
        return chosen_config(config, **settings)
    settled = chosen_config(recording.config if config is None else config, **settings)
    if (settled.logs, settled.robots) != (recording.config.logs, recording.config.robots):
        raise ConfigError("logs.*, robots.*: must be passed to open_logs")
    return settled


def opened(recording: Recording, config: Config) -> LogSet:
    """The open logs.

    Raises:
        LogError: see `open_logs`.
    """
    return recording if isinstance(recording, LogSet) else open_logs(paths_of(recording), config)


@contextmanager
def reading_ahead(recording: Recording, config: Config) -> Iterator[tuple[LogSet, Reading | None]]:
    """The open logs, and what is read of them in the background; None if they were open already.

    Raises:
        LogError: see `open_logs`.
    """
    from graphslam.scan_smoothing.log_reader import read_ahead  # noqa: PLC0415 (not needed by who compares)

    log = opened(recording, config)
    if log is recording:
        yield log, None
        return
    with read_ahead(log, config) as ahead:
        yield log, ahead
