"""Changes out of regions: what vanished, what appeared, and what is one thing that moved."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
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
    moved_points,
    near_segment,
)
from graphslam.change_detection.visit import pose_to_dict
from graphslam.core.geometry import Array, inverse

Kind = Literal["appeared", "vanished", "moved"]
#: ids and ends (2, 2), m, of line landmarks in the reference's frame
Lines = list[tuple[int, Array]]

#: a region is a part of what is this near to most of it, m
_AT_SEGMENT_M = 0.08
_LINE_SAMPLES = 40  # points of a line that are asked for whether they lie on what changed


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
            "displacement": None if moved is None else pose_to_dict(moved.motion, moved.cov),
            "beams": self.beams,
            "first_seen_ns": self.first_seen_ns,
            "lines_before": list(self.lines_before),
            "lines_now": list(self.lines_now),
        }


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """Vanished ``old`` and appeared ``new``, numbers of regions, that are one thing; its way."""

    old: list[int]
    new: list[int]
    motion: Displacement


def match_shapes(
    before: list[Shape | None], after: list[Shape | None], known: MotionSettings
) -> tuple[list[Pair], list[Pair]]:
    """Pairs of like shape, the most alike first; those with corners, and straight ones."""
    found = []
    for i, a in enumerate(before):
        for j, b in enumerate(after):
            fit = None if a is None or b is None else motion_between(a, b, known)
            if fit is not None and a is not None:
                found.append((-fit[0], i, j, is_straight(a), fit[1]))
    found.sort(key=lambda fit: fit[:3])
    cornered, straight = (
        [Pair([i], [j], motion) for _, i, j, flat, motion in found if flat == kind]
        for kind in (False, True)
    )
    return cornered, straight


def match_segments(
    vanished: list[Region], appeared: list[Region], moves: list[tuple[Array, Array, Displacement]]
) -> list[Pair]:
    """Regions along lines of the maps that moved; of each its ends before and now, (2, 2) m."""
    return [
        Pair(
            [i for i, r in enumerate(vanished) if _mostly_at(r, before)],
            [j for j, r in enumerate(appeared) if _mostly_at(r, now)],
            motion,
        )
        for before, now, motion in moves
    ]


def assemble_changes(
    vanished: list[Region],
    appeared: list[Region],
    fits: tuple[list[Pair], list[Pair]],
    stretches: list[Pair],
    lines: tuple[Lines, Lines],
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


def _lines_on(lines: Lines, regions: list[Region]) -> tuple[int, ...]:
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
    return len(near_segment(region.points, ends, _AT_SEGMENT_M)) > 0.5 * len(region.points)


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
