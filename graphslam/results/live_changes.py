"""The map of changes that moves: both visits, a swipe between them, and every change's numbers."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from graphslam.core.geometry import Array, area_centroid
from graphslam.core.thinning import evenly_thinned
from graphslam.results.drawing_elements import PALETTE
from graphslam.results.live_figure import COLORS, LiveFigure, Series, cloud, joined

if TYPE_CHECKING:
    from graphslam.results.report_changes import ChangesPicture

_MAX_POINTS = 100_000  # of one visit
_STOOD = "where it stood"


def live_changes(picture: "ChangesPicture", colors: Mapping[str, str]) -> LiveFigure:
    """The figure; ``colors`` of the kinds of changes."""
    series = []
    for kind, color in colors.items():
        chosen = [(i, mark) for i, mark in enumerate(picture.marks) if mark.kind == kind]
        if not chosen:
            continue
        outlines = [_closed(mark.polygon) for _, mark in chosen]
        columns, starts = joined(outlines)
        middle = np.array([area_centroid(mark.polygon) for _, mark in chosen])
        motions = [np.full(3, np.nan) if m.motion is None else m.motion for _, m in chosen]
        columns |= {
            "number": np.array([float(i + 1) for i, _ in chosen]),
            "at_x": middle[:, 0],
            "at_y": middle[:, 1],
            "percent": np.array([100 * mark.probability for _, mark in chosen]),
            "beams": np.array([float(mark.beams) for _, mark in chosen]),
            "moved": np.array([100 * float(np.hypot(*motion[:2])) for motion in motions]),
            "turned": np.array([float(np.degrees(motion[2])) for motion in motions]),
        }
        tip = (
            f"<b>@number{{0}} {kind}</b><br>at @at_x{{0.00}}, @at_y{{0.00}} m<br>"
            "@percent{0.0} % sure, @beams{0} beams"
        )
        if kind == "moved":
            tip += "<br>moved @moved{0.0} cm, turned @turned{0.0}°"
        series.append(Series("areas", kind, color, columns, 2.0, 1.0, starts=starts, tip=tip))
        before = [_closed(mark.before) for _, mark in chosen if mark.before is not None]
        if before:
            stood, starts = joined(before)
            series.append(
                Series("lines", _STOOD, color, stood, 1.5, 1.0, dash="dashed", starts=starts)
            )
    names = picture.names
    clouds = [
        cloud(evenly_thinned(picture.reference, _MAX_POINTS), "reference", "soft", "before"),
        cloud(evenly_thinned(picture.later, _MAX_POINTS), "later", COLORS[PALETTE[0]], "after"),
    ]
    layers = {"reference": True, "later": True, **{one.layer: True for one in series}}
    return LiveFigure(
        "changes", "Interactive map.",
        "Drag to move; click, then turn the wheel to zoom; point at a change for its numbers. "
        f"Swipe: {_named('reference', names[0])} left of the line, {_named('later', names[1])} "
        "right of it.",
        "map", picture.limits, series, layers, sides=("reference", "both"),
        clouds=clouds,
    )  # fmt: skip


def _named(visit: str, name: str) -> str:
    """A visit with the name of its folder, where that says more."""
    return visit if name == visit else f"{name} ({visit})"


def _closed(polygon: Array) -> Array:
    return np.concatenate([polygon, polygon[:1]])
