"""The style of the figures in docs/figures: colours, panels, and common plot elements."""

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from graphslam.core.geometry import Array, compose

INK, WALL, MARK = "#1b1f24", "#c8601a", "#228833"
BLUE, RED, GREY = "#4477aa", "#ee6677", "#9aa4af"


def panels(columns: int, size: tuple[float, float]) -> tuple[Figure, list[Axes]]:
    """A figure of one row; ``size`` in inches."""
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(1, columns, squeeze=False)[0]
    for ax in axes:
        ax.set_aspect("equal")
        ax.tick_params(labelsize=7, color=GREY, labelcolor=INK)
        for spine in ax.spines.values():
            spine.set_color(GREY)
    return figure, list(axes)


def scatter(ax: Axes, points: Array, title: str, color: str = INK, size: float = 0.4) -> None:
    """Superposed measurements (..., 2)."""
    flat = points.reshape(-1, 2)
    marker = "," if size <= 1 else "."
    ax.plot(*flat.T, marker, color=color, markersize=size, alpha=0.5, rasterized=True)
    ax.set_title(title, fontsize=9, color=INK)


def path(ax: Axes, poses: Array, color: str, label: str, frame: Array | None = None) -> None:
    """A trajectory (n, 3)."""
    moved = poses if frame is None else compose(frame, poses)
    ax.plot(*moved[:, :2].T, color=color, lw=1.1, label=label)


def window(ax: Axes, center: Array, half_m: float) -> None:
    """An enlargement."""
    ax.set_xlim(center[0] - half_m, center[0] + half_m)
    ax.set_ylim(center[1] - half_m, center[1] + half_m)


def legend(ax: Axes) -> None:
    """Small, where there is room."""
    ax.legend(fontsize=7, frameon=False, loc="best")
