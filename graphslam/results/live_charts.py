"""Curves that can be zoomed and hovered: of comparisons and experiments."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from graphslam.core.geometry import Array
from graphslam.results.drawing_elements import Style
from graphslam.results.drawing_scales import linear_scale, log_scale
from graphslam.results.live_figure import LiveFigure, Series, tip_text

_DECADES = (
    1e-4  # what is smaller than this share of the greatest value of a logarithmic axis is cut
)


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """A curve ``x``, ``y`` (n,) with its name in the legend; several may share one."""

    name: str
    style: Style
    x: Array
    y: Array


def live_chart(
    name: str,
    title: str,
    caption: str,
    curves: Sequence[Curve],
    labels: tuple[str, str],
    *,
    log: tuple[bool, bool] = (False, False),
    marked: bool = False,
) -> LiveFigure:
    """Curves over x with their values where one points; ``marked``: with a disc at each value."""
    series = []
    for curve in curves:
        y = np.where(curve.y > 0, curve.y, np.nan) if log[1] else curve.y
        columns = {"x": np.asarray(curve.x, dtype=float), "y": np.asarray(y, dtype=float)}
        tip = (
            f"<b>{tip_text(curve.name)}</b><br>{tip_text(labels[0])} @x{{0.[00]}}<br>"
            f"{tip_text(labels[1])} @y{{0.[000000]}}"
        )
        dash = "solid"
        if curve.style.dashes:
            dash = "dashed" if curve.style.dashes[0] > 2 else "dotted"
        look = (curve.style.width, curve.style.opacity, dash)
        color = curve.style.color
        series.append(Series("path", curve.name, color, columns, *look, tip="" if marked else tip))
        if marked:
            series.append(Series("points", curve.name, color, columns, 7.0, 1.0, tip=tip))
    x, y = (np.concatenate([one.columns[axis] for one in series]) for axis in ("x", "y"))
    return LiveFigure(
        name, title, caption, "chart", np.array([_range(x, log[0]), _range(y, log[1])]), series,
        {curve.name: True for curve in curves}, labels=labels, log=log,
    )  # fmt: skip


def _range(values: Array, is_log: bool) -> tuple[float, float]:
    """Limits of an axis that shows all values."""
    known = values[np.isfinite(values)]
    if not len(known):
        return 0.1, 1.0
    high = float(known.max())
    scale = (
        log_scale(max(float(known.min()), _DECADES * high), high)
        if is_log
        else linear_scale(float(known.min()), high)
    )
    return scale.low, scale.high
