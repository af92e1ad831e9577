"""metadata.yaml of rosbag2: which files belong to a recording, and how many messages they have.

It is a help only: a recording that was ended by force has none, and its files are read without.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

METADATA = "metadata.yaml"


@dataclass(frozen=True, slots=True)
class Metadata:
    """Names of the files, and their numbers of messages where they are given."""

    files: tuple[str, ...] = ()
    messages: Mapping[str, int] = field(default_factory=dict)

    def listed(self, name: str) -> bool:
        """Whether the file ``name`` belongs to the recording."""
        return _plain(name) in self.files

    def messages_of(self, name: str) -> int | None:
        """Number of messages that were recorded into the file ``name``; None if not given."""
        return self.messages.get(_plain(name))

    def missing(self, names: Sequence[str]) -> list[str]:
        """Files that are not among ``names``."""
        there = {_plain(name) for name in names}
        return [name for name in self.files if name not in there]


def read_metadata(path: Path) -> Metadata:
    """The metadata in ``path``; empty if there is no such file or if it is damaged."""
    if not path.is_file():
        return Metadata()
    # only for these folders
    from ruamel.yaml import YAML  # noqa: PLC0415
    from ruamel.yaml.error import YAMLError  # noqa: PLC0415

    try:
        tree: Any = YAML(typ="safe", pure=True).load(path.read_text(encoding="utf-8"))
        found = tree["rosbag2_bagfile_information"]
        names = tuple(_plain(str(name)) for name in found["relative_file_paths"])
        counts = {
            _plain(str(file["path"])): int(file["message_count"]) for file in found.get("files", [])
        }
        if not counts and len(names) == 1:
            counts = {names[0]: int(found["message_count"])}
    except (YAMLError, LookupError, TypeError, ArithmeticError, ValueError, AttributeError):
        return Metadata()
    return Metadata(names, counts)


def _plain(name: str) -> str:
    """Name of a file without folders and without the suffix of its compression.

    Old versions of rosbag2 write the folder's name too, and leave the suffix out. In one line: it
    is shown, and may be damaged.
    """
    return " ".join(PurePosixPath(name).name.removesuffix(".zstd").split())
