"""Which line most returns lie on, weighted by range: Hough transform, thesis 4.7.1-4.7.3.

Two ways to find it, rows of `HOUGH_VOTES`. OpenCV's transform counts returns and so proposes lines,
near walls first; the thesis' weights g = r then move each of them and choose. The thesis' own
accumulator (eq. 4.29-4.31) sums the weights in a table.
"""

from functools import lru_cache
from typing import Protocol

import numpy as np

from graphslam.core.config import FrontEndConfig
from graphslam.core.geometry import Array
from graphslam.perception.line_moments import fitted_lines, offset_lines, point_moments
from graphslam.perception.ordered_scan import Indices, Mask

SEED_POINTS = 3
"""Fewest returns of a peak: any two lie on a line, and far ones have large weights."""

PROPOSALS = 64
"""Lines that OpenCV proposes at once. With 32 or 128 the same walls are found; when none of them
has enough votes any more, it proposes anew."""

REFITS = 2
"""A proposal lies on the grid; each fit moves it towards the wall, so that its stripe holds more
of it. The third finds nothing more. Lines as proposed come first: of a wall and a cupboard 6 cm
before it, a line that was moved would join both."""


class Votes(Protocol):
    """Votes of the returns that have not been removed yet.

    Made of ``points`` (k, 2) m, laser frame, ``weights`` (k,) g, ``voting`` (k,): which of them
    vote, and the settings.
    """

    def __init__(
        self, points: Array, weights: Array, voting: Mask, config: FrontEndConfig
    ) -> None: ...

    def peak(self) -> Indices:
        """Rows of the returns in the stripe with most votes; none if it is below the threshold."""
        ...

    def remove(self, rows: Indices) -> None:
        """These returns stop voting."""
        ...


class ThesisVotes:
    """Accumulator C(d, γ) of eq. 4.29-4.31 for the returns that still vote: `Votes`.

    A line at (d, γ + π) is the one at (-d, γ): angles cover half a turn, distances both signs.
    Stripes touch (Δd = 2a), so at each angle a return is in one stripe.
    """

    def __init__(self, points: Array, weights: Array, voting: Mask, config: FrontEndConfig) -> None:
        normals = _normals(config.hough_gamma_steps)
        reach = min(config.hough_d_max_m, float(np.abs(points).sum(axis=1).max()))
        half = round(reach / config.hough_delta_d_m)
        self._width = 2 * half + 1
        size = self._width * normals.shape[1]
        stripe = np.rint(points @ normals / config.hough_delta_d_m).astype(np.intp)
        outside = np.abs(stripe) > half
        stripe += half + self._width * np.arange(normals.shape[1])
        stripe[outside] = size  # one extra cell, which is ignored
        self._stripe, self._weights, self._voting = stripe, weights, voting.copy()
        self._threshold = config.hough_threshold_m
        cells = stripe[voting]
        each = np.repeat(weights[voting], stripe.shape[1])
        self.C = np.bincount(cells.ravel(), each, minlength=size + 1)[:-1]
        self.C[np.bincount(cells.ravel(), minlength=size + 1)[:-1] < SEED_POINTS] = 0.0

    def peak(self) -> Indices:
        """The returns in the fullest stripe of the table."""
        while True:
            cell = int(np.argmax(self.C))
            if self.C[cell] <= self._threshold:
                return np.zeros(0, dtype=np.intp)
            inside = self._stripe[:, cell // self._width] == cell
            rows = np.flatnonzero(inside & self._voting)
            if len(rows) >= SEED_POINTS:
                return rows
            self.C[cell] = 0.0

    def remove(self, rows: Indices) -> None:
        """Their weights are subtracted from the table."""
        rows = rows[self._voting[rows]]
        self._voting[rows] = False
        cells = self._stripe[rows]
        each = np.repeat(self._weights[rows], cells.shape[1])
        inside = cells.ravel() < len(self.C)
        np.subtract.at(self.C, cells.ravel()[inside], each[inside])


class OpenCvVotes:
    """Lines proposed by `cv2.HoughLinesPointSet`, moved and ranked by the weights: `Votes`.

    The votes of a line are those of eq. 4.29-4.31. When no proposal has enough of them, d and γ are
    those of weighted least-squares lines instead of those of the grid.
    """

    def __init__(self, points: Array, weights: Array, voting: Mask, config: FrontEndConfig) -> None:
        self._points, self._moments = points, point_moments(points)
        self._weights, self._voting, self._config = weights, voting.copy(), config
        self._refits, self._removed = 0, False
        self._inside = self._stripes()

    def peak(self) -> Indices:
        """The returns in the fullest stripe; proposes anew when none has votes enough.

        First of the lines as they are proposed, then of those moved by the weights.
        """
        while True:
            votes = self._inside @ (self._weights * self._voting)
            votes[self._inside @ self._voting.astype(np.float64) < SEED_POINTS] = 0.0
            if len(votes) and votes.max() > self._config.hough_threshold_m:
                return np.flatnonzero(self._inside[np.argmax(votes)] * self._voting)
            if self._refits == REFITS and not self._removed:
                return np.zeros(0, dtype=np.intp)
            self._refits, self._removed = REFITS, False
            self._inside = self._stripes()

    def remove(self, rows: Indices) -> None:
        """They leave all stripes, and take no part in the next proposals."""
        self._voting[rows] = False
        self._removed = True

    def _stripes(self) -> Array:
        """(p, k): 1 where a return that votes is in the stripe of a proposed line, else 0."""
        within_sq = (self._config.hough_delta_d_m / 2) ** 2
        lines = offset_lines(*self._proposals())
        inside = (lines.T @ self._moments <= within_sq) & self._voting
        for _ in range(self._refits):
            inside = inside[np.count_nonzero(inside, axis=1) >= SEED_POINTS]
            lines = fitted_lines(((inside * self._weights) @ self._moments.T).T)
            inside = (lines.T @ self._moments <= within_sq) & self._voting
        return inside.astype(np.float64)

    def _proposals(self) -> tuple[Array, Array]:
        """Distances d (p,) m and angles γ (p,) rad of the lines with most returns, unweighted."""
        import cv2  # noqa: PLC0415  (16 MB, which only scans need)

        config, points = self._config, self._points[self._voting]
        steps = (config.hough_gamma_steps + 1) // 2
        step = np.pi / steps
        found = None
        if len(points) >= SEED_POINTS:
            # OpenCV does not test whether a return is within the table
            reach = float(np.hypot(*points.T).max()) + 2 * config.hough_delta_d_m
            found = cv2.HoughLinesPointSet(
                points.astype(np.float32)[:, None],
                PROPOSALS,
                SEED_POINTS - 1,
                -reach,
                reach,
                config.hough_delta_d_m,
                0.0,
                np.pi - step / 2,
                step,
            )
        if found is None:
            return np.zeros(0), np.zeros(0)
        _, d, gamma = np.asarray(found, dtype=np.float64).reshape(-1, 3).T
        near = np.abs(d) <= config.hough_d_max_m
        return d[near], gamma[near]


@lru_cache(maxsize=8)
def _normals(gamma_steps: int) -> Array:
    """Unit normals (2, t) of half a turn of γ; an odd number of steps is rounded up."""
    t = (gamma_steps + 1) // 2
    gamma = np.pi / t * np.arange(t)
    return np.array((np.cos(gamma), np.sin(gamma)))


HOUGH_VOTES: dict[str, type[Votes]] = {"opencv": OpenCvVotes, "thesis": ThesisVotes}
