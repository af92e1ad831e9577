"""Smooth curves through points: straight segments joined by pairs of clothoids.

The curvature is continuous and piecewise linear in the arc length, so a wheeled robot can follow
the curve without a jump in its turn rate, and its heading is known in closed form.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from graphslam.core.geometry import Array, wrap
from graphslam.simulation.scenario import ScenarioError

Ints = np.ndarray[tuple[int, ...], np.dtype[np.int64]]

_STEP_M = 0.02  # spacing of tabulated positions; evaluation in between is exact to rounding
_STRAIGHT_RAD = 1e-6  # smaller corners are not rounded
_SHARPEST_RAD = np.radians(150.0)  # a sharper corner would need a loop
# Three-point Gauss-Legendre: the error over one step is below 1e-13 m at curvatures up to 10 / m.
_NODES = (np.array([-np.sqrt(0.6), 0.0, np.sqrt(0.6)]) + 1) / 2
_WEIGHTS = np.array([5.0, 8.0, 5.0]) / 18


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """A curve with curvature linear between tabulated arc lengths.

    ``s`` (k,) m, ``curvature`` (k,) rad/m (left positive), ``heading`` (k,) rad, not wrapped,
    ``position`` (k, 2) m at ``s``.
    """

    s: Array
    curvature: Array
    heading: Array
    position: Array

    @property
    def length_m(self) -> float:
        """Arc length of the whole curve."""
        return float(self.s[-1])

    def at(self, s: Array) -> tuple[Array, Array]:
        """Positions (n, 2) and headings (n,), not wrapped, at arc lengths ``s`` (n,)."""
        i = np.clip(np.searchsorted(self.s, s, side="right") - 1, 0, len(self.s) - 2)
        ds = s - self.s[i]
        return self.position[i] + self.steps(i, ds), self._heading(i, ds)

    def steps(self, i: Ints, ds: Array) -> Array:
        """Displacements (n, 2) m over ``ds`` (n,) m from tabulated arc lengths number i (n,)."""
        inner = self._heading(i[:, None], ds[:, None] * _NODES)
        return ds[:, None] * np.stack([np.cos(inner) @ _WEIGHTS, np.sin(inner) @ _WEIGHTS], -1)

    def _heading(self, i: Ints, ds: Array) -> Array:
        slope = (self.curvature[i + 1] - self.curvature[i]) / (self.s[i + 1] - self.s[i])
        return np.asarray(self.heading[i] + ds * (self.curvature[i] + 0.5 * ds * slope))


def curve_from_curvature(
    start: Array, heading_rad: float, knots_m: Array, curvature: Array
) -> Curve:
    """The curve from ``start`` (2,) whose ``curvature`` (k,) rad/m is linear between knots (k,)."""
    inside = [
        np.linspace(a, b, max(2, int(np.ceil((b - a) / _STEP_M)) + 1))[:-1]
        for a, b in pairwise(knots_m)
    ]
    s = np.append(np.concatenate(inside), knots_m[-1])
    kappa = np.interp(s, knots_m, curvature)
    heading = heading_rad + np.append(0.0, np.cumsum(np.diff(s) * (kappa[:-1] + kappa[1:]) / 2))
    shape = Curve(s, kappa, heading, np.zeros((len(s), 2)))
    steps = shape.steps(np.arange(len(s) - 1), np.diff(s))
    return replace(shape, position=start + np.vstack([np.zeros(2), np.cumsum(steps, axis=0)]))


def round_corners(points: Sequence[Sequence[float]], corner_m: float) -> Curve:
    """The polyline through ``points`` (k, 2) m with its inner corners rounded.

    Each corner is replaced by two equal clothoids that begin at most ``corner_m``, and at most half
    of the shorter adjacent segment, before the corner.

    Raises:
        ScenarioError: two points coincide, or a corner turns back by more than 150 degrees.
    """
    path = np.array(points, dtype=float)
    along = np.diff(path, axis=0)
    lengths = np.hypot(along[:, 0], along[:, 1])
    if lengths.min() < 1e-6:
        raise ScenarioError("two points of the drive coincide; leave one out")
    headings = np.arctan2(along[:, 1], along[:, 0])
    turns = wrap(np.diff(headings))
    if len(turns) and np.abs(turns).max() > _SHARPEST_RAD:
        x, y = path[1 + int(np.argmax(np.abs(turns)))]
        raise ScenarioError(
            f"the drive turns back at ({x:g}, {y:g}); end the leg there and begin another"
        )
    cuts = np.minimum(corner_m, np.minimum(lengths[:-1], lengths[1:]) / 2)
    cuts[np.abs(turns) < _STRAIGHT_RAD] = 0.0
    knots, curvature, s = [0.0], [0.0], 0.0
    before = 0.0  # part of the current segment that the last corner replaced
    for length, turn, cut in zip(lengths[:-1], turns, cuts, strict=True):
        s += length - before - cut
        before = cut
        if cut:
            arc = cut / _tangent_share(float(turn))
            peak = 2 * turn / arc  # the curvature is a triangle of area `turn`
            knots += [s, s + arc / 2, s + arc]
            curvature += [0.0, peak, 0.0]
            s += arc
    knots.append(s + lengths[-1] - before)
    curvature.append(0.0)
    # adjacent corners have no straight part in between
    first = np.append(True, np.diff(knots) > 1e-12)
    return curve_from_curvature(
        path[0], float(headings[0]), np.array(knots)[first], np.array(curvature)[first]
    )


def _tangent_share(turn_rad: float) -> float:
    """Distance from the corner to the start of a pair of clothoids of total length 1."""
    unit = curve_from_curvature(
        np.zeros(2), 0.0, np.array([0.0, 0.5, 1.0]), np.array([0.0, 2 * turn_rad, 0.0])
    )
    return float(unit.position[-1, 1] / np.sin(turn_rad))
