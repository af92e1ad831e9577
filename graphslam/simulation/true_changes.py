"""What truly changed between two visits, as far as both of them could see it.

A cell counts as changed where the noise-free scans of one visit met a thing that was moved, taken
away or put there, and those of the other visit looked through.
"""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from graphslam.core.geometry import Array, between, inverse, transform, unit_vectors
from graphslam.simulation.raycast import NO_SURFACE
from graphslam.simulation.recording import NoiseFreeScans, Recording
from graphslam.simulation.scenario import LaterVisit, Scenario
from graphslam.simulation.scene import SimulatedVisit
from graphslam.simulation.world import displacement

CELL_M = 0.05
_CORNERS = 24  # of the polygon that stands for a circle


def true_changes(
    scenario: Scenario,
    later: LaterVisit,
    visits: tuple[SimulatedVisit, SimulatedVisit],
    recordings: tuple[Recording, Recording],
    seed: int,
) -> dict[str, Any]:
    """The contents of truth.json; see docs/simulator.md. World frame of the simulator."""
    before, after = visits
    appeared = _cells(after, recordings[1].sweeps, _names(later, "appeared"))
    vanished = _cells(before, recordings[0].sweeps, _names(later, "vanished"))
    motions = {move.name: displacement(move) for move in later.moved}
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
            for visit in visits
        },
        "changes": [
            {
                "name": name,
                "kind": kind,
                "before": _polygon(before, name),
                "after": _polygon(after, name),
                "displacement": _named(motions[name]) if name in motions else None,
            }
            for name, kind in _kinds(later)
        ],
        "cells": [
            *_rows("appeared", appeared, recordings[0].sweeps, motions, back=True),
            *_rows("vanished", vanished, recordings[1].sweeps, motions, back=False),
        ],
    }


def _kinds(later: LaterVisit) -> Iterator[tuple[str, str]]:
    yield from ((move.name, "moved") for move in later.moved)
    yield from ((name, "vanished") for name in later.vanished)
    yield from ((name, "appeared") for name in _added(later))


def _added(later: LaterVisit) -> Iterator[str]:
    things = later.appeared
    for kind in (things.walls, things.boxes, things.boards, things.cylinders, things.doors):
        yield from (thing.name for thing in kind)


def _names(later: LaterVisit, kind: str) -> set[str]:
    """Things of which a visit saw surfaces that the other one did not have."""
    only = later.vanished if kind == "vanished" else tuple(_added(later))
    return {*(move.name for move in later.moved), *only}


def _polygon(visit: SimulatedVisit, name: str) -> list[list[float]] | None:
    """Corners, m, of a thing's outline; None at the visit at which it is not there."""
    for outline in visit.world.outlines:
        if outline.name == name:
            if not outline.radius_m:
                return [[float(x), float(y)] for x, y in outline.points]
            angles = 2 * np.pi * np.arange(_CORNERS) / _CORNERS
            ring = outline.radius_m * unit_vectors(angles)
            return [[float(x), float(y)] for x, y in outline.points[0] + ring]
    return None


def _named(pose: Array) -> dict[str, float]:
    return dict(zip(("x", "y", "phi"), pose.tolist(), strict=True))


def _cells(
    visit: SimulatedVisit, sweeps: Mapping[str, NoiseFreeScans], names: set[str]
) -> dict[tuple[int, int], str]:
    """Cells in which noise-free beams ended on one of the named things -> the thing."""
    world = visit.world
    cells: dict[tuple[int, int], str] = {}
    for sweep in sweeps.values():
        surfaces = sweep.hits.surfaces
        numbers = [n for n, t in enumerate(world.things) if world.outlines[t].name in names]
        scan, beam = np.nonzero(np.isin(surfaces, numbers) & _within(sweep))
        points = _ends(sweep, scan, beam)
        for (x, y), surface in zip(
            np.floor(points / CELL_M).astype(int).tolist(), surfaces[scan, beam], strict=True
        ):
            cells[x, y] = world.outlines[world.things[surface]].name
    return dict(sorted(cells.items()))


def _within(sweep: NoiseFreeScans) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """Which beams (scans, beams) would be reported."""
    reported = sweep.hits.ranges <= sweep.laser.range_max_m
    return np.asarray(reported & (sweep.hits.surfaces != NO_SURFACE))


def _angles(sweep: NoiseFreeScans) -> Array:
    """Directions (beams,) rad in the laser's frame."""
    beams = sweep.hits.ranges.shape[1]
    return np.asarray(np.radians(sweep.laser.step_deg) * (np.arange(beams) - (beams - 1) / 2))


def _ends(sweep: NoiseFreeScans, scan: Any, beam: Any) -> Array:
    """World points (n, 2) where beams ended."""
    direction = sweep.poses[scan, 2] + _angles(sweep)[beam]
    along = unit_vectors(direction)
    return np.asarray(sweep.poses[scan, :2] + sweep.hits.ranges[scan, beam, None] * along)


def _rows(
    kind: str,
    cells: Mapping[tuple[int, int], str],
    other: Mapping[str, NoiseFreeScans],
    motions: Mapping[str, Array],
    *,
    back: bool,
) -> list[dict[str, Any]]:
    """The cells through which the other visit looked, with how far their surface moved."""
    if not cells:
        return []
    centers = (np.array(list(cells), dtype=float) + 0.5) * CELL_M
    free = np.zeros(len(centers), dtype=bool)
    for sweep in other.values():
        free |= _looked_through(sweep, centers)
    rows = []
    for center, name in zip(centers[free], np.array(list(cells.values()))[free], strict=True):
        motion = motions.get(str(name))
        moved = None
        if motion is not None:
            pose = inverse(motion) if back else motion
            moved = float(np.hypot(*(transform(pose, center[None])[0] - center)))
        x, y = center.tolist()
        rows.append({"kind": kind, "x": x, "y": y, "name": str(name), "displacement_m": moved})
    return rows


def _looked_through(sweep: NoiseFreeScans, centers: Array) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """Which cells (n,) some beam crossed well inside and ended behind."""
    found = np.zeros(len(centers), dtype=bool)
    step = np.radians(sweep.laser.step_deg)
    beams = sweep.hits.ranges.shape[1]
    points = np.column_stack([centers, np.zeros(len(centers))])
    for pose, ranges in zip(sweep.poses, sweep.hits.ranges, strict=True):
        x, y = between(pose[None], points)[:, :2].T
        nearest = np.round(np.arctan2(y, x) / step + (beams - 1) / 2).astype(int)
        inside = (nearest >= 0) & (nearest < beams)
        beam = np.clip(nearest, 0, beams - 1)
        angle = _angles(sweep)[beam]
        aside = np.abs(x * np.sin(angle) - y * np.cos(angle))
        along = x * np.cos(angle) + y * np.sin(angle)
        reach = np.minimum(ranges[beam], sweep.laser.range_max_m)
        found |= inside & (aside < CELL_M / 4) & (along > 0) & (reach > along + CELL_M)
    return found
