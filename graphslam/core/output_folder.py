"""Output files and folders that appear whole or not at all.

They are made beside their target, under a name that has the number of the process, and renamed.
What a killed process left behind is removed by the next one that writes the same target.
"""

import os
import re
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from graphslam.core.errors import OutputError

#: where this process makes files and folders that may be unfinished
_made_here: set[Path] = set()
#: device, number and time of change of what stands at a path; None: nothing does
Identity = tuple[int, int, int] | None

#: of recordings in files, see `graphslam.logs.containers`
RECORDING_SUFFIXES = frozenset({".mcap", ".db3", ".bag", ".zstd"})
#: what graphslam writes into folders itself: of results, of changes, of simulated visits
OWN_FOLDERS = frozenset({"trajectories"})
OWN_RECORDINGS = frozenset({"result.mcap", "changes.mcap", "reference.mcap", "later.mcap"})


def unfinished(target: Path) -> Path:
    """Where ``target`` is made; what dead processes left there is removed.

    A folder that was moved away by a process that died before it put the new one in its place
    is moved back.
    """
    final = target.absolute()
    for path in sorted(final.parent.glob(f".{_escaped(final.name)}.*")):
        found = re.fullmatch(r"\.(\d+)\.(part|old)", path.name[1 + len(final.name) :])
        if found is None or _is_alive(int(found[1])):
            continue
        if found[2] == "old" and not os.path.lexists(final):
            path.rename(final)
        else:
            _remove(path)
    made = final.with_name(f".{final.name}.{os.getpid()}.part")
    _made_here.add(made)
    return made


def remove_unfinished() -> None:
    """Remove at the end of a process what it did not finish.

    Blocks that make a file or folder remove it themselves. But a signal may come after the file
    was opened and before the block began, or while its end is at work.
    """
    for path in _made_here:
        _remove(path)


def _remove(path: Path) -> None:
    """Remove a file or folder, if it is there and the disk allows it."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink()


def _escaped(name: str) -> str:
    return re.sub(r"([*?[])", r"[\1]", name)


def _is_alive(number: int) -> bool:
    """Whether a process with this number runs on this machine."""
    try:
        os.kill(number, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return True


def identity(path: Path) -> Identity:
    """What stands at ``path`` now, to be compared with what stands there later."""
    try:
        found = path.stat(follow_symlinks=False)
    except OSError:
        return None
    return found.st_dev, found.st_ino, found.st_mtime_ns


def _is_same(target: Path, before: Identity) -> bool:
    """Whether nobody wrote ``target`` since `identity` gave ``before``."""
    return identity(target) in (None, before)


def check_same(target: Path, before: Identity) -> None:
    """Check that nobody wrote ``target`` since `identity` gave ``before``.

    Raises:
        OutputError: another process did.
    """
    if not _is_same(target, before):
        raise OutputError(
            f"{target}: was written by another process meanwhile; it is left as it is, choose "
            "another name"
        )


def check_nothing_else_in(directory: Path) -> None:
    """See that no recording and no folder would be lost with a folder that is to be replaced.

    Raises:
        OutputError: there is one that graphslam does not write there.
    """
    foreign = sorted(
        one.name
        for one in directory.iterdir()
        if (one.name not in OWN_FOLDERS and one.is_dir())
        or (one.name not in OWN_RECORDINGS and one.suffix in RECORDING_SUFFIXES)
    )
    if foreign:
        raise OutputError(
            f"{directory}: has {foreign[0]} in it, which would be lost, so it is not replaced; "
            "move that, or choose another name"
        )


@contextmanager
def atomic_folder(target: Path, before: Identity) -> Iterator[Path]:
    """A temporary folder beside ``target``; it is renamed to ``target`` when the block ends.

    A folder that stands at ``target`` is moved away, replaced and only then deleted, so that one
    of the two exists at any time. If the block raises, ``target`` stays as it was. ``before`` is
    what stood there when it was found out that it may be replaced.

    Raises:
        OutputError: the disk refuses, and nothing is left behind; or another process wrote
            ``target`` meanwhile, and the new folder stands beside it under a name of its own.
    """
    final = target.absolute()
    part = old = None
    try:
        part = unfinished(final)
        old = part.with_suffix(".old")
        part.mkdir(parents=True)
        yield part
        _keep_beside(part, final, before)
        if before is not None and final.exists():  # else the rename refuses to replace it
            final.rename(old)
        try:
            part.rename(final)
        except OSError:
            with suppress(FileNotFoundError):
                old.rename(final)
            _keep_beside(part, final, before)
            raise
    except OSError as error:
        raise OutputError(f"{target}: cannot be written: {error.strerror}") from error
    finally:
        if part is not None:
            shutil.rmtree(part, ignore_errors=True)
    shutil.rmtree(old, ignore_errors=True)


def _keep_beside(part: Path, final: Path, before: Identity) -> None:
    """Put a finished folder under a free name if somebody wrote ``final`` since ``before``.

    It may be the work of hours, and a file manager that leaves a file there is enough.

    Raises:
        OutputError: it was so.
    """
    if _is_same(final, before):
        return
    names = (f"{final.name}-new{number}" for number in ("", *(f"-{n}" for n in range(2, 10_000))))
    kept = next(path for name in names if not os.path.lexists(path := final.with_name(name)))
    part.rename(kept)
    raise OutputError(
        f"{final}: was written by another process meanwhile; it is left as it is, and what was "
        f"made now is {kept.name} beside it"
    )


def write_into(
    folder: Path, files: Sequence[tuple[str, str | bytes]], *, force: bool = False
) -> None:
    """Write files (name, content) into a folder, which is made if missing: all, or none.

    Raises:
        OutputError: see `files_in`.
    """
    with files_in(folder, [name for name, _ in files], force=force) as part:
        for name, content in files:
            (part / name).write_bytes(content.encode() if isinstance(content, str) else content)


@contextmanager
def files_in(folder: Path, names: Sequence[str], *, force: bool = False) -> Iterator[Path]:
    """A temporary folder for files of these ``names``; when the block ends they are renamed.

    They go into ``folder``, which is made if missing: all, or none. What they replace is moved
    aside first, as for a folder of `atomic_folder`.

    Raises:
        OutputError: one exists there and ``force`` is not given, or is a folder, or the disk
            refuses; what was there before is then as it was.
    """
    olds = {name: unfinished(folder / name).with_suffix(".old") for name in names}
    taken = [name for name in names if os.path.lexists(folder / name)]
    if taken and not force:
        raise OutputError(f"{folder / taken[0]}: already exists; give --force to replace it")
    for path in (folder / name for name in taken):
        if path.is_dir() and not path.is_symlink():
            raise OutputError(f"{path}: is a folder, so it is not replaced; move it away")
    is_new, done, put = not folder.exists(), False, list[str]()
    part = unfinished(folder / names[0])
    try:
        part.mkdir(parents=True)
        yield part
        for name in taken:
            (folder / name).rename(olds[name])
        for name in names:
            (part / name).rename(folder / name)
            put.append(name)
        done = True
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written: {error.strerror}") from error
    finally:
        for name, old in olds.items():
            if done:
                _remove(old)
            elif os.path.lexists(old):
                with suppress(OSError):
                    old.replace(folder / name)
            elif name in put:
                _remove(folder / name)
        shutil.rmtree(part, ignore_errors=True)
        if is_new and not done:
            with suppress(OSError):
                folder.rmdir()
