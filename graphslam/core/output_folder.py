"""Output folders and files that appear whole or not at all."""

import os
import shutil
from collections.abc import Iterator, Sequence
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


def write_into(
    folder: Path, files: Sequence[tuple[str, str | bytes]], *, force: bool = False
) -> None:
    """Write files (name, content) into a folder, which is made if missing: all, or none.

    Each is written beside its name and renamed when all are whole.

    Raises:
        OutputError: a file exists and ``force`` is not given, or the disk refuses; what was there
            before is then as it was.
    """
    taken = [name for name, _ in files if os.path.lexists(folder / name)]
    if taken and not force:
        raise OutputError(f"{folder / taken[0]}: already exists; give --force to replace it")
    parts = [folder / f".{name}.{os.getpid()}.part" for name, _ in files]
    is_new = not folder.exists()
    done = False
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for part, (_, content) in zip(parts, files, strict=True):
            part.write_bytes(content.encode() if isinstance(content, str) else content)
        for part, (name, _) in zip(parts, files, strict=True):
            part.replace(folder / name)
        done = True
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written: {error.strerror}") from error
    finally:
        for part in parts:
            with suppress(OSError):
                part.unlink(missing_ok=True)
        if is_new and not done:
            with suppress(OSError):
                folder.rmdir()
