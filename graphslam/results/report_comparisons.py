# ruff: noqa: RUF001 -- × and – are meant: people read them
"""The overview of comparisons on many logs: back ends over all logs, and a line of each log."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from graphslam.results import report_html as html
from graphslam.results.report_batch import Column, Row, overview_page


def comparisons_page(found: Mapping[str, Any], maps: Mapping[str, str]) -> str:
    """The page; ``maps``: SVG by the name of the log, as far as there are any."""
    done = [row for row in found["logs"] if row.get("backends")]
    specs = list(dict.fromkeys(spec for row in done for spec in row["backends"]))
    known = any(one["error_m"] is not None for row in done for one in row["backends"].values())
    what = "error" if known else "distance from the reference"
    columns = [_column(spec, known) for spec in specs]
    columns.append(
        Column("took", "time of the worker", lambda row: row.get("seconds"), html.duration)
    )
    tiles = [
        ("logs", html.number(found["counts"]["logs"])),
        ("back ends", html.number(len(specs))),
        ("worker time", html.duration(found["totals"]["seconds"])),
    ]
    heads = ["back end", "logs", "failed", f"median {what}", "worst", "over the reference"]
    rows = [_line(spec, done, known) for spec in specs]
    table = html.table([*heads, "median NEES", "total time", "most memory"], rows)
    note = f"<p class=note>Columns of back ends: {what} of the final positions, RMS.</p>"
    above = html.section("Over all logs", table + note) if done else ""
    return overview_page("graphslam compare", found, maps, tiles, columns, above)


def _key(known: bool) -> str:
    return "error_m" if known else "difference_m"


def _column(spec: str, known: bool) -> Column:
    def value(row: Row) -> float | None:
        found: float | None = row.get("backends", {}).get(spec, {}).get(_key(known))
        return found

    return Column(spec, f"{spec}: final positions, root mean square", value, html.length)


def _line(spec: str, rows: Sequence[Row], known: bool) -> list[object]:
    """A back end over all logs: medians, and the ratio of its errors to those of the reference."""
    own = [row["backends"][spec] for row in rows if spec in row["backends"]]
    errors = [one[_key(known)] for one in own if one[_key(known)] is not None]
    ratios = [
        row["backends"][spec]["error_m"] / best
        for row in rows
        if spec in row["backends"]
        and row["backends"][spec]["error_m"] is not None
        and (best := row["backends"].get(row["reference"], {}).get("error_m"))
    ]
    nees = [one["nees_per_dof"] for one in own if one["nees_per_dof"] is not None]
    times = [one["total_s"] for one in own if one["total_s"] is not None]
    memory = [one["memory_mb"] for one in own if one["memory_mb"] is not None]
    return [
        f"{own[0]['label']} ({spec})" if own[0]["label"] != spec else spec,
        len(own),
        sum(one["error"] is not None for one in own),
        html.length(float(np.median(errors))) if errors else None,
        html.length(max(errors)) if errors else None,
        f"{html.number(float(np.median(ratios)))} ×" if ratios else None,
        float(np.median(nees)) if nees else None,
        html.duration(sum(times)) if times else None,
        f"{html.number(max(memory))} MB" if memory else None,
    ]
