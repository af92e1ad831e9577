"""Recordings in folders: each file or rosbag2 folder that can be read as a log of its own."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from graphslam.core.errors import LogError
from graphslam.core.output_folder import RECORDING_SUFFIXES
from graphslam.logs.containers import is_recording
from graphslam.logs.rosbag2_metadata import METADATA


@dataclass(frozen=True)
class FoundRecordings:
    """What is in the folders: recordings, and other files, which were passed over."""

    recordings: tuple[tuple[str, Path], ...]
    others: tuple[Path, ...]


def find_recordings(places: Sequence[Path], without: Path | None = None) -> FoundRecordings:
    """Every recording in files and folders, by name; folders are searched through.

    Links are followed, into each folder once. A folder with a metadata.yaml is one recording, and
    so is every file elsewhere whose content or name is that of one: a damaged file is to be heard
    of. The name is the path below its folder, without suffix and separators. ``without``: a folder
    that is not searched.

    Raises:
        LogError: a place does not exist or cannot be searched, or there is no recording.
    """
    found: dict[Path, Path] = {}
    others: list[Path] = []
    skipped = without.resolve() if without is not None else None
    for place in places:
        base = place if place.is_dir() and not _is_rosbag2(place) else place.parent
        for path, is_log in _search(place, {skipped} if skipped else set()):
            if is_log:
                found.setdefault(path.resolve(), path.relative_to(base))
            else:
                others.append(path)
    if not found:
        told = ", ".join(map(str, places))
        raise LogError(f"{told}: no recording in it; name a folder of MCAP files or bags")
    names = _unique(found)
    return FoundRecordings(tuple(sorted(zip(names, found, strict=True))), tuple(others))


def _unique(found: Mapping[Path, Path]) -> list[str]:
    """Names of paths by their parts below a folder, without suffix.

    Where several are the same, with suffix, and with as many folders as it takes.
    """
    names = ["-".join(_without_suffix(below).parts) for below in found.values()]
    for more in range(max(len(path.parts) for path in found)):
        counts = Counter(names)
        longer = [path.parts[-len(below.parts) - more :] for path, below in found.items()]
        names = [
            "-".join(parts) if counts[name] > 1 else name
            for name, parts in zip(names, longer, strict=True)
        ]
    if len(set(names)) < len(names):  # a-b/c and a/b-c
        return [f"{number}-{name}" for number, name in enumerate(names)]
    return names


def _without_suffix(path: Path) -> Path:
    return path.with_suffix("") if path.suffix in RECORDING_SUFFIXES else path


def _search(place: Path, visited: set[Path]) -> Iterator[tuple[Path, bool]]:
    """Files and rosbag2 folders of a place, and whether each is a recording.

    ``visited`` are folders, resolved, that are not searched (again): links may lead in circles.
    """
    if not place.exists():
        raise LogError(f"{place}: no such file or folder; check the path")
    if not place.is_dir() or _is_rosbag2(place):
        yield place, True
        return
    visited.add(place.resolve())
    try:
        for path in sorted(place.iterdir(), key=lambda path: path.name):
            if path.name.startswith("."):
                continue
            # of a link to itself both are false, where the entries of os.scandir raise
            if path.is_dir():
                if path.resolve() not in visited:
                    yield from _search(path, visited)
            elif path.is_file():
                yield path, path.suffix in RECORDING_SUFFIXES or is_recording(path)
    except OSError as error:
        raise LogError(f"{place}: cannot be searched: {error.strerror}") from error


def _is_rosbag2(path: Path) -> bool:
    return (path / METADATA).is_file()
