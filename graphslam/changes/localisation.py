"""Each later scan in the map of the reference, where no rigid motion brings the maps together.

Two runs through the same place bend their maps differently where little holds them: odometry over
a corridor, few loops. Each scan still fits the reference's surfaces somewhere. Where is found by
laying one map over the other in all ways. From the scan that fits best the others follow one after
another, forwards and backwards, predicted by the run's own motion and corrected by their beams.
"""

from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np

from graphslam.changes.alignment import align
from graphslam.changes.flexed import flexed
from graphslam.changes.grid import grid_over
from graphslam.changes.registration import Registration
from graphslam.changes.straighten import straightened
from graphslam.changes.surface import Surface, surface_of
from graphslam.changes.visit import Bools, Ints, Visit
from graphslam.config import ChangesConfig
from graphslam.errors import OutputError
from graphslam.geometry import Array, compose, inverse, rotation, wrap

#: sigmas of a scan's place before its beams are held against the map: of a vote, of a prediction
_VOTE_SIGMAS = np.array([0.5, 0.5, 0.1])
_STEP_SIGMAS = np.array([0.08, 0.08, np.radians(2.0)])
#: sigmas that are stated of a placed scan: of a map that bends they are no more than a bound
_PLACED_SIGMAS = np.array([0.02, 0.02, np.radians(0.5)])
_GATES = (0.5, 0.4, 0.3, 0.2, 0.15, 0.1)
_FLEX_GATES = tuple(np.repeat([0.5, 0.4, 0.3, 0.2, 0.15, 0.1], 3))
#: scans that are placed together, as the motion between them is known well enough, and with how
#: many before them
_TOGETHER, _WINDOW = 5, 30
_RANGE_SIGMA_M = 0.02
#: a return this near to a surface of the reference, m, agrees with it
_AGREES_M = 0.1
#: shares of a scan's returns that must agree (legs and clutter are no surfaces); of scans that must
_SCAN_SHARE, _RUN_SHARE = 0.3, 0.5
_FEWEST = 20  # returns of a scan that may agree by chance
#: every so many scans vote; so many of the best votes are followed
_EVERY, _FOLLOWED = 10, 2
#: pictures of the maps: cells, m, and how many a side; turns that are tried, rad; best of them kept
_CELL_M, _MOST_CELLS, _TURN_RAD, _OVERLAYS = 0.1, 600, np.radians(2.0), 6


def localise(
    reference: Visit, later: Visit, config: ChangesConfig
) -> tuple[Visit, Visit, Registration]:
    """Both visits, straightened, in one frame: that in which the reference's first scan stays.

    Scans that fit nowhere are left out.

    Args:
        reference: in its world frame.
        later: in its own.
        config: settings.

    Returns:
        The reference, the later visit, and the mean of its scans' motions with their scatter.

    Raises:
        OutputError: too few of the scans fit.
    """
    started = later.poses
    reference, later = straightened(reference), straightened(later)
    ends = reference.ends[reference.surface]
    grid = grid_over(ends, config.resolution_m, config.max_side_cells**2)
    surface = surface_of(reference, grid, _RANGE_SIGMA_M, config)
    best = (0.0, later, np.zeros(len(later.poses)))
    for pose, start in _starts(surface, reference, later):
        tracked = _tracked(surface, later, pose, start)
        tracked = flexed(tracked, later.poses, surface, _FLEX_GATES)
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
    motions = compose(tracked.poses[kept], inverse(started[kept]))
    mean = motions.mean(axis=0)
    mean[2] = np.arctan2(np.sin(motions[:, 2]).mean(), np.cos(motions[:, 2]).mean())
    away = motions - mean
    away[:, 2] = wrap(away[:, 2])
    cov = away.T @ away / len(away) + np.diag(_PLACED_SIGMAS**2)
    none = np.zeros((0, 2), dtype=np.int64)
    return (
        _as_placed(reference),
        _as_placed(tracked.chosen(kept)),
        Registration(mean, cov, none, np.zeros(0, dtype=np.int64)),
    )


def _as_placed(visit: Visit) -> Visit:
    covs = np.tile(np.diag(_PLACED_SIGMAS**2), (len(visit.poses), 1, 1))
    return replace(visit, covs=covs, shared=covs)


def agreement(surface: Surface, visit: Visit) -> Array:
    """Share (s,) of each scan's returns that lie on a surface; 0 for scans with hardly any."""
    beams = np.nonzero(visit.surface)[0]
    cell = surface.nearest.grid.cells(visit.ends[beams])
    near = (cell >= 0) & (surface.nearest.distance_m[cell] < _AGREES_M)
    scan, size = visit.scan[beams], len(visit.poses)
    returns = np.bincount(scan, minlength=size)
    share = np.bincount(scan, near, size) / np.maximum(returns, 1)
    return np.asarray(np.where(returns >= _FEWEST, share, 0.0))


def _starts(surface: Surface, reference: Visit, later: Visit) -> Iterator[tuple[Array, int]]:
    """World motions (3,) and a scan that each fits, the best first."""
    some = np.zeros(len(later.poses), dtype=bool)
    some[::_EVERY] = True
    few, number = later.chosen(some), np.nonzero(some)[0]
    found = []
    for guess in overlays(reference.ends[reference.surface], later.ends[later.surface]):
        placed = align(few.placed(guess, np.diag(_VOTE_SIGMAS**2)), surface, _GATES)
        share = agreement(surface, placed)
        at = int(share.argmax())
        motion = compose(placed.poses[at], inverse(few.poses[at]))
        # what many scans agree with counts, the start is where one fits best
        found.append((float(np.sort(share)[-5:].mean()), motion, int(number[at])))
    found.sort(key=lambda start: -start[0])
    yield from ((motion, scan) for _, motion, scan in found[:_FOLLOWED])


def overlays(reference: Array, later: Array) -> list[Array]:
    """Motions (3,) with which the two maps' points (n, 2), (m, 2) m overlap most.

    All turns and shifts are tried: the correlation of two pictures is a product of their spectra.
    """
    low, high = np.quantile(reference, [0.005, 0.995], axis=0)
    middle = np.median(later, axis=0)
    later = later - middle
    radius = float(np.quantile(np.hypot(*later.T), 0.995))
    side = float((high - low).max()) + 2 * radius
    cell = max(_CELL_M, side / _MOST_CELLS)
    size = int(np.ceil(side / cell)) + 2
    spectrum = np.fft.rfft2(_picture(reference - (low + high) / 2, cell, size))
    found = []
    for turn in np.arange(0, 2 * np.pi, _TURN_RAD):
        other = np.fft.rfft2(_picture(later @ rotation(turn).T, cell, size))
        match = np.fft.irfft2(spectrum * np.conj(other), (size, size))
        steps = np.array(np.unravel_index(int(match.argmax()), match.shape))
        steps = np.where(steps > size // 2, steps - size, steps)
        to = (low + high) / 2 + steps * cell
        found.append((float(match.max()), np.array([*(to - rotation(turn) @ middle), wrap(turn)])))
    found.sort(key=lambda one: -one[0])
    return [motion for _, motion in found[:_OVERLAYS]]


def _picture(points: Array, cell_m: float, size: int) -> Array:
    """Where points (n, 2) m about the origin lie, (size, size), 0 to 1, a little blurred."""
    ij = np.floor(points / cell_m).astype(np.int64) + size // 2
    ij = ij[((ij >= 0) & (ij < size)).all(axis=1)]
    image = np.zeros((size, size), dtype=np.float32)
    image[ij[:, 0], ij[:, 1]] = 1.0
    return np.asarray(cv2.GaussianBlur(image, (3, 3), 0), dtype=float)


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
