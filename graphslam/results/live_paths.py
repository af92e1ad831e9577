"""The paths of all back ends of a comparison in one map that moves."""

from typing import TYPE_CHECKING

import numpy as np

from graphslam.core.geometry import Array
from graphslam.core.thinning import rows_along
from graphslam.results.drawing_elements import INK, Style
from graphslam.results.live_figure import LiveFigure, Series, tip_text
from graphslam.results.report_html import MINUTES_FROM_S

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from graphslam.results.report_comparison import BackendCurves, Comparison, ErrorCurve, TimedPath

#: of one back end and kind, all robots together: at even intervals, and at most
_MAX_POSES, _MOST_POSES = 3000, 9000
#: poses at even intervals of one robot at least; and m: how far what is drawn is from a path
_LEAST_POSES, _WITHIN_M = 250, 0.01
_TRUTH = "the truth"
#: which side of the swipe a kind of trajectory is on
_SIDES = {"causal": "before", "final": "after"}


def live_paths(
    comparison: "Comparison",
    styled: "Iterable[tuple[BackendCurves, Style]]",
    limits: Array,
    against: str,
) -> LiveFigure:
    """The figure: a layer for each back end, swiped from final to causal paths, and replayed.

    ``styled``: the back ends with the styles of their curves; ``limits`` [[x_min, x_max],
    [y_min, y_max]], m; ``against``: what errors are distances to.
    """
    stamps = [
        path.stamps_ns
        for backend in comparison.backends
        for paths in backend.paths.values()
        for path in paths.values()
    ]
    start_ns, end_ns = min(int(s[0]) for s in stamps), max(int(s[-1]) for s in stamps)
    in_minutes = end_ns - start_ns > 1e9 * MINUTES_FROM_S
    clock = "@clock{0.00} min" if in_minutes else "@clock{0.0} s"
    unit = 60.0 if in_minutes else 1.0
    series = []
    for backend, style in styled:
        dash = "dashed" if style.dashes else "solid"
        for kind, side in _SIDES.items():
            for name, path in backend.paths[kind].items():
                columns = _columns(path, start_ns, len(backend.paths[kind]))
                series.append(
                    Series(
                        "path", backend.label, style.color, columns, style.width, 0.9, dash,
                        side=side, timed=True, robot=True,
                    )
                )  # fmt: skip
                named = f" {tip_text(name)}" if len(backend.paths[kind]) > 1 else ""
                tip = f"<b>{tip_text(backend.label)}</b>{named}, {kind}<br>at {clock}"
                points = {key: columns[key] for key in ("x", "y", "time")}
                points["clock"] = columns["time"] / unit
                curve = backend.curves[kind].get(name)
                if curve is not None:
                    points["error"] = 100 * _error_at(curve, columns["time"], start_ns)
                    tip += f"<br>@error{{0.0}} cm from {tip_text(against)}"
                # discs that are not seen, only pointed at
                series.append(
                    Series(
                        "points", backend.label, style.color, points, 7.0, 0.0, tip=tip, side=side,
                        timed=True,
                    )
                )  # fmt: skip
    for xy in comparison.truth.values():
        kept = xy[_followed(xy, len(comparison.truth))]
        truth = {"x": kept[:, 0], "y": kept[:, 1]}
        series.append(Series("path", _TRUTH, INK, truth, 1.0, 0.9, "dashed"))
    return LiveFigure(
        "paths", "Interactive map of the paths.",
        "Drag to move; click, then turn the wheel to zoom; point at a path for its back end, time "
        f"and distance to {against}. Switch back ends off; swipe from final paths (all data) to "
        "causal ones (data up to each pose); replay the drive.",
        "map", limits, series, {one.layer: True for one in series},
        duration_s=(end_ns - start_ns) / 1e9, in_minutes=in_minutes, sides=("causal", "final"),
    )  # fmt: skip


def _followed(points: Array, robots: int) -> "NDArray[np.int64]":
    """Rows of a path (n, 2), of one of so many robots, that follow it; some at even intervals."""
    even = max(_LEAST_POSES, _MAX_POSES // robots)
    return rows_along(points, _WITHIN_M, even, max(even, _MOST_POSES // robots))


def _columns(path: "TimedPath", start_ns: int, robots: int) -> dict[str, Array]:
    """Poses that follow a path, of one of so many robots, and their times, s."""
    chosen = _followed(path.poses[:, :2], robots)
    x, y, heading = path.poses[chosen].T
    time = (path.stamps_ns[chosen] - start_ns) / 1e9
    return {"x": x, "y": y, "heading": heading, "time": time}


def _error_at(curve: "ErrorCurve", seconds: Array, start_ns: int) -> Array:
    """Position errors, m, at times (n,) s after ``start_ns``; NaN beyond what was compared."""
    known = (curve.stamps_ns - start_ns) / 1e9
    return np.interp(seconds, known, curve.position_m, left=np.nan, right=np.nan)
