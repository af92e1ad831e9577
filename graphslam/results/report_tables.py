# ruff: noqa: RUF001 -- σ, × and – are meant: people read them
"""Tables of the report of a result: counts, reasons, times, calibration, errors, landmarks."""

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from graphslam.core.geometry import area_centroid
from graphslam.core.records import Landmark, Result
from graphslam.results.metric_tables import evaluation_notes, evaluation_tables
from graphslam.results.report_html import counted, duration, length, number, table


def headline(result: Result) -> str:
    """One sentence on the input, the result, its uncertainty and the speed."""
    counts = result.summary.get("counts", {})
    robots = len(result.robots)
    fleet = "one robot" if robots == 1 else f"{robots} robots"
    paths = [robot.final for robot in result.robots.values()]
    metres = sum(robot.driven_m for robot in result.robots.values())
    span = (max(p.stamps_ns[-1] for p in paths) - min(p.stamps_ns[0] for p in paths)) / 1e9
    source = f"{counted(counts['scans'], 'scan')} of {fleet}" if counts.get("scans") else fleet
    kinds = {landmark.kind for landmark in result.landmarks}
    kind = {frozenset({"point"}): "point ", frozenset({"line"}): "line "}.get(frozenset(kinds), "")
    parts = [
        f"From {source} over {number(float(metres))} m and {duration(float(span))}: "
        f"{counted(counts.get('keyframes', 0), 'keyframe')} and "
        f"{counted(len(result.landmarks), kind + 'landmark')}"
    ]
    if counts.get("loop_closures"):
        parts.append(f", {counted(counts['loop_closures'], 'loop closure')}")
    sigma = median_sigma(result)
    if sigma is not None:
        parts.append(f"; position known to {length(sigma)} (median 1σ)")
    factor = result.summary.get("real_time_factor")
    if factor:
        parts.append(f", computed {number(factor, 2)} times faster than real time")
    return "".join(parts) + "."


def median_sigma(result: Result) -> float | None:
    """Median over all final poses of the position's larger standard deviation, m."""
    covs = np.concatenate([robot.final.covs[:, :2, :2] for robot in result.robots.values()])
    covs = covs[np.isfinite(covs).all(axis=(1, 2))]
    if not len(covs):
        return None
    return float(np.sqrt(np.median(np.maximum(np.linalg.eigvalsh(covs)[:, -1], 0.0))))


def counts(summary: Mapping[str, Any]) -> str:
    """Counts of messages, keyframes and landmarks; error and degrees of freedom of the graph."""
    rows = [(name.replace("_", " "), value) for name, value in summary.get("counts", {}).items()]
    graph = summary.get("graph", {})
    if graph:
        rows += [("graph error (½ χ²)", float(graph["error"])), ("graph dof", graph["dof"])]
    return table(["count", ""], rows, "Counts")


def session_changes(summary: Mapping[str, Any]) -> str:
    """What changed from each session to the next one; empty if there are no sessions."""
    found = summary.get("sessions", {}).get("changes", ())
    rows: list[Sequence[object]] = []
    for one in found:
        name = f"{one['session']}, since {one['since']}"
        rows += [(name, *_change(change)) for change in one["changes"]]
        if not one["changes"]:
            rows.append((name, "nothing", "", "", ""))
    heads = ["session", "what", "where", "size", "probability"]
    return table(heads, rows, "What changed between the sessions") if rows else ""


def _change(change: Mapping[str, Any]) -> tuple[str, str, str, str]:
    """What, where in the map, of what size, and how probable."""
    corners = np.array(change["polygon"])
    x, y = area_centroid(corners).tolist()
    width, height = np.ptp(corners, axis=0).tolist()
    return (
        change["kind"], f"({x:.1f}, {y:.1f}) m", f"{width:.1f} × {height:.1f} m",
        f"{change['probability']:.3f}",
    )  # fmt: skip


def reasons(summary: Mapping[str, Any]) -> str:
    """Rejected observations and dropped data by reason; also where there are none."""
    parts = []
    for key, caption in (("rejected", "Observations rejected"), ("dropped", "Data dropped")):
        found = sorted(summary.get(key, {}).items(), key=lambda item: (-item[1], item[0]))
        rows = found or [("nothing", 0)]
        parts.append(table(["reason", "n"], rows, caption))
    return "\n".join(parts)


def stages(summary: Mapping[str, Any]) -> str:
    """Seconds per stage with a bar each."""
    found = {name: float(value) for name, value in summary.get("stages", {}).items()}
    found = dict(sorted(found.items(), key=lambda item: -item[1]))
    longest = max(found.values(), default=0.0) or 1.0
    rows = "".join(
        f'<tr><th scope="row">{escape(name)}</th><td>{number(value)}</td>'
        f'<td class="bar"><i style="width:{100 * value / longest:.1f}%"></i></td></tr>\n'
        for name, value in found.items()
    )
    memory = summary.get("peak_memory_mb")
    note = f"<p class=note>Peak memory {number(float(memory))} MB.</p>" if memory else ""
    return (
        '<div class="scroll"><table><caption>Time per stage</caption><thead><tr>'
        '<th scope="col">stage</th><th scope="col">s</th><th></th></tr></thead>\n'
        f"<tbody>{rows}</tbody></table></div>{note}"
    )


#: ends of the names of parameters -> their units
_UNITS = {"_rad_per_m": "rad/m", "_m2": "m²", "_m": "m", "_rad": "rad", "_s": "s"}


def calibration(summary: Mapping[str, Any], robots: Sequence[str]) -> str:
    """Calibrated parameters, a column for each robot; empty text where there are none.

    What is fixed for all of them is named below.
    """
    found = summary.get("calibration", {})
    names = dict.fromkeys(name.removeprefix(f"{r}.") for r in robots for name in found
                          if name.startswith(f"{r}."))  # fmt: skip
    cells = {n: [_calibrated(found.get(f"{r}.{n}")) for r in robots] for n in names}
    rows = [(_parameter(n), *texts) for n, texts in cells.items() if set(texts) != {"fixed"}]
    fixed = [_parameter(n) for n, texts in cells.items() if set(texts) == {"fixed"}]
    note = f"<p class=note>Fixed: {escape('; '.join(fixed))}.</p>" if fixed else ""
    heads = ["parameter", *(robots if len(robots) > 1 else ["value ± σ"])]
    caption = "Calibration" if len(robots) == 1 else "Calibration: value ± σ"
    return (table(heads, rows, caption) if rows else "") + note


def _parameter(name: str) -> str:
    """The name of a parameter with its unit: drift, rad/m."""
    for end, unit in _UNITS.items():
        if name.endswith(end):
            return f"{name.removesuffix(end).replace('_', ' ')}, {unit}"
    return name.replace("_", " ")


def _calibrated(found: Mapping[str, Any] | None) -> str:
    if found is None:
        return "–"
    if found["observable"]:
        return f"{found['value']:.4f} ± {found['sigma']:.4f}"
    return "not observable" if found["sigma"] else "fixed"


def landmarks(found: Sequence[Landmark]) -> str:
    """Every landmark with its position and uncertainty."""
    rows = [
        [
            str(m.id),
            m.kind,
            m.identity or "",
            f"{m.position[0]:.3f}",
            f"{m.position[1]:.3f}",
            "–" if m.line is None else f"{np.degrees(m.position[2]):.2f}",
            "–" if m.line is None else f"{np.hypot(*(m.extent[1] - m.extent[0])):.2f}",
            100 * landmark_sigma(m),
            m.sightings,
        ]
        for m in found
    ]
    head = ["no", "kind", "identity", "x, m", "y, m", "heading, °", "length, m", "σ, cm", "seen"]
    return table(head, rows)


def landmark_sigma(landmark: Landmark) -> float:
    """Standard deviation, m: of a point in its worst direction, of a line across its middle.

    At ``t`` along the line its normal offset varies as offset error - t * direction error.
    """
    if landmark.line is None:
        variance = float(np.linalg.eigvalsh(landmark.cov[:2, :2])[-1])
    else:
        normal, _, cov = landmark.line
        t = float(landmark.extent.mean(axis=0) @ np.array([-np.sin(normal), np.cos(normal)]))
        a = np.array([-t, 1.0])
        variance = float(a @ cov @ a)
    return float(np.sqrt(max(variance, 0.0)))


def quality(evaluation: Mapping[str, Any]) -> str:
    """Errors against truth and relations, as far as there are any, and what they mean in words."""
    notes = (f"<p class=note>{escape(text)}</p>" for text in evaluation_notes(evaluation))
    tables = (
        table(
            [heads[0], *heads[2:]],
            [(", ".join(filter(None, row[:2])), *row[2:]) for row in rows],
            title,
        )
        for title, heads, rows in evaluation_tables(evaluation)
    )
    return "\n".join([*tables, *notes])
