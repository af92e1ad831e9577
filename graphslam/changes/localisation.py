"""Each later scan in the map of the reference, where no rigid motion brings the maps together.

Two runs through the same place bend their maps differently where little holds them: odometry over
a corridor, few loops. Each scan still fits the reference's surfaces somewhere. Crossing landmarks
vote where, as in `registration`; from the scan that fits best the others follow one after another,
forwards and backwards, each predicted by the run's own motion and corrected by its beams.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from graphslam.changes.alignment import align
from graphslam.changes.registration import Registration, guesses
from graphslam.changes.surface import Surface
from graphslam.changes.visit import Bools, Ints, Visit
from graphslam.errors import OutputError
from graphslam.geometry import Array, compose, inverse, wrap

#: sigmas of a scan's place before its beams are held against the map: of a vote, of a prediction
_VOTE_SIGMAS = np.array([0.5, 0.5, 0.1])
_STEP_SIGMAS = np.array([0.08, 0.08, np.radians(2.0)])
#: sigmas that are stated of a placed scan: of a map that bends they are no more than a bound
_PLACED_SIGMAS = np.array([0.05, 0.05, np.radians(1.0)])
_GATES = (0.5, 0.4, 0.3, 0.2, 0.15, 0.1)
#: scans that are placed together, as the motion between them is known well enough, and with how
#: many before them
_TOGETHER, _WINDOW = 5, 30
#: a return this near to a surface of the reference, m, agrees with it
_AGREES_M = 0.1
#: shares of a scan's returns that must agree; of scans that must be placed
_SCAN_SHARE, _RUN_SHARE = 0.5, 0.5
#: every so many scans vote; so many of the best votes are followed
_EVERY, _FOLLOWED = 10, 2


def localise(surface: Surface, reference: Visit, later: Visit) -> tuple[Visit, Registration]:
    """The later visit in the reference's frame, scan by scan; scans that fit nowhere are left out.

    Args:
        surface: of the reference.
        reference: in its world frame.
        later: in its own.

    Returns:
        The placed visit, and the mean of its scans' motions with their scatter as covariance.

    Raises:
        OutputError: fewer than half of the scans fit.
    """
    best = (0.0, later, np.zeros(0))
    for pose, start in _starts(surface, reference, later):
        tracked = _tracked(surface, later, pose, start)
        share = agreement(surface, tracked)
        if (share > _SCAN_SHARE).mean() > best[0]:
            best = (float((share > _SCAN_SHARE).mean()), tracked, share)
    placed_share, tracked, share = best
    if placed_share < _RUN_SHARE:
        raise OutputError(
            "the two runs cannot be registered: no motion brings their landmarks together, and "
            f"only {100 * placed_share:.0f} % of the later scans fit the reference's surfaces "
            "one by one; did both drive through the same place?"
        )
    kept: Bools = share > _SCAN_SHARE
    motions = compose(tracked.poses[kept], inverse(later.poses[kept]))
    mean = motions.mean(axis=0)
    mean[2] = np.arctan2(np.sin(motions[:, 2]).mean(), np.cos(motions[:, 2]).mean())
    away = motions - mean
    away[:, 2] = wrap(away[:, 2])
    cov = away.T @ away / len(away) + np.diag(_PLACED_SIGMAS**2)
    covs = np.tile(np.diag(_PLACED_SIGMAS**2), (int(kept.sum()), 1, 1))
    found = replace(tracked.chosen(kept), covs=covs, shared=covs)
    none = np.zeros((0, 2), dtype=np.int64)
    return found, Registration(mean, cov, none, np.zeros(0, dtype=np.int64))


def agreement(surface: Surface, visit: Visit) -> Array:
    """Share (s,) of each scan's returns that lie on a surface."""
    beams = np.nonzero(visit.surface)[0]
    cell = surface.nearest.grid.cells(visit.ends[beams])
    near = (cell >= 0) & (surface.nearest.distance_m[cell] < _AGREES_M)
    scan, size = visit.scan[beams], len(visit.poses)
    return np.asarray(np.bincount(scan, near, size) / np.maximum(np.bincount(scan, None, size), 1))


def _starts(surface: Surface, reference: Visit, later: Visit) -> Iterator[tuple[Array, int]]:
    """World motions (3,) and a scan that each fits, the best first."""
    some = np.zeros(len(later.poses), dtype=bool)
    some[::_EVERY] = True
    few, number = later.chosen(some), np.nonzero(some)[0]
    found = []
    for guess in guesses(reference.landmarks, later.landmarks):
        placed = align(few.placed(guess, np.diag(_VOTE_SIGMAS**2)), surface, _GATES)
        share = agreement(surface, placed)
        at = int(share.argmax())
        motion = compose(placed.poses[at], inverse(few.poses[at]))
        # what many scans agree with counts, the start is where one fits best
        found.append((float(np.sort(share)[-5:].mean()), motion, int(number[at])))
    found.sort(key=lambda start: -start[0])
    yield from ((motion, scan) for _, motion, scan in found[:_FOLLOWED])


def _tracked(surface: Surface, later: Visit, motion: Array, start: int) -> Visit:
    """The later scans, followed from scan ``start`` that lies where ``motion`` (3,) brings it."""
    poses = np.zeros_like(later.poses)
    scans = np.arange(len(poses))
    for order in (scans[start:], scans[: start + 1][::-1]):
        now = motion
        for i in range(0, len(order), _TOGETHER):
            new = order[i : i + _TOGETHER]
            window = np.sort(order[max(i + _TOGETHER - _WINDOW, 0) : i + _TOGETHER])
            now = _motion(surface, later, window, int(new[-1]), now)
            poses[new] = compose(np.tile(now, (len(new), 1)), later.poses[new])
    return replace(later, poses=poses)


def _motion(surface: Surface, later: Visit, window: Ints, last: int, guess: Array) -> Array:
    """The motion (3,) near ``guess`` that brings some neighbouring scans onto the surfaces.

    They are one large scan from where the ``last`` of them stood: a single one may see too little.
    """
    low, high = np.searchsorted(later.scan, [window[0], window[-1] + 1])
    used = low + np.nonzero(later.surface[low:high])[0]
    away = _ends(later, used) - later.poses[last, :2]
    angle = np.arctan2(away[:, 1], away[:, 0]) - later.poses[last, 2]
    cov = np.diag(_STEP_SIGMAS**2)[None]
    one = Visit(
        later.stamps_ns[last : last + 1], compose(guess, later.poses[last])[None], cov, cov,
        np.zeros(len(used), dtype=np.int64), angle, np.hypot(*away.T),
        np.ones(len(used), dtype=bool), later.landmarks,
    )  # fmt: skip
    return compose(align(one, surface, _GATES).poses[0], inverse(later.poses[last]))


def _ends(visit: Visit, beams: Ints) -> Array:
    """World points (k, 2) m of some beams (k,)."""
    pose = visit.poses[visit.scan[beams]]
    heading = pose[:, 2] + visit.angle[beams]
    d = np.column_stack([np.cos(heading), np.sin(heading)])
    return np.asarray(pose[:, :2] + visit.range_m[beams, None] * d)
