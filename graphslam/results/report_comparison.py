"""The page of a comparison of back ends: its words and its tables.

`COLUMNS` says which numbers are shown and which of them is best; the terminal shows the same.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from math import degrees, log
from pathlib import PurePath
from typing import Any

import numpy as np

from graphslam.core.geometry import Array
from graphslam.results.report_tables import number, table

Stamps = np.ndarray[tuple[int], np.dtype[np.int64]]


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """Errors of one robot over time, (n,) each: ns, m, rad, and NEES per degree of freedom.

    NEES is NaN where it would mean nothing.
    """

    stamps_ns: Stamps
    position_m: Array
    heading_rad: Array
    nees: Array


@dataclass(frozen=True, slots=True, eq=False)
class Lane:
    """What is drawn of one back end.

    ``paths[kind][robot]`` (n, 2) m and ``curves[kind][robot]``, kind `final` or `causal`;
    ``step_ms`` (n,) per step, with ``landmarks`` in the map and ``path_m`` driven by then.
    """

    spec: str
    label: str
    final_is_causal: bool
    paths: Mapping[str, Mapping[str, Array]]
    curves: Mapping[str, Mapping[str, Curve]]
    step_ms: Array
    landmarks: Array
    path_m: Array


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """compare.json as ``found``, with what the page draws: lanes and true paths (n, 2), m."""

    found: Mapping[str, Any]
    lanes: tuple[Lane, ...]
    truth: Mapping[str, Array]


# ---------------------------------------------------------------- tables


@dataclass(frozen=True, slots=True)
class Column:
    """A number of a row.

    ``value`` finds it (None: there is none); the best is the smallest if ``aim`` is 0, else the one
    nearest to ``aim`` in ratio; ``aim`` None has no best.
    """

    head: str
    value: Callable[[Mapping[str, Any]], Any]
    aim: float | None = 0.0


def _at(*keys: str) -> Callable[[Mapping[str, Any]], Any]:
    def find(row: Mapping[str, Any]) -> Any:
        value: Any = row
        for key in keys:
            value = None if value is None else value.get(key)
        return value

    return find


def _shown(show: Callable[[Any], object], *keys: str) -> Callable[[Mapping[str, Any]], Any]:
    """The value at ``keys`` as ``show`` makes it; None stays None."""
    find = _at(*keys)

    def shown(row: Mapping[str, Any]) -> object:
        value = find(row)
        return None if value is None else show(value)

    return shown


def _interval(bounds: Sequence[float]) -> str:
    return f"{bounds[0]:.2f}…{bounds[1]:.2f}"


def _percent(share: float) -> float:
    return 100.0 * share


def _trajectory(kind: str) -> tuple[Column, ...]:
    at = ("joint", kind)
    return (
        Column("ATE, m", _at(*at, "ate_rmse_m")),
        Column("aligned, m", _at(*at, "ate_aligned_rmse_m")),
        Column("max, m", _at(*at, "max_m")),
        Column("heading, °", _shown(degrees, *at, "heading_rmse_rad")),
        Column("RPE 1 s, m", _at(*at, "rpe", "1_s", "trans_rmse_m")),
        Column("RPE 10 m, m", _at(*at, "rpe", "10_m", "trans_rmse_m")),
        Column("NEES/dof", _at(*at, "nees_per_dof"), 1.0),
        Column("95 % bounds", _shown(_interval, *at, "nees_bounds"), None),
        Column("coverage, %", _shown(_percent, *at, "coverage"), 95.0),
    )


def _relations(*at: str) -> tuple[Column, ...]:
    groups = ("all", "local", "loops")
    return tuple(
        Column(f"{group}, {unit}", _at("relations", *at, group, key))
        for group in groups
        for unit, key in (("m", "trans_mean_m"), ("°", "rot_mean_deg"))
    )


#: table -> its columns; a table without a number is left out
COLUMNS: dict[str, tuple[Column, ...]] = {
    "Final trajectory, from all data": _trajectory("final"),
    "Causal trajectory, from data up to each pose": _trajectory("causal"),
    "Landmarks": (
        Column("RMSE, m", _at("landmarks", "rmse_m")),
        Column("NEES/dof", _at("landmarks", "nees_per_dof"), 1.0),
        Column("matched", _at("landmarks", "matched"), None),
        Column("missed", _at("landmarks", "missed"), None),
        Column("extra", _at("landmarks", "extra"), None),
    ),
    "Reference relations, final: mean error": _relations(),
    "Reference relations, causal: mean error": _relations("causal"),
    "Distance to the final trajectory of {reference}": (
        Column("final, m", _at("difference", "final", "rmse_m"), None),
        Column("max, m", _at("difference", "final", "max_m"), None),
        Column("heading, °", _shown(degrees, "difference", "final", "heading_rmse_rad"), None),
        Column("causal, m", _at("difference", "causal", "rmse_m"), None),
        Column("max, m", _at("difference", "causal", "max_m"), None),
        Column("heading, °", _shown(degrees, "difference", "causal", "heading_rmse_rad"), None),
    ),
    "Cost": (
        Column("ms/step p50", _at("ms_per_step", "p50")),
        Column("p99", _at("ms_per_step", "p99")),
        Column("max", _at("ms_per_step", "max")),
        Column("finish, ms", _at("finish_ms"), None),
        Column("all, s", _at("total_s")),
        Column("memory, MB", _at("memory_mb", "growth")),
        Column("process, MB", _at("memory_mb", "peak"), None),
        Column("~ landmarks^", _shown("{:.2f}".format, "growth_exponent", "landmarks"), None),
        Column("~ path^", _shown("{:.2f}".format, "growth_exponent", "path"), None),
    ),
    "Associations of each": (
        Column("states", _at("states"), None),
        Column("associations", _at("associations"), None),
        Column("of them late", _at("late"), None),
        Column("landmarks", _at("map_landmarks"), None),
        Column("whole run, s", _at("recording_s"), None),
    ),
}

Cell = tuple[object, bool]


def filled(found: Mapping[str, Any]) -> dict[str, tuple[Sequence[str], list[list[Cell]]]]:
    """Table -> heads, and per row of ``found`` its cells, each with whether it is the best.

    A row that failed has no cells. Equal to three digits is equally good; if all are, none is best.
    """
    rows = found["rows"]
    tables: dict[str, tuple[Sequence[str], list[list[Cell]]]] = {}
    for title, columns in COLUMNS.items():
        if title.startswith("Associations") and found["mode"] == "replay":
            continue  # they are the same for all
        done = [row for row in rows if row["error"] is None]
        values = [[column.value(row) for row in done] for column in columns]
        if all(value is None for column in values for value in column):
            continue
        marked = [
            list(zip(column, _best(column, head.aim), strict=True))
            for column, head in zip(values, columns, strict=True)
        ]
        cells = iter(zip(*marked, strict=True))
        tables[title.format(**found)] = (
            [column.head for column in columns],
            [list(next(cells)) if row["error"] is None else [] for row in rows],
        )
    return tables


def _best(values: Sequence[Any], aim: float | None) -> list[bool]:
    """Which values are the best of their column, see `Column`."""
    numbers = [value for value in values if isinstance(value, int | float)]
    nothing = [False] * len(values)
    if aim is None:
        return nothing
    grades = {_badness(value, aim) for value in numbers}
    if len(grades) < 2:
        return nothing
    least = min(grades)
    return [isinstance(value, int | float) and _badness(value, aim) == least for value in values]


def _badness(value: float, aim: float) -> float:
    """How far a value is from what it should be, to the three digits that are shown."""
    if aim == 0.0:
        return float(f"{abs(value):.3g}")
    return float(f"{abs(log(max(value, 1e-300) / aim)):.3g}")


#: heads of `ahead`'s table
AHEAD = ("number", "best filter", "its value", "best smoother", "its value")


def ahead(found: Mapping[str, Any]) -> list[tuple[str, str, Any, str, Any]]:
    """The numbers in which a filter is better than every smoother: rows of a table, see `AHEAD`.

    What revises no state is a filter; dead reckoning, which is none, is left out.
    """
    done = [row for row in found["rows"] if row["error"] is None]
    done = [row for row in done if not row["spec"].startswith("dead-reckoning")]
    out = []
    for title, columns in COLUMNS.items():
        if title.startswith(("Final", "Associations")):
            continue  # a filter's final numbers are its causal ones
        for column in columns:
            if column.aim is None:
                continue
            graded = [
                (_badness(value, column.aim), i, value)
                for i, row in enumerate(done)
                if isinstance(value := column.value(row), int | float)
            ]
            filters = [one for one in graded if done[one[1]]["final_is_causal"]]
            smoothers = [one for one in graded if not done[one[1]]["final_is_causal"]]
            if filters and smoothers and min(filters)[0] < min(smoothers)[0]:
                (_, i, mine), (_, k, theirs) = min(filters), min(smoothers)
                name = f"{re.split('[ ,:]', title)[0].lower()}: {column.head}"
                out.append((name, done[i]["label"], mine, done[k]["label"], theirs))
    return out


# ---------------------------------------------------------------- words


def sentence(found: Mapping[str, Any]) -> str:
    """What was held equal, in one sentence."""
    done = [row for row in found["rows"] if row["error"] is None]
    count = f"{len(done)} back end{'s' * (len(done) != 1)}"
    if found["mode"] == "associate":
        return f"{count}, each associating for itself: a comparison of whole systems."
    return (
        f"{count} on the same {number(done[0]['steps'])} recorded steps with "
        f"{number(done[0]['associations'])} associations, made by {found['recorded_by']}: "
        "a comparison of estimation and nothing else."
    )


def notes(found: Mapping[str, Any]) -> list[str]:
    """What one has to know to read the tables."""
    done = [row for row in found["rows"] if row["error"] is None]
    texts = []
    filters = [row["spec"] for row in done if row["final_is_causal"]]
    if filters:
        texts.append(f"Final equals causal for {', '.join(filters)}: nothing revises the past.")
    rivals = any(spec != "dead-reckoning" for spec in filters) and len(filters) < len(done)
    if rivals and not ahead(found):
        texts.append("No filter is ahead of every smoother in any number.")
    late = max(row["late"] for row in done)
    if late:
        texts.append(
            f"{number(late)} associations are late: from before their landmark was confirmed."
        )
    for row in done:
        for reason, count in sorted(row["skipped"].items()):
            texts.append(f"{row['spec']} could not use {number(count)} x {reason}.")
    if any("joint" in row for row in done):
        texts.append(
            "NEES bounds are for independent poses; those of one run are correlated, so a single "
            "run leaves them often. Its expectation is 1."
        )
    texts.append(
        "ms per step are of the estimator alone, without association and covariances, one back end "
        "after another, each in a process of its own; memory is what that process grew by."
    )
    return texts


# ---------------------------------------------------------------- the page


def render_comparison(comparison: Comparison, settings: str = "") -> str:
    """The comparison as one self-contained HTML document.

    Args:
        comparison: what was found.
        settings: the effective configuration (TOML), printed in full.
    """
    # matplotlib takes half a second to import, and most commands draw nothing
    from graphslam.results import report_comparison_plots as plots  # noqa: PLC0415
    from graphslam.results.report_page import document, section  # noqa: PLC0415

    found, lanes = comparison.found, comparison.lanes
    won = ahead(found)
    # as the figures draw them: six colours, then the same dashed
    colors = {
        lane.spec: f"repeating-linear-gradient(90deg, {color} 0 5px, transparent 5px 7px)"
        if i >= 6
        else color
        for i, lane in enumerate(lanes)
        for color in [f"var(--robot{i % 6})"]
    }
    title = " + ".join(PurePath(log["path"]).name for log in found["logs"])
    keys = "".join(
        f"<span>{_swatch(colors, lane.spec)}{escape(lane.label)}</span>" for lane in lanes
    )
    legend = f"<p class=lanes>{keys}</p>"
    warnings = "".join(f"<li>{escape(text)}</li>" for text in found["warnings"])
    sections = [
        f"<header><p class=brand>graphslam compare</p><h1>{escape(title)}</h1>\n"
        f"<p class=lead>{escape(sentence(found))}</p></header>",
        f'<section class="warn"><h2>Warnings</h2><ul>{warnings}</ul></section>' if warnings else "",
        "<section><h2>Numbers</h2>"
        + "".join(_table(found, colors, name, *rest) for name, rest in filled(found).items())
        + (table(AHEAD, won, "Where a filter is ahead of every smoother") if won else "")
        + "".join(f"<p class=note>{escape(text)}</p>" for text in ("Best in bold.", *notes(found)))
        + "</section>",
    ]
    for name, figures in plots.figures(comparison).items():
        if figures:
            sections.append(section(name, figures).replace("</h2>", f"</h2>{legend}", 1))
    sections.append(_reproduce(found, settings))
    return document(f"{title}, compared", sections)


def _swatch(colors: Mapping[str, str], spec: str) -> str:
    color = colors.get(spec)
    return f'<i class=lane style="background:{color}"></i>' if color else ""


def _table(
    found: Mapping[str, Any],
    colors: Mapping[str, str],
    title: str,
    heads: Sequence[str],
    rows: Sequence[Sequence[Cell]],
) -> str:
    top = "".join(f'<th scope="col">{escape(head)}</th>' for head in ("back end", *heads))
    body = ""
    for row, cells in zip(found["rows"], rows, strict=True):
        label = row["label"]
        if title.startswith("Final") and row.get("final_is_causal"):
            label += " (= causal)"
        name = f'<th scope="row">{_swatch(colors, row["spec"])}{escape(label)}</th>'
        if row["error"] is None:
            content = "".join(
                f"<td{' class=best' * best}>{number(value)}</td>" for value, best in cells
            )
        else:
            content = f"<td class=none colspan={len(heads)}>failed: {escape(row['error'])}</td>"
        body += f"<tr>{name}{content}</tr>\n"
    return (
        f'<div class="scroll compared"><table><caption>{escape(title)}</caption>'
        f"<thead><tr>{top}</tr></thead>\n<tbody>{body}</tbody></table></div>"
    )


def _reproduce(found: Mapping[str, Any], settings: str) -> str:
    logs = " ".join(str(log["path"]) for log in found["logs"])
    specs = ",".join(row["spec"] for row in found["rows"])
    command = (
        f"graphslam compare {logs} --backends {specs} --mode {found['mode']} "
        "--config config.toml -o DIR"
    )
    sums = "".join(
        f"<p class=note>{escape(str(log['path']))} sha256 <code>{log['sha256']}</code></p>"
        for log in found["logs"]
    )
    return (
        "<section><details><summary>How to reproduce this</summary>"
        f"<p>With the config.toml beside this file: <code>{escape(command)}</code></p>{sums}"
        f"<pre>{escape(settings)}</pre></details></section>"
    )
