"""Reads two result folders and writes a folder of changes: JSON, a map, MCAP, a report."""

from collections.abc import Callable
from pathlib import Path
from typing import Literal

from graphslam.change_detection.detect import ChangeResult, detect_changes, identity_registration
from graphslam.change_detection.export import write_mcap, write_overlay_map
from graphslam.change_detection.visit import Visit, load_visit, select_time_span
from graphslam.core.config import ChangesConfig
from graphslam.core.errors import OutputError
from graphslam.core.output_folder import Identity, atomic_folder
from graphslam.results.file_formats import to_json
from graphslam.results.folder import load
from graphslam.results.target_folder import check_target

Span = tuple[float, float]


def changes_between(
    reference: Path,
    later: Path,
    config: ChangesConfig,
    reference_span_s: Span | None = None,
    later_span_s: Span | None = None,
) -> ChangeResult:
    """Compare two result folders of `smooth`, or time spans of them, s since the first scan.

    ``later`` may be the reference itself, with another span.

    Raises:
        OutputError: a folder is not a result, has no scans or covariances, or the two have nothing
            in common.
        LogError: a log is missing or has changed.
    """
    a, b, same = load_visits(reference, later, config, reference_span_s, later_span_s)
    return detect_changes(a, b, config, identity_registration(a) if same else None)


def load_visits(
    reference: Path,
    later: Path,
    config: ChangesConfig,
    reference_span_s: Span | None,
    later_span_s: Span | None,
) -> tuple[Visit, Visit, bool]:
    """Both visits, and whether they are of one run, which has one frame.

    Raises:
        OutputError: a folder is not a result, has no scans or covariances in the span, or one
            folder is given twice without spans.
        LogError: a log is missing or has changed.
    """
    same = reference.resolve() == later.resolve()
    if same and (reference_span_s is None or later_span_s is None):
        raise OutputError(
            f"{later}: is the reference itself; give --reference-span and --later-span"
        )
    a = load_visit(load(reference), reference, config)
    b = a if same else load_visit(load(later), later, config)
    if reference_span_s is not None:
        a = select_time_span(a, reference_span_s, "--reference-span")
    if later_span_s is not None:
        b = select_time_span(b, later_span_s, "--later-span")
    return a, b, same


def check_changes_target(directory: Path, *, force: bool) -> Identity:
    """`check_target` for `save_changes`, before a long computation.

    Raises:
        OutputError: it exists and may not be replaced, or it cannot be written.
    """
    return check_target(
        directory, force=force, replaceable=lambda d: (d / "changes.json").is_file()
    )


def save_changes(
    found: ChangeResult,
    directory: Path,
    *,
    force: bool,
    report: Callable[[ChangeResult], str] | None = None,
    before: Identity | Literal["now"] = "now",
) -> None:
    """Write the folder of docs/formats.md, with report.html if ``report`` renders one.

    It appears whole or not at all. ``before``: what `check_changes_target` found when the work
    began, which alone may be replaced.

    Raises:
        OutputError: the target exists and may not be replaced, or the disk refuses.
    """
    if before == "now":
        before = check_changes_target(directory, force=force)
    texts = {"changes.json": to_json(found.to_dict(), "changes.json")}
    if report is not None:
        texts["report.html"] = report(found)
    old = [c.polygon if c.kind == "vanished" else c.before for c in found.changes]
    new = [c.polygon for c in found.changes if c.kind != "vanished"]
    with atomic_folder(directory, before) as part:
        write_overlay_map(
            part, found.surfaces[0].nearest.grid, [p for p in old if p is not None], new
        )
        write_mcap(found, part / "changes.mcap")
        for name, text in texts.items():
            (part / name).write_text(text, encoding="utf-8")
