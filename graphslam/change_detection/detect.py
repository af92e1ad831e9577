"""Change detection, top to bottom: one frame, surfaces, evidence, changes.

1. both visits come to lie in the reference's frame, scan by scan (`laying`);
2. the beams of each visit are held against the surfaces of the other (`evidence`);
3. flagged pieces of surface that hang together (`regions`) are changes, of which some are one
   thing that moved (`things`).
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from graphslam.change_detection.alignment import (
    align_visits,
    align_visits_nonrigid,
    beams_on_surface,
    consistency_warnings,
    laser_warnings,
)
from graphslam.change_detection.beam_evidence import Evidence, null_sigma, repeatability
from graphslam.change_detection.objects import (
    Change,
    Lines,
    assemble_changes,
    match_segments,
    match_shapes,
)
from graphslam.change_detection.regions import find_regions, flag_pieces
from graphslam.change_detection.rigid_registration import Registration
from graphslam.change_detection.shapes import MotionSettings, extract_shape
from graphslam.change_detection.surface_map import Surface
from graphslam.change_detection.transparency import without_transparent
from graphslam.change_detection.visit import Bools, Visit, pose_to_dict
from graphslam.change_detection.wall_motion import segment_motions
from graphslam.core.config import ChangesConfig
from graphslam.core.geometry import transform

_BENT = (
    "the maps bend differently, so no one motion brings their landmarks together: both paths were "
    "straightened by their scans and the later one bent onto the reference; only large changes "
    "are found, and where they are is known to decimetres"
)


@dataclass(frozen=True, slots=True, eq=False)
class ChangeResult:
    """All that a comparison found.

    Attributes:
        changes: largest first.
        registration: of the later world frame in the reference's.
        reference, later: the visits, aligned, in the reference's frame.
        surfaces: of the reference and of the later visit.
        evidence: later beams past reference surfaces; reference beams past later surfaces.
        compared, flagged: (n,) which later beams were compared, and flagged.
        spread: factor on the stated sigmas that keeps the rate asked for where nothing changed.
        range_sigma_m: range noise of both visits as found.
        rate: the false-alarm rate that was asked for.
        warnings: what makes the result weaker than its numbers say, one line each.
    """

    changes: tuple[Change, ...]
    registration: Registration
    reference: Visit
    later: Visit
    surfaces: tuple[Surface, Surface]
    evidence: tuple[Evidence, Evidence]
    compared: Bools
    flagged: Bools
    spread: float
    range_sigma_m: tuple[float, float]
    rate: float
    warnings: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """The contents of changes.json."""
        return {
            "changes": [change.to_dict() for change in self.changes],
            "beams_compared": int(self.compared.sum()),
            "beams_flagged": int(self.flagged.sum()),
            "false_alarm_rate_requested": self.rate,
            "registration": pose_to_dict(self.registration.pose, self.registration.cov)
            | {"landmarks": len(self.registration.matched)},
            "spread": self.spread,
            "range_sigma_m": list(self.range_sigma_m),
            "warnings": list(self.warnings),
        }


def identity_registration(visit: Visit) -> Registration:
    """The registration of two spans of one run: they share its world frame."""
    every = np.arange(len(visit.landmarks))
    return Registration(
        np.zeros(3), np.zeros((3, 3)), np.column_stack([every, every]), np.zeros(0, dtype=np.int64)
    )


def detect_changes(
    reference: Visit,
    later: Visit,
    config: ChangesConfig,
    registration: Registration | None = None,
) -> ChangeResult:
    """Find what is different in the later visit.

    Args:
        reference: in its world frame.
        later: in its own.
        config: settings.
        registration: where the later frame lies; found by landmarks if not given.

    Raises:
        OutputError: the two cannot be registered, or saw nothing in common.
    """
    warnings = laser_warnings(reference, later)
    laid = align_visits(reference, later, registration, config)
    if laid.broken and registration is None and max(reference.robots, later.robots) == 1:
        # a motion that some landmarks agree on, while the rest of the maps lies elsewhere
        laid = align_visits_nonrigid(reference, later, config)
    reference, later, registration = laid.reference, laid.later, laid.registration
    surfaces, evidence, sigmas, config = laid.surfaces, laid.evidence, laid.sigmas, laid.config
    if laid.bent:
        warnings += (_BENT,)
    # judged with all there is: of paths that are broken little seems solid
    warnings += consistency_warnings(null_sigma(evidence), laid.bent)
    surfaces, evidence = _of_solid(surfaces, evidence, (reference, later), config)
    a, b = surfaces
    factor = null_sigma(evidence)
    flags = tuple(flag_pieces(e, factor, config.false_alarm_rate / 2) for e in evidence)
    compared, marked = _beams(later, surfaces, evidence, (flags[0], flags[1]))
    seen = np.nonzero(b.beams >= 0)[0]
    vanished = find_regions(
        a, evidence[0], evidence[0].beams, evidence[0].rows, evidence[0].first_ns, factor, config
    )
    appeared = find_regions(b, evidence[1], seen, b.beams[seen], b.first_ns, factor, config)
    shapes = (
        [extract_shape(a, reference, evidence[0], factor, r.points) for r in vanished],
        [extract_shape(b, later, evidence[1], factor, r.points) for r in appeared],
    )
    known = MotionSettings(
        config.bias_sigma_m,
        repeatability(evidence),
        a.nearest.grid.cell_m,
        config.max_displacement_m,
    )
    fits = match_shapes(*shapes, known)
    marks = (reference.landmarks, later.landmarks)
    moves = segment_motions(
        marks, registration, surfaces, (reference, later), evidence, known, factor
    )
    stretches = match_segments(vanished, appeared, moves)
    lines = (
        _placed_lines(reference, identity_registration(reference)),
        _placed_lines(later, registration),
    )
    changes = assemble_changes(vanished, appeared, fits, stretches, lines)
    return ChangeResult(
        changes, registration, reference, later, surfaces, evidence, compared, marked,
        factor, sigmas, config.false_alarm_rate, warnings,
    )  # fmt: skip


def _of_solid(
    surfaces: tuple[Surface, Surface],
    evidence: tuple[Evidence, Evidence],
    visits: tuple[Visit, Visit],
    config: ChangesConfig,
) -> tuple[tuple[Surface, Surface], tuple[Evidence, Evidence]]:
    """Surfaces and evidence without what a visit itself looked through."""
    a, b = without_transparent(surfaces, visits, config)
    left = [replace(e, tested=e.tested & s.good) for e, s in zip(evidence, (a, b), strict=True)]
    return (a, b), (left[0], left[1])


def _beams(
    later: Visit,
    surfaces: tuple[Surface, Surface],
    evidence: tuple[Evidence, Evidence],
    flags: tuple[Bools, Bools],
) -> tuple[Bools, Bools]:
    """Which later beams (n,) met something that could be tested, and which are flagged."""
    compared = np.zeros(len(later.range_m), dtype=bool)
    marked = compared.copy()
    for beams, rows, e, flag in (
        (evidence[0].beams, evidence[0].rows, evidence[0], flags[0]),
        (*beams_on_surface(surfaces[1], later), evidence[1], flags[1]),
    ):
        compared[beams[e.tested[rows]]] = True
        marked[beams[flag[rows]]] = True
    return compared, marked


def _placed_lines(visit: Visit, registration: Registration) -> Lines:
    """Ids and ends (2, 2) m of a visit's line landmarks in the reference's frame."""
    return [
        (mark.id, transform(registration.pose, mark.extent))
        for mark in visit.landmarks
        if mark.line is not None
    ]
