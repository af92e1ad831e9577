"""Motions of a track in pieces that each count as one increment: short arcs.

For many motions from few starts, each with a calibration of its own.
"""

from typing import TYPE_CHECKING

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.geometry import Array, between
from graphslam.core.motion_models import Increments
from graphslam.core.record import replace
from graphslam.odometry.increment_sums import IncrementSums, Motions

if TYPE_CHECKING:
    from graphslam.odometry.preintegration import Track

#: m of effort (see `Track.effort`): a motion this short is close enough to an arc to be integrated
#: as one increment
COARSE_M = 0.3


def coarse_motions(track: "Track", begin: IntArray, end: IntArray, calibration: Array) -> Motions:
    """The base's motions of a track between times (n,) of the odometry's clock.

    By parameters (n, p). Knots lie `COARSE_M` of effort apart, counted from each start; motions
    with the same start share them.
    """
    effort_begin, effort_end = track.effort(np.stack([begin, end]))
    if np.all(effort_end <= effort_begin + COARSE_M):  # so are those of a live robot
        return _motions(_piece(track, begin, end, calibration))
    _, group = np.unique(begin, return_inverse=True)
    passed = np.zeros(len(begin), dtype=np.int64)  # pieces before each end
    knot = begin.copy()  # the last one before each end
    order = np.argsort(group, kind="stable")
    members = np.split(order, np.flatnonzero(np.diff(group[order])) + 1)
    levels = [
        np.arange(effort_begin[own[0]] + COARSE_M, float(effort_end[own].max()), COARSE_M)
        for own in members
    ]
    # of all groups at once: the whole odometry is searched
    reached = track.times_of_effort(np.concatenate([np.zeros(0), *levels]))
    inner = np.split(reached, np.cumsum([len(own) for own in levels]))
    pieces: list[IntArray] = []  # knots of each group, its start included
    for own, after in zip(members, inner, strict=False):
        knots = np.append(begin[own[0]], after)
        passed[own] = np.searchsorted(after, end[own], side="right")
        knot[own] = knots[passed[own]]
        pieces.append(knots)
    counts = np.array([len(knots) - 1 for knots in pieces])
    first = np.cumsum(counts) - counts
    of = np.repeat([own[0] for own in members], counts)
    whole = _piece(
        track,
        np.concatenate([knots[:-1] for knots in pieces]),
        np.concatenate([knots[1:] for knots in pieces]),
        calibration[of],
    )
    sums = IncrementSums(whole, np.repeat(first, counts))
    part = _piece(track, knot, end, calibration)
    return sums.query(first[group] + passed, first[group], part).motions()


def _piece(track: "Track", begin: IntArray, end: IntArray, calibration: Array) -> Increments:
    """Base motions between times (n,) of the odometry's clock, each as one increment."""
    part = track.increments(track.added_rows(begin, end), np.zeros(track.increment_parameters))
    delta = between(*track.pose(np.stack([begin, end])))
    delta = delta + np.einsum("nij,nj->ni", part.d_cal, calibration)
    return replace(part, delta=delta)


def _motions(one: Increments) -> Motions:
    """Motions of one increment each."""
    return Motions(one.delta, one.cov, one.d_cal, np.hypot(one.delta[:, 0], one.delta[:, 1]))
