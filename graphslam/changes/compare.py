"""Change detection, top to bottom: one frame, surfaces, evidence, changes.

1. the later run's frame lies in the reference's by landmarks of both (`registration`), or, where
   the maps bend, its path by the surfaces its scans see (`localisation`);
2. every scan is brought onto the surfaces of the reference, within its covariance (`alignment`);
3. the beams of each visit are held against the surfaces of the other (`evidence`);
4. flagged pieces of surface that hang together are changes (`regions`), of which some are one
   thing that moved (`moves`).
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from scipy.spatial import cKDTree

from graphslam.changes.alignment import align
from graphslam.changes.evidence import (
    Evidence,
    past,
    range_noise,
    repeatability,
    spread,
    visit_step,
)
from graphslam.changes.glass import solid
from graphslam.changes.grid import grid_over
from graphslam.changes.localisation import localise
from graphslam.changes.moves import motion_between
from graphslam.changes.regions import Region, flagged, regions
from graphslam.changes.registration import Registration, register
from graphslam.changes.shapes import (
    Displacement,
    Known,
    Shape,
    close_to,
    is_straight,
    moved_points,
    shape_of,
)
from graphslam.changes.stretches import stretch_moves
from graphslam.changes.surface import Surface, surface_of
from graphslam.changes.visit import Bools, Ints, Visit, dictionary
from graphslam.config import ChangesConfig
from graphslam.errors import OutputError
from graphslam.geometry import Array, inverse, transform

Kind = Literal["appeared", "vanished", "moved"]
_Lines = list[tuple[int, Array]]

#: farthest returns that pull a scan, m, round by round: wide first
_REFERENCE_GATES = (0.15, 0.1, 0.1)
_LATER_GATES = (0.5, 0.5, 0.4, 0.3, 0.2, 0.15, 0.1, 0.07, 0.06)
#: from this share of suspected beams on, scans are placed again without them; scores, in sigmas,
#: that make a beam suspect
_MANY_SUSPECTS, _SUSPECT = 0.03, 3.0
_REFERENCE_ROUNDS = 2
_OVERLAP = 0.05  # share of the later returns that must lie where the reference looked
_FIRST_SIGMA_M = 0.02  # of ranges, until they tell themselves
#: a region is a part of what is this near to most of it, m
_AT_SEGMENT_M = 0.08
_LINE_SAMPLES = 40  # points of a line that are asked for whether they lie on what changed


#: where maps bend: how far off a return is still compared, m, and what to say
_BENT_GATE_M = 0.3
#: factor on the stated sigmas from which on two maps are not of one place: where a path was
#: bent to fit, anything that is left was free to fit; and from which on it is warned of
_MOST_SPREAD, _WIDE_SPREAD = {False: 5.0, True: 1.8}, 1.5
_BENT = (
    "the maps bend differently, so no one motion brings their landmarks together: both paths were "
    "straightened by their scans and the later one bent onto the reference; only large changes "
    "are found, and where they are is known to decimetres"
)


@dataclass(frozen=True, slots=True, eq=False)
class Change:
    """One change, in the reference's world frame.

    ``polygon`` (c, 2) m counter-clockwise: of the new place, of the old one if it vanished;
    ``before`` the old place of what moved, where it was seen. ``displacement`` is the rigid motion
    of the world that takes it from the old to the new place. ``lines_before`` and ``lines_now`` are
    ids of line landmarks of either map most of which is what changed: walls that were removed,
    added or moved.
    """

    kind: Kind
    polygon: Array
    probability: float
    displacement: Displacement | None
    beams: int
    first_seen_ns: int
    before: Array | None = None
    lines_before: tuple[int, ...] = ()
    lines_now: tuple[int, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """The entry in changes.json."""
        moved = self.displacement
        return {
            "kind": self.kind,
            "polygon": self.polygon.tolist(),
            "before": None if self.before is None else self.before.tolist(),
            "probability": self.probability,
            "displacement": None if moved is None else dictionary(moved.motion, moved.cov),
            "beams": self.beams,
            "first_seen_ns": self.first_seen_ns,
            "lines_before": list(self.lines_before),
            "lines_now": list(self.lines_now),
        }


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """All that a comparison found.

    Attributes:
        changes: largest first.
        registration: of the later world frame in the reference's.
        reference, later: the visits, aligned, in the reference's frame.
        surfaces: of the reference and of the later visit.
        evidence: later beams past reference surfaces; reference beams past later surfaces.
        compared, flagged: (n,) which later beams were compared, and flagged.
        spread: factor on the stated sigmas with which the bulk of the scores is normal.
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
            "registration": dictionary(self.registration.pose, self.registration.cov)
            | {"landmarks": len(self.registration.matched)},
            "spread": self.spread,
            "range_sigma_m": list(self.range_sigma_m),
            "warnings": list(self.warnings),
        }


def same_frame(visit: Visit) -> Registration:
    """The registration of two spans of one run: they share its world frame."""
    every = np.arange(len(visit.landmarks))
    return Registration(
        np.zeros(3), np.zeros((3, 3)), np.column_stack([every, every]), np.zeros(0, dtype=np.int64)
    )


def compare(
    reference: Visit,
    later: Visit,
    config: ChangesConfig,
    registration: Registration | None = None,
) -> Comparison:
    """Find what is different in the later visit.

    Args:
        reference: in its world frame.
        later: in its own.
        config: settings.
        registration: where the later frame lies; found by landmarks if not given.

    Raises:
        OutputError: the two cannot be registered, or saw nothing in common.
    """
    warnings = lasers_differ(reference, later)
    laid = _laid(reference, later, registration, config)
    if laid.broken and registration is None and max(reference.robots, later.robots) == 1:
        # a motion that some landmarks agree on, while the rest of the maps lies elsewhere
        laid = _laid_bent(reference, later, config)
    reference, later, registration = laid.reference, laid.later, laid.registration
    surfaces, evidence, sigmas, config = laid.surfaces, laid.evidence, laid.sigmas, laid.config
    if laid.bent:
        warnings += (_BENT,)
    # judged with all there is: of paths that are broken little seems solid
    warnings += _plausible(spread(evidence), laid.bent)
    surfaces, evidence = _of_solid(surfaces, evidence, (reference, later), config)
    a, b = surfaces
    factor = spread(evidence)
    flags = tuple(flagged(e, factor, config.false_alarm_rate / 2) for e in evidence)
    compared, marked = _beams(later, surfaces, evidence, (flags[0], flags[1]))
    seen = np.nonzero(b.beams >= 0)[0]
    vanished = regions(
        a, evidence[0], evidence[0].beams, evidence[0].rows, evidence[0].first_ns, factor, config
    )
    appeared = regions(b, evidence[1], seen, b.beams[seen], b.first_ns, factor, config)
    shapes = (
        [shape_of(a, reference, evidence[0], factor, r.points) for r in vanished],
        [shape_of(b, later, evidence[1], factor, r.points) for r in appeared],
    )
    known = Known(config.bias_sigma_m, repeatability(evidence), a.nearest.grid.cell_m)
    fits = _fits(*shapes, known)
    marks = (reference.landmarks, later.landmarks)
    moves = stretch_moves(
        marks, registration, surfaces, (reference, later), evidence, known, factor
    )
    stretches = _stretches(vanished, appeared, moves)
    lines = (_placed_lines(reference, same_frame(reference)), _placed_lines(later, registration))
    changes = _changes(vanished, appeared, fits, stretches, lines)
    return Comparison(
        changes, registration, reference, later, surfaces, evidence, compared, marked,
        factor, sigmas, config.false_alarm_rate, warnings,
    )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class _Laid:
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
        return spread(self.evidence) > _MOST_SPREAD[self.bent]


def _laid(
    reference: Visit, later: Visit, registration: Registration | None, config: ChangesConfig
) -> _Laid:
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
            return _laid_bent(reference, later, config)
    placed = later.placed(registration.pose, registration.cov)
    reference, later, surfaces, sigmas = aligned(reference, placed, config)
    evidence = _evidence(reference, later, surfaces, sigmas, config)
    suspects = _suspects(later, surfaces, evidence)
    if suspects.mean() > _MANY_SUSPECTS:
        # what changed pulled at the scans that saw it: place them again without it
        a = surfaces[0]
        later = align(placed, a, _LATER_GATES, suspects)
        surfaces = (a, surface_of(later, a.nearest.grid, sigmas[1], config))
        evidence = _evidence(reference, later, surfaces, sigmas, config)
    return _Laid(reference, later, registration, surfaces, sigmas, evidence, config, False)


def _laid_bent(reference: Visit, later: Visit, config: ChangesConfig) -> _Laid:
    """Both visits in one frame although their maps bend differently.

    Raises:
        OutputError: they are hardly of one place.
    """
    reference, placed, registration = localise(reference, later, config)
    config = replace(config, gate_m=max(config.gate_m, _BENT_GATE_M))
    reference, later, surfaces, sigmas = aligned(reference, placed, config, bent=True)
    evidence = _evidence(reference, later, surfaces, sigmas, config)
    return _Laid(reference, later, registration, surfaces, sigmas, evidence, config, True)


def lasers_differ(reference: Visit, later: Visit) -> tuple[str, ...]:
    """A warning if the two visits were made with different lasers."""
    steps = [2 * np.degrees(visit_step(v)) for v in (reference, later)]
    beams = [int(np.median(np.bincount(v.scan))) for v in (reference, later)]
    if abs(steps[0] - steps[1]) < 0.02 * steps[0] and abs(beams[0] - beams[1]) < 0.02 * beams[0]:
        return ()
    return (
        f"the lasers differ ({beams[0]} beams of {steps[0]:.2f} deg, {beams[1]} of "
        f"{steps[1]:.2f} deg): where they look at different heights, things seem to have changed",
    )


def aligned(
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
    a = surface_of(reference, grid, sigma, config)
    for _ in range(_REFERENCE_ROUNDS):
        reference = first if bent else align(first, a, _REFERENCE_GATES)
        a = surface_of(reference, grid, sigma, config)
        sigma = range_noise(a, reference, config.gate_m)
    at = grid.cells(later.ends[later.surface])
    near = (at >= 0) & (a.nearest.distance_m[at] < _LATER_GATES[0])
    if not a.good.any() or near.mean() < _OVERLAP:
        raise OutputError(
            f"nothing to compare: {100 * near.mean():.0f} % of the later returns lie on surfaces "
            "of the reference; did both runs see the same place?"
        )
    later = later if bent else align(later, a, _LATER_GATES)
    sigmas = (sigma, range_noise(a, later, config.gate_m))
    return reference, later, (a, surface_of(later, grid, sigmas[1], config)), sigmas


def _plausible(factor: float, bent: bool) -> tuple[str, ...]:
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
        past(a, later, a.incidence, sigmas[1], config),
        past(b, reference, b.incidence, sigmas[0], config),
    )


def _of_solid(
    surfaces: tuple[Surface, Surface],
    evidence: tuple[Evidence, Evidence],
    visits: tuple[Visit, Visit],
    config: ChangesConfig,
) -> tuple[tuple[Surface, Surface], tuple[Evidence, Evidence]]:
    """Surfaces and evidence without what a visit itself looked through."""
    a, b = solid(surfaces, visits, config)
    left = [replace(e, tested=e.tested & s.good) for e, s in zip(evidence, (a, b), strict=True)]
    return (a, b), (left[0], left[1])


def _suspects(
    later: Visit, surfaces: tuple[Surface, Surface], evidence: tuple[Evidence, Evidence]
) -> Bools:
    """Later beams (n,) on anything that seems to lie elsewhere than before, to either side."""
    suspect = np.zeros(len(later.range_m), dtype=bool)
    odd = [np.abs(e.scores(1.0)) > _SUSPECT for e in evidence]
    suspect[evidence[0].beams[odd[0][evidence[0].rows]]] = True
    beams, rows = _on_pieces(surfaces[1], later)
    suspect[beams[odd[1][rows]]] = True
    return suspect


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
        (*_on_pieces(surfaces[1], later), evidence[1], flags[1]),
    ):
        compared[beams[e.tested[rows]]] = True
        marked[beams[flag[rows]]] = True
    return compared, marked


def _on_pieces(surface: Surface, visit: Visit) -> tuple[Ints, Ints]:
    """Beams (k,) of a visit and the good piece (k,) of its own surfaces next to their ends."""
    beams = np.nonzero(surface.beams >= 0)[0]
    cell = surface.cells[surface.beams[beams]]
    near = surface.nearest.distance_m[cell] < 2.5 * surface.nearest.grid.cell_m
    return beams[near], surface.nearest.member[cell[near]].astype(np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class _Pair:
    """Vanished ``old`` and appeared ``new``, numbers of regions, that are one thing; its way."""

    old: list[int]
    new: list[int]
    motion: Displacement


def _fits(
    before: list[Shape | None], after: list[Shape | None], known: Known
) -> tuple[list[_Pair], list[_Pair]]:
    """Pairs of like shape, the most alike first; those with corners, and straight ones."""
    found = []
    for i, a in enumerate(before):
        for j, b in enumerate(after):
            fit = None if a is None or b is None else motion_between(a, b, known)
            if fit is not None and a is not None:
                found.append((-fit[0], i, j, is_straight(a), fit[1]))
    found.sort(key=lambda fit: fit[:3])
    cornered, straight = (
        [_Pair([i], [j], motion) for _, i, j, flat, motion in found if flat == kind]
        for kind in (False, True)
    )
    return cornered, straight


def _stretches(
    vanished: list[Region], appeared: list[Region], moves: list[tuple[Array, Array, Displacement]]
) -> list[_Pair]:
    """Regions along lines of the maps that moved."""
    return [
        _Pair(
            [i for i, r in enumerate(vanished) if _mostly_at(r, before)],
            [j for j, r in enumerate(appeared) if _mostly_at(r, now)],
            motion,
        )
        for before, now, motion in moves
    ]


def _changes(
    vanished: list[Region],
    appeared: list[Region],
    fits: tuple[list[_Pair], list[_Pair]],
    stretches: list[_Pair],
    lines: tuple[_Lines, _Lines],
) -> tuple[Change, ...]:
    """Regions as changes; what moved once instead of twice.

    Shapes with corners say most about what is which, then lines of both maps (of a box they
    may be opposite sides), then other straight shapes.
    """
    found: list[Change] = []
    old_left, new_left = set(range(len(vanished))), set(range(len(appeared)))
    for pairs, needs_both in ((fits[0], True), (stretches, False), (fits[1], True)):
        for pair in pairs:
            old = [i for i in pair.old if i in old_left]
            new = [j for j in pair.new if j in new_left]
            if not (old and new if needs_both else old or new):
                continue
            # other parts of the same thing: the motion brings them onto it
            there = [vanished[i].points for i in old]
            here = [appeared[j].points for j in new]
            back = Displacement(inverse(pair.motion.motion), pair.motion.cov)
            if old and new:
                old += [
                    i for i in sorted(old_left - set(old))
                    if _lands(moved_points(vanished[i].points, pair.motion), here)
                ]  # fmt: skip
                new += [
                    j for j in sorted(new_left - set(new))
                    if _lands(moved_points(appeared[j].points, back), there)
                ]  # fmt: skip
            parts = [appeared[j] for j in new] or [vanished[i] for i in old]
            change = _moved(parts, [vanished[i] for i in old] if new else [], pair.motion)
            on = _lines_on(lines[0], [vanished[i] for i in old])
            now = _lines_on(lines[1], [appeared[j] for j in new])
            found.append(replace(change, lines_before=on, lines_now=now))
            old_left -= set(old)
            new_left -= set(new)
    kinds: Mapping[Kind, list[Region]] = {
        "vanished": [vanished[i] for i in sorted(old_left)],
        "appeared": [appeared[j] for j in sorted(new_left)],
    }
    for kind, rest in kinds.items():
        for r in rest:
            change = Change(kind, r.outline, r.probability, None, r.beams, r.first_ns)
            if kind == "vanished":
                change = replace(change, lines_before=_lines_on(lines[0], [r]))
            else:
                change = replace(change, lines_now=_lines_on(lines[1], [r]))
            found.append(change)
    return tuple(sorted(found, key=lambda c: (-c.beams, c.kind, c.first_seen_ns)))


def _placed_lines(visit: Visit, registration: Registration) -> _Lines:
    """Ids and ends (2, 2) m of a visit's line landmarks in the reference's frame."""
    return [
        (mark.id, transform(registration.pose, mark.extent))
        for mark in visit.landmarks
        if mark.line is not None
    ]


def _lines_on(lines: _Lines, regions: list[Region]) -> tuple[int, ...]:
    """Ids of lines most of whose length lies on regions."""
    if not regions:
        return ()
    points = [region.points for region in regions]
    steps = np.linspace(0, 1, _LINE_SAMPLES)[:, None]
    return tuple(
        number for number, ends in lines if _lands(ends[0] + steps * (ends[1] - ends[0]), points)
    )


def _lands(points: Array, parts: list[Array]) -> bool:
    """Whether most points (k, 2) m lie at some of the parts (n, 2) m."""
    away = cKDTree(np.concatenate(parts)).query(points)[0]
    return bool((away < _AT_SEGMENT_M).mean() > 0.5)


def _mostly_at(region: Region, ends: Array) -> bool:
    return len(close_to(region.points, ends, _AT_SEGMENT_M)) > 0.5 * len(region.points)


def _moved(new: list[Region], old: list[Region], motion: Displacement) -> Change:
    largest = max(new, key=lambda r: len(r.rows))
    before = max(old, key=lambda r: len(r.rows)).outline if old else None
    every = [*new, *old]
    return Change(
        "moved",
        largest.outline,
        max(r.probability for r in every),
        motion,
        sum(r.beams for r in every),
        min(r.first_ns for r in every),
        before,
    )
