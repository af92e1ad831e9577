"""White noise of the ranges of a laser, from its scans.

On a straight wall 1 / range is a sinusoid of the bearing, so that three neighbouring beams tell by
how much they miss one line, whatever the wall's place and direction are. That is done in windows of
a few beams. Corners, edges and rough surfaces only add to what is found, so a low quantile of the
windows tells the noise; the share of windows with more than that tells where few of them are of
smooth surfaces (ranges from where beams are far apart), and those are not used.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from graphslam.core.geometry import Array

#: triples of neighbouring beams in a window, and windows that tell something together
WINDOW, LEAST_WINDOWS = 5, 60
#: the quantiles of the windows' deviations that are compared, in ten thousands of draws of white
#: noise of 1 m
LOW, LOW_M, MIDDLE_M = 0.1, 0.466, 0.876
#: by how much more the middle of the windows may deviate than noise does. Simulated walls without
#: edges 1.0 to 1.1; offices from 4 m on, whose beams are 4 cm and more apart, 1.2 to 6
MOST_CLUTTER = 1.3
#: noise that grows by less from the nearest ranges to the farthest does not grow: edges that are
#: left add up to a fifth from 1 to 8 m
LEAST_GROWTH = 1.5
#: nearer returns are often of the robot itself
NEAREST_M = 0.5


@dataclass(frozen=True, slots=True)
class BeamNoise:
    """White noise of ranges: sigma is the root of sigma_m² + (ratio * range)².

    ``farthest_m``: the largest ranges that it was measured at.
    """

    sigma_m: float
    ratio: float
    farthest_m: float

    @property
    def largest_m(self) -> float:
        """Sigma at the largest ranges that were measured."""
        return self.at(self.farthest_m)

    def at(self, range_m: float) -> float:
        """Sigma at a range, m."""
        return math.hypot(self.sigma_m, self.ratio * range_m)


def find_range_noise(scans: Iterable[tuple[ArrayLike, ArrayLike]]) -> BeamNoise | None:
    """The noise of a laser; None if too few of its returns are of smooth surfaces.

    Args:
        scans: ranges (n,) m, not finite or not positive without a return, and bearings (n,) rad.
    """
    windows = [_windows(*(np.asarray(v, dtype=float) for v in scan)) for scan in scans]
    if not windows:
        return None
    at, off = (np.concatenate(parts) for parts in zip(*windows, strict=True))
    octave = np.floor(np.log2(at / NEAREST_M))
    found = []  # range, variance, number
    for k in np.unique(octave[octave >= 0]):
        own = octave == k
        low, middle = np.quantile(off[own], (LOW, 0.5)) / (LOW_M, MIDDLE_M)
        number = np.count_nonzero(own)
        if number >= LEAST_WINDOWS and 0 < middle <= MOST_CLUTTER * low:
            found.append((math.sqrt(np.mean(at[own] ** 2)), low**2, number))
        elif found:
            break  # beyond, all windows may be as bad
    return _fitted(*np.array(found).T) if found else None


def _windows(ranges: Array, bearings: Array) -> tuple[Array, Array]:
    """Of windows of one scan in which all beams returned (k,): range and deviation, m."""
    with np.errstate(all="ignore"):  # of angles that are none
        r = np.where(np.isfinite(ranges) & (ranges > 0), ranges, np.nan)
        step = np.sin(np.diff(bearings))
        # a sinusoid through two beams, at the third: 0 on a wall, by these shares of the inverses
        shares = np.array([step[1:], -np.sin(bearings[2:] - bearings[:-2]), step[:-1]])
        three = np.array([r[:-2], r[1:-1], r[2:]])
        # a range that is off by e changes its inverse by e / range²; the three variances add up
        square = (shares / three).sum(axis=0) ** 2 / ((shares / three**2) ** 2).sum(axis=0)
    whole = len(square) // WINDOW * WINDOW
    square = square[:whole].reshape(-1, WINDOW).mean(axis=1)
    at = np.sqrt((r[1 : whole + 1] ** 2).reshape(-1, WINDOW).mean(axis=1))
    there = np.isfinite(square)
    return at[there], np.sqrt(square[there])


def _fitted(at: Array, variance: Array, number: Array) -> BeamNoise:
    """The noise that has the variances (k,), m², at ranges (k,), m, of so many windows (k,)."""
    farthest = float(at.max())
    constant = BeamNoise(math.sqrt(np.average(variance, weights=number)), 0.0, farthest)
    if variance[-1] < LEAST_GROWTH**2 * variance[0]:
        return constant
    weight = np.sqrt(number) / variance
    columns = weight[:, None] * np.column_stack((np.ones(len(at)), at**2))
    (own, square_ratio), *_ = np.linalg.lstsq(columns, weight * variance, rcond=None)
    if square_ratio <= 0:
        return constant
    if own < 0:
        square_ratio = np.average(variance / at**2, weights=number)
    return BeamNoise(math.sqrt(max(own, 0.0)), math.sqrt(square_ratio), farthest)
