"""The output of the commands for people; --json uses none of it."""

import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from math import degrees
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from graphslam.core.geometry import area_centroid
from graphslam.core.records import Result
from graphslam.importers import ImportSummary
from graphslam.logs import LogInfo, RobotInfo, TopicInfo
from graphslam.logs.laser_noise import BeamNoise
from graphslam.results.metric_tables import evaluation_notes, evaluation_tables
from graphslam.results.report_comparison import (
    FILTER_WIN_HEADS,
    comparison_tables,
    filter_wins,
    headline,
    reading_notes,
)

if TYPE_CHECKING:
    from graphslam.simulation import Simulation

_MUCH = 1.5  # chi2/dof above it: the noise is larger than stated, or something is wrong
_PIPE_WIDTH = 200  # columns; output into a pipe has no width of its own


def log_info(info: LogInfo, *, same_place: bool = False) -> None:
    """Files, topics and robots, warnings, and whether the log can be smoothed.

    ``same_place``: the files are sessions.
    """
    console = make_console()
    for file in info.files:
        lost = "an unknown number" if file.lost is None else _number(file.lost)
        damage = "" if file.lost == 0 else f", {lost} lost"
        console.print(f"{file.path}: {_number(file.messages)} messages{damage}")
    for name, text in info.notes.items():
        console.print(f"  {name}: {text}")
    console.print(_span(info.topics))
    console.print()
    head = ["topic", "schema", "robot", "used", "messages", "Hz", "gaps", "time jumps back"]
    console.print(make_table(head, map(_topic_row, info.topics), texts=4))
    for topic in info.topics:
        if topic.scan is not None:
            console.print(f"{topic.name}: {_scan(topic)}")
    head = ["robot", "odometry", "path, m", "turning, deg", "mean m/s", "top m/s", "reverses"]
    console.print()
    console.print(make_table(head, map(_robot_row, info.robots), texts=2))
    _reasons(console, "dropped", info.dropped)
    for finding in info.findings:
        kind = {"note": "note", "doubt": "warning", "unusable": "not usable"}[finding.severity]
        # a problem of the log as a whole says itself where it is
        where = f"{finding.topic}: " if finding.topic else ""
        console.print(f"{kind}: {where}{finding.text}")
        if finding.remedy:
            console.print("  " + "to mend it: " * (finding.severity != "note") + finding.remedy)
    if info.usable:
        names = " ".join(str(file.path) for file in info.files)
        doubts = " with doubts" if info.doubtful else ""
        sessions = " --same-place" if same_place else ""
        console.print(f"usable{doubts}: graphslam smooth {names}{sessions} -o DIR")


def imported(done: ImportSummary) -> None:
    """The log, its messages per topic, warnings."""
    console = make_console()
    console.print(f"{done.target}: {_number(sum(done.counts.values()))} messages")
    for topic, count in sorted(done.counts.items()):
        console.print(f"  {topic}: {_number(count)}")
    for warning in done.warnings:
        console.print(f"warning: {warning}")


def simulation(done: "Simulation") -> dict[str, Any]:
    """What ``simulate --json`` prints."""
    return {
        "scenario": done.scenario,
        "seed": done.seed,
        "target": str(done.target),
        "counts": dict(done.counts),
        "changed_cells": done.changed_cells,
        "recordings": [
            {
                "path": str(recording.path),
                "robots": {name: asdict(facts) for name, facts in recording.robots.items()},
            }
            for recording in done.recordings
        ],
    }


def simulated(done: "Simulation") -> None:
    """The logs, the drive of each robot, and the error of its dead reckoning at the end."""
    console = make_console()
    head = ["log", "robot", "path, m", "s", "scans", "sightings", "dead reckoning ends off, m"]
    rows = [
        (
            str(recording.path),
            name,
            facts.path_m,
            facts.duration_s,
            facts.scans,
            facts.sightings,
            facts.dead_reckoning_end_m,
        )
        for recording in done.recordings
        for name, facts in recording.robots.items()
    ]
    console.print(make_table(head, rows, texts=2))
    if done.changed_cells:
        console.print(f"{done.changed_cells} changed cells in {done.target / 'truth.json'}")


def smoothed(result: Result, directory: Path) -> None:
    """A line on the run, what was rejected or dropped and why, and where the report is."""
    console, summary, robots = make_console(), result.summary, len(result.robots)
    counts = summary["counts"]
    parts = [_counted(robots, "robot")]
    parts += [
        _counted(counts[key], key.replace("_", " ").removesuffix("s"))
        for key in ("scans", "keyframes", "landmarks", "loop_closures")
        if counts[key]
    ]
    console.print(f"{', '.join(parts)}; {summary['stages']['all']:.1f} s")
    if summary["real_time_factor"] is None:  # the stamps are invented
        console.print(f"stamps: {summary['notes']['stamps']}")
    for robot, found in summary["clocks"].items():
        console.print(f"clock of {robot}: {_clock(found)}")
    console.print(summary_line(result))
    _reasons(console, "rejected", summary["rejected"])
    _reasons(console, "dropped", summary["dropped"])
    _unobservable(console, summary["calibration"])
    for warning in summary["warnings"]:
        console.print(f"warning: {warning}")
    for fact in summary["verdict"].get("facts", ()):
        console.print(f"note: {fact['text']}")
    for reason in summary["verdict"]["reasons"]:
        console.print(f"{reason['level']}: {reason['text']}")
    console.print(f"verdict: {summary['verdict']['verdict']}")
    console.print(f"report: {directory / 'report.html'}")


def summary_line(result: Result) -> Text:
    """How sure, how consistent and how fast; bold and coloured on a terminal that wants colours."""
    from graphslam.results.report_html import length
    from graphslam.results.report_tables import median_sigma

    graph, text = result.summary["graph"], Text()
    sigma, parts = median_sigma(result), []
    if sigma is not None:
        parts.append((length(sigma), "median position sigma", "bold cyan"))
    if graph["dof"] > 0:
        # twice the error is chi-square where the noise is as stated
        ratio = 2 * graph["error"] / graph["dof"]
        good = ratio < _MUCH
        parts.append((f"{ratio:.2f}", "chi2/dof", "bold green" if good else "bold yellow"))
    factor = result.summary["real_time_factor"]
    if factor is not None:
        parts.append((f"{factor:.3g} x", "real time", "bold cyan" if factor > 1 else "bold yellow"))
    for i, (number, name, style) in enumerate(parts):
        text.append(", " if i else "").append(number, style).append(f" {name}")
    return text


def _unobservable(console: Console, calibration: Mapping[str, Any]) -> None:
    """The calibration parameters that are not observable in this log."""
    names = [name for name, p in calibration.items() if not p["observable"] and p["sigma"] > 0]
    if names:
        console.print(f"calibration: not observable in this log: {', '.join(names)}")


def _clock(found: Mapping[str, Any]) -> str:
    """Offset and drift of a clock against the first robot's, and whether they were corrected."""
    if not found["observable"]:
        return "not observable: too few sightings between moving robots"
    text = f"{found['offset_s']:+.3f} ± {found['offset_sigma_s']:.3f} s"
    text += f", {found['drift_ppm']:+.0f} ± {found['drift_sigma_ppm']:.0f} ppm"
    return f"{text}; {'corrected' if found['applied'] else 'not significant, not applied'}"


def mapped(made: Mapping[str, Any], directory: Path) -> None:
    """The size of the grid map, and where the files are."""
    console, grid = make_console(), made["grid"]
    if grid is None:
        console.print("no scans, so there is no grid map")
    else:
        width, height = (grid["resolution_m"] * grid[side] for side in ("columns", "rows"))
        console.print(
            f"grid map: {width:.1f} x {height:.1f} m, cells of {_number(grid['resolution_m'])} m, "
            f"{_number(grid['occupied'])} occupied, {_number(grid['free'])} free"
        )
    if made["verdict"] in ("doubtful", "bad"):
        console.print(f"warning: the verdict on the result is {made['verdict']}: see its report")
    console.print(f"in {directory}: {', '.join(made['files'])}")


def evaluation(errors: Mapping[str, Any]) -> None:
    """Tables of errors: trajectories, relations, landmarks, as far as they were compared."""
    console = make_console()
    for _, heads, rows in evaluation_tables(errors):
        console.print(make_table(heads, rows, texts=2))
    for text in evaluation_notes(errors):
        console.print(text)
    landmarks = errors.get("landmarks", {})
    if worst := landmarks.get("worst"):
        console.print(
            f"largest NEES/dof: {worst['nees_per_dof']:.3g}, landmark {worst['id']}, "
            f"{worst['error_m']:.3g} m off"
        )
    for a, b in landmarks.get("exchanged", ()):
        console.print(f"landmarks {a} and {b} have each other's names; matched by position")
    if "relations" in errors and not errors["relations"]["all"]["n"]:
        console.print("warning: no scan has the stamps of a relation, to the nanosecond")


def stage(text: str) -> None:
    """Print on stderr what is done now, if it is a terminal."""
    if sys.stderr.isatty():
        Console(stderr=True, markup=False, highlight=False).print(f"{text} ...")


def comparison(found: Mapping[str, Any], directory: Path) -> None:
    """Tables with a star at the best of each column; then what failed."""
    console = make_console()
    console.print(headline(found))
    for title, (heads, rows) in comparison_tables(found).items():
        lines = [
            (row["label"], *(f"{_number(value)}{' *'[best]}" for value, best in cells))
            for row, cells in zip(found["rows"], rows, strict=True)
            if cells
        ]
        console.print()
        console.print(title)
        console.print(make_table(["", *heads], lines))
    if won := filter_wins(found):
        console.print("\nWhere a filter is ahead of every smoother")
        console.print(
            make_table(["", *FILTER_WIN_HEADS[1:]], [tuple(map(_number, row)) for row in won])
        )
    console.print()
    for text in ("* best of its column.", *reading_notes(found)):
        console.print(text)
    for warning in found["warnings"]:
        console.print(f"warning: {warning}")
    for row in found["rows"]:
        if row["error"]:
            console.print(f"failed: {row['label']}: {row['error']}")
    console.print(f"report: {directory / 'report.html'}")


def changes(found: Mapping[str, Any], directory: Path) -> None:
    """The changes, the beams compared and flagged, and where the report is."""
    console = make_console()
    compared, flagged = found["beams_compared"], found["beams_flagged"]
    console.print(
        f"{_number(compared)} beams compared, {100 * flagged / max(compared, 1):.2f} % flagged; "
        f"{100 * found['false_alarm_rate_requested']:g} % are expected where nothing changed"
    )
    rows = []
    for change in found["changes"]:
        polygon = np.array(change["polygon"])
        size = np.ptp(polygon, axis=0).tolist()
        moved = change["displacement"]
        rows.append(
            (
                change["kind"],
                *(f"{value:.2f}" for value in area_centroid(polygon)),
                *size,
                change["probability"],
                None if moved is None else degrees(moved["phi"]),
                change["beams"],
            )
        )
    head = ["change", "x, m", "y, m", "size x, m", "size y, m", "probability", "turned, deg"]
    if rows:
        console.print(make_table([*head, "beams"], rows))
    else:
        console.print("no change was found where both visits observed")
    for warning in found["warnings"]:
        console.print(f"warning: {warning}")
    console.print(f"report: {directory / 'report.html'}")


def experiment(found: Mapping[str, Any], directory: Path) -> None:
    """A line per variant and noise scale, what failed, and where the report is."""
    from graphslam.results.report_experiment import coverage

    console = make_console()
    if found["kind"] == "chapter":
        _chapter(console, found)
        console.print(f"report: {directory / 'report.html'}")
        return
    rows = []
    for row in found["table"]:
        name = " ".join(str(row[key]) for key in ("scenario", "front_end", "variant") if key in row)
        cells = [name, row["scale"], row["runs"], row["failed"], row.get("diverged")]
        if "nees_per_dof" in row:
            low, high = row["nees_bounds"]
            cells += [row["nees_per_dof"], f"{low:.3f}..{high:.3f}", row["nees_verdict"]]
            cells += [row[kind]["position_m2"]["over_bound"] for kind in ("final", "causal")]
        elif "final" in row:
            cells += [row[k]["ate_rmse_m"]["mean"] for k in ("final", "causal")]
            cells += [row[k]["nees_per_dof"]["mean"] for k in ("final", "causal")]
            cells += [coverage(row, k) for k in ("final", "causal", "landmarks")]
        rows.append(cells)
    head = ["", "noise", "runs", "failed", "diverged"]
    if found["kind"] == "bench":
        head += ["NEES/dof", "bounds", "", "RMSE/bound", "causal RMSE/bound"]
    else:
        head += ["ATE, m", "causal ATE, m", "NEES/dof", "causal NEES/dof", "coverage, %"]
        head += ["causal", "landmarks"]
    console.print(make_table(head, [(*row, *[None] * (len(head) - len(row))) for row in rows]))
    console.print(f"diverged: {found['diverged_if']}")
    for text, count in found["errors"].items():
        console.print(f"failed {count} times: {text}")
    for warning in found["warnings"]:
        console.print(f"warning: {warning}")
    console.print(f"report: {directory / 'report.html'}")


def _chapter(console: Console, found: Mapping[str, Any]) -> None:
    """The thesis' experiments: a table each, and what failed."""
    from graphslam.evaluation.thesis_chapter import table_rows

    for experiment in found["chapter"].values():
        head, lines = table_rows(experiment)
        console.print(experiment["title"])
        console.print(make_table(head, lines))
    for warning in found["warnings"]:
        console.print(f"warning: {warning}")


def make_console() -> Console:
    """A console for plain text: names of topics may look like markup."""
    width = None if sys.stdout.isatty() else _PIPE_WIDTH
    return Console(width=width, markup=False, highlight=False, emoji=False, soft_wrap=True)


def make_table(head: Sequence[str], rows: Iterable[Sequence[object]], texts: int = 1) -> Table:
    """A table without borders; all but the first ``texts`` columns are right-aligned."""
    table = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False, header_style="bold")
    for column, name in enumerate(head):
        table.add_column(name, justify="left" if column < texts else "right", overflow="fold")
    for row in rows:
        table.add_row(*map(_number, row))
    return table


def _number(value: object) -> str:
    """Text of a cell: integers in groups of three, other numbers with at least three digits."""
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}".replace(",", " ")
    if isinstance(value, float):
        return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"
    return str(value)


def _counted(count: int, noun: str) -> str:
    return f"{_number(count)} {noun}{'s' * (count != 1)}"


def _topic_row(topic: TopicInfo) -> tuple[object, ...]:
    return (
        topic.name,
        topic.schema,
        topic.robot,
        topic.used,
        topic.count,
        topic.rate_hz,
        len(topic.gaps),
        topic.jumps_back,
    )


def _robot_row(robot: RobotInfo) -> tuple[object, ...]:
    return (
        robot.name,
        robot.odometry,
        robot.path_m,
        None if robot.turning_rad is None else degrees(robot.turning_rad),
        robot.speed_m_s,
        robot.top_speed_m_s,
        robot.reverses,
    )


def _scan(topic: TopicInfo) -> str:
    """The laser in one line."""
    assert topic.scan is not None  # only called for topics with scans
    scan = topic.scan
    parts = [
        f"{scan.beams} beams over {degrees(scan.field_of_view_rad):.0f} deg",
        f"range {_number(scan.range_min_m)} to {_number(scan.range_max_m)} m",
    ]
    if topic.dropouts is not None:
        parts.append(f"{100 * topic.dropouts:.1f} % of the beams without a range")
    if topic.range_noise is not None:
        parts.append(f"noise {_noise(topic.range_noise)}")
    return ", ".join(parts)


def _noise(noise: BeamNoise) -> str:
    """White noise of ranges."""
    grows = f" and {100 * noise.ratio:.1f} % of the range" if noise.ratio else ""
    return f"{1000 * noise.sigma_m:.0f} mm{grows}"


def _span(topics: Sequence[TopicInfo]) -> str:
    """Duration and start, UTC, over all topics."""
    times = [t for topic in topics for t in (topic.first_ns, topic.last_ns) if t is not None]
    if not times:
        return "no time"
    start = datetime.fromtimestamp(min(times) // 10**9, UTC)
    return f"{(max(times) - min(times)) * 1e-9:.1f} s from {start:%Y-%m-%d %H:%M:%S} UTC"


def _reasons(console: Console, what: str, reasons: Mapping[str, int]) -> None:
    for reason, count in sorted(reasons.items(), key=lambda item: (-item[1], item[0])):
        if reason == "range: no return":  # is no loss
            console.print(f"no return: {_number(count)} beams")
        else:
            console.print(f"{what}: {_number(count)} {reason}")
