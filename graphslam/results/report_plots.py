# ruff: noqa: RUF001 -- σ and – are meant: people read them
"""Curves over time: uncertainty, revision of past poses, innovations, time per step."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array, wrap
from graphslam.core.observation_models import MODELS
from graphslam.core.records import Result, Trajectory
from graphslam.core.thinning import evenly_thinned
from graphslam.results.drawing_elements import ACCENT, INK, Style, robot_color
from graphslam.results.drawing_scales import linear_scale
from graphslam.results.report_figure import (
    Drawing,
    log_scale,
    positive,
    svg,
    time_axis,
    time_rows,
)
from graphslam.results.report_html import number
from graphslam.results.report_maps import worst_sigma

_MAX_DOTS = 4000


def uncertainty(result: Result) -> str:
    """Standard deviations of position (worst direction) and heading over time."""
    axis = _TimeAxis(result)

    def draw(drawing: Drawing) -> None:
        top, bottom = time_rows(drawing, 2, axis.label)
        for i, (name, robot) in enumerate(sorted(result.robots.items())):
            both = ((robot.final, 1.0, 3, "final"), (robot.causal, 0.5, 2, "causal"))
            for path, opacity, layer, kind in both:
                if path is None:
                    continue  # not asked for
                label = _legend_text(name, kind, len(result.robots))
                t, style = axis.time(path), Style(robot_color(i), opacity=opacity)
                top.line(t, positive(worst_sigma(path.covs)), style, label, layer)
                bottom.line(t, np.degrees(_root(path.covs[:, 2, 2])), style, layer=layer)
        log_scale(top, "position σ, m")
        log_scale(bottom, "heading σ, °")

    return svg("Uncertainty over time", 3.5, draw)


def revision(result: Result) -> str:
    """How far causal estimates and dead reckoning are from the final trajectory, over time."""
    axis = _TimeAxis(result)

    def draw(drawing: Drawing) -> None:
        top, bottom = time_rows(drawing, 2, axis.label)
        for i, (name, robot) in enumerate(sorted(result.robots.items())):
            solid = Style(robot_color(i), 1.0)
            dashed = solid._replace(opacity=0.8, dashes=(2, 1.2))
            others = (
                (robot.causal, solid, 3, "causal"),
                (robot.dead_reckoning, dashed, 2, "odometry"),
            )
            for path, style, layer, kind in others:
                if path is None or len(path) != len(robot.final):
                    continue  # not asked for, or at other stamps
                off = path.poses - robot.final.poses
                t = axis.time(path)
                label = _legend_text(name, kind, len(result.robots))
                distance = np.hypot(off[:, 0], off[:, 1])
                top.line(t, positive(distance), style, label, layer)
                turn = np.degrees(np.abs(wrap(off[:, 2])))
                bottom.line(t, positive(turn), style, layer=layer)
        log_scale(top, "position, m")
        log_scale(bottom, "heading, °")

    return svg("Distance from the final trajectory over time", 3.5, draw)


def innovations(found: Mapping[str, Array], unit: tuple[float, str] = (1e9, "time, s")) -> str:
    """Normalised innovation squared per degree of freedom of each model, over time.

    ``found[model]`` (n, 2) has a row per innovation: time s, d² / dof.
    ``unit``: of the axis of time, ns, and its label. The expectation is 1; the dashed line is the
    95 % quantile of chi-square for one innovation.
    """
    scale = np.array([1e9 / unit[0], 1.0])
    found = {model: values * scale for model, values in sorted(found.items()) if len(values)}

    def draw(drawing: Drawing) -> None:
        rows = time_rows(drawing, len(found), unit[1])
        times = np.concatenate([values[:, 0] for values in found.values()])
        span = linear_scale(float(times.min()), float(times.max()), 0.01)
        for axes, (model, values) in zip(rows, found.items(), strict=True):
            axes.set_x(span.low, span.high)
            dots = evenly_thinned(values, _MAX_DOTS)
            axes.dots(dots[:, 0], positive(dots[:, 1], 1e-3), robot_color(0), 1.25, 0.55)
            axes.line(*_running(values, np.mean), Style(INK))
            axes.level(1.0, Style(ACCENT, 1.0))
            title = f"{model}: n {number(len(values))}, mean {values[:, 1].mean():.2f}"
            if model in MODELS:
                limit = float(chi2_quantile(0.95, MODELS[model].rows)) / MODELS[model].rows
                axes.level(limit, Style(ACCENT, 0.8, dashes=(3.7, 1.6)))
                title += f", {100 * np.mean(values[:, 1] > limit):.1f} % above the dashes"
            axes.title = title
            low = max(1e-3, float(np.quantile(values[:, 1], 0.005)) / 2)
            log_scale(axes, "NIS / dof", low)

    return svg("Innovations per observation model", 0.75 + 1.35 * len(found), draw)


def timing(step_ms: Array) -> str:
    """Wall time ``step_ms`` (n,), ms, of every step with its running median."""
    steps = np.arange(len(step_ms))
    dots = evenly_thinned(steps, _MAX_DOTS)

    def draw(drawing: Drawing) -> None:
        (axes,) = time_rows(drawing, 1, "step")
        axes.dots(dots, positive(step_ms[dots], 1e-3), robot_color(0), 1.5, 0.6)
        axes.line(*_running(np.column_stack([steps, step_ms]), np.median), Style(INK))
        log_scale(axes, "ms")

    return svg("Wall time per step", 2.6, draw)


def unit_of_time(result: Result) -> tuple[float, str]:
    """Unit, ns, and label of every axis of time on the page of a result."""
    axis = _TimeAxis(result)
    return axis.unit_ns, axis.label


class _TimeAxis:
    """Time since the first pose of any robot, in a unit that fits the span."""

    def __init__(self, result: Result) -> None:
        stamps = [robot.final.stamps_ns for robot in result.robots.values()]
        self._start_ns, last_ns = int(min(s[0] for s in stamps)), int(max(s[-1] for s in stamps))
        self.unit_ns, self.label = time_axis(self._start_ns, last_ns)

    def time(self, path: Trajectory) -> Array:
        return np.asarray((path.stamps_ns - self._start_ns) / self.unit_ns)


def _root(variance: Array) -> Array:
    return positive(np.sqrt(np.maximum(variance, 0.0)))


def _running(
    values: Array, statistic: Callable[[Array], Any], bins: int = 60
) -> tuple[Array, Array]:
    """Mean abscissa and a statistic of the ordinate in bins of equally many samples."""
    parts = np.array_split(values, min(bins, max(1, len(values) // 5)))
    x = np.array([part[:, 0].mean() for part in parts])
    return x, np.array([statistic(part[:, 1]) for part in parts])


def _legend_text(name: str, kind: str, robots: int) -> str:
    """Legend text: colours tell several robots apart, strokes the kinds of one robot."""
    return kind if robots == 1 else name
