"""The paths of all runs of an experiment around the true ones: a map that moves, and its drawing.

Errors of a good estimator are too small for a map of the whole room, so they are drawn enlarged, by
a factor that the caption tells; what pointing shows are the errors as they are.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from graphslam.core.geometry import Array
from graphslam.results.drawing_elements import INK, Style
from graphslam.results.live_figure import LiveFigure, Series, joined, tip_text
from graphslam.results.report_figure import WIDTH_IN, Drawing, map_axes, svg
from graphslam.results.report_html import MINUTES_FROM_S

_TRUTH, _ROOM = "the truth", "room"
#: of the size of the map: how far the larger errors of most variants are drawn from the truth, and
#: from where on a variant would hide the others
_DRAWN, _HIDING = 0.04, 0.25
_QUANTILE = 0.9  # what the larger errors of a variant are
_FACTORS = [step * 10**k for k in range(4) for step in (1, 2, 5)]


@dataclass(frozen=True, slots=True, eq=False)
class RunPath:
    """A robot's path in one run: times (n,) s from its begin, positions (n, 2) m, true ones."""

    run: int
    robot: str
    time_s: Array
    estimate: Array
    truth: Array

    @property
    def errors_m(self) -> Array:
        """Distances (n,) from the truth."""
        return np.asarray(np.hypot(*(self.estimate - self.truth).T))


@dataclass(frozen=True, slots=True, eq=False)
class RunsMap:
    """Runs in one room by variant: ``walls`` (k, 2) m each, and ``points`` (n, 2) m.

    ``name`` is unique on the page, ``title`` what the map is of.
    """

    name: str
    title: str
    walls: Sequence[Array]
    points: Array
    runs: Mapping[str, Sequence[RunPath]]


def live_runs(shown: RunsMap, styles: Mapping[str, Style]) -> LiveFigure:
    """The figure: a layer for each variant, replayed; ``styles`` of the variants."""
    factor, first = enlargement(shown), shown_first(shown)
    end_s = max(float(path.time_s[-1]) for path in _all(shown))
    in_minutes = end_s > MINUTES_FROM_S
    clock = "@clock{0.00} min" if in_minutes else "@clock{0.0} s"
    several = len(_true_paths(shown)) > 1
    series = _room(shown)
    for variant, paths in shown.runs.items():
        if not paths:
            continue
        drawn = [_enlarged(path, factor) for path in paths]
        gap = np.full((1, 2), np.nan)
        lines = np.concatenate([part for line in drawn for part in (line, gap)])
        times = np.concatenate([part for p in paths for part in (p.time_s, [np.nan])])
        color = styles[variant].color
        columns = {"x": lines[:, 0], "y": lines[:, 1], "time": times}
        series.append(Series("path", variant, color, columns, 1.0, 0.5, timed=True))
        time = np.concatenate([path.time_s for path in paths])
        ends = np.concatenate(drawn)
        points = {
            "x": ends[:, 0], "y": ends[:, 1], "time": time,
            "clock": time / 60.0 if in_minutes else time,
            "run": np.repeat([float(p.run) for p in paths], [len(p.time_s) for p in paths]),
            "error": 100 * np.concatenate([path.errors_m for path in paths]),
        }  # fmt: skip
        robots = [path.robot for path in paths for _ in path.time_s]
        tip = f"<b>{tip_text(variant)}</b>, run @run{{0}}{', @robot' if several else ''}"
        tip += f"<br>at {clock}<br>@error{{0.0}} cm from the truth"
        # discs that are not seen, only pointed at
        series.append(
            Series(
                "points", variant, color, points, 6.0, 0.0, tip=tip, timed=True,
                texts={"robot": robots} if several else {},
            )
        )  # fmt: skip
    for path in _true_paths(shown):
        series.append(_truth(path))
    layers = {one.layer: one.layer in {*first, _ROOM, _TRUTH} for one in series}
    return LiveFigure(
        shown.name, f"{shown.title}, interactive.",
        f"{caption(shown)} Drag to move; click, then turn the wheel to zoom; point at a path for "
        "its run and error; switch variants on and off; replay the drive.",
        "map", limits(shown), series, layers, duration_s=end_s, in_minutes=in_minutes,
    )  # fmt: skip


def runs_drawing(shown: RunsMap, styles: Mapping[str, Style]) -> str:
    """The same as a drawing, for print and where there are no scripts."""
    factor, first = enlargement(shown), shown_first(shown)
    shape = limits(shown)
    size = shape[:, 1] - shape[:, 0]
    height_in = float(np.clip(WIDTH_IN * size[1] / size[0], 1.6, 5.5))

    def draw(drawing: Drawing) -> None:
        axes = map_axes(drawing, shape)
        axes.lines(list(shown.walls), Style(INK, 1.0, opacity=0.5))
        axes.symbols(shown.points, INK, 4, triangles=True)
        for variant, paths in shown.runs.items():
            if variant in first:
                style = Style(styles[variant].color, 0.6, opacity=0.5)
                axes.legend.append((variant, Style(styles[variant].color, 1.5)))
                axes.lines([_enlarged(path, factor) for path in paths], style, layer=3)
        axes.legend.append((_TRUTH, Style(INK, 0.8, dashes=(4, 2.5))))
        axes.lines(
            [path.truth for path in _true_paths(shown)], Style(INK, 0.8, dashes=(4, 2.5)), layer=4
        )

    return svg(shown.title, height_in, draw)


def caption(shown: RunsMap) -> str:
    """Which variants are drawn at first, and how large their errors."""
    factor, first = enlargement(shown), shown_first(shown)
    count = len({path.run for path in _all(shown)})
    runs = "one run" if count == 1 else f"{count} runs"
    how = "to scale" if factor == 1 else f"{factor} times as large"
    who = " and ".join(first)
    return f"Final paths of {runs} of {who} around the true one; errors are drawn {how}."


def enlargement(shown: RunsMap) -> int:
    """How many times as large errors are drawn: those of most variants are then seen."""
    typical = float(np.median(list(_larger_errors(shown).values())))
    fitting = [f for f in _FACTORS if f * typical <= _DRAWN * _size(shown)]
    return max(fitting, default=1)


def shown_first(shown: RunsMap) -> list[str]:
    """Two variants, since more hide each other: the others can be switched on.

    The first and the last of five that are not too far off, whose colours are told apart at once.
    """
    far = _HIDING * _size(shown) / enlargement(shown)
    errors = _larger_errors(shown)
    near = [name for name, error in errors.items() if error <= far][:5] or list(errors)
    return list(dict.fromkeys([near[0], near[-1]]))


def _larger_errors(shown: RunsMap) -> dict[str, float]:
    """A high quantile, m, of the errors of each variant that has runs."""
    return {
        variant: float(np.quantile(np.concatenate([path.errors_m for path in paths]), _QUANTILE))
        for variant, paths in shown.runs.items()
        if paths
    }


def _size(shown: RunsMap) -> float:
    shape = limits(shown)
    return float((shape[:, 1] - shape[:, 0]).max())


def limits(shown: RunsMap) -> Array:
    """What shows the room and all true paths: [[x_min, x_max], [y_min, y_max]], m."""
    seen = np.concatenate(
        [*shown.walls, shown.points.reshape(-1, 2), *(path.truth for path in _true_paths(shown))]
    )
    low, high = seen.min(axis=0), seen.max(axis=0)
    margin = 0.04 * max(float((high - low).max()), 1.0)
    return np.column_stack([low - margin, high + margin])


def _all(shown: RunsMap) -> list[RunPath]:
    return [path for paths in shown.runs.values() for path in paths]


def _true_paths(shown: RunsMap) -> list[RunPath]:
    """A run of each robot: the true paths of runs differ by little or nothing."""
    first: dict[str, RunPath] = {}
    for path in _all(shown):
        first.setdefault(path.robot, path)
    return [first[robot] for robot in sorted(first)]


def _enlarged(path: RunPath, factor: int) -> Array:
    return np.asarray(path.truth + factor * (path.estimate - path.truth))


def _truth(path: RunPath) -> Series:
    """A true path, along which the replay drives; its heading is that of the motion."""
    x, y = path.truth.T
    step = np.diff(path.truth, axis=0, append=path.truth[-1:])
    heading = np.arctan2(step[:, 1], step[:, 0])
    if len(heading) > 1:
        heading[-1] = heading[-2]
    columns = {"x": x, "y": y, "time": path.time_s, "heading": heading}
    return Series("path", _TRUTH, INK, columns, 1.5, 0.9, "dashed", timed=True, robot=True)


def _room(shown: RunsMap) -> list[Series]:
    found = []
    if shown.walls:
        columns, starts = joined(list(shown.walls))
        found.append(Series("lines", _ROOM, INK, columns, 2.0, 0.5, starts=starts))
    if len(shown.points):
        x, y = shown.points.T
        found.append(Series("points", _ROOM, INK, {"x": x, "y": y}, 8.0, 0.7, marker="triangle"))
    return found
