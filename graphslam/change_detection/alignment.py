"""Two visits in one frame, each with its surfaces and the evidence of the other's beams on them.

The frames are registered by landmarks (`rigid_registration`), or, where the maps are bent against
each other and no rigid motion fits, by the scans along the paths (`nonrigid_registration`). Then
every scan is aligned with the reference's surfaces within its covariance (`surface_alignment`), and
once more without the beams that seem to have hit something that changed.
"""

from dataclasses import dataclass, replace

import numpy as np

from graphslam.change_detection.beam_evidence import (
    DOUBTFUL_SIGMA,
    BeamEvidence,
    agreeing_share,
    beams_past_surfaces,
    half_beam_spacing,
    null_sigma,
    range_noise,
)
from graphslam.change_detection.grid import grid_over
from graphslam.change_detection.nonrigid_registration import aligned_at_once, register_nonrigid
from graphslam.change_detection.rigid_registration import (
    Registration,
    landmarks_of_map,
    register_rivals,
)
from graphslam.change_detection.surface_alignment import align_scans
from graphslam.change_detection.surface_map import Surface, fit_surfaces
from graphslam.change_detection.visit import Bools, Ints, Visit, scatter_of_ranges
from graphslam.core.config import ChangesConfig
from graphslam.core.errors import OutputError
from graphslam.core.geometry import Array, wrap

#: gates over `max_pose_error_m`, one per iteration, from coarse to fine: of the later visit, and of
#: the reference, whose scans the surfaces are made of
_LATER_GATES = np.array([1.0, 1.0, 0.8, 0.6, 0.4, 0.3, 0.2, 0.14, 0.12])
_REFERENCE_GATES = np.array([0.3, 0.2, 0.2])
_REFERENCE_ROUNDS = 2
#: beams with a score above _SUSPECT_SIGMAS are suspected to have hit something that changed; above
#: this share of them the scans are aligned again without them
_SUSPECT_SIGMAS, _MAX_SUSPECTS = 3.0, 0.03
_OVERLAP = 0.05  # least share of the later returns on surfaces of the reference
#: null sigma above which two maps, registered rigidly, are not of one place
_MAX_SIGMA = 5.0
#: two maps are not of one place if less than this share agrees, to so many sigmas: of the surface
#: that both saw (where all furniture of a room moved 0.81 to 0.87 agree, where two of its four
#: walls are elsewhere 0.75);
#: after a nonrigid registration of the beams, as a path that was bent to fit should leave less
_LEAST_AGREEMENT = {False: 0.78, True: 0.8}
_AGREEING_SIGMAS = {False: 5.0, True: 2.2}
#: surface with a higher score is elsewhere in the other visit. Shares of that which differ by less
#: than _TIE are equal; one is clearly less than another if it is below this part of it
_ELSEWHERE_SIGMAS, _TIE, _CLEARLY = 5.0, 0.01, 0.5
#: least side of a cell, in sigmas of the range noise: five cells must be longer than noise is wide,
#: or a window has no direction
_CELL_SIGMAS = 1.55
#: least share of the returns that lie on surface which is compared, without a warning
_LEAST_USABLE = 0.6
#: a pose counts if it compares at least this part of the surface that another one compares
_ENOUGH = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class AlignedVisits:
    """Two visits in the reference's frame, with what is compared of them.

    ``surfaces``, ``range_sigmas_m``: of the reference and of the later visit; ``evidence``: later
    beams on reference surfaces, reference beams on later surfaces; ``config``: the settings for the
    comparison; ``nonrigid``: whether the maps were bent against each other; ``rivals``: other poses
    (3,) of the later frame that explain the scans nearly as well, each with the share of surface
    that is elsewhere there, which is ``elsewhere`` at the pose that was taken.
    """

    reference: Visit
    later: Visit
    registration: Registration
    surfaces: tuple[Surface, Surface]
    range_sigmas_m: tuple[float, float]
    evidence: tuple[BeamEvidence, BeamEvidence]
    config: ChangesConfig
    nonrigid: bool
    rivals: tuple[tuple[Array, float], ...] = ()
    elsewhere: float = 0.0

    @property
    def is_inconsistent(self) -> bool:
        """Whether the visits disagree too much to be of one place.

        What changed does not count unless it is most of what was seen: what did not still agrees.
        """
        too_far = not self.nonrigid and null_sigma(self.evidence) > _MAX_SIGMA
        return too_far or self.agreement < _LEAST_AGREEMENT[self.nonrigid]

    @property
    def agreement(self) -> float:
        """Share of what both visits saw that is where the other saw it."""
        sigma = 1.0 if self.nonrigid else max(null_sigma(self.evidence), 1.0)
        gate = _AGREEING_SIGMAS[self.nonrigid] * sigma
        return agreeing_share(self.evidence, gate, per_beam=self.nonrigid)


def settings_for_noise(reference: Visit, later: Visit, config: ChangesConfig) -> ChangesConfig:
    """The settings, with cells and the first range noise as large as the noisier laser asks for."""
    sigma = max(scatter_of_ranges(reference), scatter_of_ranges(later))
    return replace(
        config,
        resolution_m=max(config.resolution_m, _CELL_SIGMAS * sigma),
        range_sigma_m=max(config.range_sigma_m, sigma),
    )


def align_visits(
    reference: Visit, later: Visit, registration: Registration | None, config: ChangesConfig
) -> AlignedVisits:
    """Both visits in the reference's frame, registered by landmarks, or else nonrigidly.

    Raises:
        OutputError: neither is possible.
    """
    if registration is not None:
        rivals: tuple[Registration, ...] = (registration,)
    else:
        try:
            rivals = register_rivals(landmarks_of_map(reference), landmarks_of_map(later))
        except OutputError:
            if max(reference.robots, later.robots) > 1:  # consecutive scans are of several paths
                raise
            return align_visits_nonrigid(reference, later, config)
    if len(rivals) == 1:
        return _align_rigidly(reference, later, rivals[0], config)
    # scans see more than the landmarks that two poses of a symmetric building explain alike
    tried: list[AlignedVisits] = []
    for number, one in enumerate(rivals, 1):
        try:
            tried.append(_align_rigidly(reference, later, one, config))
        except OutputError:
            if number == len(rivals) and not tried:
                raise
    return _best_of(tried)


def _best_of(tried: list[AlignedVisits]) -> AlignedVisits:
    """Of the visits, aligned at several poses, those at which least of the surface is elsewhere.

    In doubt at that which landmarks explain best, the first. With the poses that are as good.
    """
    shares = np.array([_share_elsewhere(one.evidence) for one in tried])
    # a pose at which the visits have little in common has little to be elsewhere as well
    tests = np.array([sum(int(e.tested.sum()) for e in one.evidence) for one in tried])
    shares = np.where(tests >= _ENOUGH * tests.max(), shares, 1.0)
    k = int(np.argmin(shares))
    k = k if shares[k] < shares[0] - _TIE else 0
    alike = tuple(
        (one.registration.pose, float(share))
        for i, (one, share) in enumerate(zip(tried, shares, strict=True))
        if i != k and not one.is_inconsistent and not _is_clearly_less(shares[k], share)
    )
    return replace(tried[k], rivals=alike, elsewhere=float(shares[k]))


def _is_clearly_less(share: float, other: float) -> bool:
    return share < _CLEARLY * other and other - share > _TIE


def _align_rigidly(
    reference: Visit, later: Visit, registration: Registration, config: ChangesConfig
) -> AlignedVisits:
    """`align_visits` at one pose; what changed does not count in the end.

    Raises:
        OutputError: the later visit observed hardly any surface of the reference.
    """
    prior = later.transformed(registration.pose, registration.cov)
    aligned = _align(reference, prior, registration, config, nonrigid=False)
    suspects = _suspects(aligned)
    if suspects.mean() <= _MAX_SUSPECTS:
        return aligned
    # what changed affected the alignment of the scans that observed it
    surface, sigmas = aligned.surfaces[0], aligned.range_sigmas_m
    later = align_scans(prior, surface, _gates(_LATER_GATES, config), suspects)
    surfaces = (surface, fit_surfaces(later, surface.nearest.grid, sigmas[1], config))
    evidence = _evidence((aligned.reference, later), surfaces, sigmas, config)
    return replace(aligned, later=later, surfaces=surfaces, evidence=evidence)


def align_visits_nonrigid(reference: Visit, later: Visit, config: ChangesConfig) -> AlignedVisits:
    """Both visits in one frame although their maps are bent against each other.

    Raises:
        OutputError: they are hardly of one place.
    """
    fitted, best = register_nonrigid(reference, later, config)
    config = replace(config, gate_m=max(config.gate_m, config.nonrigid_gate_m))
    aligned = _align(*fitted.registered(config, whole_reference=True), config, nonrigid=True)
    if aligned.is_inconsistent:
        return aligned  # of two different places: all scans at once would bend both until they fit
    registered = aligned_at_once(best).registered(config, whole_reference=False)
    return _align(*registered, config, nonrigid=True)


def _align(
    reference: Visit,
    later: Visit,
    registration: Registration,
    config: ChangesConfig,
    nonrigid: bool,
) -> AlignedVisits:
    """Both visits, registered, with every scan aligned with the reference's surfaces.

    After a ``nonrigid`` registration scans are not aligned: alone they are constrained too little.

    Raises:
        OutputError: the later visit observed hardly any surface of the reference.
    """
    ends = np.concatenate([v.ends_of(v.surface) for v in (reference, later)])
    grid = grid_over(ends, config.resolution_m, config.max_side_cells**2)
    sigma = config.range_sigma_m
    prior = reference
    surface = fit_surfaces(reference, grid, sigma, config)
    for _ in range(_REFERENCE_ROUNDS):
        if not nonrigid:
            reference = align_scans(prior, surface, _gates(_REFERENCE_GATES, config))
        surface = fit_surfaces(reference, grid, sigma, config)
        sigma = range_noise(surface, reference, config)
    cells = grid.cells(later.ends_of(later.surface))
    near = (cells >= 0) & (surface.nearest.distance_m[cells] < config.max_pose_error_m)
    if not surface.good.any() or near.mean() < _OVERLAP:
        raise OutputError(
            f"nothing to compare: {100 * near.mean():.0f} % of the later returns lie on surfaces "
            "of the reference; did both runs see the same place?"
        )
    if not nonrigid:
        later = align_scans(later, surface, _gates(_LATER_GATES, config))
    sigmas = (sigma, range_noise(surface, later, config))
    surfaces = (surface, fit_surfaces(later, grid, sigmas[1], config))
    evidence = _evidence((reference, later), surfaces, sigmas, config)
    return AlignedVisits(
        reference, later, registration, surfaces, sigmas, evidence, config, nonrigid
    )


def _gates(shares: Array, config: ChangesConfig) -> tuple[float, ...]:
    return tuple((config.max_pose_error_m * shares).tolist())


def _evidence(
    visits: tuple[Visit, Visit],
    surfaces: tuple[Surface, Surface],
    sigmas: tuple[float, float],
    config: ChangesConfig,
) -> tuple[BeamEvidence, BeamEvidence]:
    """Evidence of later beams on reference surfaces, of reference beams on later surfaces."""
    return (
        beams_past_surfaces(surfaces[0], visits[1], sigmas[1], config),
        beams_past_surfaces(surfaces[1], visits[0], sigmas[0], config),
    )


def _share_elsewhere(evidence: tuple[BeamEvidence, ...]) -> float:
    """Share of the surface that both visits saw which is elsewhere in the other."""
    scores = np.concatenate([e.scores(1.0)[e.tested] for e in evidence])
    return float(np.mean(np.abs(scores) > _ELSEWHERE_SIGMAS)) if len(scores) else 1.0


def _suspects(aligned: AlignedVisits) -> Bools:
    """Later beams (n,) on surfaces that seem to have moved, in either direction."""
    suspect = np.zeros(len(aligned.later.range_m), dtype=bool)
    moved = [np.abs(e.scores(1.0)) > _SUSPECT_SIGMAS for e in aligned.evidence]
    on_old = aligned.evidence[0]
    suspect[on_old.beams[moved[0][on_old.rows]]] = True
    beams, rows = beams_on_surface(aligned.surfaces[1])
    suspect[beams[moved[1][rows]]] = True
    return suspect


def beams_on_surface(surface: Surface) -> tuple[Ints, Ints]:
    """Beams (k,) that end near good pieces of their visit's own surfaces, and those pieces (k,)."""
    beams = np.nonzero(surface.beams >= 0)[0]
    cell = surface.cells[surface.beams[beams]]
    near = surface.nearest.distance_m[cell] < 2.5 * surface.nearest.grid.cell_m
    return beams[near], surface.nearest.member[cell[near]].astype(np.int64)


def laser_warnings(reference: Visit, later: Visit) -> tuple[str, ...]:
    """A warning if the two visits were made with different lasers."""
    steps = [2 * np.degrees(half_beam_spacing(v)) for v in (reference, later)]
    beams = [int(np.median(np.bincount(v.scan))) for v in (reference, later)]
    if abs(steps[0] - steps[1]) < 0.02 * steps[0] and abs(beams[0] - beams[1]) < 0.02 * beams[0]:
        return ()
    return (
        f"the lasers differ ({beams[0]} beams of {steps[0]:.2f} deg, {beams[1]} of "
        f"{steps[1]:.2f} deg): where they look at different heights, things seem to have changed",
    )


def consistency_warnings(aligned: AlignedVisits) -> tuple[str, ...]:
    """Warnings if the visits disagree all over by more than is stated, or fit at several poses.

    Raises:
        OutputError: by so much more that they are hardly of one place.
    """
    sigma = null_sigma(aligned.evidence)
    if aligned.is_inconsistent:
        raise OutputError(
            f"nothing to compare: the surfaces of the two runs disagree by {sigma:.1f} times what "
            f"their covariances allow, and only {100 * aligned.agreement:.0f} % of them agree to "
            "that; they are of different places, or one of the maps is broken"
        )
    warnings = _rival_warnings(aligned) + _usable_warnings(aligned)
    if sigma < DOUBTFUL_SIGMA:
        return warnings
    return (
        *warnings,
        f"the surfaces of the two runs disagree by {sigma:.1f} times what their covariances "
        "allow, everywhere; a trajectory's covariance is too small, or materials bias the ranges "
        "of two lasers differently; changes may be false, and their probabilities allow for it",
    )


def _rival_warnings(aligned: AlignedVisits) -> tuple[str, ...]:
    """A warning if the place looks alike from several poses, as a symmetric room does."""
    if not aligned.rivals:
        return ()
    others = ", or ".join(f"{_pose_text(pose)}, {100 * n:.1f} %" for pose, n in aligned.rivals)
    taken = _pose_text(aligned.registration.pose)
    return (
        f"the place looks alike from several poses: the later map was taken to lie at {taken}, "
        f"where {100 * aligned.elsewhere:.1f} % of the surface is elsewhere; it may lie at {others}"
        ", and then the changes are others",
    )


def _usable_warnings(aligned: AlignedVisits) -> tuple[str, ...]:
    """A warning for each visit of which many returns lie on no surface that is compared."""
    found = []
    for name, surface, sigma in zip(
        ("reference", "later run"), aligned.surfaces, aligned.range_sigmas_m, strict=True
    ):
        returns = int((surface.beams >= 0).sum())
        usable = len(beams_on_surface(surface)[0]) / max(returns, 1)
        if usable < _LEAST_USABLE:
            found.append(
                f"only {100 * usable:.0f} % of the returns of the {name}, whose range noise is "
                f"{100 * sigma:.1f} cm, lie on straight surface that can be compared; what changed "
                "elsewhere is not found"
            )
    return tuple(found)


def _pose_text(pose: Array) -> str:
    return f"({pose[0]:.2f} m, {pose[1]:.2f} m, {np.degrees(wrap(pose[2])):.0f} deg)"
