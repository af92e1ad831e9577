"""Reads two result folders and writes a folder of changes: JSON, a map, MCAP, a report."""

from collections.abc import Callable
from dataclasses import dataclass, replace
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
    visits = load_visits(reference, later, config, reference_span_s, later_span_s)
    registration = identity_registration(visits.reference) if visits.same_frame else None
    found = detect_changes(visits.reference, visits.later, config, registration)
    return replace(found, warnings=(*visits.warnings, *found.warnings))


@dataclass(frozen=True, slots=True, eq=False)
class Visits:
    """Two visits that have no scan in common.

    ``same_frame``: whether they are spans of one run; ``warnings``: what was left out.
    """

    reference: Visit
    later: Visit
    same_frame: bool
    warnings: tuple[str, ...] = ()


def load_visits(
    reference: Path,
    later: Path,
    config: ChangesConfig,
    reference_span_s: Span | None,
    later_span_s: Span | None,
) -> Visits:
    """Both visits, without the scans that they share.

    Raises:
        OutputError: a folder is not a result, has no scans or covariances in the span, one folder
            is given twice without spans, or both are of the same scans.
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
    return _independent(Visits(a, b, same), reference, later)


def _independent(visits: Visits, reference: Path, later: Path) -> Visits:
    """The visits without what they share: a scan that is compared with itself is no second visit.

    Both estimate its pose, and differ by less than their covariances say; where they differ by
    more, as whole maps do that were solved with different sessions, nothing has changed either. It
    is left out of the later visit, or of the reference if nothing else is in the later one.

    Raises:
        OutputError: they have nothing else.
    """
    a, b = visits.reference, visits.later
    of_b, of_a = b.shared_with(a), a.shared_with(b)
    if not of_b.any():
        return visits
    if of_a.all() and of_b.all():
        raise OutputError(
            f"{later}: is of the same scans as {reference}; compare results of different "
            "recordings, or spans of one run that do not overlap"
        )
    folder, shared = (reference, of_a) if of_b.all() else (later, of_b)
    said = (
        f"{int(shared.sum())} of {len(shared)} scans of {folder.name} are left out: "
        "the other visit has the same ones"
    )
    left = (a if of_b.all() else b).select(~shared)
    if not visits.same_frame:  # of one run both have its landmarks, by number
        left = left.with_shown_landmarks()
    if of_b.all():
        return replace(visits, reference=left, warnings=(said,))
    return replace(visits, later=left, warnings=(said,))


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
