# ruff: noqa: RUF001 -- σ, ± and – are meant: people read them
"""The report on changes: where they are, how certain, and the distribution of the scores."""

from collections.abc import Mapping
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

from graphslam.core.geometry import Array, area_centroid
from graphslam.core.thinning import evenly_thinned
from graphslam.results import report_html as html
from graphslam.results.drawing import Axes
from graphslam.results.drawing_elements import INK, OPAQUE, PALETTE, Levels, Shade, Style
from graphslam.results.live_changes import live_changes
from graphslam.results.live_figure import live_html
from graphslam.results.report_figure import WIDTH_IN, Drawing, density, map_axes, svg

COLORS = {"appeared": PALETTE[2], "vanished": PALETTE[1], "moved": PALETTE[3]}
_REFERENCE, _LATER, _UNSEEN = "#7d8590", PALETTE[0], "#a8adb3"
_MAX_CLOSE_UPS = 8
_STRIPE_SPACING = 7  # pixels from stripe to stripe of the hatching

#: only on this page: the colours of the kinds of changes in the table
_CSS = "".join(
    f".{kind}::before {{ content: ''; display: inline-block; width: .7em; height: .7em; "
    f"margin-right: .45em; border-radius: 2px; background: var(--robot{PALETTE.index(color)}); }}\n"
    for kind, color in COLORS.items()
)
_CSS += "tbody th { white-space: nowrap; }\n"


@dataclass(frozen=True, slots=True, eq=False)
class ChangeMark:
    """One change: its outline (c, 2) m, that ``before`` (if it moved), and the cells of its row.

    ``motion`` (3,) of its centre and ``sigmas`` (3,): m, m, rad, None if unknown.
    """

    kind: str
    polygon: Array
    before: Array | None
    motion: Array | None
    sigmas: Array | None
    probability: float
    beams: int
    first_seen_s: float


@dataclass(frozen=True, slots=True, eq=False)
class ChangesPicture:
    """What the page shows, in the reference's world frame.

    ``reference``, ``later``: (n, 2) m ends of beams. ``unseen`` (columns, rows): cells of
    ``limits`` [[x_min, x_max], [y_min, y_max]] that at least one visit did not observe. ``scores``
    (k,) of all pieces of surface: normal with sigma ``spread`` where nothing changed. ``facts``:
    name and value of the tiles.
    """

    names: tuple[str, str]
    reference: Array
    later: Array
    unseen: NDArray[np.bool_]
    limits: Array
    marks: tuple[ChangeMark, ...]
    scores: Array
    spread: float
    facts: Mapping[str, str]
    settings: str
    warnings: tuple[str, ...] = ()


def changes_page(picture: ChangesPicture) -> str:
    """One self-contained HTML document."""
    title = f"{picture.names[1]} against {picture.names[0]}"
    legend = (
        "Grey: returns of the reference. Blue: later returns. Hatched: not observed by both "
        "visits, so not compared."
    )
    figures = [
        html.figure(_map(picture), "Changes.", legend),
        html.figure(
            _scores(picture),
            "Scores.",
            "Distance of the ends of beams of one visit behind each piece of the other's surfaces, "
            "in stated sigmas. The line is the normal distribution of the test; changes are in the "
            "right tail.",
        ),
    ]
    figures += [
        html.figure(_close_up(picture, i), f"{i + 1}: {mark.kind}.", _caption(mark))
        for i, mark in enumerate(picture.marks[:_MAX_CLOSE_UPS])
    ]
    notes = [f"Note: {line}." for line in picture.warnings]
    sections = [
        html.header("graphslam changes", title, _headline(picture), picture.facts.items(), notes),
        _table(picture),
        html.section("Map", live_html(live_changes(picture, COLORS)) + html.figure_grid(figures)),
        html.details("Settings", f"<pre>{escape(picture.settings)}</pre>"),
    ]
    return html.document(title, sections, _CSS)


def _headline(picture: ChangesPicture) -> str:
    kinds = [mark.kind for mark in picture.marks]
    parts = [f"{kinds.count(kind)} {kind}" for kind in COLORS if kind in kinds]
    if not parts:
        return "No change was found where both visits observed."
    changes = "change" if len(kinds) == 1 else "changes"
    return f"{len(kinds)} {changes}: {', '.join(parts)}."


def _caption(mark: ChangeMark) -> str:
    x, y = area_centroid(mark.polygon)
    text = f"At x {x:.2f} m, y {y:.2f} m."
    if mark.motion is None or mark.sigmas is None:
        return text
    away = float(np.hypot(*mark.motion[:2]))
    return (
        f"{text} Its centre moved {html.length(away)}, and it turned "
        f"{np.degrees(mark.motion[2]):.1f}° ± {np.degrees(mark.sigmas[2]):.1f}° (1σ)."
    )


def _table(picture: ChangesPicture) -> str:
    if not picture.marks:
        return ""
    rows = []
    for i, mark in enumerate(picture.marks):
        moved = turned = None
        if mark.motion is not None and mark.sigmas is not None:
            sigma = float(np.hypot(*mark.sigmas[:2]))
            moved = f"{np.hypot(*mark.motion[:2]):.3f} ± {sigma:.3f}"
            turned = f"{np.degrees(mark.motion[2]):.1f} ± {np.degrees(mark.sigmas[2]):.1f}"
        x, y = area_centroid(mark.polygon)
        size = np.ptp(mark.polygon, axis=0)
        rows.append(
            (
                f"{i + 1} {mark.kind}",
                f"{x:.2f}, {y:.2f}",
                f"{size[0]:.2f} × {size[1]:.2f}",
                f"{100 * mark.probability:.1f} %" if mark.probability < 0.999 else "> 99.9 %",
                moved,
                turned,
                mark.beams,
                f"{mark.first_seen_s:.1f}",
            )
        )
    head = ["change", "at x, y, m", "size, m", "probability", "moved, m", "turned, °"]
    head += ["beams", "first seen, s"]
    rows_html = html.table(head, rows)
    for kind in COLORS:
        rows_html = rows_html.replace(f" {kind}</th>", f' <span class="{kind}">{kind}</span></th>')
    note = "First seen: seconds since the later visit's first scan. ±: 1σ."
    return html.section("Changes", f"{rows_html}<p class=note>{note}</p>")


def _map(picture: ChangesPicture) -> str:
    (x0, x1), (y0, y1) = picture.limits
    height = WIDTH_IN * float(np.clip((y1 - y0) / (x1 - x0), 0.6, 1.15))

    def draw(drawing: Drawing) -> None:
        axes = map_axes(drawing, picture.limits)
        _background(axes, picture, picture.limits, 900)
        for i, mark in enumerate(picture.marks):
            _outlines(axes, mark)
            x, y = mark.polygon[mark.polygon.sum(axis=1).argmax()].tolist()
            axes.text(x, y, str(i + 1), 9, (4, 4))

    return svg("Changes on a map of both visits", height, draw)


def _close_up(picture: ChangesPicture, index: int) -> str:
    mark = picture.marks[index]
    points = mark.polygon if mark.before is None else np.concatenate([mark.polygon, mark.before])
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    half = max(float(np.ptp(points, axis=0).max()) * 0.75, 0.5)
    room = half * np.array([1.0, 0.7])
    limits = np.column_stack([middle - room, middle + room])

    def draw(drawing: Drawing) -> None:
        axes = map_axes(drawing, limits)
        for cloud, color, size in (
            (picture.reference, _REFERENCE, 1.1),
            (picture.later, _LATER, 0.7),
        ):
            shown = ((cloud > limits[:, 0]) & (cloud < limits[:, 1])).all(axis=1)
            # more points cannot be told apart and enlarge the page
            chosen = evenly_thinned(cloud[shown], 2500)
            axes.dots(chosen[:, 0], chosen[:, 1], color, size, 0.55)
        _outlines(axes, mark)

    return svg(f"Change {index + 1}, close up", 0.72 * WIDTH_IN, draw)


def _background(axes: Axes, picture: ChangesPicture, limits: Array, pixels: int) -> None:
    """Hatching where nothing was compared, then the returns of both visits."""
    axes.image(Shade(_hatched(picture.unseen, pixels), _UNSEEN), limits)
    axes.image(density(picture.reference, limits, _REFERENCE, pixels), limits)
    axes.image(density(picture.later, limits, _LATER, pixels), limits)


def _hatched(unseen: NDArray[np.bool_], pixels: int) -> Levels:
    """Stripes (rows, columns) where ``unseen`` (columns, rows) is true."""
    factor = max(1, pixels // max(unseen.shape))
    large = np.kron(unseen.T, np.ones((factor, factor), dtype=bool))
    row, column = np.indices(large.shape)
    stripes = large & ((row + column) % _STRIPE_SPACING == 0)
    return np.where(stripes, 2 * OPAQUE // 3, 0).astype(np.uint8)


def _outlines(axes: Axes, mark: ChangeMark) -> None:
    color = COLORS[mark.kind]
    axes.area(mark.polygon, color, 0.25)
    axes.lines([_closed(mark.polygon)], Style(color, 1.2))
    if mark.before is not None:
        axes.lines([_closed(mark.before)], Style(color, 1.0, dashes=(3, 2)))


def _closed(polygon: Array) -> Array:
    return np.concatenate([polygon, polygon[:1]])


def _scores(picture: ChangesPicture) -> str:
    def draw(drawing: Drawing) -> None:
        axes = drawing.axes(0.59, 0.55, 0.15, 0.24)
        edges = np.linspace(-8, 12, 81)
        count, _ = np.histogram(np.clip(picture.scores, edges[0], edges[-1] - 1e-9), edges)
        axes.log_y = True
        # bars as one outline, from below the axis
        heights = np.concatenate([[0.1], np.repeat(np.maximum(count, 0.1), 2), [0.1]])
        axes.area(np.column_stack([np.repeat(edges, 2), heights]), _LATER, 0.6)
        x = np.linspace(edges[0], edges[-1], 400)
        scale = len(picture.scores) * (edges[1] - edges[0]) / np.sqrt(2 * np.pi)
        normal = scale / picture.spread * np.exp(-0.5 * (x / picture.spread) ** 2)
        axes.line(x, np.maximum(normal, 0.1), Style(INK, 1.0))
        axes.set_y(0.7, max(10.0, 2 * np.sqrt(2 * np.pi) * scale / (picture.spread * 2.5)))
        axes.set_x(edges[0], edges[-1])
        axes.x_label = "score, σ (values beyond are in the last bin)"
        axes.y_label = "pieces of surface"

    return svg("Histogram of the scores", 0.8 * WIDTH_IN, draw)


def tile(value: float, unit: str) -> str:
    """A number with its unit for a tile."""
    return f"{html.number(value)}{unit}"
