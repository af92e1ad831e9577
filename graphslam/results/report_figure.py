"""Figures as inline SVG in the colours of the page.

Figures are drawn in the colours of the light page, which become CSS variables in the SVG, so that
the page chooses light or dark. Text stays text. The output is deterministic: no dates, no random
identifiers.
"""

import io
import re
from collections.abc import Callable
from html import escape
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from graphslam.core.geometry import Array

INK = "#1b1f24"
FAINT = "#d5d9de"
#: One colour a robot, told apart with any colour vision: P. Tol, Colour schemes, SRON/EPS/TN/09-002
PALETTE = ("#4477aa", "#ee6677", "#228833", "#aa3377", "#ccbb44", "#66ccee")
ACCENT = "#c8601a"

WIDTH_IN = 4.9
#: m or degrees: smaller values are not worth a decade of a logarithmic axis
SMALLEST = 1e-6
_THEMED = {INK: "currentColor", FAINT: "var(--grid)", ACCENT: "var(--accent)"} | {
    color: f"var(--robot{i})" for i, color in enumerate(PALETTE)
}
# Any: matplotlib types the keys of rcParams as literals since 3.11 and as str before
_STYLE: Any = {
    "axes.facecolor": "none",
    "axes.edgecolor": FAINT,
    "axes.grid": True,
    "axes.labelcolor": INK,
    "axes.labelsize": 8.5,
    "axes.linewidth": 0.8,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlecolor": INK,
    "axes.titlesize": 9,
    "axes.titleweight": "normal",
    "font.size": 8.5,
    "grid.color": FAINT,
    "grid.linewidth": 0.6,
    "legend.fontsize": 8,
    "legend.frameon": False,
    "legend.labelcolor": INK,
    "lines.linewidth": 1.2,
    "svg.fonttype": "none",
    "text.color": INK,
    "xtick.color": FAINT,
    "xtick.labelcolor": INK,
    "xtick.labelsize": 8,
    "ytick.color": FAINT,
    "ytick.labelcolor": INK,
    "ytick.labelsize": 8,
}


def svg(label: str, height_in: float, draw: Callable[[Figure], None]) -> str:
    """What ``draw`` draws as an inline SVG element, described by ``label`` for screen readers."""
    # the salt makes identifiers repeatable, and different between the figures of a page
    with mpl.rc_context():
        mpl.rcdefaults()  # independent of the user's matplotlibrc
        mpl.rcParams.update({**_STYLE, "svg.hashsalt": label})
        figure = Figure(figsize=(WIDTH_IN, height_in), dpi=200, facecolor="none")
        FigureCanvasSVG(figure)
        draw(figure)
        text = io.StringIO()
        figure.savefig(text, format="svg", metadata={"Date": None})
    return _clean(text.getvalue(), label)


def _clean(text: str, label: str) -> str:
    """The <svg> element alone: colours and font of the page, no fixed size, no unused ids."""
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>\s*", "", text, flags=re.DOTALL)
    # matplotlib's style sheet would apply to the whole page; that of the page has its rules
    text = re.sub(r"<defs>\s*<style.*?</defs>\s*", "", text, flags=re.DOTALL)
    for size in ("width", "height"):
        text = re.sub(rf'(<svg[^>]*?) {size}="[^"]*"', r"\1", text, count=1)
    text = re.sub(r"(font: [^;\"']*px) [^;\"]*", r"\1 system-ui, sans-serif", text)
    used = set(re.findall(r'(?:url\(|href=")#([^)"]+)', text))
    text = re.sub(r' id="halo[^"]*"', ' class="halo"', text)
    text = re.sub(r' id="([^"]+)"', lambda m: m[0] if m[1] in used else "", text)
    for color, variable in _THEMED.items():
        text = text.replace(color, variable)
    text = re.sub(r"\s*\n\s*", "\n", text)
    return text.replace("<svg", f'<svg role="img" aria-label="{escape(label)}"', 1)


def robot_color(index: int) -> str:
    """Colour of the robot with this number in alphabetical order."""
    return PALETTE[index % len(PALETTE)]


def density(points: Array, limits: Array, color: str, pixels: int = 900) -> Array:
    """Density of points (n, 2) as an image (rows, columns, 4) of one colour and varying opacity.

    Args:
        points: world frame, m.
        limits: [[x_min, x_max], [y_min, y_max]] of the image; points outside are left out.
        color: hexadecimal.
        pixels: of the longer side.

    Returns:
        RGBA bytes, first row at y_min.
    """
    size = np.maximum(limits[:, 1] - limits[:, 0], 1e-9)
    shape = np.maximum(1, np.round(pixels * size / size.max())).astype(int)
    cell = np.floor((points - limits[:, 0]) / size * shape).astype(np.int64)
    cell = cell[((cell >= 0) & (cell < shape)).all(axis=1)]
    count = np.bincount(cell[:, 1] * shape[0] + cell[:, 0], minlength=int(shape.prod()))
    hit = count > 0
    # a single return is visible, the densest cells are solid; the square root between them
    dense = np.quantile(count[hit], 0.95) if hit.any() else 1.0
    alpha = np.where(hit, 0.25 + 0.75 * np.sqrt(np.minimum(count / dense, 1.0)), 0.0)
    image = np.empty((len(count), 4), dtype=np.uint8)
    image[:, :3] = [int(color[i : i + 2], 16) for i in (1, 3, 5)]
    # few levels of opacity keep the PNG small
    image[:, 3] = np.round(alpha * 15) * 17
    return np.asarray(image.reshape(shape[1], shape[0], 4))


def map_axes(figure: Figure, limits: Array) -> Axes:
    """Axes in metres with equal scales that include ``limits`` [[x_min, x_max], [y_min, y_max]]."""
    width, height = figure.get_size_inches()
    left, bottom, right, top = 0.5, 0.42, 0.08, 0.24
    box = np.array([width - left - right, height - bottom - top])
    # widen the narrower direction for equal scales
    scale = ((limits[:, 1] - limits[:, 0]) / box).max()
    half, middle = box * scale / 2, limits.mean(axis=1)
    axes = figure.add_axes((left / width, bottom / height, *(box / (width, height))))
    axes.set_xlim(middle[0] - half[0], middle[0] + half[0])
    axes.set_ylim(middle[1] - half[1], middle[1] + half[1])
    axes.set_autoscale_on(False)
    axes.set_xlabel("x, m", labelpad=1)
    axes.set_ylabel("y, m", labelpad=0)
    return axes


def time_rows(figure: Figure, rows: int, label: str) -> list[Axes]:
    """Axes one above the other with one common x axis."""
    grid = figure.add_gridspec(
        rows,
        1,
        left=0.13,
        right=0.98,
        top=1 - 0.25 / figure.get_figheight(),
        bottom=0.46 / figure.get_figheight(),
        hspace=0.35,
    )
    first = figure.add_subplot(grid[0])
    found = [first, *(figure.add_subplot(grid[i], sharex=first) for i in range(1, rows))]
    for axes in found[:-1]:
        axes.tick_params(labelbottom=False)
    figure.align_ylabels(found)
    found[-1].set_xlabel(label, labelpad=2)
    return found


def legend(axes: Axes) -> None:
    """A legend in one row above the axes; each name once."""
    handles, labels = axes.get_legend_handles_labels()
    first = dict(reversed(list(zip(labels, handles, strict=True))))
    names = list(dict.fromkeys(labels))
    axes.legend(
        [first[name] for name in names], names, loc="lower right", bbox_to_anchor=(1, 0.98),
        ncols=min(len(names), 6), handlelength=1.4, columnspacing=1.0, borderaxespad=0,
    )  # fmt: skip


def time_axis(first_ns: int, last_ns: int) -> tuple[float, str]:
    """Unit, ns, and label of a time axis over a span: minutes from a quarter of an hour on."""
    return (60e9, "time, min") if last_ns - first_ns > 900e9 else (1e9, "time, s")


def positive(values: Array, smallest: float = SMALLEST) -> Array:
    """Values (n,) for a logarithmic axis: what is not above ``smallest`` leaves a gap."""
    return np.where(values > smallest, values, np.nan)


def log_scale(axes: Axes, label: str) -> None:
    """A logarithmic y axis with plain numbers; ticks at 1, 2 and 5 where decades are few."""
    axes.set_yscale("log")
    low, high = axes.get_ylim()
    low = max(low, 1e-4 * high)  # a difference that passes through zero goes below any limit
    if high < 3 * low:  # a small spread is not magnified
        middle = float(np.sqrt(low * high))
        low, high = middle / 2, middle * 2
    axes.set_ylim(low, high)
    subs = (1.0,) if high > 300 * low else (1.0, 2.0, 5.0)
    axes.yaxis.set_major_locator(LogLocator(subs=subs))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_locator(NullLocator())  # hundreds of ticks would take most of the time
    axes.set_ylabel(label)
    axes.margins(x=0.01)
