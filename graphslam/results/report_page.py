# ruff: noqa: RUF001 -- σ, × and – are meant: people read them
"""The sections of the report of a result, in their order."""

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import PurePath
from typing import Any

import numpy as np

from graphslam.core.config_io import dump_config
from graphslam.core.records import Result
from graphslam.results import report_html as html
from graphslam.results import report_maps as maps
from graphslam.results import report_plots as plots
from graphslam.results import report_tables as tables
from graphslam.results.live_figure import live_html
from graphslam.results.live_map import live_map
from graphslam.results.report_verdict import verdict_section


def page(result: Result, evaluation: Mapping[str, Any] | None) -> str:
    """See `graphslam.results.report.render`."""
    summary = result.summary
    title = " + ".join(PurePath(log["path"]).name for log in summary.get("logs", [])) or "Result"
    sections = [
        _header(result, title),
        verdict_section(summary),
        _warnings(summary),
        _map_section(result),
        _sessions_section(summary),
        _quality_section(evaluation or {}),
        _uncertainty_section(result),
        _estimator_section(result),
        _accounting_section(summary, sorted(result.robots)),
        _landmark_section(result),
        _reproduce_section(result),
    ]
    return html.document(title, sections)


def _header(result: Result, title: str) -> str:
    counts, summary = result.summary.get("counts", {}), result.summary
    sigma = tables.median_sigma(result)
    tiles: list[tuple[str, object, str]] = [
        ("scans", counts.get("scans"), ""),
        ("keyframes", counts.get("keyframes"), ""),
        ("landmarks", len(result.landmarks), ""),
        ("loop closures", counts.get("loop_closures"), ""),
        ("median σ of position", html.length(sigma) if sigma is not None else None, ""),
        ("real time", summary.get("real_time_factor"), " ×"),
        ("peak memory", summary.get("peak_memory_mb"), " MB"),
    ]
    # what is zero or unknown (no scans, no closures) has no tile
    shown = [(name, f"{html.number(value)}{unit}") for name, value, unit in tiles if value]
    return html.header("graphslam", title, tables.headline(result), shown)


def _warnings(summary: Mapping[str, Any]) -> str:
    stamps = summary.get("notes", {}).get("stamps", "")
    texts = [f"stamps: {stamps}"] if stamps.startswith("invented") else []
    paths = [log["path"] for log in summary.get("logs", [])]
    texts += [html.without_folders(str(text), paths) for text in summary.get("warnings", [])]
    return html.warning_box(texts)


def _map_section(result: Result) -> str:
    scans = bool(result.keyframe_scans)
    what = "Superposed scans" if scans else "Paths"
    landmark_note = "" if scans else " Triangles are landmarks."
    final, by_odometry = maps.overview_of(result), maps.overview_of(result, dead_reckoning=True)
    height_in = final.height_in
    figures = [
        html.figure(
            maps.overview_map(final, height_in, "the final trajectory"),
            "Final trajectory.",
            f"{what} on the trajectory from all data.{landmark_note}",
        ),
        html.figure(
            maps.overview_map(by_odometry, height_in, "odometry alone"),
            "Dead reckoning.",
            f"The same {'scans' if scans else 'paths'} by odometry alone.",
        ),
    ]
    if result.landmarks:
        drawing, factor = maps.landmark_map(result, height_in)
        points = any(m.kind == "point" for m in result.landmarks)
        lines = any(m.line is not None for m in result.landmarks)
        bounds = " and ".join(["ellipses"] * points + ["bars across the ends"] * lines)
        named = min(len(result.landmarks), maps.MAX_LABELS)
        which = "" if named == len(result.landmarks) else " of those with the most sightings"
        figures.append(
            html.figure(
                drawing,
                "Landmarks.",
                f"Numbers{which} as in landmarks.json; 95 % {bounds}{_times(factor)}.",
            )
        )
    drawing, factor = maps.trajectory_map(result, height_in)
    figures.append(
        html.figure(
            drawing,
            "Uncertainty of the trajectory.",
            f"95 % ellipses{_times(factor)}; a dot marks the start"
            + ("; the faint line is the causal estimate." if _has_causal(result) else "."),
        )
    )
    return html.section(
        "Map", live_html(live_map(result, final.limits)) + html.figure_grid(figures)
    )


def _sessions_section(summary: Mapping[str, Any]) -> str:
    return html.section("Between the sessions", tables.session_changes(summary))


def _has_causal(result: Result) -> bool:
    return all(robot.causal is not None for robot in result.robots.values())


def _times(factor: int) -> str:
    return f" drawn {factor} times as large" if factor > 1 else " to scale"


def _quality_section(evaluation: Mapping[str, Any]) -> str:
    return html.section("Against the truth", tables.quality(evaluation))


def _uncertainty_section(result: Result) -> str:
    causal = _has_causal(result)
    figures = [
        html.figure(
            plots.uncertainty(result),
            "Standard deviations.",
            "Final (strong) and causal (pale); position in its worst direction."
            if causal
            else "Position in its worst direction.",
        ),
        html.figure(
            plots.revision(result),
            "Final against causal." if causal else "Final against odometry.",
            "Distance of the causal estimate (solid) and of odometry alone (dashed) from the "
            "final trajectory: the effect of later data."
            if causal
            else "Distance of odometry alone from the final trajectory.",
        ),
    ]
    return html.section("Over time", html.figure_grid(figures))


def _estimator_section(result: Result) -> str:
    figures = []
    if any(len(values) for values in result.innovations.values()):
        figures.append(
            html.figure(
                plots.innovations(result.innovations, plots.unit_of_time(result)),
                "Innovations.",
                "Normalised innovation squared per degree of freedom of accepted associations; "
                "with its running mean; orange: expectation 1 and (dashed) 95 % quantile. A "
                "mean below 1 means that the stated noise is too large; the gate cuts the tail.",
            )
        )
    if len(result.step_ms):
        p50, p99 = np.quantile(result.step_ms, [0.5, 0.99])
        figures.append(
            html.figure(
                plots.timing(result.step_ms),
                "Wall time per step.",
                f"With its running median; p50 {html.number(float(p50))} ms, "
                f"p99 {html.number(float(p99))} ms, max "
                f"{html.number(float(result.step_ms.max()))} ms.",
            )
        )
    return html.section("Estimator", html.figure_grid(figures)) if figures else ""


def _accounting_section(summary: Mapping[str, Any], robots: Sequence[str]) -> str:
    several = len(robots) > 1  # then the table is a wide one
    parts = [
        tables.counts(summary),
        f"<div>{tables.reasons(summary)}</div>",
        f"<div>{tables.stages(summary)}</div>",
        "" if several else tables.calibration(summary, robots),
    ]
    content = "\n".join(part for part in parts if part)
    below = tables.calibration(summary, robots) if several else ""
    return html.section("Accounts", f'<div class="accounts">{content}</div>{below}')


def _landmark_section(result: Result) -> str:
    if not result.landmarks:
        return ""
    count = html.counted(len(result.landmarks), "landmark")
    return html.details(f"Table of {count}", tables.landmarks(result.landmarks))


def _reproduce_section(result: Result) -> str:
    summary = result.summary
    logs = [
        (PurePath(log["path"]).name, log["messages"], log["lost"], log["sha256"])
        for log in summary.get("logs", [])
    ]
    versions = ", ".join(f"{name} {text}" for name, text in summary.get("versions", {}).items())
    paths = " ".join(str(log[0]) for log in logs)
    command = f"graphslam smooth {paths} -o DIR --config config.toml"
    parts = [
        f"<p>With the config.toml beside this file: <code>{escape(command)}</code></p>",
        f"<p class=note>Versions: {escape(versions)}. Configuration sha256 "
        f"<code>{escape(str(summary.get('config_sha256', '–')))}</code></p>",
        html.table(["log", "messages", "lost", "sha256"], logs),
        f"<pre>{escape(dump_config(result.config))}</pre>",
    ]
    return html.details("How to reproduce this", "\n".join(parts))
