"""Grid maps as nav2's map_server reads them: a grey image and its YAML."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

#: grey values in mode trinary
OCCUPIED, FREE, UNKNOWN = 0, 254, 205


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
    rows, columns = image.shape
    north_up = np.ascontiguousarray(image[::-1])
    head = f"P5\n{columns} {rows}\n255\n".encode()
    (folder / f"{name}.pgm").write_bytes(head + north_up.tobytes())
    x, y = origin_m
    (folder / f"{name}.yaml").write_text(
        f"# {meaning}\nimage: {name}.pgm\nmode: trinary\nresolution: {cell_m:.6g}\n"
        f"origin: [{x:.6f}, {y:.6f}, 0.0]\nnegate: 0\n"
        "occupied_thresh: 0.65\nfree_thresh: 0.196\n",
        encoding="utf-8",
    )
