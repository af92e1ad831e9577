"""True changes between two visits, as far as both of them observed them.

A cell counts as changed if noise-free beams of one visit ended in it on an object that was moved,
removed or added, and beams of the other visit passed through it.
"""

from collections.abc import Mapping
from itertools import compress
from typing import Any

import numpy as np

from graphslam.core.geometry import Array, inverse, transform, unit_vectors
from graphslam.logs.writer import xy_phi
from graphslam.simulation.laser import beam_fan
from graphslam.simulation.raycast import points_in_frames
from graphslam.simulation.recording import NoiseFreeScans, SimulatedLog
from graphslam.simulation.scenario import LaterVisit, Scenario
from graphslam.simulation.scene import SimulatedVisit
from graphslam.simulation.world import displacement

CELL_M = 0.05
_CORNERS = 24  # of the polygon that approximates a circle


def true_changes(
    scenario: Scenario, recordings: tuple[SimulatedLog, SimulatedLog], seed: int
) -> dict[str, Any]:
    """The contents of truth.json; see docs/simulator.md. World frame of the simulator."""
    later = scenario.later or LaterVisit()
    before, after = recordings
    motions = {move.name: displacement(move) for move in later.moved}
    kinds = {"moved": motions, "vanished": later.vanished, "appeared": later.appeared.names}
    appeared = _cells(after, {*motions, *later.appeared.names})
    vanished = _cells(before, {*motions, *later.vanished})
    return {
        "format": 1,
        "scenario": scenario.name,
        "seed": seed,
        "cell_m": CELL_M,
        "starts": {
            visit.name: {
                name: actor.drive.at(np.zeros(1)).poses[0].tolist()
                for name, actor in visit.actors.items()
            }
            for visit in (before.visit, after.visit)
        },
        "changes": [
            {
                "name": name,
                "kind": kind,
                "before": _polygon(before.visit, name),
                "after": _polygon(after.visit, name),
                "displacement": xy_phi(motions[name]) if name in motions else None,
            }
            for kind, names in kinds.items()
            for name in names
        ],
        "cells": [
            *_rows("appeared", appeared, before.scans, motions, back=True),
            *_rows("vanished", vanished, after.scans, motions, back=False),
        ],
    }


def _polygon(visit: SimulatedVisit, name: str) -> list[list[float]] | None:
    """Corners (k, 2) m of an object's outline; None if the visit does not have it."""
    for outline in visit.world.outlines:
        if outline.name == name:
            points = outline.points
            if outline.radius_m:
                angles = 2 * np.pi * np.arange(_CORNERS) / _CORNERS
                points = points + outline.radius_m * unit_vectors(angles)
            return [[float(x), float(y)] for x, y in points]
    return None


def _cells(recording: SimulatedLog, names: set[str]) -> dict[tuple[int, int], str]:
    """Cells in which noise-free beams ended on one of the named objects -> its name."""
    world = recording.visit.world
    cells: dict[tuple[int, int], str] = {}
    for scans in recording.scans.values():
        ranges, surfaces = scans.hits.ranges, scans.hits.surfaces
        numbers = [n for n, t in enumerate(world.things) if world.outlines[t].name in names]
        chosen = np.isin(surfaces, numbers) & (ranges <= scans.laser.range_max_m)
        scan, beam = np.nonzero(chosen)
        along = unit_vectors(scans.poses[scan, 2] + beam_fan(scans.laser).angles[beam])
        points = scans.poses[scan, :2] + ranges[chosen][:, None] * along
        ends = np.floor(points / CELL_M).astype(int).tolist()
        for (x, y), surface in zip(ends, surfaces[chosen], strict=True):
            cells[x, y] = world.outlines[world.things[surface]].name
    return dict(sorted(cells.items()))


def _rows(
    kind: str,
    cells: Mapping[tuple[int, int], str],
    other: Mapping[str, NoiseFreeScans],
    motions: Mapping[str, Array],
    *,
    back: bool,
) -> list[dict[str, Any]]:
    """The cells that the other visit observed as free, with the displacement of their surface."""
    if not cells:
        return []
    centers = (np.array(list(cells), dtype=float) + 0.5) * CELL_M
    free = np.zeros(len(centers), dtype=bool)
    for scans in other.values():
        free |= _observed_free(scans, centers)
    rows = []
    for center, name in zip(centers[free], compress(cells.values(), free), strict=True):
        moved = None
        if name in motions:
            motion = inverse(motions[name]) if back else motions[name]
            moved = float(np.hypot(*(transform(motion, center[None])[0] - center)))
        x, y = center.tolist()
        rows.append({"kind": kind, "x": x, "y": y, "name": name, "displacement_m": moved})
    return rows


def _observed_free(scans: NoiseFreeScans, centers: Array) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """Which cells (n,) some beam crossed near the centre and passed."""
    found = np.zeros(len(centers), dtype=bool)
    fan = beam_fan(scans.laser)
    angles = fan.angles
    for pose, ranges in zip(scans.poses, scans.hits.ranges, strict=True):
        x, y = points_in_frames(pose[None], centers)[0].T
        nearest = np.round((np.arctan2(y, x) - fan.start_rad) / fan.step_rad).astype(int)
        beam = np.clip(nearest, 0, fan.count - 1)
        inside, angle = nearest == beam, angles[beam]
        aside = np.abs(x * np.sin(angle) - y * np.cos(angle))
        along = x * np.cos(angle) + y * np.sin(angle)
        reach = np.minimum(ranges[beam], scans.laser.range_max_m)
        found |= inside & (aside < CELL_M / 4) & (along > 0) & (reach > along + CELL_M)
    return found
