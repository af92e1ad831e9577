# ruff: noqa: RUF001 -- σ and × are meant: people read them
"""What `graphslam changes --method thesis` writes: the maps of chapter 5, the decisions, a page."""

from dataclasses import dataclass, replace
from html import escape
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from graphslam.change_detection.export import write_overlay_map
from graphslam.change_detection.folder import Span, check_changes_target, load_visits
from graphslam.change_detection.grid import Grid
from graphslam.change_detection.thesis_changes import ThesisChanges, reference_maps, thesis_changes
from graphslam.change_detection.visit import Bools
from graphslam.core.config import ChangesConfig
from graphslam.core.geometry import Array, unit_vectors
from graphslam.core.output_folder import Identity, atomic_folder
from graphslam.core.thinning import evenly_thinned
from graphslam.results import report_html as html
from graphslam.results.drawing_elements import INK, PALETTE, Shade, Style, opacity_levels
from graphslam.results.file_formats import to_json
from graphslam.results.grid_map import FREE, OCCUPIED, write_grid_map
from graphslam.results.report_figure import WIDTH_IN, Drawing, density, map_axes, svg

_REFERENCE, _LATER, _CHANGED = "#7d8590", PALETTE[0], PALETTE[1]
#: cells of the longer side of a picture
_PIXELS = 900


def thesis_changes_between(
    reference: Path,
    later: Path,
    config: ChangesConfig,
    reference_span_s: Span | None = None,
    later_span_s: Span | None = None,
) -> ThesisChanges:
    """As `changes_between`, by the method of the thesis.

    Raises:
        OutputError: a folder is not a result, has no scans or covariances, or the two cannot be
            registered.
        LogError: a log is missing or has changed.
    """
    visits = load_visits(reference, later, config, reference_span_s, later_span_s)
    found = thesis_changes(visits.reference, visits.later, config, same_frame=visits.same_frame)
    return replace(found, warnings=visits.warnings)


def write_thesis_changes(
    reference: Path,
    later: Path,
    config: ChangesConfig,
    reference_span_s: Span | None = None,
    later_span_s: Span | None = None,
    *,
    directory: Path,
    force: bool = False,
) -> ThesisChanges:
    """`thesis_changes_between`, and the folder of docs/formats.md; it appears whole or not at all.

    The maps are those that the later scan with most marked beams was compared with.

    Raises:
        OutputError: as there; or the target exists and may not be replaced, or the disk refuses.
        LogError: a log is missing or has changed.
    """
    before = check_changes_target(directory, force=force)
    found = thesis_changes_between(reference, later, config, reference_span_s, later_span_s)
    write_folder(found, config, directory, (reference.name, later.name), before)
    return found


def write_folder(
    found: ThesisChanges,
    config: ChangesConfig,
    directory: Path,
    names: tuple[str, str],
    before: Identity,
) -> None:
    """The folder, instead of what stood there ``before``; ``names`` of the two visits."""
    grid, shown = found.grid, Shown.of(found, config)
    deep = np.where(shown.depth > 0, 200 - 200 * shown.depth, FREE).astype(np.uint8)
    seen = np.where(shown.visible, FREE, OCCUPIED).astype(np.uint8)
    old = [r.polygon for r in found.regions if r.kind == "vanished"]
    new = [r.polygon for r in found.regions if r.kind == "appeared"]
    with atomic_folder(directory, before) as part:
        (part / "changes.json").write_text(
            to_json(found.to_dict(), "changes.json"), encoding="utf-8"
        )
        _save_map(part, "reference_map", grid, deep, "the darker, the deeper the dent")
        _save_map(part, "occlusion_map", grid, seen, "free = seen by the reference, else occluded")
        write_overlay_map(part, grid, old, new)
        (part / "decision.csv").write_text(decision_table(found), encoding="utf-8")
        (part / "report.html").write_text(thesis_page(found, shown, names), encoding="utf-8")


@dataclass(frozen=True, slots=True, eq=False)
class Shown:
    """The later scan that is shown, and the maps (cells,) that it was compared with.

    ``depth`` of the dents, from 0 to 1 (square root, of the deepest); ``visible`` by the reference.
    """

    scan: int
    reference_scan: int
    depth: Array
    visible: Bools

    @classmethod
    def of(cls, found: ThesisChanges, config: ChangesConfig) -> "Shown":
        """Of the scan with most marked beams."""
        counts = np.bincount(found.later.scan, found.marked, len(found.later.poses))
        scan = int(np.argmax(counts))
        near = int(found.nearest[scan])
        dents, visible = reference_maps(found.reference, near, found.grid, config)
        return cls(
            scan, near, np.sqrt(dents.depth / max(float(dents.bottom.max()), 1e-12)), visible
        )


def _save_map(folder: Path, name: str, grid: Grid, values: NDArray[np.uint8], meaning: str) -> None:
    """Values (cells,) as a map for nav2's map_server."""
    image = values.reshape(grid.shape).T
    write_grid_map(folder, name, image, cell_m=grid.cell_m, origin_m=grid.origin_m, meaning=meaning)


def decision_table(found: ThesisChanges) -> str:
    """One line per beam that was compared: measured, expected, distance, and what was decided."""
    later, expected = found.later, found.expected
    lines = ["stamp_ns,angle_rad,range_m,expected_m,expected_sigma_m,d2,dismissed,changed"]
    for n in np.flatnonzero(expected.compared).tolist():
        lines.append(
            f"{later.stamps_ns[later.scan[n]]},{later.angle[n]:.6f},{later.range_m[n]:.4f},"
            f"{expected.ranges[n]:.4f},{expected.sigmas[n]:.4f},{expected.d2[n]:.4g},"
            f"{int(expected.dismissed[n])},{int(found.marked[n])}"
        )
    return "\n".join(lines) + "\n"


# ---------------------------------------------------------------- the page


def thesis_page(found: ThesisChanges, shown: Shown, names: tuple[str, str]) -> str:
    """The report as one self-contained HTML document; ``names`` of the two visits."""
    title = f"{names[1]} against {names[0]}"
    compared, marked = int(found.expected.compared.sum()), int(found.marked.sum())
    facts = {
        "regions": str(len(found.regions)),
        "beams compared": html.number(compared),
        "marked": f"{100 * marked / max(compared, 1):.2f} %",
        "expected if nothing changed": f"{100 * found.rate:g} %",
        "dismissed as hidden": html.number(int(found.expected.dismissed.sum())),
    }
    limits = _limits(found)
    figures = [
        html.figure(_dents(found, shown, limits), "Reference map.",
            "Dents of equal volume (5.7–5.12) of one reference scan: that nearest to the later "
            "scan with most marked beams.",),
        html.figure(
            _expected(found, shown.scan, limits), "Expected scan.",
            "What the reference map lets expect from the pose of one later scan (grey, with its "
            "σ), and what was measured (blue).",
        ),
        html.figure(
            _occlusion(found, shown, limits), "Occlusion map.",
            "Grey: seen by the reference scan, free or hit. White: occluded (5.4).",
        ),
        html.figure(
            _decision(found, limits), "Decision.",
            "Rings: marked as changed. Dots: compared and not marked, of all later scans.",
        ),
    ]  # fmt: skip
    rows = [
        (f"{i + 1} {r.kind}", f"{x:.2f}, {y:.2f}", f"{w:.2f} × {h:.2f}", r.beams)
        for i, r in enumerate(found.regions[:50])
        for (x, y), (w, h) in [(r.polygon.mean(axis=0), np.ptp(r.polygon, axis=0))]
    ]
    note = (
        "The thesis' method marks beams one by one and takes their errors for independent; they "
        "are not, so its false-alarm rate is not what the gate is for."
    )
    return html.document(
        title,
        [
            html.header(
                "graphslam changes --method thesis", title, note, facts.items(), found.warnings
            ),
            html.section("Chapter 5", html.figure_grid(figures)),
            html.section("Regions", html.table(["region", "at x, y, m", "size, m", "beams"], rows)),
            html.details("Gate", f"<pre>d² &gt; {escape(f'{found.gate:.3f}')}, 2 dof</pre>"),
        ],
    )


def _limits(found: ThesisChanges) -> Array:
    ends = [v.ends[np.isfinite(v.range_m)] for v in (found.reference, found.later)]
    low, high = np.quantile(np.concatenate(ends), [0.002, 0.998], axis=0)
    margin = 0.04 * float((high - low).max())
    return np.column_stack([low - margin, high + margin])


def _height(limits: Array) -> float:
    (x0, x1), (y0, y1) = limits
    return WIDTH_IN * float(np.clip((y1 - y0) / (x1 - x0), 0.6, 1.15))


def _cells(values: Array, grid: Grid, color: str) -> tuple[Shade, Array]:
    """Values (cells,) from 0 to 1 as a picture of at most `_PIXELS`, and its limits."""
    table = values.reshape(grid.shape).T
    step = -(-max(table.shape) // _PIXELS)
    rows, columns = (size // step * step for size in table.shape)
    blocks = table[:rows, :columns].reshape(rows // step, step, columns // step, step)
    low = np.array(grid.origin_m)
    limits = np.column_stack([low, low + grid.cell_m * np.array([columns, rows])])
    return Shade(opacity_levels(blocks.max(axis=(1, 3))), color), limits


def _dents(found: ThesisChanges, shown: Shown, limits: Array) -> str:
    def draw(drawing: Drawing) -> None:
        map_axes(drawing, limits).image(*_cells(shown.depth, found.grid, INK))

    return svg("Reference map of dents", _height(limits), draw)


def _occlusion(found: ThesisChanges, shown: Shown, limits: Array) -> str:
    reference = found.reference
    own = (reference.scan == shown.reference_scan) & np.isfinite(reference.range_m)

    def draw(drawing: Drawing) -> None:
        axes = map_axes(drawing, limits)
        axes.image(*_cells(np.where(shown.visible, 0.35, 0.0), found.grid, _REFERENCE))
        axes.image(density(reference.ends[own], limits, INK, _PIXELS), limits)

    return svg("Occlusion map", _height(limits), draw)


def _expected(found: ThesisChanges, scan: int, limits: Array) -> str:
    later, expected = found.later, found.expected
    beams = np.flatnonzero((later.scan == scan) & expected.compared)
    origin, heading = later.poses[scan, :2], later.headings(beams)
    d = unit_vectors(heading)
    point = origin + expected.ranges[beams][:, None] * d
    spread = expected.sigmas[beams][:, None] * d

    def draw(drawing: Drawing) -> None:
        axes = map_axes(drawing, limits)
        bars = [np.array([p - s, p + s]) for p, s in zip(point, spread, strict=True)]
        axes.lines(bars, Style(_REFERENCE, 0.8))
        axes.dots(point[:, 0], point[:, 1], _REFERENCE, 1.4, 0.9)
        ends = later.ends[beams]
        axes.dots(ends[:, 0], ends[:, 1], _LATER, 1.4, 0.9)
        axes.symbols(origin[None], INK, 4.0, triangles=True)

    return svg("Expected and measured scan", _height(limits), draw)


def _decision(found: ThesisChanges, limits: Array) -> str:
    ends, marked = found.later.ends, found.marked

    def draw(drawing: Drawing) -> None:
        axes = map_axes(drawing, limits)
        quiet = found.expected.compared & ~marked
        axes.image(density(ends[quiet], limits, _LATER, _PIXELS), limits)
        # more symbols cannot be told apart
        axes.symbols(evenly_thinned(ends[marked], 3000), _CHANGED, 3.0)

    return svg("Decision of the thesis' method", _height(limits), draw)
