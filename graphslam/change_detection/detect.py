"""Change detection between two visits, top to bottom.

1. Both visits are aligned in the reference's frame, scan by scan (`alignment`).
2. The beams of each visit are tested against the surfaces of the other (`beam_evidence`).
3. Connected regions of flagged surface (`regions`) are changes; pairs of them may be one object
   that moved (`objects`).
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
    settings_for_noise,
)
from graphslam.change_detection.beam_evidence import (
    DOUBTFUL_SIGMA,
    BeamEvidence,
    null_sigma,
    repeatability,
)
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
from graphslam.core.geometry import Array, transform

_NONRIGID = (
    "the maps bend differently, so no one motion brings their landmarks together: both paths were "
    "refined by scan matching and registered nonrigidly; only large changes are found, and their "
    "positions are known to decimetres"
)


@dataclass(frozen=True, slots=True, eq=False)
class ChangeResult:
    """The result of a comparison of two visits.

    Attributes:
        changes: largest first.
        registration: of the later world frame in the reference's.
        reference, later: the visits, aligned, in the reference's frame.
        surfaces: of the reference and of the later visit.
        evidence: of later beams on reference surfaces, of reference beams on later surfaces.
        compared, flagged: (n,) which later beams were compared, and flagged.
        null_sigma: sigma of the scores without a change, see
            `graphslam.change_detection.beam_evidence.null_sigma`; "spread" in changes.json.
        range_sigmas_m: estimated range noise of both visits.
        rate: the requested false-alarm rate.
        warnings: reasons to doubt the result, one line each.
    """

    changes: tuple[Change, ...]
    registration: Registration
    reference: Visit
    later: Visit
    surfaces: tuple[Surface, Surface]
    evidence: tuple[BeamEvidence, BeamEvidence]
    compared: Bools
    flagged: Bools
    null_sigma: float
    range_sigmas_m: tuple[float, float]
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
            "spread": self.null_sigma,
            "range_sigma_m": list(self.range_sigmas_m),
            "warnings": list(self.warnings),
        }


def identity_registration(visit: Visit) -> Registration:
    """The registration of two time spans of one run, which share its world frame."""
    every = np.arange(len(visit.landmarks))
    return Registration(np.zeros(3), np.zeros((3, 3)), np.column_stack([every, every]))


def detect_changes(
    reference: Visit,
    later: Visit,
    config: ChangesConfig,
    registration: Registration | None = None,
    *,
    one_map: bool = False,
) -> ChangeResult:
    """Find what changed between two visits, each in its own world frame.

    ``registration`` of the later frame in the reference's is by default found from both maps.
    ``one_map``: the two were solved together, so that most may have changed and nothing else
    explains that.

    Raises:
        OutputError: the two cannot be registered, or have nothing in common.
    """
    warnings = laser_warnings(reference, later)
    config = settings_for_noise(reference, later, config)
    aligned = align_visits(reference, later, registration, config)
    one_robot = max(reference.robots, later.robots) == 1
    if aligned.is_inconsistent and registration is None and one_robot:
        # a motion that some landmarks agree on, while the rest of the maps disagrees
        aligned = align_visits_nonrigid(reference, later, config)
    reference, later, registration = aligned.reference, aligned.later, aligned.registration
    config = aligned.config
    if aligned.nonrigid:
        warnings += (_NONRIGID,)
    # before transparent surfaces are left out: in maps that disagree most surfaces seem so
    if not one_map or not aligned.is_inconsistent:
        warnings += consistency_warnings(aligned)
    a, b = surfaces = without_transparent(aligned.surfaces, (reference, later), config)
    on_a, on_b = evidence = tuple(
        replace(e, tested=e.tested & s.good)
        for e, s in zip(aligned.evidence, surfaces, strict=True)
    )
    sigma = min(null_sigma(evidence), DOUBTFUL_SIGMA if one_map else np.inf)
    compared, flagged = _classify_beams(later, b, (on_a, on_b), sigma, config)
    ended = np.nonzero(b.beams >= 0)[0]
    vanished = find_regions(a, on_a, on_a.beams, on_a.rows, on_a.first_ns, sigma, config)
    appeared = find_regions(b, on_b, ended, b.beams[ended], b.first_ns, sigma, config)
    shapes = (
        [extract_shape(a, reference, on_a, sigma, r.points) for r in vanished],
        [extract_shape(b, later, on_b, sigma, r.points) for r in appeared],
    )
    settings = MotionSettings(
        config.bias_sigma_m, repeatability(evidence), a.nearest.grid.cell_m,
        config.max_displacement_m,
    )  # fmt: skip
    moves = segment_motions(
        registration, surfaces, (reference, later), (on_a, on_b), settings, sigma
    )
    lines = (_lines(reference, np.zeros(3)), _lines(later, registration.pose))
    fits, segments = match_shapes(*shapes, settings), match_segments(vanished, appeared, moves)
    changes = assemble_changes(vanished, appeared, fits, segments, lines)
    return ChangeResult(
        changes, registration, reference, later, surfaces, (on_a, on_b), compared, flagged,
        sigma, aligned.range_sigmas_m, config.false_alarm_rate, warnings,
    )  # fmt: skip


def _classify_beams(
    later: Visit,
    surface: Surface,
    evidence: tuple[BeamEvidence, BeamEvidence],
    sigma: float,
    config: ChangesConfig,
) -> tuple[Bools, Bools]:
    """Which later beams (n,) are on or behind tested pieces, and which on flagged ones.

    ``surface``: of the later visit; ``evidence`` and ``sigma``: see `ChangeResult`.
    """
    compared = np.zeros(len(later.range_m), dtype=bool)
    marked = compared.copy()
    behind_old, own = (evidence[0].beams, evidence[0].rows), beams_on_surface(surface)
    for (beams, rows), e in zip((behind_old, own), evidence, strict=True):
        compared[beams[e.tested[rows]]] = True
        marked[beams[flag_pieces(e, sigma, config.false_alarm_rate / 2)[rows]]] = True
    return compared, marked


def _lines(visit: Visit, frame: Array) -> Lines:
    """Ids and ends (2, 2) m of a visit's line landmarks, their map being at ``frame`` (3,)."""
    return [(m.id, transform(frame, m.extent)) for m in visit.landmarks if m.line is not None]
