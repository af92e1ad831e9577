"""The output for people of what is done with many logs."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console

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
    _end(console, found, directory)


def comparisons(found: Mapping[str, Any], directory: Path) -> None:
    """The error of every back end on every log, what failed, and where the overview is."""
    console = make_console()
    done = [row for row in found["logs"] if row.get("backends")]
    specs = list(dict.fromkeys(spec for row in done for spec in row["backends"]))
    errors = [[row["backends"].get(spec, {}) for spec in specs] for row in done]
    known = any(one.get("error_m") is not None for row in errors for one in row)
    key = "error_m" if known else "difference_m"
    console.print("error, m" if known else "distance from the reference, m")
    lines = [
        [row["name"], *(one.get(key) for one in own)] for row, own in zip(done, errors, strict=True)
    ]
    console.print(make_table(["log", *specs], lines))
    for row in done:
        for spec, one in row["backends"].items():
            if one["error"]:
                console.print(f"failed: {row['name']}: {spec}: {one['error']}")
    _end(console, found, directory)


def _end(console: Console, found: Mapping[str, Any], directory: Path) -> None:
    """What failed as a whole, how much is done, and where the overview is."""
    for row in found["logs"]:
        if row["error"] and "backends" not in row:
            console.print(f"failed: {row['name']}: {row['error']}")
    counts = found["counts"]
    new = f", {counts['done_now']} of them now" if counts["done_now"] < counts["logs"] else ""
    console.print(f"{counts['done']} of {counts['logs']} logs are done{new}")
    if found["not_recordings"]:
        console.print(f"passed over: {len(found['not_recordings'])} files that are no recordings")
    console.print(f"report: {directory / 'report.html'}")
