"""Landmarks of an earlier map that are gone: the laser saw through the places where they were.

A wall that a log does not observe may be out of sight, or gone. Beams that end well behind it have
passed where it was. A thing that is seen through once may be glass, or a door, or a beam of a pose
that is off: most of a wall must have been crossed, each part by beams of several scans.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.geometry import Array, compose, transform, unit_vectors
from graphslam.core.records import KeyframeScan, Landmark, Trajectory

#: m: a beam has passed a landmark if it ends so far behind it; parts of walls that are judged one
#: by one; ends of walls that are left out
BEHIND_M, PART_M, END_M = 0.3, 0.25, 0.15
#: m: half the width of what stands for a point
POINT_M = 0.04
#: scans that must have crossed a part, and the share of the parts
MIN_SCANS, MIN_SHARE = 3, 0.7
#: sine of the least angle between a beam and a wall: along a wall, small errors decide
MIN_SINE = 0.3
#: scans that are looked at, evenly over the log, at most
MAX_SCANS = 1000


def seen_through(
    landmarks: Sequence[Landmark],
    scans: Sequence[KeyframeScan],
    states: Mapping[str, Trajectory],
) -> set[int]:
    """Numbers of the landmarks that the scans, placed at the final states, saw through."""
    some = scans[:: 1 + len(scans) // MAX_SCANS]
    if not some:
        return set()
    at = [states[scan.robot].at(scan.time_ns) for scan in some]
    ends = np.concatenate([transform(x, s.points) for x, s in zip(at, some, strict=True)])
    sensors = np.array([compose(x, s.sensor)[:2] for x, s in zip(at, some, strict=True)])
    scan = np.repeat(np.arange(len(some)), [len(s.points) for s in some])
    return {
        mark.id
        for mark in landmarks
        if _is_crossed(*_ends(mark, sensors), sensors[scan], ends, scan)
    }


def _ends(mark: Landmark, sensors: Array) -> tuple[Array, Array]:
    """The end points of what must be crossed; that of a point faces the nearest sensor."""
    if mark.kind != "point":
        return mark.extent[0], mark.extent[1]
    middle = mark.position[:2]
    off = sensors - middle
    nearest = off[np.argmin((off**2).sum(axis=1))]
    across = POINT_M * unit_vectors(np.arctan2(nearest[1], nearest[0]) + np.pi / 2)
    return middle - across, middle + across


def _is_crossed(a: Array, b: Array, sensors: Array, ends: Array, scan: IntArray) -> bool:
    """Whether beams (n) from sensors (n, 2) to ends (n, 2) passed most of the wall from a to b."""
    length = float(np.hypot(*(b - a)))
    margin = min(END_M, length / 4)
    along, normal = (b - a) / length, np.array([-(b - a)[1], (b - a)[0]]) / length
    from_m, to_m = (sensors - a) @ normal, (ends - a) @ normal
    sides = from_m * to_m < 0
    sensors, ends, from_m, to_m = (each[sides] for each in (sensors, ends, from_m, to_m))
    beams = ends - sensors
    length_m = np.hypot(*beams.T)
    where = sensors @ along - a @ along + (beams @ along) * from_m / (from_m - to_m)
    behind = length_m * np.abs(to_m) / np.abs(from_m - to_m)
    sine = np.abs(from_m - to_m) / length_m
    used = (where > margin) & (where < length - margin) & (behind > BEHIND_M) & (sine > MIN_SINE)
    count = max(1, round((length - 2 * margin) / PART_M))
    part = ((where[used] - margin) / (length - 2 * margin) * count).astype(np.int64)
    crossed = np.unique(np.column_stack([part, scan[sides][used]]), axis=0)
    scans_of = np.bincount(crossed[:, 0], minlength=count)
    return bool((scans_of >= MIN_SCANS).mean() >= MIN_SHARE)
