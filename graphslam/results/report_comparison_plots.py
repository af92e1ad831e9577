"""Figures of a comparison of back ends: paths, errors and consistency over time, cost."""

from collections.abc import Iterator

import numpy as np

from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array
from graphslam.results.drawing import Axes
from graphslam.results.drawing_elements import ACCENT, INK, PALETTE, Style, robot_color
from graphslam.results.live_charts import Curve, live_chart
from graphslam.results.live_figure import LiveFigure
from graphslam.results.live_paths import live_paths
from graphslam.results.report_comparison import BackendCurves, Comparison, ErrorCurve
from graphslam.results.report_figure import (
    WIDTH_IN,
    Drawing,
    log_scale,
    map_axes,
    positive,
    svg,
    time_axis,
    time_rows,
)
from graphslam.results.report_html import figure

_MAX_POINTS = 120  # of one curve; more would hide other curves where errors vary quickly


def figures(comparison: Comparison) -> dict[str, list[str]]:
    """Heading -> figures."""
    found: dict[str, list[str]] = {"Trajectories": [], "Errors over time": [], "Time per step": []}
    against = "the truth" if comparison.truth else "{reference}".format(**comparison.summary)
    moved = comparison.truth and not comparison.summary["start_given"]
    aligned = " Every back end is aligned with the truth separately." if moved else ""
    dashed = " Dashed: the truth." if comparison.truth else ""
    for kind in ("final", "causal"):
        found["Trajectories"].append(
            figure(_paths(comparison, kind), f"{kind.title()}.", f"In the plane.{dashed}{aligned}")
        )
        if any(backend.curves[kind] for backend in comparison.backends):
            caption = (
                f"Distance to {against} and difference of heading, RMS of neighbouring poses."
                f"{aligned}"
            )
            title = f"Error, {kind}."
            found["Errors over time"].append(figure(_errors(comparison, kind), title, caption))
    for kind in ("final", "causal"):
        if any(np.isfinite(c.nees).any() for _, _, c in _curves(comparison, kind)):
            caption = (
                "NEES per degree of freedom, mean of neighbouring poses; solid 1, dashed the 95 % "
                "bounds of one pose."
            )
            title = f"Consistency, {kind}."
            found["Errors over time"].append(figure(_nees(comparison, kind), title, caption))
    for label, axis, caption in (
        ("steps", None, "Median and 99 % quantile (pale) of neighbouring steps."),
        ("landmarks in the map", "landmarks", "Against map size: medians."),
        ("path driven, m", "path_m", "Against path length: medians."),
    ):
        drawing = _cost(comparison.backends, label, axis)
        found["Time per step"].append(figure(drawing, f"By {label}.", caption))
    return found


def live_errors(comparison: Comparison, kind: str) -> LiveFigure | None:
    """Position errors over time with their values where one points; None without any."""
    curves = list(_curves(comparison, kind))
    if not curves:
        return None
    start, unit, label = _clock(comparison)
    against = "the truth" if comparison.truth else "{reference}".format(**comparison.summary)
    drawn = []
    for backend, style, curve in curves:
        t, squares = _averaged((curve.stamps_ns - start) / unit, curve.position_m**2)
        drawn.append(Curve(backend.label, style, t, np.sqrt(squares)))
    return live_chart(
        f"errors-{kind}",
        f"Error, {kind}, interactive.",
        f"Distance to {against}, RMS of neighbouring poses. Drag to move; click, then turn the "
        "wheel to zoom; point at a curve for its values; switch back ends off.",
        drawn,
        (label, "position, m"),
        log=(False, True),
    )


def live_map(comparison: Comparison) -> LiveFigure:
    """The paths of all back ends in one map that moves."""
    final, causal = (_limits(comparison, kind) for kind in ("final", "causal"))
    limits = np.column_stack(
        [np.minimum(final[:, 0], causal[:, 0]), np.maximum(final[:, 1], causal[:, 1])]
    )
    against = "the truth" if comparison.truth else "{reference}".format(**comparison.summary)
    return live_paths(comparison, _styled(comparison.backends), limits, against)


def _limits(comparison: Comparison, kind: str) -> Array:
    """What shows all paths of a kind and the truth: [[x_min, x_max], [y_min, y_max]], m."""
    paths = [path for backend in comparison.backends for path in backend.paths[kind].values()]
    shown = [*(path.poses[:, :2] for path in paths), *comparison.truth.values()]
    low = np.min([path.min(axis=0) for path in shown], axis=0)
    high = np.max([path.max(axis=0) for path in shown], axis=0)
    margin = 0.03 * max(float((high - low).max()), 1.0)
    return np.column_stack([low - margin, high + margin])


def _paths(comparison: Comparison, kind: str) -> str:
    limits = _limits(comparison, kind)
    size = limits[:, 1] - limits[:, 0]
    height = float(np.clip(WIDTH_IN * size[1] / size[0], 2.2, 5.5))

    def draw(drawing: Drawing) -> None:
        axes = map_axes(drawing, limits)
        for backend, style in _styled(comparison.backends):
            for path in backend.paths[kind].values():
                axes.path(path.poses[:, :2], style)
        for true in comparison.truth.values():
            axes.path(true, Style(INK, 0.7, dashes=(4, 2.5)), layer=8)

    return svg(f"Paths of all back ends, {kind}", height, draw)


def _errors(comparison: Comparison, kind: str) -> str:
    start, unit, label = _clock(comparison)

    def draw(drawing: Drawing) -> None:
        top, bottom = time_rows(drawing, 2, label)
        for _, style, curve in _curves(comparison, kind):
            t = (curve.stamps_ns - start) / unit
            for axes, values in ((top, curve.position_m), (bottom, np.degrees(curve.heading_rad))):
                middle, squares = _averaged(t, values**2)
                axes.line(middle, positive(np.sqrt(squares)), style)
        _log(top, "position, m")
        _log(bottom, "heading, °")

    return svg(f"Errors over time, {kind}", 3.5, draw)


def _nees(comparison: Comparison, kind: str) -> str:
    start, unit, label = _clock(comparison)

    def draw(drawing: Drawing) -> None:
        (axes,) = time_rows(drawing, 1, label)
        for _, style, curve in _curves(comparison, kind):
            t = (curve.stamps_ns - start) / unit
            axes.line(*_averaged(t, curve.nees), style)
        for bound in chi2_quantile([0.025, 0.975], 3) / 3:
            axes.level(float(bound), Style(ACCENT, 1.0, dashes=(4, 2.5)), layer=8)
        axes.level(1.0, Style(ACCENT, 0.9), layer=8)
        _log(axes, "NEES / dof")

    return svg(f"Consistency over time, {kind}", 2.6, draw)


def _cost(backends: tuple[BackendCurves, ...], label: str, axis: str | None) -> str:
    def draw(drawing: Drawing) -> None:
        (axes,) = time_rows(drawing, 1, label)
        for backend, style in _styled(backends):
            size = np.arange(len(backend.step_ms)) if axis is None else getattr(backend, axis)
            order = np.argsort(size, kind="stable")
            parts = np.array_split(order, max(1, min(60, len(order) // 8)))
            x = np.array([np.median(size[part]) for part in parts])
            middle = np.array([np.median(backend.step_ms[part]) for part in parts])
            sizes = np.unique(x)  # a map may keep its size for many steps
            axes.line(sizes, [float(np.median(middle[x == value])) for value in sizes], style)
            if axis is None:
                high = [float(np.quantile(backend.step_ms[part], 0.99)) for part in parts]
                axes.line(x, high, style._replace(width=0.7, opacity=0.45))
        _log(axes, "ms")

    return svg(f"Time per step by {label}", 2.6, draw)


def _log(axes: Axes, label: str) -> None:
    """A logarithmic axis over at most three decades: zero crossings go below any limit."""
    axes.log_y = True
    low, high = axes.data_range(1)
    if high > 0:
        log_scale(axes, label, max(low, 1e-3 * high) / 1.2)


def _styled(backends: tuple[BackendCurves, ...]) -> Iterator[tuple[BackendCurves, Style]]:
    """Back ends with their line styles: later ones thinner, so that equal curves are all seen."""
    widths = np.linspace(2.6, 1.0, len(backends)) if len(backends) > 1 else [1.2]
    for i, (backend, width) in enumerate(zip(backends, widths, strict=True)):
        dashes = () if i < len(PALETTE) else (3, 1.2)  # the colours repeat
        yield backend, Style(robot_color(i), float(width), dashes=dashes)


def _curves(comparison: Comparison, kind: str) -> Iterator[tuple[BackendCurves, Style, ErrorCurve]]:
    for backend, style in _styled(comparison.backends):
        for curve in backend.curves[kind].values():
            yield backend, style, curve


def _clock(comparison: Comparison) -> tuple[int, float, str]:
    """First stamp, ns per unit, and the name of the time axis."""
    stamps = [c.stamps_ns for k in ("final", "causal") for _, _, c in _curves(comparison, k)]
    first, last = min(int(s[0]) for s in stamps), max(int(s[-1]) for s in stamps)
    return first, *time_axis(first, last)


def _averaged(t: Array, values: Array) -> tuple[Array, Array]:
    """Means of neighbouring values, at most `_MAX_POINTS`; every value is in one of them."""
    parts = max(1, min(len(t), _MAX_POINTS))
    means = [[part.mean() for part in np.array_split(x, parts)] for x in (t, values)]
    return np.array(means[0]), np.array(means[1])
