"""Output folders that appear whole or not at all."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from graphslam.core.errors import OutputError


@contextmanager
def atomic_folder(target: Path) -> Iterator[Path]:
    """A temporary folder beside ``target``; it is renamed to ``target`` when the block ends.

    A folder that stands at ``target`` is moved away, replaced and only then deleted, so that one
    of the two exists at any time. If the block raises, ``target`` stays as it was.

    Raises:
        OutputError: the disk refuses; nothing is left behind.
    """
    final = target.absolute()
    part = final.with_name(f".{final.name}.{os.getpid()}.part")
    old = final.with_name(f".{final.name}.{os.getpid()}.old")
    try:
        part.mkdir(parents=True)
        yield part
        if final.exists():
            final.rename(old)
        try:
            part.rename(final)
        except OSError:
            with suppress(FileNotFoundError):
                old.rename(final)
            raise
    except OSError as error:
        raise OutputError(f"{target}: cannot be written: {error.strerror}") from error
    finally:
        shutil.rmtree(part, ignore_errors=True)
    shutil.rmtree(old, ignore_errors=True)
