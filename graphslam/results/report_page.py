# ruff: noqa: RUF001 -- σ, × and – are meant: people read them
"""The order of the report, its words and its style."""

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import PurePath
from typing import Any

import numpy as np

from graphslam.core.config_io import dump_config
from graphslam.core.records import Result
from graphslam.results import report_maps as maps
from graphslam.results import report_plots as plots
from graphslam.results import report_tables as tables
from graphslam.results.report_style import CSS


def page(result: Result, evaluation: Mapping[str, Any] | None) -> str:
    """See `graphslam.results.report.render`."""
    summary = result.summary
    title = " + ".join(PurePath(log["path"]).name for log in summary.get("logs", [])) or "Result"
    sections = [
        _header(result, title),
        _warnings(summary),
        _map_section(result),
        _quality_section(evaluation or {}),
        _uncertainty_section(result),
        _estimator_section(result),
        _accounting_section(summary),
        _landmark_section(result),
        _reproduce_section(result),
    ]
    return document(title, sections)


def document(title: str, sections: Sequence[str]) -> str:
    """A whole HTML document of the sections that are not empty."""
    body = "\n".join(part for part in sections if part)
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="color-scheme" content="light dark">\n'
        f"<title>{escape(title)} – graphslam</title>\n<style>{CSS}</style>\n</head>\n"
        f"<body>\n<main>\n{body}\n</main>\n</body>\n</html>\n"
    )


def _header(result: Result, title: str) -> str:
    counts, summary = result.summary.get("counts", {}), result.summary
    sigma = tables.median_sigma(result)
    tiles: list[tuple[str, object, str]] = [
        ("scans", counts.get("scans"), ""),
        ("keyframes", counts.get("keyframes"), ""),
        ("landmarks", len(result.landmarks), ""),
        ("loop closures", counts.get("loop_closures"), ""),
        ("median σ", 100 * sigma if sigma is not None else None, " cm"),
        ("real time", summary.get("real_time_factor"), " ×"),
        ("peak memory", summary.get("peak_memory_mb"), " MB"),
    ]
    # what is zero or unknown (no scans, no closures) has no tile
    shown = "".join(
        f"<div><dt>{name}</dt><dd>{tables.number(value)}{unit}</dd></div>"
        for name, value, unit in tiles
        if value
    )
    return (
        f"<header><p class=brand>graphslam</p><h1>{escape(title)}</h1>\n"
        f"<p class=lead>{escape(tables.headline(result))}</p>\n"
        f"<dl class=tiles>{shown}</dl></header>"
    )


def _warnings(summary: Mapping[str, Any]) -> str:
    stamps = summary.get("notes", {}).get("stamps", "")
    texts = [f"stamps: {stamps}"] if stamps.startswith("invented") else []
    texts += [str(text) for text in summary.get("warnings", [])]
    items = "".join(f"<li>{escape(text)}</li>" for text in texts)
    return f'<section class="warn"><h2>Warnings</h2><ul>{items}</ul></section>' if items else ""


def figure(drawing: str, title: str, caption: str) -> str:
    """A drawing (SVG) with a caption that begins with its title."""
    return (
        f"<figure><figcaption><b>{escape(title)}</b> {escape(caption)}</figcaption>\n"
        f"{drawing}</figure>"
    )


def _map_section(result: Result) -> str:
    scans = bool(result.pictures)
    what = "Superposed scans" if scans else "Paths"
    landmark_note = "" if scans else " Triangles are landmarks."
    figures = [
        figure(
            maps.overview(result, dead_reckoning=False),
            "Final trajectory.",
            f"{what} on the trajectory from all data.{landmark_note}",
        ),
        figure(
            maps.overview(result, dead_reckoning=True),
            "Dead reckoning.",
            f"The same {'scans' if scans else 'paths'} by odometry alone.",
        ),
    ]
    if result.landmarks:
        drawing, factor = maps.landmark_map(result)
        points = any(m.kind == "point" for m in result.landmarks)
        lines = any(m.line is not None for m in result.landmarks)
        bounds = " and ".join(["ellipses"] * points + ["bars across the ends"] * lines)
        named = min(len(result.landmarks), maps.MAX_LABELS)
        which = "" if named == len(result.landmarks) else " of those seen most often"
        figures.append(
            figure(
                drawing,
                "Landmarks.",
                f"Numbers{which} as in landmarks.json; 95 % {bounds}{_times(factor)}.",
            )
        )
    drawing, factor = maps.trajectory_map(result)
    figures.append(
        figure(
            drawing,
            "Uncertainty of the trajectory.",
            f"95 % ellipses{_times(factor)}; a dot marks the start; "
            "the faint line is the causal estimate.",
        )
    )
    return section("Map", figures)


def _times(factor: int) -> str:
    return f" drawn {factor} times as large" if factor > 1 else " to scale"


def _quality_section(evaluation: Mapping[str, Any]) -> str:
    content = tables.quality(evaluation)
    return f"<section><h2>Against the truth</h2>{content}</section>" if content else ""


def _uncertainty_section(result: Result) -> str:
    return section(
        "Over time",
        [
            figure(
                plots.uncertainty(result),
                "Standard deviations.",
                "Final (strong) and causal (pale); position along its worst direction.",
            ),
            figure(
                plots.revision(result),
                "Final against causal.",
                "Distance of the causal estimate (solid) and of odometry alone (dashed) from the "
                "final trajectory: what later data changed.",
            ),
        ],
    )


def _estimator_section(result: Result) -> str:
    figures = []
    if any(len(values) for values in result.innovations.values()):
        figures.append(
            figure(
                plots.innovations(result.innovations),
                "Innovations.",
                "Normalised innovation squared per degree of freedom of accepted associations; "
                "with its running mean, in orange its expectation 1 and (dashed) 95 % quantile. "
                "A mean below 1 says that the stated noise is cautious; the gate cuts the tail.",
            )
        )
    if len(result.step_ms):
        p50, p99 = np.quantile(result.step_ms, [0.5, 0.99])
        figures.append(
            figure(
                plots.timing(result.step_ms),
                "Wall time per keyframe.",
                f"With its running median; p50 {tables.number(float(p50))} ms, "
                f"p99 {tables.number(float(p99))} ms, max "
                f"{tables.number(float(result.step_ms.max()))} ms.",
            )
        )
    return section("Estimator", figures) if figures else ""


def _accounting_section(summary: Mapping[str, Any]) -> str:
    parts = [
        tables.counts(summary),
        f"<div>{tables.reasons(summary)}</div>",
        f"<div>{tables.stages(summary)}</div>",
        tables.calibration(summary),
    ]
    content = "\n".join(part for part in parts if part)
    return f'<section><h2>Accounts</h2><div class="accounts">{content}</div></section>'


def _landmark_section(result: Result) -> str:
    if not result.landmarks:
        return ""
    return (
        f"<section><details><summary>All {tables.number(len(result.landmarks))} landmarks</summary>"
        f"{tables.landmarks(result.landmarks)}</details></section>"
    )


def _reproduce_section(result: Result) -> str:
    summary = result.summary
    logs = [
        (log["path"], log["messages"], log["lost"], log["sha256"])
        for log in summary.get("logs", [])
    ]
    versions = ", ".join(f"{name} {text}" for name, text in summary.get("versions", {}).items())
    paths = " ".join(str(log[0]) for log in logs)
    command = f"graphslam smooth {paths} -o DIR --config config.toml"
    parts = [
        "<section><details><summary>How to reproduce this</summary>",
        f"<p>With the config.toml beside this file: <code>{escape(command)}</code></p>",
        f"<p class=note>Versions: {escape(versions)}. Configuration sha256 "
        f"<code>{escape(str(summary.get('config_sha256', '–')))}</code></p>",
        tables.table(["log", "messages", "lost", "sha256"], logs),
        f"<pre>{escape(dump_config(result.config))}</pre>",
        "</details></section>",
    ]
    return "\n".join(parts)


def section(title: str, figures: Sequence[str]) -> str:
    """Figures side by side where there is room, under a heading."""
    return f'<section><h2>{title}</h2><div class="grid">{"".join(figures)}</div></section>'
