"""The output of `batch` for people."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from graphslam.cli.show import make_console, make_table


def batch(found: Mapping[str, Any], directory: Path) -> None:
    """A line per log, what failed, and where the overview is."""
    console = make_console()
    head = ["log", "", "length, m", "error, m", "sigma, m", "loops", "warnings", "s"]
    rows = []
    for row in found["logs"]:
        cells = [row["name"], row.get("verdict") or row["status"]]
        cells += [row.get(key) for key in ("length_m", "error_m", "sigma_m", "loops")]
        cells += [len(row["warnings"]) if "warnings" in row else None, row.get("seconds")]
        rows.append(cells)
    console.print(make_table(head, rows, texts=2))
    for row in found["logs"]:
        if row["error"]:
            console.print(f"failed: {row['name']}: {row['error']}")
    counts = found["counts"]
    new = f", {counts['done_now']} of them now" if counts["done_now"] < counts["logs"] else ""
    console.print(f"{counts['done']} of {counts['logs']} logs are done{new}")
    if found["not_recordings"]:
        console.print(f"passed over: {len(found['not_recordings'])} files that are no recordings")
    console.print(f"report: {directory / 'report.html'}")
