"""A small drawing of a result's map, for pages with many of them."""

from collections.abc import Mapping, Sequence

import numpy as np

from graphslam.core.geometry import Array
from graphslam.core.records import Landmark, Result
from graphslam.results.drawing_elements import (
    ACCENT,
    INK,
    Style,
    filled,
    path_data,
    robot_color,
    stroked,
)

#: user units; of the page's pixels three each
WIDTH, HEIGHT = 480, 360
_MARGIN = 14
#: path, walls, and the sides of squares that are points, user units
_PATH, _WALL, _POINT = 0.45, 0.3, 7


def small_map(result: Result) -> str:
    """Paths over landmarks as an SVG file, north up, as large as fits.

    Its colours are those of the page that it is put into.
    """
    paths = {name: robot.final.poses[:, :2] for name, robot in sorted(result.robots.items())}
    return draw(paths, result.landmarks)


def draw(paths: Mapping[str, Array], landmarks: Sequence[Landmark]) -> str:
    """See `small_map`; paths (n, 2), m, by robot."""
    limits = _limits([*paths.values(), *(m.extent for m in landmarks)])
    walls = [m.extent for m in landmarks if m.kind != "point"]
    points = [m.position[:2] for m in landmarks if m.kind == "point"]
    parts = []
    if walls:
        lines = "".join(path_data(_placed(line, limits)) for line in walls)
        parts.append(stroked(lines, Style(INK, _WALL, 0.75)))
    if points:
        half, side = _POINT // 2, _POINT
        corners = np.rint(_placed(np.array(points), limits)).astype(int) - half
        squares = "".join(f"M{x} {y}h{side}v{side}h{-side}z" for x, y in corners.tolist())
        parts.append(filled(squares, INK, 0.75))
    for number, path in enumerate(paths.values()):
        color = robot_color(number) if len(paths) > 1 else ACCENT
        parts.append(stroked(path_data(_placed(path, limits)), Style(color, _PATH)))
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" role="img" aria-label="map" '
        f'viewBox="0 0 {WIDTH} {HEIGHT}">{"".join(parts)}</svg>'
    )


def _limits(parts: Sequence[Array]) -> Array:
    """[[x_min, x_max], [y_min, y_max]] of points (n, 2), m; at least a metre wide."""
    points = np.concatenate([part for part in parts if len(part)])
    low, high = points.min(axis=0), points.max(axis=0)
    wider = np.maximum(1.0 - (high - low), 0.0) / 2
    return np.column_stack([low - wider, high + wider])


def _placed(points: Array, limits: Array) -> Array:
    """User units (n, 2) of points (n, 2), m: equal scales, in the middle, y upwards."""
    size = limits[:, 1] - limits[:, 0]
    room = np.array([WIDTH - 2 * _MARGIN, HEIGHT - 2 * _MARGIN])
    scale = float((room / size).min())
    off = (points - limits.mean(axis=1)) * scale
    return np.column_stack([WIDTH / 2 + off[:, 0], HEIGHT / 2 - off[:, 1]])
