# ruff: noqa: RUF001 -- σ, ± and – are meant: people read them
"""The report on changes: where they are, how certain, and the distribution of the scores."""

from collections.abc import Mapping
from dataclasses import dataclass
from html import escape

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from numpy.typing import NDArray
from scipy.stats import norm

from graphslam.core.geometry import Array
from graphslam.results import report_html as html
from graphslam.results.report_figure import INK, PALETTE, WIDTH_IN, density, map_axes, svg

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
        html.section("Map", html.figure_grid(figures)),
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
    x, y = mark.polygon.mean(axis=0)
    text = f"At x {x:.2f} m, y {y:.2f} m."
    if mark.motion is None or mark.sigmas is None:
        return text
    away = float(np.hypot(*mark.motion[:2]))
    return (
        f"{text} Its centre moved {100 * away:.0f} cm, and it turned "
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
            moved = f"{100 * np.hypot(*mark.motion[:2]):.1f} ± {100 * sigma:.1f}"
            turned = f"{np.degrees(mark.motion[2]):.1f} ± {np.degrees(mark.sigmas[2]):.1f}"
        x, y = mark.polygon.mean(axis=0)
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
    head = ["change", "at x, y, m", "size, m", "probability", "moved, cm", "turned, °"]
    head += ["beams", "first seen, s"]
    rows_html = html.table(head, rows)
    for kind in COLORS:
        rows_html = rows_html.replace(f" {kind}</th>", f' <span class="{kind}">{kind}</span></th>')
    note = "First seen: seconds since the later visit's first scan. ±: 1σ."
    return html.section("Changes", f"{rows_html}<p class=note>{note}</p>")


def _map(picture: ChangesPicture) -> str:
    (x0, x1), (y0, y1) = picture.limits
    height = WIDTH_IN * float(np.clip((y1 - y0) / (x1 - x0), 0.6, 1.15))

    def draw(figure: Figure) -> None:
        axes = map_axes(figure, picture.limits)
        _background(axes, picture, picture.limits, 900)
        for i, mark in enumerate(picture.marks):
            _outlines(axes, mark)
            axes.annotate(
                str(i + 1),
                mark.polygon[mark.polygon.sum(axis=1).argmax()],
                (4, 4),
                textcoords="offset points",
                fontsize=9,
                gid=f"halo{i}",
            )

    return svg("Changes on a map of both visits", height, draw)


def _close_up(picture: ChangesPicture, index: int) -> str:
    mark = picture.marks[index]
    points = mark.polygon if mark.before is None else np.concatenate([mark.polygon, mark.before])
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    half = max(float(np.ptp(points, axis=0).max()) * 0.75, 0.5)
    room = half * np.array([1.0, 0.7])
    limits = np.column_stack([middle - room, middle + room])

    def draw(figure: Figure) -> None:
        axes = map_axes(figure, limits)
        for cloud, color, size in (
            (picture.reference, _REFERENCE, 2.2),
            (picture.later, _LATER, 1.4),
        ):
            shown = ((cloud > limits[:, 0]) & (cloud < limits[:, 1])).all(axis=1)
            # more points cannot be told apart and enlarge the page
            chosen = cloud[shown]
            chosen = chosen[:: max(1, len(chosen) // 2500)]
            axes.plot(*chosen.T, ".", color=color, markersize=size, markeredgewidth=0, alpha=0.55,
                      rasterized=True)  # fmt: skip
        _outlines(axes, mark)

    return svg(f"Change {index + 1}, close up", 0.72 * WIDTH_IN, draw)


def _background(axes: Axes, picture: ChangesPicture, limits: Array, pixels: int) -> None:
    """Hatching where nothing was compared, then the returns of both visits."""
    extent = (limits[0, 0], limits[0, 1], limits[1, 0], limits[1, 1])
    for image in (
        _hatched(picture.unseen, pixels),
        density(picture.reference, limits, _REFERENCE, pixels),
        density(picture.later, limits, _LATER, pixels),
    ):
        axes.imshow(image, extent=extent, origin="lower", interpolation="none", aspect="auto")


def _hatched(unseen: NDArray[np.bool_], pixels: int) -> NDArray[np.uint8]:
    """Stripes where ``unseen`` (columns, rows) is true, as an image (rows, columns, 4)."""
    factor = max(1, pixels // max(unseen.shape))
    large = np.kron(unseen.T, np.ones((factor, factor), dtype=bool))
    row, column = np.indices(large.shape)
    image = np.zeros((*large.shape, 4), dtype=np.uint8)
    image[:, :, :3] = [int(_UNSEEN[i : i + 2], 16) for i in (1, 3, 5)]
    image[:, :, 3] = np.where(large & ((row + column) % _STRIPE_SPACING == 0), 170, 0)
    return image


def _outlines(axes: Axes, mark: ChangeMark) -> None:
    color = COLORS[mark.kind]
    axes.add_patch(Polygon(mark.polygon, facecolor=color, alpha=0.25, edgecolor="none"))
    axes.add_patch(Polygon(mark.polygon, fill=False, edgecolor=color, linewidth=1.2))
    if mark.before is not None:
        axes.add_patch(
            Polygon(mark.before, fill=False, edgecolor=color, linewidth=1.0, linestyle=(0, (3, 2)))
        )


def _scores(picture: ChangesPicture) -> str:
    def draw(figure: Figure) -> None:
        axes = figure.add_axes((0.12, 0.14, 0.85, 0.8))
        edges = np.linspace(-8, 12, 81)
        inside = np.clip(picture.scores, edges[0], edges[-1] - 1e-9)
        axes.hist(inside, edges.tolist(), color=_LATER, alpha=0.6)
        x = np.linspace(edges[0], edges[-1], 400)
        scale = len(inside) * (edges[1] - edges[0])
        axes.plot(x, scale * norm.pdf(x, scale=picture.spread), color=INK, linewidth=1.0)
        axes.set_yscale("log")
        axes.set_ylim(0.7, max(10.0, 2 * scale / (picture.spread * 2.5)))
        axes.set_xlim(edges[0], edges[-1])
        axes.set_xlabel("score, σ (values beyond are in the last bin)")
        axes.set_ylabel("pieces of surface")

    return svg("Histogram of the scores", 0.8 * WIDTH_IN, draw)


def tile(value: float, unit: str) -> str:
    """A number with its unit for a tile."""
    return f"{html.number(value)}{unit}"
