# ruff: noqa: RUF001 -- σ is meant: people read it
"""From a comparison to its page: what is drawn, and the numbers beside it."""

from dataclasses import asdict

import numpy as np

from graphslam.change_detection.detect import ChangeResult
from graphslam.change_detection.shapes import Displacement, moved_points
from graphslam.change_detection.visit import Bools, Visit
from graphslam.core.config import ChangesConfig
from graphslam.core.geometry import Array, rotation

#: squares of the picture of what was not seen, and scans that it is made of at most
_SQUARE_M, _SQUARES, _SCANS = 0.1, 400, 300


def render_changes(
    found: ChangeResult, config: ChangesConfig, names: tuple[str, str] = ("reference", "later")
) -> str:
    """The report as one self-contained HTML document; ``names`` of the two visits."""
    # matplotlib takes half a second to import, and --json may do without
    from graphslam.results.report_changes import ChangesPicture, Mark, changes_page, tile  # noqa: PLC0415

    reference, later = (v.ends[v.surface] for v in (found.reference, found.later))
    every = np.concatenate([reference, later])
    low, high = np.quantile(every, [0.002, 0.998], axis=0)
    margin = 0.04 * float((high - low).max())
    limits = np.column_stack([low - margin, high + margin])
    square = max(_SQUARE_M, float((limits[:, 1] - limits[:, 0]).max()) / _SQUARES)
    unseen = ~(_seen(found.reference, limits, square) & _seen(found.later, limits, square))
    start = found.later.stamps_ns.min()
    marks = []
    for change in found.changes:
        moved = (
            None if change.displacement is None else _at_middle(change.polygon, change.displacement)
        )
        motion, sigmas = (None, None) if moved is None else moved
        marks.append(
            Mark(
                change.kind, change.polygon, change.before, motion, sigmas, change.probability,
                change.beams, float((change.first_seen_ns - start) * 1e-9),
            )
        )  # fmt: skip
    compared, flagged = int(found.compared.sum()), int(found.flagged.sum())
    sigma = np.sqrt(np.diag(found.registration.cov))
    facts = {
        "changes": str(len(found.changes)),
        "beams compared": tile(compared, ""),
        "beams flagged": f"{100 * flagged / max(compared, 1):.2f} %",
        "false alarms asked for": f"{100 * found.rate:g} %",
        "landmarks in common": str(len(found.registration.matched)),
        "registration σ": f"{1000 * max(sigma[:2]):.1f} mm, {np.degrees(sigma[2]):.2f}°",
        "range noise σ": f"{1000 * found.range_sigma_m[1]:.1f} mm",
    }
    scores = [e.scores(1.0)[e.tested] for e in found.evidence]
    settings = "\n".join(f"changes.{key} = {value}" for key, value in asdict(config).items())
    return changes_page(
        ChangesPicture(
            names, reference, later, unseen, limits, tuple(marks), np.concatenate(scores),
            found.spread, facts, settings, found.warnings,
        )
    )  # fmt: skip


def _at_middle(polygon: Array, by: Displacement) -> tuple[Array, Array]:
    """How far the middle of a polygon moved, and sigmas: that of the world's origin says little.

    Args:
        polygon: (c, 2) m, the new place.
        by: the motion of the world.

    Returns:
        Shift and turn (3,) m, rad, and their sigmas (3,).
    """
    arm = polygon.mean(axis=0) - by.motion[:2]
    was = arm @ rotation(by.motion[2])
    shift = moved_points(was[None], by)[0] - was
    J = np.array([[1, 0, -arm[1]], [0, 1, arm[0]], [0, 0, 1.0]])
    return np.array([*shift, by.motion[2]]), np.sqrt(np.diag(J @ by.cov @ J.T))


def _seen(visit: Visit, limits: Array, square_m: float) -> Bools:
    """Squares (columns, rows) of ``limits`` that some beam of a visit reached or crossed."""
    shape = np.ceil((limits[:, 1] - limits[:, 0]) / square_m).astype(int)
    seen = np.zeros(shape, dtype=bool)
    every = max(1, len(visit.poses) // _SCANS)
    used = np.isfinite(visit.range_m) & (visit.scan % every == 0)
    origin, d = visit.poses[visit.scan[used], :2], visit.directions[used]
    end = visit.range_m[used]
    reach = min(float(end.max()), float(np.hypot(*(limits[:, 1] - limits[:, 0]))))
    for r in np.arange(0.0, reach, square_m):
        on = r <= end
        ij = np.floor((origin[on] + r * d[on] - limits[:, 0]) / square_m).astype(int)
        ij = ij[((ij >= 0) & (ij < shape)).all(axis=1)]
        seen[ij[:, 0], ij[:, 1]] = True
    return seen
