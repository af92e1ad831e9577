"""Sources that are several files: a folder, or an archive of it, read without unpacking."""

import lzma
import re
import tarfile
import zipfile
import zlib
from pathlib import Path, PurePosixPath

from graphslam.core.errors import LogError

#: endings that claim to be an archive or compressed
_PACKED = {".zip", ".tar", ".tgz", ".tbz2", ".txz", ".gz", ".bz2", ".xz"}


def text_files(source: Path, names: re.Pattern[str]) -> dict[str, str]:
    """Texts of the files of a folder or archive whose last name matches, at any depth.

    Args:
        source: a folder, a .zip or a .tar (plain or compressed in any way Python knows).
        names: what a file's name must match as a whole.

    Returns:
        Name without folders -> text; bytes that are not UTF-8 are replaced.

    Raises:
        LogError: no such file, not readable to its end, or two files of one name.
    """
    try:
        if source.is_dir():
            found = [(p.name, p.read_bytes) for p in sorted(source.rglob("*")) if p.is_file()]
            return _texts(source, [(n, read()) for n, read in found if names.fullmatch(n)])
        if zipfile.is_zipfile(source):
            with zipfile.ZipFile(source) as packed:
                inside = [(_last(name), name) for name in packed.namelist()]
                return _texts(
                    source, [(n, packed.read(path)) for n, path in inside if names.fullmatch(n)]
                )
        if source.is_file() and not source.stat().st_size:
            return {}
        return _texts(source, _tar_members(source, names))
    except FileNotFoundError as error:
        raise LogError(f"{source}: no such file; check the path") from error
    except (OSError, EOFError, tarfile.TarError, zipfile.BadZipFile) as error:
        raise _unreadable(source, error) from error
    except (lzma.LZMAError, zlib.error) as error:
        raise _unreadable(source, error) from error


def _tar_members(source: Path, names: re.Pattern[str]) -> list[tuple[str, bytes]]:
    """Matching members of a tar file, in its order; a stream, as seeking in .xz is slow."""
    members = []
    try:
        packed = tarfile.open(source, "r|*")  # noqa: SIM115 (closed below)
    except tarfile.ReadError:
        if source.suffix.lower() in _PACKED:
            raise
        return []  # a plain file of another kind: nothing in it matches
    with packed:
        for member in packed:
            content = packed.extractfile(member) if names.fullmatch(_last(member.name)) else None
            if content is not None:
                members.append((_last(member.name), content.read()))
    return members


def _last(path: str) -> str:
    return PurePosixPath(path).name


def _texts(source: Path, found: list[tuple[str, bytes]]) -> dict[str, str]:
    texts: dict[str, str] = {}
    for name, content in found:
        if name in texts:
            raise LogError(f"{source}: holds two files {name}; name the folder of one data set")
        texts[name] = content.decode("utf-8", errors="replace")
    return texts


def _unreadable(source: Path, error: Exception) -> LogError:
    why = " ".join(str(getattr(error, "strerror", None) or error).split())
    return LogError(f"{source}: cannot be read to its end: {why}; fetch it again")
