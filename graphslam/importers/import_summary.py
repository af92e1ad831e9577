"""What every importer returns."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class ImportSummary:
    """Result of an importer: messages written per topic, and warnings, one line each."""

    source: Path
    target: Path
    counts: Mapping[str, int]
    warnings: tuple[str, ...]
