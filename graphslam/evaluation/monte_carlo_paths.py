"""Paths of the runs of an experiment: kept in its rows, put together for the maps of its report."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import PurePath
from typing import Any

import numpy as np

from graphslam.core.geometry import Array
from graphslam.evaluation.monte_carlo_definition import Bench, Definition
from graphslam.results.live_runs import RunPath, RunsMap
from graphslam.simulation import load_scenario
from graphslam.simulation.scenario import ScenarioError
from graphslam.simulation.world import outlines_of

Row = Mapping[str, Any]

#: positions kept of a path; runs of a variant that a map shows
MAX_POSITIONS, MAX_RUNS = 60, 20
_CIRCLE = np.linspace(0.0, 2 * np.pi, 25)


def path_columns(time_s: Array, estimate: Array, truth: Array) -> dict[str, Any]:
    """A path as plain numbers for a row: times (n,), positions (n, 2) and true ones, thinned.

    Positions are rounded to a tenth of a millimetre, times to a millisecond.
    """
    last = len(time_s) - 1
    chosen = np.unique(np.linspace(0, last, min(MAX_POSITIONS, last + 1)).round().astype(np.int64))
    return {
        "time_s": time_s[chosen].round(3).tolist(),
        "estimate": estimate[chosen, :2].round(4).tolist(),
        "truth": truth[chosen, :2].round(4).tolist(),
    }


def run_maps(definition: Definition, rows: Sequence[Row]) -> list[RunsMap]:
    """A map of each scenario and front end, or of the bench, at the first noise scale.

    Rows without paths (of runs that failed, of an earlier version) are left out, and maps without
    any.
    """
    scale = definition.noise_scales[0]
    known = [row for row in rows if row.get("paths") and row["scale"] == scale]
    found: list[RunsMap] = []
    for scenario, front_end in dict.fromkeys((row["scenario"], row["front_end"]) for row in known):
        chosen = [r for r in known if (r["scenario"], r["front_end"]) == (scenario, front_end)]
        several = definition.logs is not None and len(definition.logs.front_ends) > 1
        name = PurePath(scenario).name  # or a file of the writer's machine
        what = f"{name}, {front_end}" if several else name
        walls, points = _room(definition.bench, scenario)
        found.append(
            RunsMap(
                f"runs-{len(found)}",
                ", ".join(part for part in (what or "All runs", _noise(definition)) if part),
                walls,
                points,
                {name: _paths(name, chosen) for name in definition.variants},
            )
        )
    return found


def _noise(definition: Definition) -> str:
    several = len(definition.noise_scales) > 1
    return f"noise × {definition.noise_scales[0]:g}" if several else ""  # noqa: RUF001


def _paths(variant: str, rows: Sequence[Row]) -> list[RunPath]:
    chosen = [row for row in rows if row["variant"] == variant][:MAX_RUNS]
    return [
        RunPath(
            row["run"],
            robot,
            *(np.array(path[name], dtype=float) for name in ("time_s", "estimate", "truth")),
        )
        for row in chosen
        for robot, path in sorted(row["paths"].items())
    ]


def _room(bench: Bench | None, scenario: str) -> tuple[list[Array], Array]:
    """Walls (k, 2) m each, and points (n, 2) m, of a bench or a scenario; of a lost file none."""
    if bench is not None:
        return [np.array(wall) for wall in bench.walls_m], np.array(bench.points_m).reshape(-1, 2)
    walls: list[Array] = []
    with suppress(ScenarioError):  # its file may be gone since the run
        for thing in outlines_of(load_scenario(scenario).world):
            if thing.radius_m:
                ring = np.column_stack([np.cos(_CIRCLE), np.sin(_CIRCLE)])
                walls.append(thing.points[0] + thing.radius_m * ring)
            else:
                walls.append(np.concatenate([thing.faces[:, 0], thing.faces[-1:, 1]]))
    return walls, np.empty((0, 2))
