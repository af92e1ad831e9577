"""Tables, growth exponents and the gate of `speed.py`, from what was measured (its JSON).

``measured["groups"][GROUP][JOB]`` has `what` and `runs`, and `absent` or `failed` with a reason.
Each run has wall_s, cpu_s, peak_mb, those of the yardstick just before it, and more by group.
"""

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

#: by how much a cost may grow over the baseline before the gate fails
TOLERANCE = 1.2
#: s of the yardstick, wall and CPU, at which the bars hold as they stand; elsewhere they are scaled
YARDSTICK_S = 2.0
#: job -> what a whole command may cost at most: wall s, CPU s, MB
BARS: dict[str, dict[str, float]] = {
    "help": {"wall_s": 0.4},
    "lab": {"wall_s": 2.5},
    "intel": {"wall_s": 10.0, "cpu_s": 14.0, "peak_mb": 400.0},
    "aces": {"wall_s": 5.0},
    "mrclam6": {"wall_s": 9.0},
    "mrclam6-truth": {"wall_s": 9.0},
    "building": {"wall_s": 35.0, "peak_mb": 600.0},
    "grid": {"wall_s": 4.0},
}

Measured = Mapping[str, Any]


@dataclass(frozen=True)
class Cost:
    """The least cost of some runs, how far they are spread, and the same over the yardstick.

    Spreads are those of wall and CPU time, largest over least less one. Ratios are the median of
    each run's time over that of the yardstick just before it: the least of either, which is of
    different moments, would compare a job with a yardstick that met a fast one.
    """

    wall_s: float
    cpu_s: float
    peak_mb: float
    wall_spread: float
    cpu_spread: float
    wall_ratio: float
    cpu_ratio: float


def cost(runs: Sequence[Measured]) -> Cost:
    """Cost of the runs of one job."""
    wall, cpu = ([run[key] for run in runs] for key in ("wall_s", "cpu_s"))
    return Cost(
        min(wall),
        min(cpu),
        min(run["peak_mb"] for run in runs),
        max(wall) / min(wall) - 1,
        max(cpu) / min(cpu) - 1,
        median(run["wall_s"] / run["yardstick_wall_s"] for run in runs),
        median(run["cpu_s"] / run["yardstick_cpu_s"] for run in runs),
    )


def costs(measured: Measured, group: str) -> dict[str, Cost]:
    """Cost of each job of a group that ran."""
    entries = measured["groups"].get(group, {})
    return {name: cost(entry["runs"]) for name, entry in entries.items() if entry["runs"]}


def exponents(values: Mapping[int, float]) -> dict[int, float]:
    """By size: the exponent with which a cost grew since half of that size.

    1 where it grows like the size, 2 like its square; only for sizes whose half was measured.
    """
    return {
        size: math.log2(value / values[size / 2])
        for size, value in values.items()
        if size / 2 in values
    }


# ---------------------------------------------------------------- gate


def baseline_of(measured: Measured) -> dict[str, dict[str, float]]:
    """What the gate compares: of each whole command its ratios to the yardstick and its memory."""
    return {
        name: {"wall_ratio": c.wall_ratio, "cpu_ratio": c.cpu_ratio, "peak_mb": c.peak_mb}
        for group in ("jobs", "laps", "robots")
        for name, c in costs(measured, group).items()
    }


def failures(measured: Measured) -> list[str]:
    """One line for each job whose command failed."""
    return [
        f"{name}: failed, {entry['failed']}"
        for group in measured["groups"].values()
        for name, entry in group.items()
        if "failed" in entry
    ]


def regressions(
    now: Mapping[str, Mapping[str, float]], baseline: Mapping[str, Mapping[str, float]]
) -> list[str]:
    """One line for each cost that is more than `TOLERANCE` times that of the baseline.

    Jobs that are in one of the two only are not compared.
    """
    return [
        f"{name}: {key} {now[name][key]:.3g} is {now[name][key] / limit:.2f} times the baseline's"
        for name, limits in baseline.items()
        if name in now
        for key, limit in limits.items()
        if now[name][key] > TOLERANCE * limit
    ]


def bars_missed(found: Cost, bars: Mapping[str, float]) -> list[str]:
    """Which bars are not held; times are scaled by how much the yardstick takes here."""
    scaled = {
        "wall_s": found.wall_ratio * YARDSTICK_S,
        "cpu_s": found.cpu_ratio * YARDSTICK_S,
        "peak_mb": found.peak_mb,
    }
    return [key for key, limit in bars.items() if scaled[key] > limit]


# ---------------------------------------------------------------- tables


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table; columns of numbers are right-aligned."""
    numbers = [
        all(re.fullmatch(r"[-\d.% ]*", row[column]) for row in rows) for column in range(len(head))
    ]
    lines = [head, ["---:" if number else "---" for number in numbers], *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def machine_table(measured: Measured) -> str:
    """Machine, versions and the yardstick's own seconds, least of all runs."""
    described = "; ".join(
        ", ".join(f"{key} {value}" for key, value in measured[part].items())
        for part in ("machine", "versions")
    )
    runs = measured["yardstick"]
    parts = list(runs[0]["wall_s"]) if runs else []
    rows = [
        [
            kind,
            *(f"{min(run[key][part] for run in runs):.2f}" for part in parts),
            f"{max(run[key]['all'] for run in runs):.2f}",
        ]
        for kind, key in (("wall s", "wall_s"), ("CPU s", "cpu_s"))
        if runs
    ]
    return (
        f"{measured['made']}, runs of each: {measured['repeats']}; {described}.\n\n"
        f"{table(['yardstick', *parts, 'slowest'], rows)}"
    )


def jobs_table(measured: Measured) -> str:
    """Whole commands: seconds, ratios to the yardstick, memory, error, and their bars."""
    head = ["job", "log", *SECONDS, "MB", "error, m", "bar"]
    rows = []
    for name, entry in measured["groups"].get("jobs", {}).items():
        if not entry["runs"]:
            rows.append(_not_measured(head, name, entry))
            continue
        found, bars = cost(entry["runs"]), BARS.get(name, {})
        missed = bars_missed(found, bars)
        rows.append(
            [
                name,
                entry["what"],
                *_seconds(found),
                f"{found.peak_mb:.0f}",
                _error(entry["runs"][0]),
                ", ".join(
                    f"{UNITS[key].format(limit)} {'missed' if key in missed else 'held'}"
                    for key, limit in bars.items()
                ),
            ]
        )
    return table(head, rows)


SECONDS = ("wall s", "spread", "CPU s", "spread", "wall / Y", "CPU / Y")
UNITS = {"wall_s": "{:g} s", "cpu_s": "{:g} CPU s", "peak_mb": "{:g} MB"}


def _seconds(found: Cost) -> list[str]:
    """The columns `SECONDS`."""
    return [
        f"{found.wall_s:.2f}",
        f"{found.wall_spread:.0%}",
        f"{found.cpu_s:.2f}",
        f"{found.cpu_spread:.0%}",
        f"{found.wall_ratio:.2f}",
        f"{found.cpu_ratio:.2f}",
    ]


def _not_measured(head: Sequence[str], name: str, entry: Measured) -> list[str]:
    """A row with the reason why a job has no run in its last column."""
    reason = entry.get("absent") or f"failed, {entry['failed']}"
    return [name, *[""] * (len(head) - 2), str(reason)]


def _error(run: Measured) -> str:
    error = run.get("error_m")
    return "" if error is None else f"{error:.4f}"


def stages_table(measured: Measured) -> str:
    """Wall seconds of each job's stages, from the fastest of its runs; the rest is not in them."""
    best = {
        name: min(entry["runs"], key=lambda run: run["wall_s"])
        for name, entry in measured["groups"].get("jobs", {}).items()
        if entry["runs"] and "stages" in entry["runs"][0]
    }
    names = sorted({stage for run in best.values() for stage in run["stages"]} - {"all"})
    rows = [
        [
            job,
            *(f"{run['stages'][stage]:.2f}" if stage in run["stages"] else "" for stage in names),
            f"{run['stages']['all']:.2f}",
            f"{run['wall_s'] - run['stages']['all']:.2f}",
        ]
        for job, run in best.items()
    ]
    return table(["job", *names, "all", "around it"], rows)


def scaling_table(measured: Measured, group: str) -> str:
    """Costs by length, and the exponents of CPU time and memory at each doubling."""
    head = ["rounds", "keyframes", *SECONDS, "exponent", "MB", "exponent", "error, m"]
    entries = measured["groups"].get(group, {})
    ran = {int(entry["what"]): entry["runs"] for entry in entries.values() if entry["runs"]}
    found = {size: cost(runs) for size, runs in ran.items()}
    cpu = exponents({size: c.cpu_s for size, c in found.items()})
    memory = exponents({size: c.peak_mb for size, c in found.items()})

    def exponent(of: Mapping[int, float], size: int) -> str:
        return f"{of[size]:.2f}" if size in of else ""

    rows = [
        [
            str(size),
            str(ran[size][0]["keyframes"]),
            *_seconds(c),
            exponent(cpu, size),
            f"{c.peak_mb:.0f}",
            exponent(memory, size),
            _error(ran[size][0]),
        ]
        for size, c in found.items()
    ]
    rows += [
        _not_measured(head, entry["what"], entry) for entry in entries.values() if not entry["runs"]
    ]
    return table(head, rows)


def steps_table(measured: Measured) -> str:
    """Milliseconds per keyframe: quantiles, means of all and of either end; growth; over ekf's."""
    keys = ("p50_ms", "p99_ms", "max_ms", "mean_ms", "first_fifth_ms", "last_fifth_ms")
    entries = measured["groups"].get("steps", {})
    means = {
        name: min(run["mean_ms"] for run in entry["runs"])
        for name, entry in entries.items()
        if entry["runs"]
    }
    head = ["back end", "log", "keyframes", "p50", "p99", "max", "mean", "first fifth",
            "last fifth", "last / first", "mean / ekf"]  # fmt: skip
    rows = []
    for name, entry in entries.items():
        if not (runs := entry["runs"]):
            rows.append(_not_measured(head, name, entry))
            continue
        numbers = [f"{min(run[key] for run in runs):.1f}" for key in keys]
        growth = min(run["last_fifth_ms"] / run["first_fifth_ms"] for run in runs)
        of_ekf = f"{means[name] / means['ekf']:.2f}" if "ekf" in means else ""
        keyframes = str(runs[0]["keyframes"])
        rows.append([name, entry["what"], keyframes, *numbers, f"{growth:.2f}", of_ekf])
    return table(head, rows)


def peers_table(measured: Measured) -> str:
    """Bare loops of other solvers."""
    head = ["solver and graph", "vertices", "factors", "error", *SECONDS, "MB"]
    rows = []
    for name, entry in measured["groups"].get("peers", {}).items():
        if not (runs := entry["runs"]):
            rows.append(_not_measured(head, name, entry))
            continue
        found = cost(runs)
        sizes = [str(runs[0][key]) for key in ("vertices", "factors")]
        rows.append(
            [name, *sizes, f"{runs[0]['error']:.1f}", *_seconds(found), f"{found.peak_mb:.0f}"]
        )
    return table(head, rows)


#: section of the page -> its table
SECTIONS: dict[str, Callable[[Measured], str]] = {
    "machine": machine_table,
    "jobs": jobs_table,
    "stages": stages_table,
    "laps": lambda measured: scaling_table(measured, "laps"),
    "robots": lambda measured: scaling_table(measured, "robots"),
    "steps": steps_table,
    "peers": peers_table,
}


def tables(measured: Measured) -> Iterator[str]:
    """Every table of which something was measured, with its name."""
    for name, make in SECTIONS.items():
        if name == "machine" or ("jobs" if name == "stages" else name) in measured["groups"]:
            yield f"{name}\n\n{make(measured)}\n"


def with_tables(page: str, measured: Measured) -> str:
    """A Markdown page with its tables made anew, each between two comments.

    Tables of groups that were not measured stay as they are.

    Raises:
        ValueError: a comment names a table that there is not.
    """

    def made(found: re.Match[str]) -> str:
        name = found[1]
        if name not in SECTIONS:
            raise ValueError(f"no table {name!r}; known: {', '.join(SECTIONS)}")
        if name != "machine" and ("jobs" if name == "stages" else name) not in measured["groups"]:
            return found[0]
        return f"<!-- speed: {name} -->\n{SECTIONS[name](measured)}\n<!-- end -->"

    return re.sub(r"<!-- speed: (\w+) -->\n.*?<!-- end -->", made, page, flags=re.S)
