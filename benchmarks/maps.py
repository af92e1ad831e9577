"""Are grid maps right? Simulated buildings against their walls, and what a real log's map costs.

Cells are compared with what the true world shows to lasers at the estimated poses: a cell is
truly occupied if a surface is in it, truly seen if a fan of beams without errors ends in it, and
truly free if nothing stands between a laser and it.
"""

import argparse
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

import graphslam
from graphslam.core.geometry import compose, unit_vectors
from graphslam.results.occupancy_grid import GridMap, grid_map
from graphslam.results.scans_file import PlacedScan, place_scans
from graphslam.simulation.raycast import BeamFan, cast_beams
from graphslam.simulation.scenario_files import load_scenario
from graphslam.simulation.scene import prepare_visits
from graphslam.simulation.world import Shapes

BEAMS = 1440
BARS = {"precision": 0.9, "recall": 0.9, "free": 0.99}


def map_errors(grid: GridMap, scans: list[PlacedScan], shapes: Shapes) -> dict[str, float]:
    """Shares of cells, 0 to 1.

    ``precision`` of the occupied cells has a surface within one cell; ``recall`` of the surfaces
    that were seen has an occupied cell within one cell; ``free`` of the free cells is truly free;
    ``known`` of what is truly free is free.
    """
    rows, columns = grid.log_odds.shape
    low = np.array(grid.origin_m)
    sensors = np.array([compose(s.pose, s.sensor) for s in scans])
    polar = [(s.points - s.sensor[:2]).astype(float) for s in scans]
    bearings = np.concatenate(
        [np.arctan2(p[:, 1], p[:, 0]) - s.sensor[2] for p, s in zip(polar, scans, strict=True)]
    )
    reach = max(float(np.hypot(*p.T).max()) for p in polar if len(p))
    fan = BeamFan(-np.pi, 2 * np.pi / BEAMS, BEAMS)
    ranges = cast_beams(sensors, fan, shapes, reach).ranges
    in_view = (fan.angles >= bearings.min()) & (fan.angles <= bearings.max())

    def marked(points):
        image = np.zeros((rows, columns), dtype=bool)
        i, j = np.floor((points - low) / grid.cell_m).astype(int).T
        inside = (i >= 0) & (i < columns) & (j >= 0) & (j < rows)
        image[j[inside], i[inside]] = True
        return image

    ends, free = [], np.zeros((rows, columns), dtype=bool)
    xs, ys = (low[k] + (np.arange(n) + 0.5) * grid.cell_m for k, n in enumerate((columns, rows)))
    for (x, y, turn), r in zip(sensors, ranges, strict=True):
        hit = in_view & (r < reach)
        ends.append([x, y] + r[hit, None] * unit_vectors(turn + fan.angles[hit]))
        dx, dy = xs[None] - x, ys[:, None] - y
        beam = np.round((np.arctan2(dy, dx) - turn + np.pi) / fan.step_rad).astype(int) % BEAMS
        free |= np.hypot(dx, dy) < r[beam]
    seen = marked(np.concatenate(ends))
    points = [
        start + np.linspace(0, 1, int(np.hypot(*(end - start)) / grid.cell_m * 8) + 2)[:, None]
        * (end - start)
        for start, end in shapes.segments
    ]  # fmt: skip
    points += [c[:2] + c[2] * unit_vectors(np.linspace(0, 2 * np.pi, 400)) for c in shapes.circles]
    surface = marked(np.concatenate(points))

    def grown(cells):
        return cv2.dilate(cells.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0

    return {
        "precision": float(grown(surface)[grid.occupied].mean()),
        "recall": float(grown(grid.occupied)[seen].mean()),
        "free": float((free & ~surface | grown(free) & ~surface)[grid.free].mean()),
        "known": float(grid.free[free & ~surface].mean()),
    }


def main() -> None:
    """Print a table; exit code 1 if a bar is not held."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenarios", nargs="*", default=["lab", "office-loop"])
    failed = False
    print(f"{'scenario':14} {'cell':>5} precision recall  free   known, of truly free")
    for name in parser.parse_args().scenarios:
        with TemporaryDirectory() as folder:
            log = Path(folder) / "log.mcap"
            graphslam.simulate(name, log)
            result = graphslam.smooth(log, start={"from_truth": True})
        scans = list(place_scans(result.keyframe_scans, result.estimate.states))
        grid = grid_map(scans)
        (visit,) = prepare_visits(load_scenario(name))
        found = map_errors(grid, scans, visit.world.shapes)
        failed |= any(found[key] < bar for key, bar in BARS.items())
        print(f"{name:14} {grid.cell_m:5.2f} " + " ".join(f"{v:8.4f}" for v in found.values()))
    sys.exit(failed)


if __name__ == "__main__":
    main()
