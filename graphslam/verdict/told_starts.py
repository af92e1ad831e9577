"""Starts that were told of several robots in one frame, against what the robots saw.

Two told poses say where one robot is from the other; so does the map. Where they disagree the
estimate lies in between: each start takes its share, and neither looks far off. So pairs are
compared: their relative poses, whatever the estimate made of the shares.
"""

import itertools
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from graphslam.core.gaussian import chi2_quantile, mahalanobis_squared
from graphslam.core.geometry import Array, between, compose_cov, inverse, inverse_cov, wrap
from graphslam.core.records import Estimate, Start, Step

if TYPE_CHECKING:
    from graphslam.pipeline.log_pass import LogPass

#: chance that starts which are as exact as stated are said to contradict each other
FALSE_ALARM = 1e-4


class ToldStart(NamedTuple):
    """A start in ``frame`` as it was told, and the pose (3,) there in the result."""

    robot: str
    frame: str
    start: Start
    estimate: Array


class Contradiction(NamedTuple):
    """Two robots whose told starts are ``off_m`` and ``off_rad`` from what the robots saw."""

    robots: tuple[str, str]
    d2: float
    off_m: float
    off_rad: float


def told_starts(
    pipeline: "LogPass", steps: Sequence[Step], estimate: Estimate
) -> tuple[ToldStart, ...]:
    """All that the user told; those that were found, and origins, are none."""
    told = pipeline.given_config.start
    found = []
    for step in steps:
        for name, start in step.starts.items():
            if told.from_truth or name in told.poses:
                states = estimate.states[name]
                pose = states.poses[int(states.index(step.time_ns))]
                found.append(ToldStart(name, pipeline.frames.of[name], start, pose))
    return tuple(sorted(found, key=lambda one: one.robot))


def contradictions(told: Sequence[ToldStart]) -> list[Contradiction]:
    """Pairs of starts that the result contradicts, by more than they are uncertain; worst first."""
    pairs = [(a, b) for a, b in itertools.combinations(told, 2) if a.frame == b.frame]
    compared = [_compared(a, b) for a, b in pairs]
    gate = float(chi2_quantile(1 - FALSE_ALARM / max(1, len(pairs)), 3))
    return sorted((one for one in compared if one.d2 > gate), key=lambda one: -one.d2)


def _compared(a: ToldStart, b: ToldStart) -> Contradiction:
    """The pose of ``b`` from ``a`` as it was told, and as it came out."""
    cov = compose_cov(
        inverse(a.start.pose), inverse_cov(a.start.pose, a.start.cov), b.start.pose, b.start.cov
    )
    off = between(a.estimate, b.estimate) - between(a.start.pose, b.start.pose)
    off[2] = wrap(off[2])
    d2 = float(mahalanobis_squared(off, cov))
    return Contradiction((a.robot, b.robot), d2, float(np.hypot(*off[:2])), abs(float(off[2])))
