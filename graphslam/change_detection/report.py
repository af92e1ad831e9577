# ruff: noqa: RUF001 -- σ is meant: people read it
"""The report of a comparison: the contents of its pictures, tiles and tables."""

from dataclasses import asdict

import numpy as np

from graphslam.change_detection.detect import ChangeResult
from graphslam.change_detection.shapes import Displacement
from graphslam.change_detection.visit import Bools, Visit
from graphslam.core.config import ChangesConfig
from graphslam.core.geometry import Array, area_centroid, inverse, transform
from graphslam.core.thinning import evenly_thinned
from graphslam.results.report_changes import ChangeMark, ChangesPicture, changes_page, tile

#: the picture of the observed area: least size of its squares, m; most squares of a side; most
#: scans that are used
_SQUARE_M, _MAX_SQUARES, _MAX_SCANS = 0.1, 400, 300


def render_changes(
    found: ChangeResult, config: ChangesConfig, names: tuple[str, str] = ("reference", "later")
) -> str:
    """The report as one self-contained HTML document; ``names`` of the two visits."""
    reference, later = (v.ends_of(v.surface) for v in (found.reference, found.later))
    every = np.concatenate([reference, later])
    low, high = np.quantile(every, [0.002, 0.998], axis=0)
    margin = 0.04 * float((high - low).max())
    limits = np.column_stack([low - margin, high + margin])
    square = max(_SQUARE_M, float((limits[:, 1] - limits[:, 0]).max()) / _MAX_SQUARES)
    unseen = ~(_observed(found.reference, limits, square) & _observed(found.later, limits, square))
    start = found.later.stamps_ns.min()
    marks = [
        ChangeMark(
            c.kind, c.polygon, c.before, *_motion_of_middle(c.polygon, c.displacement),
            c.probability, c.beams, float((c.first_seen_ns - start) * 1e-9),
        )
        for c in found.changes
    ]  # fmt: skip
    compared, flagged = int(found.compared.sum()), int(found.flagged.sum())
    sigma = np.sqrt(np.diag(found.registration.cov))
    facts = {
        "changes": str(len(found.changes)),
        "beams compared": tile(compared, ""),
        "beams flagged": f"{100 * flagged / max(compared, 1):.2f} %",
        "false alarms requested": f"{100 * found.rate:g} %",
        "landmarks in common": str(len(found.registration.matched)),
        "registration σ": f"{1000 * max(sigma[:2]):.1f} mm, {np.degrees(sigma[2]):.2f}°",
        "range noise σ": f"{1000 * found.range_sigmas_m[1]:.1f} mm",
    }
    scores = [e.scores(1.0)[e.tested] for e in found.evidence]
    settings = "\n".join(f"changes.{key} = {value}" for key, value in asdict(config).items())
    return changes_page(
        ChangesPicture(
            names, reference, later, unseen, limits, tuple(marks), np.concatenate(scores),
            found.null_sigma, facts, settings, found.warnings,
        )
    )  # fmt: skip


def _motion_of_middle(polygon: Array, by: Displacement | None) -> tuple[Array | None, Array | None]:
    """Shift and rotation (3,) m, rad, of the centroid of a new outline (c, 2) m, and sigmas (3,).

    Those of the world's origin would depend on its distance. None without a displacement.
    """
    if by is None:
        return None, None
    middle = area_centroid(polygon)
    arm = middle - by.motion[:2]
    shift = middle - transform(inverse(by.motion), middle[None])[0]
    J = np.array([[1, 0, -arm[1]], [0, 1, arm[0]], [0, 0, 1.0]])
    return np.array([*shift, by.motion[2]]), np.sqrt(np.diag(J @ by.cov @ J.T))


def _observed(visit: Visit, limits: Array, square_m: float) -> Bools:
    """Which squares (columns, rows) of ``limits`` beams of a visit crossed or ended in."""
    shape = np.ceil((limits[:, 1] - limits[:, 0]) / square_m).astype(int)
    observed = np.zeros(shape, dtype=bool)
    scans = evenly_thinned(np.arange(len(visit.poses)), _MAX_SCANS)
    used = np.isfinite(visit.range_m) & np.isin(visit.scan, scans)
    origin, d = visit.poses[visit.scan[used], :2], visit.directions[used]
    end = visit.range_m[used]
    reach = min(float(end.max()), float(np.hypot(*(limits[:, 1] - limits[:, 0]))))
    for r in np.arange(0.0, reach, square_m):
        on = r <= end
        ij = np.floor((origin[on] + r * d[on] - limits[:, 0]) / square_m).astype(int)
        ij = ij[((ij >= 0) & (ij < shape)).all(axis=1)]
        observed[ij[:, 0], ij[:, 1]] = True
    return observed
