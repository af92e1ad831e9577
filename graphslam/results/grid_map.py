"""Grid maps as nav2's map_server reads them: an image and its YAML."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from graphslam.results.occupancy_grid import GridMap

#: grey values in mode trinary
OCCUPIED, FREE, UNKNOWN = 0, 254, 205
#: occupied_thresh and free_thresh of each mode: what is above the one is 100, below the other 0. In
#: mode scale map_server stretches what is between them, so that only these leave it as it is
THRESHOLDS = {"trinary": (0.65, 0.196), "scale": (1.0, 0.0)}


def grid_map_files(grid: GridMap, name: str, mode: str) -> list[tuple[str, str | bytes]]:
    """Names and contents of a map's image and YAML.

    Args:
        grid: the map.
        name: of both files.
        mode: ``trinary`` (a PGM: occupied, free or unknown), or ``scale`` (a PNG: grey is the
            probability, and unknown cells are transparent, as map_server asks).
    """
    if mode == "trinary":
        image = np.full(grid.log_odds.shape, UNKNOWN, dtype=np.uint8)
        image[grid.free] = FREE
        image[grid.occupied] = OCCUPIED
        picture = f"{name}.pgm", _pgm(image)
    else:
        unknown = np.isnan(grid.log_odds)
        shade = np.round(255 / (1 + np.exp(np.where(unknown, 0, grid.log_odds)))).astype(np.uint8)
        opaque = np.where(unknown, 0, 255).astype(np.uint8)
        pixels = np.stack([shade, shade, shade, opaque], axis=-1)[::-1]
        picture = f"{name}.png", cv2.imencode(".png", pixels)[1].tobytes()
    meaning = "black is occupied, white is free"
    text = _yaml(picture[0], mode, grid.cell_m, grid.origin_m, meaning)
    return [picture, (f"{name}.yaml", text)]


def write_grid_map(
    folder: Path,
    name: str,
    image: NDArray[np.uint8],
    *,
    cell_m: float,
    origin_m: tuple[float, float],
    meaning: str,
) -> None:
    """Write an image and its YAML, mode trinary.

    Args:
        folder: where ``name``.pgm and ``name``.yaml are written.
        name: of both files.
        image: (rows, columns) grey values; the first row is the southernmost.
        cell_m: edge of a cell.
        origin_m: world position of the corner where the first row and column begin.
        meaning: one line on what the values say, a comment of the YAML.
    """
    (folder / f"{name}.pgm").write_bytes(_pgm(image))
    text = _yaml(f"{name}.pgm", "trinary", cell_m, origin_m, meaning)
    (folder / f"{name}.yaml").write_text(text, encoding="utf-8")


def _pgm(image: NDArray[Any]) -> bytes:
    rows, columns = image.shape
    return f"P5\n{columns} {rows}\n255\n".encode() + np.ascontiguousarray(image[::-1]).tobytes()


def _yaml(image: str, mode: str, cell_m: float, origin_m: tuple[float, float], meaning: str) -> str:
    (x, y), (occupied, free) = origin_m, THRESHOLDS[mode]
    return (
        f"# {meaning}\nimage: {image}\nmode: {mode}\nresolution: {cell_m:.6g}\n"
        f"origin: [{x:.6f}, {y:.6f}, 0.0]\nnegate: 0\n"
        f"occupied_thresh: {occupied}\nfree_thresh: {free}\n"
    )
