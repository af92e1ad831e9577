"""Figures that can be zoomed, hovered and played, in a page that needs no network.

A figure is data for the script live.js, which draws it in the browser with BokehJS. The scripts of
BokehJS are read from the installed package, which is not imported: that would take longer than the
whole page. What is shown without scripts and in print are the drawings of `report_figure`.
"""

import base64
import importlib.util
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from html import escape
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from graphslam.core.geometry import Array
from graphslam.results.drawing_elements import ACCENT, INK, PALETTE

_LIBRARY = ("bokeh.min.js", "bokeh-api.min.js")
#: numbers below this are written in single precision: metres to 0.1 mm
_SINGLE = 2000.0
_OWN = Path(__file__).parent / "static" / "live.js"
#: type of numpy -> its name in the script
_TYPES = {"<f8": "f8", "<f4": "f4", "<i2": "i2", "<i4": "i4"}
#: names of the page's colours
COLORS = {INK: "ink", ACCENT: "accent"} | {c: f"robot{i}" for i, c in enumerate(PALETTE)}


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """What is drawn with one glyph: ``columns`` (n,) of numbers, at least x and y, in its layer.

    ``dash``: by name, or lengths in pixels of what is drawn and left out in turn.
    ``glyph``: "path" (one line), "lines" or "areas" (one from each vertex ``starts`` (m,) on),
    "ellipses" (columns width, height m, angle rad) or "points" (``marker``). ``tip``: HTML of what
    hovering shows, ``@name`` a column or one of ``texts``. ``side``: "before" or "after" the swipe.
    ``timed``: hidden until the column time, s, of a vertex, a line or a point. ``robot``: the path
    of a robot, with columns time and heading, that is drawn at the slider's time.
    """

    glyph: str
    layer: str
    color: str
    columns: Mapping[str, Array]
    width: float = 1.5
    alpha: float = 1.0
    dash: str | Sequence[float] = "solid"
    marker: str = "circle"
    starts: Array | None = None
    texts: Mapping[str, Sequence[str]] = field(default_factory=dict)
    tip: str = ""
    side: str = ""
    timed: bool = False
    robot: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class LiveFigure:
    """A figure that moves: ``limits`` [[x_min, x_max], [y_min, y_max]] and what is drawn.

    ``kind``: "map" (metres, equal scales) or "chart". ``layers``: name -> whether it is shown at
    first. ``duration_s``: of the replay, None without. ``sides``: names of before and after.
    ``scans`` and ``clouds`` are points, see `scan_points` and `cloud`.
    """

    name: str
    title: str
    caption: str
    kind: str
    limits: Array
    series: Sequence[Series]
    layers: Mapping[str, bool]
    labels: tuple[str, str] = ("x, m", "y, m")
    log: tuple[bool, bool] = (False, False)
    duration_s: float | None = None
    in_minutes: bool = False
    sides: tuple[str, str] | None = None
    scans: Mapping[str, Any] | None = None
    clouds: Sequence[Mapping[str, Any]] = ()


def encoded(values: Array) -> dict[str, str]:
    """An array (...,) as type and base64, little-endian and row after row."""
    plain = np.ascontiguousarray(values, dtype=np.dtype(values.dtype).newbyteorder("<"))
    kind = _TYPES[plain.dtype.str]
    return {"type": kind, "data": base64.b64encode(plain.tobytes()).decode()}


def _column(values: Array) -> dict[str, str]:
    values = np.asarray(values, dtype="<f8")
    near = float(np.abs(values[np.isfinite(values)]).max(initial=0.0)) < _SINGLE
    return encoded(values.astype("<f4") if near else values)


def quantised(points: Array) -> tuple[Array, float]:
    """Points (n, 2) m as 16-bit integers (2 n,) and their unit, m; half a unit is lost."""
    unit = max(float(np.abs(points).max(initial=0.0)) / 32000.0, 1e-4)
    return np.rint(points / unit).astype("<i2").ravel(), unit


def cloud(points: Array, layer: str, color: str, side: str) -> dict[str, Any]:
    """Fixed points (n, 2) m of one colour, of one side of the swipe."""
    origin = points.mean(axis=0) if len(points) else np.zeros(2)
    values, unit = quantised(points - origin)
    return {
        "layer": layer, "color": color, "side": side, "unit": unit, "origin": origin.tolist(),
        "points": encoded(values),
    }  # fmt: skip


def joined(lines: Sequence[Array]) -> tuple[dict[str, Array], Array]:
    """Columns x and y of the vertices of lines (k, 2), and where each of them starts."""
    points = np.concatenate(lines) if lines else np.empty((0, 2))
    starts = np.cumsum([0, *(len(line) for line in lines)])[:-1]
    return {"x": points[:, 0], "y": points[:, 1]}, starts.astype("<i4")


def tip_text(text: str) -> str:
    """A text as part of a tip, where an @ would name a column."""
    return escape(text).replace("@", "&#64;").replace("$", "&#36;")


def live_html(figure: LiveFigure) -> str:
    """The figure as HTML, hidden where there are no scripts; empty without the library."""
    if _library() is None:
        return ""
    low, high = figure.limits.T
    size = high - low
    data = {
        "kind": figure.kind,
        "limits": figure.limits.tolist(),
        "aspect": float(np.clip(size[1] / size[0], 0.4, 1.2)) if figure.kind == "map" else 0.5,
        "x_label": figure.labels[0], "y_label": figure.labels[1],
        "x_log": figure.log[0], "y_log": figure.log[1],
        "duration_s": figure.duration_s, "in_minutes": figure.in_minutes,
        "sides": figure.sides, "scans": figure.scans, "clouds": figure.clouds,
        "series": [_series(one) for one in figure.series],
    }  # fmt: skip
    text = json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")
    return (
        f'<figure class="live" hidden data-name="{escape(figure.name)}"><figcaption>'
        f"<b>{escape(figure.title)}</b> {escape(figure.caption)}</figcaption>\n"
        f'<div class="live-controls">{_controls(figure)}</div>\n<div class="live-stage"></div>\n'
        f'<script type="application/json">{text}</script></figure>'
    )


def _series(one: Series) -> dict[str, Any]:
    plain = ("glyph", "layer", "width", "alpha", "dash", "marker", "tip", "side", "timed", "robot")
    found: dict[str, Any] = {name: getattr(one, name) for name in plain}
    found["texts"] = dict(one.texts)
    found["columns"] = {name: _column(values) for name, values in one.columns.items()}
    found["color"] = COLORS.get(one.color, one.color)
    if one.starts is not None:
        found["starts"] = encoded(one.starts)
    return found


def _controls(figure: LiveFigure) -> str:
    parts = [
        f'<label><input type=checkbox data-layer="{escape(name)}"{" checked" * shown}>'
        f"{_swatch(figure, name)}{escape(name)}</label>"
        for name, shown in figure.layers.items()
    ]
    found = f"<div class=live-layers>{''.join(parts)}</div>"
    if figure.sides:
        before, after = map(escape, figure.sides)
        found += (
            f"<label class=live-range><span>{after}</span><input type=range name=swipe min=0 "
            f'max=100 value=0 step=any aria-label="swipe from {after} to {before}">'
            f"<span>{before}</span></label>"
        )
    if figure.duration_s:
        found += (
            "<div class=live-range><button type=button>▶ replay</button><input type=range "
            "name=time min=0 max=1000 value=1000 step=any aria-label=time><output></output></div>"
        )
    return found


def _swatch(figure: LiveFigure, layer: str) -> str:
    """The colour of a layer that has one, dashed as its first curve is."""
    colors = {COLORS.get(one.color, one.color) for one in figure.series if one.layer == layer}
    colors |= {one["color"] for one in figure.clouds if one["layer"] == layer}
    if figure.scans and figure.scans["layer"] == layer:
        colors |= set(figure.scans["colors"])
    if len(colors) != 1:
        return ""
    color = f"var(--{colors.pop()})"
    dash = next((one.dash for one in figure.series if one.layer == layer), "solid")
    if isinstance(dash, str):
        return f'<i class=lane style="background:{color}"></i>'
    ends = [0.0, *np.cumsum(dash).tolist()]
    stops = [
        f"{'transparent' if k % 2 else color} {a:g}px {b:g}px"
        for k, (a, b) in enumerate(pairwise(ends))
    ]
    drawn = f"repeating-linear-gradient(90deg,{','.join(stops)})"
    return f'<i class="lane dashed" style="background:{drawn}"></i>'


def scripts() -> str:
    """The scripts of a page with figures that move; empty without the library."""
    library = _library()
    if library is None:
        return ""
    return "\n".join(f"<script>{text}</script>" for text in (*library, _safe(_OWN)))


@cache
def _library() -> tuple[str, ...] | None:
    """The texts of BokehJS, or None where the package is not installed."""
    found = importlib.util.find_spec("bokeh")
    if found is None or found.origin is None:
        return None
    folder = Path(found.origin).parent / "server" / "static" / "js"
    if not all((folder / name).is_file() for name in _LIBRARY):
        return None
    return tuple(_safe(folder / name) for name in _LIBRARY)


def _safe(path: Path) -> str:
    """A script that can stand within a page: nothing in it ends the element."""
    text = path.read_text(encoding="utf-8")
    return text.replace("</script", "<\\/script").replace("<!--", "<\\!--")
