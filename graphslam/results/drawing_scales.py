"""Axes of a drawing: scales, ticks and their labels."""

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from graphslam.core.geometry import Array

#: share of the range that is added on both sides of the data
MARGIN = 0.05
#: from here on, as of coordinates in UTM, six digits do not tell ticks apart
LARGE = 1e5


@dataclass(frozen=True, slots=True)
class Scale:
    """A scale from ``low`` to ``high``, linear or logarithmic."""

    low: float
    high: float
    is_log: bool = False

    def share(self, values: Array) -> Array:
        """Where values (...,) are: 0 at ``low``, 1 at ``high``; NaN where there is no logarithm."""
        if not self.is_log:
            return np.asarray((values - self.low) / (self.high - self.low))
        positive = np.where(values > 0, values, np.nan)
        low, high = math.log(self.low), math.log(self.high)
        return np.asarray((np.log(positive) - low) / (high - low))

    def ticks(self, most: int) -> list[float]:
        """About ``most`` round values at most, within the scale."""
        found = _log_ticks(self.low, self.high, most) if self.is_log else []
        # few decades: the values of a linear scale
        return found if len(found) > 1 else _linear_ticks(self.low, self.high, most)

    def labels(self, ticks: list[float]) -> list[str]:
        """Texts of ticks with a proper minus sign; on a linear scale with equal decimals."""
        texts = [f"{value:g}" for value in ticks]
        if not self.is_log and max(map(abs, ticks), default=0.0) >= LARGE:
            step = min((b - a for a, b in pairwise(ticks)), default=1.0)
            places = max(0, math.ceil(-math.log10(step) - 1e-9))
            texts = [f"{value:.{places}f}" for value in ticks]
        elif not self.is_log and not any("e" in text for text in texts):
            places = max((len(text.partition(".")[2]) for text in texts), default=0)
            texts = [f"{value:.{places}f}" for value in ticks]
        return [text.replace("-", "\u2212") for text in texts]


def linear_scale(low: float, high: float, margin: float = MARGIN) -> Scale:
    """The scale of data from ``low`` to ``high``; 0 to 1 without data."""
    if not low <= high:
        low, high = 0.0, 1.0
    if low == high:
        low, high = low - 0.5, high + 0.5
    room = margin * (high - low)
    return Scale(low - room, high + room)


def log_scale(low: float, high: float, margin: float = MARGIN) -> Scale:
    """The logarithmic scale of positive data; 0.1 to 1 without data."""
    if not 0 < low <= high:
        low, high = 0.1, 1.0
    if low == high:
        low, high = low / 2, high * 2
    room = (high / low) ** margin
    return Scale(low / room, high * room, is_log=True)


def _linear_ticks(low: float, high: float, most: int) -> list[float]:
    decade = 10.0 ** math.floor(math.log10((high - low) / most))
    for factor in (1, 2, 5, 10, 20, 50):
        step = factor * decade
        first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
        if last - first < most:
            break
    # without the digits of rounding: 0.30000000000000004
    return [float(f"{n * step:.12g}") for n in range(first, last + 1)]


def _log_ticks(low: float, high: float, most: int) -> list[float]:
    """Every n-th decade, or 1, 2 and 5 in each decade where they are few."""
    first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))
    factors = (1.0,) if high > 300 * low else (1.0, 2.0, 5.0)
    step = 1 if len(factors) > 1 else max(1, math.ceil((last - first) / most))
    found = [float(f"{f:g}e{n}") for n in range(first, last + 1) if n % step == 0 for f in factors]
    return [value for value in found if low <= value <= high]
