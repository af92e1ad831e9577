"""The report of a comparison of back ends: its tables and its text.

`COLUMNS` says which numbers are shown and which of them is best; the terminal shows the same.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from math import degrees, log
from pathlib import PurePath
from typing import Any

import numpy as np

from graphslam.core.geometry import Array
from graphslam.results import report_html as html
from graphslam.results.live_figure import live_html
from graphslam.results.metric_tables import (
    NO_COMMON_FRAME,
    Column,
    converted,
    landmark_columns,
    nees_in_words,
    trajectory_columns,
    value_at,
)

Stamps = np.ndarray[tuple[int], np.dtype[np.int64]]


@dataclass(frozen=True, slots=True, eq=False)
class ErrorCurve:
    """Errors of one robot over time, (n,) each: ns, m, rad, and NEES per degree of freedom.

    NEES is NaN without truth in the frame of the estimate.
    """

    stamps_ns: Stamps
    position_m: Array
    heading_rad: Array
    nees: Array


@dataclass(frozen=True, slots=True, eq=False)
class TimedPath:
    """Poses (n, 3) m, m, rad of one robot in the frame of the truth, and their stamps (n,) ns."""

    stamps_ns: Stamps
    poses: Array


@dataclass(frozen=True, slots=True, eq=False)
class BackendCurves:
    """The curves of one back end.

    ``paths[kind][robot]`` and ``curves[kind][robot]``, kind `final` or `causal`;
    ``step_ms`` (n,) is the time of each step; ``landmarks`` (n,) the size of the map and ``path_m``
    (n,) the path driven by then.
    """

    spec: str
    label: str
    paths: Mapping[str, Mapping[str, TimedPath]]
    curves: Mapping[str, Mapping[str, ErrorCurve]]
    step_ms: Array
    landmarks: Array
    path_m: Array


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """``summary`` is compare.json; the report draws ``backends`` and the true paths (n, 2), m."""

    summary: Mapping[str, Any]
    backends: tuple[BackendCurves, ...]
    truth: Mapping[str, Array]


# ---------------------------------------------------------------- tables


def _relations(*at: str) -> tuple[Column, ...]:
    groups = ("all", "local", "loops")
    return tuple(
        Column(f"{group}, {unit}", value_at("relations", *at, group, key))
        for group in groups
        for unit, key in (("m", "trans_mean_m"), ("°", "rot_mean_deg"))
    )


#: title -> columns of a table; a table without any number is left out
COLUMNS: dict[str, tuple[Column, ...]] = {
    "What each row takes as Gaussian": (
        Column("errors of poses", value_at("error_frame"), None),
        Column("lines", value_at("lines"), None),
        Column("kernel", value_at("kernel"), None),
        Column("past states", value_at("past_states"), None),
    ),
    "Final trajectory, from all data": trajectory_columns("joint", "final"),
    "Causal trajectory, from data up to each pose": trajectory_columns("joint", "causal"),
    "Landmarks": landmark_columns("landmarks"),
    "Reference relations, final: mean error": _relations(),
    "Reference relations, causal: mean error": _relations("causal"),
    "Distance to the final trajectory of {reference}": (
        Column("final, m", value_at("difference", "final", "rmse_m"), None),
        Column("max, m", value_at("difference", "final", "max_m"), None),
        Column("heading, °", converted(degrees, "difference", "final", "heading_rmse_rad"), None),
        Column("causal, m", value_at("difference", "causal", "rmse_m"), None),
        Column("max, m", value_at("difference", "causal", "max_m"), None),
        Column("heading, °", converted(degrees, "difference", "causal", "heading_rmse_rad"), None),
    ),
    "Cost": (
        Column("ms/step p50", value_at("ms_per_step", "p50")),
        Column("p99", value_at("ms_per_step", "p99")),
        Column("max", value_at("ms_per_step", "max")),
        Column("finish, ms", value_at("finish_ms"), None),
        Column("all, s", value_at("total_s")),
        Column("memory, MB", value_at("memory_mb", "growth")),
        Column("process, MB", value_at("memory_mb", "peak"), None),
        Column(
            "exponent, landmarks", converted("{:.2f}".format, "growth_exponent", "landmarks"), None
        ),
        Column("exponent, path", converted("{:.2f}".format, "growth_exponent", "path"), None),
    ),
    "Associations of each": (
        Column("states", value_at("states"), None),
        Column("associations", value_at("associations"), None),
        Column("of them late", value_at("late"), None),
        Column("landmarks", value_at("map_landmarks"), None),
        Column("whole run, s", value_at("recording_s"), None),
    ),
}

Cell = tuple[object, bool]


def comparison_tables(
    summary: Mapping[str, Any],
) -> dict[str, tuple[Sequence[str], list[list[Cell]]]]:
    """Title -> heads, and the cells of every row of ``summary``, each with whether it is the best.

    A row that failed has no cells. Values equal to three digits tie; if all do, none is best.
    """
    rows = summary["rows"]
    tables: dict[str, tuple[Sequence[str], list[list[Cell]]]] = {}
    for title, columns in COLUMNS.items():
        if title.startswith("Associations") and summary["mode"] == "replay":
            continue  # the same for all
        done = [row for row in rows if row["error"] is None]
        known = [c for c in columns if any(c.value(row) is not None for row in done)]
        if not known:
            continue
        values = [[column.value(row) for row in done] for column in known]
        marked = [
            list(zip(column, _best(column, head.target), strict=True))
            for column, head in zip(values, known, strict=True)
        ]
        cells = iter(zip(*marked, strict=True))
        tables[title.format(**summary)] = (
            [column.head for column in known],
            [list(next(cells)) if row["error"] is None else [] for row in rows],
        )
    return tables


def _best(values: Sequence[Any], target: float | None) -> list[bool]:
    """Which values are the best of their column, see `Column`."""
    numbers = [value for value in values if isinstance(value, int | float)]
    nothing = [False] * len(values)
    if target is None:
        return nothing
    grades = {_deviation(value, target) for value in numbers}
    if len(grades) < 2:
        return nothing
    least = min(grades)
    return [
        isinstance(value, int | float) and _deviation(value, target) == least for value in values
    ]


def _deviation(value: float, target: float) -> float:
    """Distance of a value from its target, to the three digits that are shown."""
    if target == 0.0:
        return float(f"{abs(value):.3g}")
    return float(f"{abs(log(max(value, 1e-300) / target)):.3g}")


#: heads of the table of `filter_wins`
FILTER_WIN_HEADS = ("number", "best filter", "its value", "best smoother", "its value")


def filter_wins(summary: Mapping[str, Any]) -> list[tuple[str, str, Any, str, Any]]:
    """The numbers in which a filter is better than every smoother: rows under `FILTER_WIN_HEADS`.

    A filter is a back end that revises no state; dead reckoning is left out.
    """
    done = [row for row in summary["rows"] if row["error"] is None]
    done = [row for row in done if not row["spec"].startswith("dead-reckoning")]
    out = []
    for title, columns in COLUMNS.items():
        if title.startswith(("Final", "Associations")):
            continue  # a filter's final numbers are its causal ones
        for column in columns:
            if column.target is None:
                continue
            graded = [
                (_deviation(value, column.target), i, value)
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


# ---------------------------------------------------------------- text


def headline(summary: Mapping[str, Any]) -> str:
    """What is compared and what was the same for all, in one sentence."""
    done = [row for row in summary["rows"] if row["error"] is None]
    count = f"{len(done)} back end{'s' * (len(done) != 1)}"
    if summary["mode"] == "associate":
        return f"{count}, each with its own data association: a comparison of whole systems."
    return (
        f"{count} on the same {html.number(done[0]['steps'])} recorded steps with "
        f"{html.number(done[0]['associations'])} associations, made by {summary['recorded_by']}: "
        "a comparison of estimation alone."
    )


def equality_notes(summary: Mapping[str, Any]) -> list[str]:
    """The equalities of a comparison as sentences."""
    labels = {row["spec"]: row["label"] for row in summary["rows"]}
    what = {"causal": "are one filter; their causal", "final": "end at one optimum; their final"}
    texts = []
    for pair in summary.get("equal", ()):
        which = " and ".join(labels[spec] for spec in pair["specs"])
        off = f"differ by {pair['sigmas']:.1e} sigma at most" if pair["sigmas"] else "are the same"
        texts.append(f"{which} {what[pair['what']]} poses {off}.")
    return texts


def reading_notes(summary: Mapping[str, Any]) -> list[str]:
    """What is needed to read the tables."""
    done = [row for row in summary["rows"] if row["error"] is None]
    texts = []
    filters = [row["spec"] for row in done if row["final_is_causal"]]
    if filters:
        texts.append(f"Final equals causal for {', '.join(filters)}: past states are not revised.")
    rivals = any(spec != "dead-reckoning" for spec in filters) and len(filters) < len(done)
    if rivals and not filter_wins(summary):
        texts.append("No filter is ahead of every smoother in any number.")
    texts += equality_notes(summary)
    late = max(row["late"] for row in done)
    if late:
        texts.append(
            f"{html.number(late)} associations are late: from before their landmark was confirmed."
        )
    for row in done:
        for reason, count in sorted(row["skipped"].items()):
            texts.append(f"{row['spec']} could not use {html.number(count)} x {reason}.")
    if any(not row.get("common_frame", True) for row in done):
        texts.append(f"{NO_COMMON_FRAME}.")
    if any("joint" in row for row in done):
        texts.append(
            "The expectation of NEES/dof is 1; its bounds are for as many independent poses as the "
            "correlated ones of the run are worth."
        )
    for row in done:
        for kind, found in row.get("joint", {}).items():
            if row["final_is_causal"] and kind == "final":
                continue
            if text := nees_in_words(found):
                texts.append(f"{row['label']}, {kind} poses: {text}.")
    texts.append(
        "Times per step are of the estimator alone, without data association and covariances; the "
        "exponents are those with which they grow over the number of landmarks and over the path. "
        "Each back end ran in a process of its own, one after another; memory is the growth of "
        "that process."
    )
    return texts


# ---------------------------------------------------------------- the page


def render_comparison(comparison: Comparison, settings: str = "") -> str:
    """The comparison as one self-contained HTML document.

    Args:
        comparison: what `graphslam.evaluation.compare_backends.compare` returned.
        settings: the effective configuration (TOML), printed in full.
    """
    # it imports this module
    from graphslam.results import report_comparison_plots as plots  # noqa: PLC0415

    summary, backends = comparison.summary, comparison.backends
    wins = filter_wins(summary)
    # as in the figures: six colours, then the same ones dashed
    colors = {
        backend.spec: f"repeating-linear-gradient(90deg, {color} 0 5px, transparent 5px 7px)"
        if i >= 6
        else color
        for i, backend in enumerate(backends)
        for color in [f"var(--robot{i % 6})"]
    }
    title = " + ".join(PurePath(log["path"]).name for log in summary["logs"])
    keys = "".join(
        f"<span>{_swatch(colors, backend.spec)}{escape(backend.label)}</span>"
        for backend in backends
    )
    legend = f"<p class=lanes>{keys}</p>"
    numbers = "".join(
        _table(summary, colors, name, *cells) for name, cells in comparison_tables(summary).items()
    )
    if wins:
        numbers += html.table(FILTER_WIN_HEADS, wins, "Where a filter is ahead of every smoother")
    for text in ("Best in bold.", *reading_notes(summary)):
        numbers += f"<p class=note>{escape(text)}</p>"
    charts = (plots.live_errors(comparison, kind) for kind in ("final", "causal"))
    live = [live_html(chart) for chart in charts if chart]
    moving = {
        "Trajectories": live_html(plots.live_map(comparison)),
        "Errors over time": html.figure_grid(live) if any(live) else "",
    }
    sections = [
        html.header("graphslam compare", title, headline(summary)),
        html.warning_box(
            html.without_folders(text, (log["path"] for log in summary["logs"]))
            for text in summary["warnings"]
        ),
        html.section("Numbers", numbers),
        *(
            html.section(name, moving.get(name, "") + legend + html.figure_grid(drawings))
            for name, drawings in plots.figures(comparison).items()
            if drawings
        ),
        _reproduce(summary, settings),
    ]
    return html.document(f"{title}, compared", sections)


def _swatch(colors: Mapping[str, str], spec: str) -> str:
    color = colors.get(spec)
    return f'<i class=lane style="background:{color}"></i>' if color else ""


def _table(
    summary: Mapping[str, Any],
    colors: Mapping[str, str],
    title: str,
    heads: Sequence[str],
    rows: Sequence[Sequence[Cell]],
) -> str:
    top = "".join(f'<th scope="col">{escape(head)}</th>' for head in ("back end", *heads))
    body = ""
    for row, cells in zip(summary["rows"], rows, strict=True):
        label = row["label"]
        if title.startswith("Final") and row.get("final_is_causal"):
            label += " (= causal)"
        name = f'<th scope="row">{_swatch(colors, row["spec"])}{escape(label)}</th>'
        if row["error"] is None:
            content = "".join(
                f'<td data-label="{escape(head)}"{" class=best" * best}>{html.number(value)}</td>'
                for head, (value, best) in zip(heads, cells, strict=True)
            )
        else:
            paths = (log["path"] for log in summary["logs"])
            error = escape(html.without_folders(row["error"], paths))
            content = f"<td class=none colspan={len(heads)}>failed: {error}</td>"
        body += f"<tr>{name}{content}</tr>\n"
    return (
        f'<div class="scroll compared"><table class=wide><caption>{escape(title)}</caption>'
        f"<thead><tr>{top}</tr></thead>\n<tbody>{body}</tbody></table></div>"
    )


def _reproduce(summary: Mapping[str, Any], settings: str) -> str:
    logs = " ".join(PurePath(log["path"]).name for log in summary["logs"])
    specs = ",".join(row["spec"] for row in summary["rows"])
    command = (
        f"graphslam compare {logs} --backends {specs} --mode {summary['mode']} "
        "--config config.toml -o DIR"
    )
    sums = "".join(
        f"<p class=note>{escape(PurePath(log['path']).name)} sha256 "
        f"<code>{log['sha256']}</code></p>"
        for log in summary["logs"]
    )
    return html.details(
        "How to reproduce this",
        f"<p>With the config.toml beside this file: <code>{escape(command)}</code></p>{sums}"
        f"<pre>{escape(settings)}</pre>",
    )
