"""What every importer takes and returns, and how it opens its source."""

import bz2
import gzip
import lzma
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

from graphslam.core.errors import LogError

_OPENERS: dict[str, Callable[..., TextIO]] = {
    ".bz2": bz2.open,
    ".gz": gzip.open,
    ".xz": lzma.open,
}


@dataclass(frozen=True, slots=True)
class ImportSummary:
    """What an importer did: messages written per topic, and what was odd, one line each."""

    source: Path
    target: Path
    counts: Mapping[str, int]
    warnings: tuple[str, ...]


Importer = Callable[[Path, Path], ImportSummary]


def text_lines(path: Path) -> Iterator[str]:
    """Lines of a text file, plain or compressed with gzip, bzip2 or xz.

    Bytes that are not UTF-8 are replaced: old logs have comments in any encoding.

    Raises:
        LogError: no such file, a directory, or not readable to its end.
    """
    try:
        opener = _OPENERS.get(path.suffix, open)
        with opener(path, "rt", encoding="utf-8", errors="replace") as lines:
            yield from lines
    except FileNotFoundError as error:
        raise LogError(f"{path}: no such file; check the path") from error
    except IsADirectoryError as error:
        raise LogError(f"{path}: is a directory; name the log in it") from error
    except (OSError, EOFError, lzma.LZMAError) as error:
        why = getattr(error, "strerror", None) or str(error)
        raise LogError(f"{path}: cannot be read to its end: {why}; fetch it again") from error
