"""Figures of the report pages: their size, their axes, and the density of points as a picture.

Figures are SVG in the colours of the page, see `drawing`. The output is deterministic: no dates, no
random identifiers.
"""

import math
import zlib
from collections.abc import Callable

import numpy as np

from graphslam.core.geometry import Array
from graphslam.results.drawing import Axes, legend, legend_height
from graphslam.results.drawing_elements import UNIT, Box, Shade, opacity_levels, svg_element
from graphslam.results.report_html import MINUTES_FROM_S

WIDTH_IN = 4.9
POINTS_PER_INCH = 72
#: m or degrees: smaller values are not worth a decade of a logarithmic axis
SMALLEST = 1e-6


class Drawing:
    """A figure of the report while it is drawn: `axes` adds axes to it."""

    def __init__(self, label: str, height_in: float) -> None:
        """``label`` describes it for screen readers; the labels on a page differ."""
        self.label, self.height_in = label, height_in
        self._axes: list[Axes] = []
        self._legend: list[str] = []
        self._above = 0.0

    def axes(self, left: float, bottom: float, right: float, top: float) -> Axes:
        """New axes between these margins, inches."""
        unit = POINTS_PER_INCH * UNIT
        box = Box(
            left * unit, top * unit, (WIDTH_IN - right) * unit, (self.height_in - bottom) * unit
        )
        name = f"a{zlib.crc32(self.label.encode()):x}-{len(self._axes)}"
        self._axes.append(Axes(box, name))
        return self._axes[-1]

    def common_legend(self) -> None:
        """One legend at the top, that of the first axes, instead of one for each."""
        unit = POINTS_PER_INCH * UNIT
        entries = self._axes[0].legend
        left, right = 0.1 * unit, (WIDTH_IN - 0.1) * unit
        self._legend = legend(entries, left, right, 0.28 * unit)
        self._above = legend_height(entries, left, right) - 0.28 * POINTS_PER_INCH
        for axes in self._axes:
            axes.legend = []

    def to_svg(self) -> str:
        """The inline SVG element."""
        size = (WIDTH_IN * POINTS_PER_INCH, self.height_in * POINTS_PER_INCH)
        parts = [axes.to_svg() for axes in self._axes]
        above = max([self._above, *(axes.above_pt for axes in self._axes)])
        return svg_element(self.label, *size, [*parts, *self._legend], above)


def svg(label: str, height_in: float, draw: Callable[[Drawing], None]) -> str:
    """What ``draw`` draws as an inline SVG element, described by ``label`` for screen readers."""
    drawing = Drawing(label, height_in)
    draw(drawing)
    return drawing.to_svg()


def density(points: Array, limits: Array, color: str, pixels: int = 900) -> Shade:
    """Density of points (n, 2) as a picture of one colour, its first row at y_min.

    Args:
        points: world frame, m.
        limits: [[x_min, x_max], [y_min, y_max]] of the image; points outside are left out.
        color: hexadecimal.
        pixels: of the longer side.
    """
    size = np.maximum(limits[:, 1] - limits[:, 0], 1e-9)
    shape = np.maximum(1, np.round(pixels * size / size.max())).astype(int)
    cell = np.floor((points - limits[:, 0]) / size * shape).astype(np.int64)
    cell = cell[((cell >= 0) & (cell < shape)).all(axis=1)]
    count = np.bincount(cell[:, 1] * shape[0] + cell[:, 0], minlength=int(shape.prod()))
    hit = np.flatnonzero(count)
    # a single return is visible, the densest cells are solid; the square root between them
    dense = np.quantile(count[hit], 0.95) if len(hit) else 1.0
    levels = np.zeros(len(count), dtype=np.uint8)
    levels[hit] = opacity_levels(0.25 + 0.75 * np.sqrt(np.minimum(count[hit] / dense, 1.0)))
    return Shade(levels.reshape(shape[1], shape[0]), color)


def map_axes(drawing: Drawing, limits: Array) -> Axes:
    """Axes in metres with equal scales that include ``limits`` [[x_min, x_max], [y_min, y_max]]."""
    left, bottom, right, top = 0.57, 0.42, 0.08, 0.24
    digits = len(f"{np.abs(limits[1]).max():.0f}")
    left += 0.06 * max(0, digits - 4)  # northings in UTM have seven
    box = np.array([WIDTH_IN - left - right, drawing.height_in - bottom - top])
    # widen the narrower direction for equal scales
    scale = ((limits[:, 1] - limits[:, 0]) / box).max()
    half, middle = box * scale / 2, limits.mean(axis=1)
    axes = drawing.axes(left, bottom, right, top)
    axes.set_x(middle[0] - half[0], middle[0] + half[0])
    axes.set_y(middle[1] - half[1], middle[1] + half[1])
    axes.x_label, axes.y_label, axes.y_label_pt = "x, m", "y, m", 25.0
    return axes


def time_rows(drawing: Drawing, rows: int, label: str) -> list[Axes]:
    """Axes one above the other; only the last has numbers and a label on its x axis."""
    top, bottom, gap = 0.25, 0.46, 0.35  # inches, inches, of the height of a row
    height = (drawing.height_in - top - bottom) / (rows + gap * (rows - 1))
    found = []
    for row in range(rows):
        above = top + row * (1 + gap) * height
        axes = drawing.axes(0.15 * WIDTH_IN, drawing.height_in - above - height, 0.1, above)
        axes.x_margin = 0.01
        axes.has_x_numbers = row == rows - 1
        found.append(axes)
    found[-1].x_label = label
    return found


def panels(drawing: Drawing, count: int, columns: int, label: str) -> list[Axes]:
    """Axes in rows of ``columns``, below a common legend; the lowest have numbers and a label."""
    left, bottom, right, top = 0.56, 0.46, 0.1, 0.54
    rows = -(-count // columns)
    # gaps of a share of the size of axes
    width = (WIDTH_IN - left - right) / (columns + 0.42 * (columns - 1))
    height = (drawing.height_in - bottom - top) / (rows + 0.28 * (rows - 1))
    found = []
    for i in range(count):
        row, column = divmod(i, columns)
        x, y = left + 1.42 * width * column, top + 1.28 * height * row
        axes = drawing.axes(x, drawing.height_in - y - height, WIDTH_IN - x - width, y)
        axes.has_x_numbers = i + columns >= count
        axes.x_label = label if axes.has_x_numbers else ""
        axes.y_label_pt = 29.0
        found.append(axes)
    return found


def time_axis(first_ns: int, last_ns: int) -> tuple[float, str]:
    """Unit, ns, and label of a time axis over a span: minutes from a quarter of an hour on."""
    if last_ns - first_ns > 1e9 * MINUTES_FROM_S:
        return 60e9, "time, min"
    return 1e9, "time, s"


def positive(values: Array, smallest: float = SMALLEST) -> Array:
    """Values (n,) for a logarithmic axis: what is not above ``smallest`` leaves a gap."""
    return np.where(values > smallest, values, np.nan)


def log_scale(axes: Axes, label: str, low: float | None = None) -> None:
    """A logarithmic y axis over what is drawn, over four decades at most; from ``low`` if given."""
    axes.log_y, axes.y_label = True, label
    scale = axes.y
    low, high = low or scale.low, scale.high
    low = max(low, 1e-4 * high)  # a difference that passes through zero goes below any limit
    if high < 3 * low:  # a small spread is not magnified
        middle = math.sqrt(low * high)
        low, high = middle / 2, middle * 2
    axes.set_y(low, high)
