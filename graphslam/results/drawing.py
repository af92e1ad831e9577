"""Axes of a drawing with curves, dots, areas, pictures and texts, written as SVG.

Nothing but numpy is imported for it, so that a report takes no time to start.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from graphslam.core.geometry import Array
from graphslam.results.drawing_elements import (
    FAINT,
    UNIT,
    Box,
    Levels,
    Shade,
    Style,
    filled,
    opacity_levels,
    path_data,
    picture,
    stroked,
    words,
)
from graphslam.results.drawing_scales import Scale, linear_scale, log_scale

TEXT_PT, TICK_TEXT_PT, LEGEND_ROW_PT = 8.5, 8.0, 10.0
_LONGEST_SAMPLE_PT = 13.0  # of a curve in a legend, up to its name
_LETTER = 0.6  # mean width of a letter, of the height of the text
_BESIDE = 5.0  # points that a number may stand out beside the axis
_FAR = 10**6  # user units: what lies beyond is cut off anyway
_DOT_PIXELS = 4.0  # per point, of pictures of dots


@dataclass(frozen=True, slots=True)
class _Mark:
    """Something drawn in axes: its ``layer``, extent (2, 2) of x and y, and its SVG."""

    layer: int
    extent: Array | None
    draw: Callable[[], str]


class Axes:
    """Axes in a box of a drawing. Scales follow the data until `set_x` or `set_y` sets them."""

    def __init__(self, box: Box, name: str) -> None:
        """``name``: unique on the page."""
        self.box, self.name = box, name
        self.log_x = self.log_y = False
        self.x_margin = 0.05
        self.x_label = self.y_label = self.title = ""
        self.has_x_numbers = True
        #: distance of the label of the y axis from the axis, points
        self.y_label_pt = 34.0
        self.legend: list[tuple[str, Style]] = []
        self._marks: list[_Mark] = []
        self._x: Scale | None = None
        self._y: Scale | None = None

    # ------------------------------------------------------------ scales

    def set_x(self, low: float, high: float) -> None:
        """Fix the x axis."""
        self._x = Scale(low, high, self.log_x)

    def set_y(self, low: float, high: float) -> None:
        """Fix the y axis."""
        self._y = Scale(low, high, self.log_y)

    @property
    def x(self) -> Scale:
        """Scale of the x axis."""
        if self._x is not None:
            return self._x
        return (log_scale if self.log_x else linear_scale)(*self.data_range(0), self.x_margin)

    @property
    def y(self) -> Scale:
        """Scale of the y axis."""
        if self._y is not None:
            return self._y
        return (log_scale if self.log_y else linear_scale)(*self.data_range(1))

    def data_range(self, axis: int) -> tuple[float, float]:
        """Least and greatest value of everything drawn, in x (0) or y (1); NaN without any."""
        extents = [mark.extent[axis] for mark in self._marks if mark.extent is not None]
        found = np.concatenate(extents) if extents else np.empty(0)
        is_log = self.log_y if axis else self.log_x
        found = found[np.isfinite(found) & ((found > 0) | (not is_log))]
        return (float(found.min()), float(found.max())) if len(found) else (np.nan, np.nan)

    def place(self, x: Array, y: Array) -> Array:
        """User units (n, 2) of points; NaN where a coordinate has none."""
        box = self.box
        across = box.left + (box.right - box.left) * self.x.share(np.asarray(x, dtype=float))
        up = box.bottom - (box.bottom - box.top) * self.y.share(np.asarray(y, dtype=float))
        return np.clip(np.column_stack([across, up]), -_FAR, _FAR)

    # ------------------------------------------------------------ marks

    def add(self, layer: int, x: Array, y: Array, draw: Callable[[], str]) -> None:
        """A mark with its coordinates in x (n,) and y (m,), which the scales are to include."""
        with_limits = [_extent(np.asarray(values, dtype=float)) for values in (x, y)]
        self._marks.append(_Mark(layer, np.array(with_limits), draw))

    def line(self, x: Any, y: Any, style: Style, label: str | None = None, layer: int = 2) -> None:
        """A curve through points (n,); NaN leave gaps."""
        x, y = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
        if label is not None:
            self.legend.append((label, style))
        self.add(layer, x, y, lambda: stroked(path_data(self.place(x, y)), style))

    def path(self, points: Array, style: Style, label: str | None = None, layer: int = 2) -> None:
        """A curve through points (n, 2)."""
        self.line(points[:, 0], points[:, 1], style, label, layer)

    def lines(self, lines: Sequence[Array], style: Style, layer: int = 2) -> None:
        """Polylines (k, 2), each of its own length; the scales do not follow them."""
        if len(lines):
            sizes = np.cumsum([len(line) for line in lines])[:-1]
            xy = np.concatenate(lines)

            def draw() -> str:
                parts = np.split(self.place(*xy.T), sizes)
                return stroked("".join(map(path_data, parts)), style)

            self._marks.append(_Mark(layer, None, draw))

    def level(self, y: float, style: Style, layer: int = 2) -> None:
        """A horizontal line through the axes."""
        box = self.box

        def draw() -> str:
            at = self.place(np.zeros(1) + self.x.low, np.array([y]))[0, 1]
            return stroked(f"M{box.left:.0f} {at:.0f}H{box.right:.0f}", style)

        self.add(layer, np.empty(0), np.array([y]), draw)

    def band(self, low: float, high: float, color: str, opacity: float, layer: int = 1) -> None:
        """An area between two values of y through the axes."""
        box = self.box

        def draw() -> str:
            top, bottom = self.place(np.zeros(2) + self.x.low, np.array([high, low]))[:, 1]
            outline = f"M{box.left:.0f} {top:.0f}H{box.right:.0f}V{bottom:.0f}H{box.left:.0f}z"
            return filled(outline, color, opacity)

        self.add(layer, np.empty(0), np.array([low, high]), draw)

    def area(self, points: Array, color: str, opacity: float, layer: int = 1) -> None:
        """A filled polygon (n, 2)."""
        x, y = np.asarray(points, dtype=float).T
        self.add(layer, x, y, lambda: filled(path_data(self.place(x, y)) + "z", color, opacity))

    def symbols(self, points: Array, color: str, size: float, *, triangles: bool = False) -> None:
        """Discs or triangles at points (n, 2), ``size`` points across."""
        x, y = np.asarray(points, dtype=float).reshape(-1, 2).T
        r = round(size * UNIT / 2)
        if triangles:
            shape = f"l{r} {2 * r}h{-2 * r}z"
        else:
            shape = f"a{r} {r} 0 1 0 0 {2 * r}a{r} {r} 0 1 0 0 {-2 * r}z"

        def draw() -> str:
            places = self.place(x, y)
            tops = np.rint(places[np.isfinite(places).all(axis=1)]).astype(int)
            return filled("".join(f"M{a} {b - r}{shape}" for a, b in tops.tolist()), color, 1.0)

        if len(x):
            self.add(2, x, y, draw)

    def dots(self, x: Any, y: Any, color: str, size: float, opacity: float, layer: int = 2) -> None:
        """Many translucent dots of ``size`` points across, as one picture."""
        x, y = np.asarray(x, dtype=float), np.asarray(y, dtype=float)

        def draw() -> str:
            box = self.box
            scale = _DOT_PIXELS / UNIT
            shape = round((box.bottom - box.top) * scale), round((box.right - box.left) * scale)
            places = (self.place(x, y) - (box.left, box.top)) * scale
            levels = _dots(places, shape, size * _DOT_PIXELS / 2, opacity)
            return picture(Shade(levels, color), box)

        self.add(layer, x, y, draw)

    def image(self, shade: Shade, limits: Array, layer: int = 0) -> None:
        """A picture, its first row at the bottom, within ``limits`` (2, 2) of x and y."""

        def draw() -> str:
            (left, bottom), (right, top) = self.place(*limits).tolist()
            turned = shade._replace(levels=shade.levels[::-1])
            return picture(turned, Box(left, top, right, bottom))

        self.add(layer, limits[0], limits[1], draw)

    def text(self, x: float, y: float, text: str, size: float, offset: tuple[float, float]) -> None:
        """A short text in a halo, shifted by ``offset`` points right and up."""

        def draw() -> str:
            across, up = self.place(np.array([x]), np.array([y]))[0].tolist()
            right, above = offset
            return words(text, across + right * UNIT, up - above * UNIT, size, halo=True)

        self.add(9, np.array([x]), np.array([y]), draw)

    # ------------------------------------------------------------ output

    @property
    def above_pt(self) -> float:
        """Room that the legend needs above the drawing, points; negative where there is some."""
        top = self.box.top / UNIT - 6
        return legend_height(self.legend, self.box.left, self.box.right) - top

    def to_svg(self) -> str:
        """Grid, marks, labels and legend."""
        box = self.box
        clip = (
            f'<clipPath id="{self.name}"><rect x="{box.left:.0f}" y="{box.top:.0f}" '
            f'width="{box.right - box.left:.0f}" height="{box.bottom - box.top:.0f}"/></clipPath>'
        )
        marks = [mark.draw() for mark in sorted(self._marks, key=lambda mark: mark.layer)]
        inside = f'<g clip-path="url(#{self.name})">\n' + "\n".join(marks) + "\n</g>"
        edges = f"M{box.left:.0f} {box.top:.0f}V{box.bottom:.0f}H{box.right:.0f}"
        spines = stroked(edges, Style(FAINT, 0.8))
        names = legend(self.legend, box.left, box.right, box.top - 6 * UNIT)
        return "\n".join([clip, *self._grid(), inside, spines, *self._labels(), *names])

    def _grid(self) -> list[str]:
        """Lines and numbers at the ticks of both axes."""
        box, parts, texts = self.box, "", []
        ticks = self.x.ticks(_most_ticks(box.right - box.left, 34))
        at = self.place(np.array(ticks), np.full(len(ticks), self.y.low))[:, 0]
        for x, label in zip(at, self.x.labels(ticks), strict=True):
            parts += f"M{x:.0f} {box.top:.0f}V{box.bottom + 3 * UNIT:.0f}"
            if self.has_x_numbers:
                # the last number may not leave the drawing
                most = box.right + _BESIDE * UNIT - _width_pt(label, TICK_TEXT_PT) * UNIT / 2
                place = min(float(x), most), box.bottom + 12 * UNIT
                texts.append(words(label, *place, TICK_TEXT_PT, "middle"))
        ticks = self.y.ticks(_most_ticks(box.bottom - box.top, 16))
        at = self.place(np.full(len(ticks), self.x.low), np.array(ticks))[:, 1]
        for y, label in zip(at, self.y.labels(ticks), strict=True):
            parts += f"M{box.left - 3 * UNIT:.0f} {y:.0f}H{box.right:.0f}"
            texts.append(words(label, box.left - 5 * UNIT, y + 3 * UNIT, TICK_TEXT_PT, "end"))
        return [stroked(parts, Style(FAINT, 0.6)), *texts]

    def _labels(self) -> list[str]:
        box, found = self.box, []
        if self.x_label:
            x = (box.left + box.right) / 2
            found.append(words(self.x_label, x, box.bottom + 24 * UNIT, TEXT_PT, "middle"))
        if self.y_label:
            ticks = self.y.labels(self.y.ticks(_most_ticks(box.bottom - box.top, 16)))
            widest = max((_width_pt(label, TICK_TEXT_PT) for label in ticks), default=0.0)
            # beside the numbers, but never beyond the edge of the drawing
            beside = min(max(self.y_label_pt, 5 + widest + 7), box.left / UNIT - 0.7 * TEXT_PT)
            x, y = box.left - beside * UNIT, (box.top + box.bottom) / 2
            found.append(words(self.y_label, x, y, TEXT_PT, "middle", upright=True))
        if self.title:
            found.append(words(self.title, box.left, box.top - 4 * UNIT, 9.0))
        return found


def _width_pt(text: str, size_pt: float) -> float:
    return len(text) * _LETTER * size_pt


def _legend_rows(
    entries: Sequence[tuple[str, Style]], left: float, right: float
) -> list[list[tuple[str, Style, float]]]:
    """Names, each once, with their styles and widths, in rows between ``left`` and ``right``."""
    first: dict[str, Style] = {}
    for name, style in entries:
        first.setdefault(name, style)
    rows: list[list[tuple[str, Style, float]]] = [[]]
    room = right - left
    for name, style in first.items():
        width = (_width_pt(name, TICK_TEXT_PT) + 24) * UNIT
        if rows[-1] and room < width:
            rows, room = [*rows, []], right - left
        rows[-1].append((name, style, width))
        room -= width
    return rows


def legend_height(entries: Sequence[tuple[str, Style]], left: float, right: float) -> float:
    """Height of `legend` above its last row's base line, points."""
    return LEGEND_ROW_PT * len(_legend_rows(entries, left, right)) if entries else 0.0


def _sample(style: Style) -> tuple[float, Style]:
    """Length of the sample of a curve, user units: about 11 points, and whole dashes; its style.

    Long dashes are drawn shorter, where the name would be in the way.
    """
    dashes = [style.width * dash for dash in style.dashes]
    if not dashes:
        return 11.0 * UNIT, style
    length = max(1, round((11.0 - dashes[0]) / sum(dashes))) * sum(dashes) + dashes[0]
    scale = min(1.0, _LONGEST_SAMPLE_PT / length)
    return UNIT * scale * length, style._replace(dashes=tuple(scale * d for d in style.dashes))


def legend(entries: Sequence[tuple[str, Style]], left: float, right: float, y: float) -> list[str]:
    """Names with samples of their curves, each once, in right-aligned rows of which ``y`` is last.

    ``left``, ``right`` and ``y`` in user units.
    """
    found = []
    for row in reversed(_legend_rows(entries, left, right)):
        x = right - sum(width for *_, width in row)
        for name, style, width in row:
            length, sample = _sample(style)
            found.append(stroked(f"M{x + 8 * UNIT:.0f} {y - 3 * UNIT:.0f}h{length:.0f}", sample))
            found.append(words(name, x + 23 * UNIT, y, TICK_TEXT_PT))
            x += width
        y -= LEGEND_ROW_PT * UNIT
    return found


def _most_ticks(length: float, room_pt: float) -> int:
    """Ticks at most on an axis, from the room that a number needs along it."""
    return int(np.clip(round(length / (room_pt * UNIT)), 2, 8))


def _extent(values: Array) -> Array:
    """Least positive, least and greatest finite value (3,): all that either scale needs."""
    values = values[np.isfinite(values)]
    if not len(values):
        return np.full(3, np.nan)
    above = values[values > 0]
    least = above.min() if len(above) else np.nan
    return np.array([least, values.min(), values.max()])


def _dots(places: Array, shape: tuple[int, int], radius: float, opacity: float) -> Levels:
    """Translucent discs at places (n, 2), pixels, as a picture of ``shape`` (rows, columns)."""
    cell = np.rint(places[np.isfinite(places).all(axis=1)] - 0.5).astype(np.int64)
    reach = int(np.ceil(radius))
    wide = shape[0] + 2 * reach, shape[1] + 2 * reach
    inside = ((cell >= 0) & (cell < shape[::-1])).all(axis=1)
    column, row = cell[inside].T + reach
    found = np.bincount(row * wide[1] + column, minlength=wide[0] * wide[1]).reshape(wide)
    found = found.astype(np.int32)
    steps = range(-reach, reach + 1)
    disc = [(dy, dx) for dy in steps for dx in steps if dx * dx + dy * dy <= radius * radius]
    count = np.zeros(shape, dtype=np.int32)
    for dy, dx in disc:
        count += found[reach + dy : reach + dy + shape[0], reach + dx : reach + dx + shape[1]]
    # of as many as any pixel is covered by: there are far less of these than pixels
    levels = opacity_levels(1.0 - (1.0 - opacity) ** np.arange(1 + count.max(initial=0)))
    return np.asarray(levels[count])
