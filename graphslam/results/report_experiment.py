# ruff: noqa: RUF001 -- σ and – are meant: people read them
"""The page of an experiment, and its figures as files of their own.

Everything is drawn from the summary of `graphslam.evaluation.monte_carlo_summary.summarise`;
`FIGURES` lists the figures of an experiment on the bench.
"""

from collections.abc import Callable, Mapping, Sequence
from html import escape
from pathlib import PurePath
from typing import Any

import numpy as np

from graphslam.results import report_html as html
from graphslam.results.drawing import Axes
from graphslam.results.drawing_elements import ACCENT, FAINT, INK, Style, robot_color
from graphslam.results.live_charts import Curve, live_chart
from graphslam.results.live_figure import live_html
from graphslam.results.live_runs import RunsMap, caption, live_runs, runs_drawing
from graphslam.results.report_figure import Drawing, panels, positive, svg

Summary = Mapping[str, Any]


#: title -> head and lines of a table
Tables = Mapping[str, tuple[Sequence[str], Sequence[Sequence[str]]]]


def experiment_page(
    summary: Summary, tables: Tables | None = None, maps: Sequence[RunsMap] = ()
) -> str:
    """The report of an experiment as one self-contained HTML document.

    ``tables`` are those of an experiment that brings its own, instead of errors over logs. ``maps``
    show the paths of its runs.
    """
    sections = [_header(summary), _warnings(summary)]
    if summary["kind"] == "bench":
        drawings = [html.figure(draw(summary), *text) for draw, *text in FIGURES.values()]
        sections += [
            html.section("Consistency", _consistency(summary)),
            html.section("Errors against the Cramér-Rao bound", _errors(summary)),
            _maps(summary, maps),
            html.section("Figures", _live(summary) + html.figure_grid(drawings)),
        ]
    elif tables:
        sections += [
            html.section(title, html.table(head, lines)) for title, (head, lines) in tables.items()
        ]
    else:
        sections += [html.section("Errors over logs", _logs(summary)), _maps(summary, maps)]
    sections.append(_reproduce(summary))
    return html.document(str(summary["name"]), sections)


def experiment_figures(summary: Summary) -> dict[str, str]:
    """Name -> SVG file of every figure; none for an experiment over logs."""
    if summary["kind"] != "bench":
        return {}
    return {name: _standalone(draw(summary)) for name, (draw, *_) in FIGURES.items()}


def _standalone(drawing: str) -> str:
    """SVG of a page as a file: with its name space, the light colours and a background."""
    colors = {"var(--grid)": FAINT, "var(--accent)": ACCENT, "currentColor": INK}
    colors |= {f"var(--robot{i})": robot_color(i) for i in range(6)}
    for variable, color in colors.items():
        drawing = drawing.replace(variable, color)
    style = ' style="background: #ffffff" '
    if "xmlns=" not in drawing:
        style += 'xmlns="http://www.w3.org/2000/svg" '
    return drawing.replace("<svg ", f"<svg{style}", 1) + "\n"


# ---------------------------------------------------------------- text and tables


def _header(summary: Summary) -> str:
    counts = (
        ("runs", summary["rows"]),
        ("variants", len(summary["variants"])),
        ("noise scales", len(summary["noise_scales"])),
        ("failed", sum(summary["errors"].values())),
        ("diverged", sum(row.get("diverged", 0) for row in summary.get("table", ()))),
        ("run time, s", summary["seconds"]),
    )
    note = (
        f"A run has diverged if: {summary['diverged_if']}. Failed runs are in no mean, diverged "
        "ones in all."
    )
    tiles = [(name, html.number(value)) for name, value in counts]
    lead = f"{summary['description']}."
    return html.header("graphslam experiment", str(summary["name"]), lead, tiles, [note])


def _warnings(summary: Summary) -> str:
    texts = [*summary["warnings"], *(f"{n} × {text}" for text, n in summary["errors"].items())]
    scenarios = [row["scenario"] for row in summary.get("table", ()) if row.get("scenario")]
    return html.warning_box(html.without_folders(text, scenarios) for text in texts)


def _consistency(summary: Summary) -> str:
    rows: list[tuple[object, ...]] = []
    for row in summary["table"]:
        head = (f"{row['variant']}, noise × {row['scale']:g}", row["runs"], row["failed"])
        if "nees_per_dof" not in row:
            rows.append((*head, None, None, None, None, None, None))
            continue
        low, high = row["nees_bounds"]
        rows.append(
            (
                *head,
                row["diverged"],
                row["error_frame"],
                row["dof"],
                row["nees_per_dof"],
                f"{low:.3f}…{high:.3f}",
                row["nees_verdict"],
            )
        )
    columns = ["", "runs", "failed", "diverged", "errors in frame", "dof", "NEES/dof", "bounds", ""]
    note = (
        f"<p class=note>Final joint state: latest poses 3, points 2, lines 2 degrees of freedom. "
        f"Bounds: two-sided chi-square, {100 * summary['level']:g} % over all noise scales "
        "together. Of a filter, final is causal.</p>"
    )
    return html.table(columns, rows) + note


def _errors(summary: Summary) -> str:
    parts = {
        "final position": ("final", "position_m2"),
        "final heading": ("final", "heading_rad2"),
        "causal position": ("causal", "position_m2"),
        "causal heading": ("causal", "heading_rad2"),
        "points": ("landmarks", "points_m2"),
        "line offsets": ("landmarks", "lines_m2"),
        "line directions": ("landmarks", "lines_rad2"),
    }
    rows = []
    for row in summary["table"]:
        if "final" not in row:
            continue
        cells = [row[kind].get(name) for kind, name in parts.values()]
        texts = [
            None if c is None else f"{c['over_bound']:.3f} ± {c['over_bound_sigma']:.3f}"
            for c in cells
        ]
        name = f"{row['variant']}, noise × {row['scale']:g}"
        rows.append((name, cells[0]["rmse"], *texts, row["from_reference_m"]))
    columns = ["", "position RMSE, m", *parts, f"from {summary['reference']}, m"]
    note = (
        "<p class=note>Root mean square error over its Cramér-Rao bound, with its standard error: "
        "final against the bound of all data, causal against that of the data up to each time.</p>"
    )
    return html.table(columns, rows) + note


def _logs(summary: Summary) -> str:
    """A table of each kind of trajectory and one of landmarks, a row for each kind of run."""
    several = {
        key: len({row[key] for row in summary["table"]}) > 1 for key in ("front_end", "scale")
    }
    parts: dict[str, list[list[object]]] = {"final": [], "causal": [], "landmarks": []}
    for row in summary["table"]:
        scenario = PurePath(row["scenario"]).name  # or a file of the writer's machine
        named = [scenario, *([row["front_end"]] if several["front_end"] else []), row["variant"]]
        name = ", ".join([*named, *([f"noise × {row['scale']:g}"] if several["scale"] else [])])
        for kind, lines in parts.items():
            error = "rmse_m" if kind == "landmarks" else "ate_rmse_m"
            found = row.get(kind, {}).get(error, {})
            cells: list[object] = [name, _plus_minus(found), found.get("max")]
            cells += [_mean(row, kind, "nees_per_dof"), coverage(row, kind)]
            if kind == "final":
                cells += [row["runs"], row["failed"], row.get("diverged")]
            if kind == "landmarks":
                cells += [_mean(row, kind, count) for count in ("matched", "missed", "extra")]
            lines.append(cells)
    note = (
        "<p class=note>Mean ± standard deviation over the runs; coverage of 95 % ellipsoids is the "
        "mean over runs with its bootstrap interval (95 %).</p>"
    )
    heads = ["", "{}, m", "worst, m", "NEES/dof", "coverage, %"]
    titles = {
        "final": ("Final trajectory, from all data", "ATE", ["runs", "failed", "diverged"]),
        "causal": ("Causal trajectory, from data up to each pose", "ATE", []),
        "landmarks": ("Landmarks", "RMSE", ["matched", "missed", "extra"]),
    }
    tables = [
        html.table([*(head.format(error) for head in heads), *more], parts[kind], title)
        for kind, (title, error, more) in titles.items()
    ]
    return "".join(tables) + note


def coverage(row: Mapping[str, Any], kind: str) -> str | None:
    """Mean coverage of the 95 % ellipsoids over runs, %, with its bootstrap interval."""
    found = row.get(kind, {}).get("coverage", {})
    if found.get("mean") is None:
        return None
    low, high = found["interval"]
    return f"{100 * found['mean']:.1f} ({100 * low:.1f}…{100 * high:.1f})"


def _plus_minus(found: Mapping[str, Any]) -> str | None:
    if found.get("mean") is None:
        return None
    return f"{found['mean']:.4f} ± {found['std'] or 0.0:.4f}"


def _mean(row: Mapping[str, Any], kind: str, name: str) -> float | None:
    value = row.get(kind, {}).get(name, {}).get("mean")
    return None if value is None else float(value)


def _reproduce(summary: Summary) -> str:
    settings = [(name, " ".join(values)) for name, values in summary["variants"].items()]
    command = f"graphslam experiment {summary['name']} --runs {summary['runs']} -o DIR"
    return html.details(
        "How to reproduce this",
        f"<p><code>{escape(command)}</code></p>"
        f"<p class=note>Seed {summary['seed']}; code {escape(', '.join(summary['code']))}; "
        f"settings of all: {escape(' '.join(summary['settings']) or 'none')}</p>"
        f"{html.table(['variant', 'settings'], settings)}",
    )


# ---------------------------------------------------------------- figures


def _panels(summary: Summary, draw: Callable[[Axes, str], None], label: str) -> str:
    """A panel per noise scale, two in a row."""
    scales = list(summary["curves"])
    rows = (len(scales) + 1) // 2

    def whole(drawing: Drawing) -> None:
        grid = panels(drawing, len(scales), min(2, len(scales)), "step")
        for axes, scale in zip(grid, scales, strict=True):
            draw(axes, scale)
            axes.title = f"noise × {scale}"
        drawing.common_legend()

    return svg(label, 0.9 + 1.45 * rows, whole)


def _styles(summary: Summary) -> dict[str, Style]:
    """Colour and stroke of each variant; strokes differ, since some curves coincide."""
    strokes: tuple[tuple[float, ...], ...] = ((), (5, 1.5), (1.2, 1.2))
    return {
        name: Style(robot_color(i), 1.1, dashes=strokes[i % 3])
        for i, name in enumerate(summary["variants"])
    }


def _curve(axes: Axes, band: Mapping[str, Any], label: str, style: Style) -> None:
    steps = np.arange(len(band["mean"]))
    there_and_back = np.concatenate([steps, steps[::-1]])
    # bounds of the mean of few runs pass zero, which errors do not
    outline = np.maximum(np.concatenate([band["low"], band["high"][::-1]]), 0.0)
    axes.area(np.column_stack([there_and_back, outline]), style.color, 0.18)
    axes.line(steps, band["mean"], style, label)


def nees_over_time(summary: Summary) -> str:
    """Mean NEES of the robots' latest poses together, causal, with both bounds."""
    styles = _styles(summary)

    def draw(axes: Axes, scale: str) -> None:
        found = summary["curves"][scale]
        low, high = found["nees_bounds"]
        axes.band(low, high, ACCENT, 0.2)
        for name, curves in found["variants"].items():
            _curve(axes, curves["nees_per_dof"], name, styles[name])
        axes.y_label = "NEES / dof"
        axes.set_y(0.0, axes.y.high)

    return _panels(summary, draw, "Mean NEES over time")


def _rmse_over_time(summary: Summary, kind: str, label: str) -> str:
    styles = _styles(summary)

    def draw(axes: Axes, scale: str) -> None:
        found = summary["curves"][scale]
        for name, curves in found["variants"].items():
            _curve(axes, curves[f"{kind}_position_m"], name, styles[name])
        bound = found["bound"][f"{kind}_position_m"]
        axes.line(np.arange(len(bound)), bound, Style(INK, 1.4), "bound", layer=4)
        axes.y_label = "RMSE, m"
        axes.set_y(0.0, axes.y.high)

    return _panels(summary, draw, label)


def causal_rmse(summary: Summary) -> str:
    """Root mean square position error by data up to each time, over the filtering bound."""
    return _rmse_over_time(summary, "causal", "Causal position error over time")


def final_rmse(summary: Summary) -> str:
    """Root mean square position error by all data, over the smoothing bound."""
    return _rmse_over_time(summary, "final", "Final position error over time")


def error_against_noise(summary: Summary) -> str:
    """Final position error, its bound, and the distance from the reference, over the noise."""
    styles = _styles(summary)
    lines = {name: _of_variant(summary, name) for name in summary["variants"]}

    def draw(drawing: Drawing) -> None:
        left, right = panels(drawing, 2, 2, "noise scale")
        for name, rows in lines.items():
            scales = [row["scale"] for row in rows]
            rmse = [row["final"]["position_m2"]["rmse"] for row in rows]
            gap = np.array([row["from_reference_m"] or np.nan for row in rows], dtype=float)
            left.line(scales, rmse, styles[name], name)
            left.symbols(np.column_stack([scales, rmse]), styles[name].color, 3)
            if np.nanmax(gap, initial=0.0) > 0:
                right.line(scales, positive(gap, 0.0), styles[name])
                right.symbols(np.column_stack([scales, positive(gap, 0.0)]), styles[name].color, 3)
        rows = next((rows for rows in lines.values() if rows), [])
        bound = [row["final"]["position_m2"]["bound"] for row in rows]
        scales = [row["scale"] for row in rows]
        left.line(scales, bound, Style(INK, 1.4), "bound")
        left.y_label = "final position RMSE, m"
        right.y_label = f"distance from {summary['reference']}, m"
        for axes in (left, right):
            axes.log_x = axes.log_y = True
        drawing.common_legend()

    return svg("Error against noise", 2.6, draw)


def _of_variant(summary: Summary, name: str) -> list[Mapping[str, Any]]:
    return [row for row in summary["table"] if row["variant"] == name and "final" in row]


def consistency_against_noise(summary: Summary) -> str:
    """NEES of the final joint state over the noise, with the bounds of the test."""
    styles = _styles(summary)

    def draw(drawing: Drawing) -> None:
        (axes,) = panels(drawing, 1, 1, "noise scale")
        low = high = 1.0
        for name in summary["variants"]:
            rows = [row for row in _of_variant(summary, name) if row["nees_per_dof"] is not None]
            values = [row["nees_per_dof"] for row in rows]
            scales = [row["scale"] for row in rows]
            axes.line(scales, values, styles[name], name)
            axes.symbols(np.column_stack([scales, values]), styles[name].color, 3)
            for row in rows:
                low, high = row["nees_bounds"]
        axes.band(low, high, ACCENT, 0.2)
        axes.log_x = True
        axes.y_label = "final joint NEES / dof"
        drawing.common_legend()

    return svg("Consistency against noise", 2.6, draw)


def _live(summary: Summary) -> str:
    """Charts that move: consistency and error against the noise, NEES over time."""
    styles = _styles(summary)
    hint = "Drag to move; click, then turn the wheel to zoom; point at a curve for its values."
    against_noise: dict[str, list[Curve]] = {"consistency": [], "error": []}
    for name, style in styles.items():
        rows = [row for row in _of_variant(summary, name) if row["nees_per_dof"] is not None]
        scales = np.array([row["scale"] for row in rows])
        values = {
            "consistency": [row["nees_per_dof"] for row in rows],
            "error": [row["final"]["position_m2"]["rmse"] for row in rows],
        }
        for kind, found in values.items():
            against_noise[kind].append(Curve(name, style, scales, np.array(found)))
    scale = next(iter(summary["curves"]))
    over_time = [
        Curve(name, styles[name], np.arange(len(values), dtype=float), values)
        for name, c in summary["curves"][scale]["variants"].items()
        for values in [np.array(c["nees_per_dof"]["mean"], dtype=float)]
    ]
    charts = [
        live_chart(
            "consistency", "Consistency against noise, interactive.", hint,
            against_noise["consistency"], ("noise scale", "final joint NEES / dof"),
            log=(True, False), marked=True,
        ),
        live_chart(
            "error", "Error against noise, interactive.", hint, against_noise["error"],
            ("noise scale", "final position RMSE, m"), log=(True, True), marked=True,
        ),
        live_chart(
            "nees", f"NEES over time, noise × {scale}, interactive.", hint, over_time,
            ("step", "NEES / dof"),
        ),
    ]  # fmt: skip
    live = [live_html(chart) for chart in charts]
    return html.figure_grid(live) if any(live) else ""


def _maps(summary: Summary, maps: Sequence[RunsMap]) -> str:
    """Every map twice: moving, and as a drawing."""
    styles = _styles(summary)
    live = "".join(live_html(live_runs(shown, styles)) for shown in maps)
    drawings = [
        html.figure(runs_drawing(shown, styles), f"{shown.title}.", caption(shown))
        for shown in maps
    ]
    return html.section("Runs", live + html.figure_grid(drawings)) if maps else ""


#: name -> (drawing, title, caption)
FIGURES: dict[str, tuple[Callable[[Summary], str], str, str]] = {
    "consistency": (
        consistency_against_noise,
        "Consistency against noise.",
        "Mean NEES per degree of freedom of the final joint state; the bar is the test's bounds.",
    ),
    "error": (
        error_against_noise,
        "Error against noise.",
        "Left: final position error and its bound. Right: how far the last poses are from the "
        "reference's; a slope of two says that both linearise rightly.",
    ),
    "nees": (
        nees_over_time,
        "NEES over time.",
        "Latest poses of all robots together, from data up to each time; 95 % bands of the mean, "
        "the bar is the 95 % chi-square bounds.",
    ),
    "causal": (
        causal_rmse,
        "Causal position error over time.",
        "Root mean square over runs and robots, 95 % bands, over the filtering bound.",
    ),
    "final": (
        final_rmse,
        "Final position error over time.",
        "The same by all data, over the smoothing bound; a filter's is its causal one.",
    ),
}
