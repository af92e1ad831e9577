"""Two visits in one frame, each on the surfaces of the other.

By landmarks of both maps (`registration`), or, where the maps bend and no one motion brings them
together, along the path by the surfaces that its scans see (`localisation`). Then every scan is
brought onto the reference's surfaces within its covariance (`alignment`), once more without what
seems to have changed.
"""

from dataclasses import dataclass, replace

import numpy as np

from graphslam.change_detection.beam_evidence import (
    Evidence,
    beams_past_surfaces,
    half_beam_spacing,
    null_sigma,
    range_noise,
)
from graphslam.change_detection.grid import grid_over
from graphslam.change_detection.nonrigid_registration import register_nonrigid
from graphslam.change_detection.rigid_registration import Registration, register
from graphslam.change_detection.scan_to_map import align_scans
from graphslam.change_detection.surface_map import Surface, fit_surfaces
from graphslam.change_detection.visit import Bools, Ints, Visit
from graphslam.core.config import ChangesConfig
from graphslam.core.errors import OutputError

#: farthest returns that pull a scan, m, round by round: wide first
_REFERENCE_GATES = (0.15, 0.1, 0.1)
_LATER_GATES = (0.5, 0.5, 0.4, 0.3, 0.2, 0.15, 0.1, 0.07, 0.06)
#: from this share of suspected beams on, scans are placed again without them; scores, in sigmas,
#: that make a beam suspect
_MANY_SUSPECTS, _SUSPECT = 0.03, 3.0
_REFERENCE_ROUNDS = 2
_OVERLAP = 0.05  # share of the later returns that must lie where the reference looked
_FIRST_SIGMA_M = 0.02  # of ranges, until they tell themselves
#: where maps bend: how far off a return is still compared, m, and what to say
_BENT_GATE_M = 0.3
#: factor on the stated sigmas from which on two maps are not of one place: where a path was
#: bent to fit, anything that is left was free to fit; and from which on it is warned of
_MOST_SPREAD, _WIDE_SPREAD = {False: 5.0, True: 1.8}, 1.5


@dataclass(frozen=True, slots=True, eq=False)
class AlignedVisits:
    """Two visits in one frame, and what each says of the other's surfaces; ``config`` for that."""

    reference: Visit
    later: Visit
    registration: Registration
    surfaces: tuple[Surface, Surface]
    sigmas: tuple[float, float]
    evidence: tuple[Evidence, Evidence]
    config: ChangesConfig
    bent: bool

    @property
    def broken(self) -> bool:
        """Whether the visits disagree by more than can be."""
        return null_sigma(self.evidence) > _MOST_SPREAD[self.bent]


def align_visits(
    reference: Visit, later: Visit, registration: Registration | None, config: ChangesConfig
) -> AlignedVisits:
    """Both visits in the reference's frame, by landmarks, or else as the maps bend.

    Raises:
        OutputError: neither way works.
    """
    if registration is None:
        try:
            registration = register(reference.landmarks, later.landmarks)
        except OutputError:
            if max(reference.robots, later.robots) > 1:  # no path to follow from scan to scan
                raise
            return align_visits_nonrigid(reference, later, config)
    placed = later.transformed(registration.pose, registration.cov)
    reference, later, surfaces, sigmas = _aligned(reference, placed, config)
    evidence = _evidence(reference, later, surfaces, sigmas, config)
    suspects = _suspects(later, surfaces, evidence)
    if suspects.mean() > _MANY_SUSPECTS:
        # what changed pulled at the scans that saw it: place them again without it
        a = surfaces[0]
        later = align_scans(placed, a, _LATER_GATES, suspects)
        surfaces = (a, fit_surfaces(later, a.nearest.grid, sigmas[1], config))
        evidence = _evidence(reference, later, surfaces, sigmas, config)
    return AlignedVisits(reference, later, registration, surfaces, sigmas, evidence, config, False)


def align_visits_nonrigid(reference: Visit, later: Visit, config: ChangesConfig) -> AlignedVisits:
    """Both visits in one frame although their maps bend differently.

    Raises:
        OutputError: they are hardly of one place.
    """
    reference, placed, registration = register_nonrigid(reference, later, config)
    config = replace(config, gate_m=max(config.gate_m, _BENT_GATE_M))
    reference, later, surfaces, sigmas = _aligned(reference, placed, config, bent=True)
    evidence = _evidence(reference, later, surfaces, sigmas, config)
    return AlignedVisits(reference, later, registration, surfaces, sigmas, evidence, config, True)


def _aligned(
    reference: Visit, later: Visit, config: ChangesConfig, bent: bool = False
) -> tuple[Visit, Visit, tuple[Surface, Surface], tuple[float, float]]:
    """Two visits in one frame, each on the reference's surfaces; surfaces; range sigmas, m.

    Where the maps are ``bent``, scans are where their neighbours are: one alone sees too little.

    Raises:
        OutputError: the later visit saw hardly anything of what the reference saw.
    """
    ends = np.concatenate([v.ends[v.surface] for v in (reference, later)])
    grid = grid_over(ends, config.resolution_m, config.max_side_cells**2)
    sigma = _FIRST_SIGMA_M
    first = reference
    a = fit_surfaces(reference, grid, sigma, config)
    for _ in range(_REFERENCE_ROUNDS):
        reference = first if bent else align_scans(first, a, _REFERENCE_GATES)
        a = fit_surfaces(reference, grid, sigma, config)
        sigma = range_noise(a, reference, config.gate_m)
    at = grid.cells(later.ends[later.surface])
    near = (at >= 0) & (a.nearest.distance_m[at] < _LATER_GATES[0])
    if not a.good.any() or near.mean() < _OVERLAP:
        raise OutputError(
            f"nothing to compare: {100 * near.mean():.0f} % of the later returns lie on surfaces "
            "of the reference; did both runs see the same place?"
        )
    later = later if bent else align_scans(later, a, _LATER_GATES)
    sigmas = (sigma, range_noise(a, later, config.gate_m))
    return reference, later, (a, fit_surfaces(later, grid, sigmas[1], config)), sigmas


def _evidence(
    reference: Visit,
    later: Visit,
    surfaces: tuple[Surface, Surface],
    sigmas: tuple[float, float],
    config: ChangesConfig,
) -> tuple[Evidence, Evidence]:
    """Later beams past reference surfaces, reference beams past later surfaces."""
    a, b = surfaces
    return (
        beams_past_surfaces(a, later, a.incidence, sigmas[1], config),
        beams_past_surfaces(b, reference, b.incidence, sigmas[0], config),
    )


def _suspects(
    later: Visit, surfaces: tuple[Surface, Surface], evidence: tuple[Evidence, Evidence]
) -> Bools:
    """Later beams (n,) on anything that seems to lie elsewhere than before, to either side."""
    suspect = np.zeros(len(later.range_m), dtype=bool)
    odd = [np.abs(e.scores(1.0)) > _SUSPECT for e in evidence]
    suspect[evidence[0].beams[odd[0][evidence[0].rows]]] = True
    beams, rows = beams_on_surface(surfaces[1], later)
    suspect[beams[odd[1][rows]]] = True
    return suspect


def beams_on_surface(surface: Surface, visit: Visit) -> tuple[Ints, Ints]:
    """Beams (k,) of a visit and the good piece (k,) of its own surfaces next to their ends."""
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


def consistency_warnings(factor: float, bent: bool) -> tuple[str, ...]:
    """A warning if the visits disagree all over by more than is stated.

    Raises:
        OutputError: by so much more that they are hardly of one place.
    """
    allowed = _MOST_SPREAD[bent]
    if factor > allowed:
        raise OutputError(
            f"nothing to compare: the surfaces of the two runs disagree by {factor:.1f} times what "
            "their covariances allow; they are of different places, or one of the maps is broken"
        )
    if factor < _WIDE_SPREAD:
        return ()
    return (
        f"the surfaces of the two runs disagree by {factor:.1f} times what their covariances "
        "allow, all over: a path is worse than it says, and changes may be false",
    )
