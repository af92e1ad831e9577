"""Gross errors of sightings that a robust kernel is there for, and those that it cannot tell apart.

A kernel whose influence decreases follows the majority: a few false detections,
each by itself, pull less the further off they are. It does not help where most of what is seen for
a moment, or of one landmark, is wrong, nor does it say that a landmark was moved. The first are
facts about a sensor, the others reasons to doubt the result.
"""

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace

import numpy as np
from scipy.special import bdtrc

from graphslam.core.arrays import BoolArray
from graphslam.core.config import RobustConfig
from graphslam.core.geometry import Array, polar_points, transform_each
from graphslam.estimation.m_estimators import WEIGHTS
from graphslam.verdict.doubts import MOVED_M, Fact, Reason
from graphslam.verdict.evidence import Evidence, Seen
from graphslam.verdict.moved_points import APART

#: squared distance per degree of freedom of a gross error, and how many sigmas it may pull: no
#: more than a right sighting does
FAR, PULL = 25.0, 1.0
#: of a robot's sightings: with a larger share of gross errors none is taken for harmless
MOST = 0.1
#: share of a stretch of sightings, or of a landmark's, that the kernel cannot be trusted with, and
#: gross errors that are too few to say so
MAJORITY, LEAST = 0.4, 6
#: gross errors of a landmark that say that it is elsewhere
FEW = 2
#: gross errors are of one place that scatter at most so much more than the right ones
LOOSER = 2.0
#: sightings in a stretch, and how likely any of all stretches may look like that by chance
STRETCHES = (5, 10, 20, 50, 100, 200)
CHANCE = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class GrossErrors:
    """Sightings (n,) of a robot that are gross errors, and those of them that do no harm."""

    gross: BoolArray
    harmless: BoolArray


def find_gross_errors(seen: Seen, kernel: RobustConfig) -> GrossErrors:
    """Of a robot's sightings (n), under the kernel that the estimate was found with."""
    weigh = WEIGHTS[kernel.kernel]
    d2, dof = seen.d2, seen.z.shape[1]
    # points without names are gated before, those in the map again are for `vanished_points`
    named = np.isin(seen.targets, [k for k, name in enumerate(seen.names) if name])
    gross = (d2 > FAR) & (named | ~seen.stands)
    far = np.sqrt(dof * d2[gross]).tolist()
    gross[gross] = [d * weigh(d, kernel.scale) < PULL for d in far]
    if not gross.any() or gross.mean() > MOST:
        return GrossErrors(gross, np.zeros_like(gross))
    return GrossErrors(gross, gross & ~_in_stretch(gross) & ~_of_doubted_targets(seen, gross))


def _in_stretch(gross: BoolArray) -> BoolArray:
    """Which (n,) are in a stretch of the log of which too many are gross errors for chance."""
    n, share = len(gross), float(gross.mean())
    change = np.zeros(n + 1, dtype=np.int64)  # of the number of such stretches around a sighting
    total = np.append(0, np.cumsum(gross))
    for length in STRETCHES:
        if length > n:
            break
        count = total[length:] - total[:-length]
        by_chance = bdtrc(count - 1.0, length, share)
        many = (count > MAJORITY * length) & (by_chance < CHANCE / (n * len(STRETCHES)))
        change[: n + 1 - length] += many
        change[length:] -= many
    return np.asarray(np.cumsum(change[:-1]) > 0)


def _of_doubted_targets(seen: Seen, gross: BoolArray) -> BoolArray:
    """Which (n,) are of something that is mostly elsewhere, or at one other place now and then."""
    count = np.bincount(seen.targets)
    wrong = np.bincount(seen.targets[gross], minlength=len(count))
    doubted = (wrong >= FEW) & (wrong > MAJORITY * count)
    at = transform_each(seen.poses, polar_points(seen.z[:, 1], seen.z[:, 0]))
    for target in np.flatnonzero((wrong >= LEAST) & ~doubted).tolist():
        own = seen.targets == target
        doubted[target] = _at_another_place(at[own & gross], at[own & ~gross])
    return np.asarray(doubted[seen.targets])


def _at_another_place(wrong: Array, right: Array) -> bool:
    """Whether places (m, 2) agree with each other as those (n, 2) that are right, but elsewhere."""
    places = [np.median(at, axis=0) for at in (wrong, right)]
    spreads = [
        float(np.median(np.hypot(*(at - place).T)))
        for at, place in zip((wrong, right), places, strict=True)
    ]
    away = float(np.hypot(*(places[0] - places[1])))
    return spreads[0] < max(MOVED_M, LOOSER * spreads[1]) and away > max(
        MOVED_M, APART * spreads[0]
    )


def misplaced_doubts(evidence: Evidence) -> Iterator[Reason]:
    """Named landmarks where they are by few of their sightings: where they are is not known."""
    for robot in evidence.robots:
        seen = robot.seen
        gross = find_gross_errors(seen, evidence.kernel).gross
        count = np.bincount(seen.targets, minlength=len(seen.names))
        wrong = np.bincount(seen.targets[gross], minlength=len(count))
        lost = np.flatnonzero((wrong >= FEW) & (wrong > 0.5 * count)).tolist()
        names = sorted(seen.names[k] for k in lost if k < len(seen.names) and seen.names[k])
        if names:
            text = (
                f"{robot.name}: most of its sightings of {', '.join(names[:5])}"
                f"{' and others' if len(names) > 5 else ''} are nowhere near where the map has it: "
                "wrong names?"
            )
            yield Reason("doubtful", "misplaced", robot.name, text)


def without_harmless(evidence: Evidence) -> tuple[Evidence, tuple[Fact, ...]]:
    """The evidence without the gross errors that do no harm, and what is to be told of all."""
    robots, facts, error, dof = [], [], 0.0, 0
    for robot in evidence.robots:
        found = find_gross_errors(robot.seen, evidence.kernel)
        robots.append(replace(robot, seen=_only(robot.seen, ~found.harmless)))
        rows = robot.seen.z.shape[1]
        error += 0.5 * rows * float(robot.seen.d2[found.harmless].sum())
        dof += rows * int(found.harmless.sum())
        if found.gross.any():
            facts.append(_fact(robot.name, found))
    if not dof:
        return evidence, tuple(facts)
    graph = evidence.summary["graph"]
    graph = {
        **graph,
        "error_without_kernels": graph["error_without_kernels"] - error,
        "dof": graph["dof"] - dof,
    }
    summary = {**evidence.summary, "graph": graph}
    return replace(evidence, robots=tuple(robots), summary=summary), tuple(facts)


def _only(seen: Seen, kept: BoolArray) -> Seen:
    columns = [field.name for field in fields(Seen) if field.name != "names"]
    return replace(seen, **{name: getattr(seen, name)[kept] for name in columns})


def _fact(robot: str, found: GrossErrors) -> Fact:
    """How many of a robot's sightings are gross errors, and what that means."""
    number, harmless, n = int(found.gross.sum()), int(found.harmless.sum()), len(found.gross)
    text = f"{robot}: {100 * number / n:.2g} % of its {n} sightings are gross errors"
    if harmless == number:
        text += ", each by itself: they hardly count"
    elif number > MOST * n:
        text += ", too many to be harmless"
    else:
        text += f", {number - harmless} of {number} not by themselves"
    return Fact("gross_errors", robot, number / n, text)
