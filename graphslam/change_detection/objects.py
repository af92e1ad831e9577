"""Changes from regions: what vanished, what appeared, and which pairs are one moved object."""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy.spatial import cKDTree

from graphslam.change_detection.regions import Region
from graphslam.change_detection.shape_motion import motion_between
from graphslam.change_detection.shapes import (
    Displacement,
    MotionSettings,
    Shape,
    is_straight,
    near_segment,
)
from graphslam.change_detection.visit import pose_to_dict
from graphslam.core.geometry import Array, inverse, transform

Kind = Literal["appeared", "vanished", "moved"]
#: ids and ends (2, 2), m, of line landmarks in the reference's frame
Lines = list[tuple[int, Array]]

#: points within this distance, m, of a segment or region lie on it
_NEAR_M = 0.08
_LINE_SAMPLES = 40  # points of a line that are tested for lying on changed regions


@dataclass(frozen=True, slots=True, eq=False)
class Change:
    """One change, in the reference's world frame.

    ``polygon`` (c, 2) m, counter-clockwise: the new outline, or the old one if it vanished;
    ``before``: the old outline of what moved, if observed. ``displacement``: the rigid motion of
    the world from the old to the new pose. ``lines_before``, ``lines_now``: ids of line landmarks
    of either map that lie mostly on the change: walls that were removed, added or moved.
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
            "displacement": None if moved is None else pose_to_dict(moved.motion, moved.cov),
            "beams": self.beams,
            "first_seen_ns": self.first_seen_ns,
            "lines_before": list(self.lines_before),
            "lines_now": list(self.lines_now),
        }


@dataclass(frozen=True, slots=True, eq=False)
class MoveHypothesis:
    """Vanished ``old`` and appeared ``new`` regions (indices) may be one object that moved."""

    old: list[int]
    new: list[int]
    motion: Displacement


def match_shapes(
    before: list[Shape | None], after: list[Shape | None], settings: MotionSettings
) -> tuple[list[MoveHypothesis], list[MoveHypothesis]]:
    """Pairs of similar shapes, the most similar first: those with corners, and straight ones."""
    found = []
    for i, a in enumerate(before):
        for j, b in enumerate(after):
            fit = None if a is None or b is None else motion_between(a, b, settings)
            if fit is not None and a is not None:
                found.append((-fit[0], i, j, is_straight(a), fit[1]))
    found.sort(key=lambda fit: fit[:3])
    cornered, straight = (
        [MoveHypothesis([i], [j], motion) for _, i, j, flat, motion in found if flat == kind]
        for kind in (False, True)
    )
    return cornered, straight


def match_segments(
    vanished: list[Region], appeared: list[Region], moves: list[tuple[Array, Array, Displacement]]
) -> list[MoveHypothesis]:
    """Regions along line landmarks that moved; ``moves``: see `wall_motion.segment_motions`."""
    return [
        MoveHypothesis(
            [i for i, r in enumerate(vanished) if _mostly_on_segment(r, before)],
            [j for j, r in enumerate(appeared) if _mostly_on_segment(r, now)],
            motion,
        )
        for before, now, motion in moves
    ]


def assemble_changes(
    vanished: list[Region],
    appeared: list[Region],
    fits: tuple[list[MoveHypothesis], list[MoveHypothesis]],
    segments: list[MoveHypothesis],
    lines: tuple[Lines, Lines],
) -> tuple[Change, ...]:
    """Changes from regions; an object that moved is one change instead of two.

    Of the ``fits`` of `match_shapes` those with corners are the least ambiguous, then the
    ``segments`` of `match_segments` (of a box they may be opposite sides), then straight shapes.
    """
    found: list[Change] = []
    old_left, new_left = set(range(len(vanished))), set(range(len(appeared)))
    for pairs, needs_both in ((fits[0], True), (segments, False), (fits[1], True)):
        for pair in pairs:
            old = [i for i in pair.old if i in old_left]
            new = [j for j in pair.new if j in new_left]
            if not (old and new if needs_both else old or new):
                continue
            if old and new:
                # other parts of the same object: the motion brings them onto it
                before = [vanished[i].points for i in old]
                after = [appeared[j].points for j in new]
                motion = pair.motion.motion
                old += [
                    i for i in sorted(old_left - set(old))
                    if _mostly_near(transform(motion, vanished[i].points), after)
                ]  # fmt: skip
                new += [
                    j for j in sorted(new_left - set(new))
                    if _mostly_near(transform(inverse(motion), appeared[j].points), before)
                ]  # fmt: skip
            parts = [vanished[i] for i in old], [appeared[j] for j in new]
            found.append(_change("moved", *parts, lines, pair.motion))
            old_left -= set(old)
            new_left -= set(new)
    found += [_change("vanished", [vanished[i]], [], lines) for i in sorted(old_left)]
    found += [_change("appeared", [], [appeared[j]], lines) for j in sorted(new_left)]
    return tuple(sorted(found, key=lambda c: (-c.beams, c.kind, c.first_seen_ns)))


def _lines_on(lines: Lines, regions: list[Region]) -> tuple[int, ...]:
    """Ids of the lines that lie on regions for most of their length."""
    points = [region.points for region in regions]
    steps = np.linspace(0, 1, _LINE_SAMPLES)[:, None]
    return tuple(
        number
        for number, ends in lines
        if points and _mostly_near(ends[0] + steps * (ends[1] - ends[0]), points)
    )


def _mostly_near(points: Array, parts: list[Array]) -> bool:
    """Whether most points (k, 2) m lie near points (n, 2) m of the parts."""
    away = cKDTree(np.concatenate(parts)).query(points)[0]
    return bool((away < _NEAR_M).mean() > 0.5)


def _mostly_on_segment(region: Region, ends: Array) -> bool:
    return len(near_segment(region.points, ends, _NEAR_M)) > 0.5 * len(region.points)


def _change(
    kind: Kind,
    old: list[Region],
    new: list[Region],
    lines: tuple[Lines, Lines],
    motion: Displacement | None = None,
) -> Change:
    """The change made of ``old`` regions of the reference and ``new`` ones of the later visit."""
    outlines = [max(side, key=lambda r: len(r.rows)).outline for side in (new, old) if side]
    every = [*new, *old]
    return Change(
        kind, outlines[0], max(r.probability for r in every), motion,
        sum(r.beams for r in every), min(r.first_ns for r in every),
        outlines[1] if len(outlines) > 1 else None,
        _lines_on(lines[0], old), _lines_on(lines[1], new),
    )  # fmt: skip
