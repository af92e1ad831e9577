"""The folder of a comparison: compare.json, config.toml and report.html."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from graphslam.core.config import Config
from graphslam.core.config_io import dump_config
from graphslam.core.output_folder import Identity
from graphslam.results.file_formats import to_json
from graphslam.results.report_comparison import Comparison, render_comparison
from graphslam.results.target_folder import check_target, write_folder


def is_comparison(directory: Path) -> bool:
    """Whether `save_comparison` wrote this folder; no other folder may be replaced."""
    try:
        found = json.loads((directory / "compare.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(found, dict) and str(found.get("format", "")).startswith("graphslam-comp")


def failed_backends(found: Mapping[str, Any]) -> str:
    """How many back ends of a comparison failed, and the line of the first; empty if none did.

    ``found``: what compare.json holds.
    """
    failed = [f"{row['spec']}: {row['error']}" for row in found["rows"] if row["error"]]
    count = f"{len(failed)} of {len(found['rows'])} back ends failed"
    return f"{count}; {failed[0]}" if failed else ""


def save_comparison(
    comparison: Comparison,
    config: Config,
    directory: Path,
    *,
    force: bool,
    before: Identity | Literal["now"] = "now",
) -> None:
    """Write compare.json, config.toml and report.html atomically.

    ``before``: what `check_target` found when the work began, which alone may be replaced.

    Raises:
        OutputError: the target exists and may not be replaced, or the disk refuses.
    """
    if before == "now":
        before = check_target(directory, force=force, replaceable=is_comparison)
    settings = dump_config(config)
    files = [
        ("compare.json", to_json(comparison.summary, "compare.json")),
        ("config.toml", settings),
        ("report.html", render_comparison(comparison, settings)),
    ]
    write_folder(directory, files, before)
