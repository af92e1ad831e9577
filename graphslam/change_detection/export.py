"""Changes for other tools: a map to overlay on the reference's, and an MCAP file for viewers."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from graphslam.change_detection.detect import ChangeResult
from graphslam.change_detection.grid import Grid
from graphslam.change_detection.objects import Change
from graphslam.core.geometry import Array
from graphslam.core.thinning import evenly_thinned
from graphslam.logs.writer import LogWriter
from graphslam.results.grid_map import FREE, OCCUPIED, UNKNOWN, write_grid_map
from graphslam.results.viewer_messages import (
    CLOUD,
    LINE_STRIP,
    MARKERS,
    TEXT,
    marker,
    marker_array,
    point_cloud,
)

_FRAME = "map"
#: red, green, blue of the kinds
_RGB = {"appeared": (0.16, 0.63, 0.17), "vanished": (0.89, 0.34, 0.1), "moved": (0.58, 0.2, 0.75)}
_MAX_POINTS = 200_000


def write_overlay_map(folder: Path, grid: Grid, old: Iterable[Array], new: Iterable[Array]) -> None:
    """The changes as a map ``changes`` for nav2's map_server.

    Occupied within the polygons (m, 2) of ``new``: something is there now; free within those of
    ``old``: something was there before; unknown elsewhere. Overlaid on the reference's map it gives
    the current map.
    """
    image = np.full(grid.shape[::-1], UNKNOWN, dtype=np.uint8)
    for polygons, value in ((old, FREE), (new, OCCUPIED)):  # the new are drawn over the old
        for polygon in polygons:
            cells = (polygon - np.array(grid.origin_m)) / grid.cell_m - 0.5
            cv2.fillPoly(image, [np.round(cells).astype(np.int32)], value)
    write_grid_map(
        folder, "changes", image, cell_m=grid.cell_m, origin_m=grid.origin_m,
        meaning="changes: occupied = appeared or moved here, free = vanished or moved away",
    )  # fmt: skip


def write_mcap(found: ChangeResult, path: Path) -> None:
    """MCAP for viewers: `/changes` as markers, `/reference` and `/later` as point clouds.

    Each change has the stamp at which it was first observed.

    Raises:
        OutputError: the file cannot be written.
    """
    begin = int(found.later.stamps_ns.min())
    with LogWriter(path) as log:
        for name, visit in (("reference", found.reference), ("later", found.later)):
            points = evenly_thinned(visit.ends_of(visit.surface), _MAX_POINTS)
            log.message(f"/{name}", CLOUD, point_cloud(points, begin, _FRAME), begin)
        for stamp in sorted({change.first_seen_ns for change in found.changes}):
            markers = [
                marker
                for number, change in enumerate(found.changes)
                if change.first_seen_ns == stamp
                for marker in _markers(number, change)
            ]
            log.message("/changes", MARKERS, marker_array(markers), stamp)


def _markers(number: int, change: Change) -> list[Any]:
    """Markers of the outline, of the old one if it is known, and of a label."""
    lines = [_marker(3 * number, change, LINE_STRIP, change.polygon, 0.03, "")]
    if change.before is not None:
        lines.append(_marker(3 * number + 1, change, LINE_STRIP, change.before, 0.015, ""))
    label = f"{number + 1} {change.kind}"
    return [*lines, _marker(3 * number + 2, change, TEXT, change.polygon, 0.25, label)]


def _marker(
    number: int, change: Change, kind: int, polygon: Array, size_m: float, text: str
) -> Any:
    points = polygon if text else np.concatenate([polygon, polygon[:1]])
    return marker(
        number, kind, points, stamp_ns=change.first_seen_ns, frame=_FRAME, namespace="changes",
        size_m=size_m, rgb=_RGB[change.kind], text=text,
    )  # fmt: skip
