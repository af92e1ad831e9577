"""Whether the end of a segment is the end of the wall, or only of what the laser saw of it.

Thesis 4.7.8: a segment is completely visible unless a nearer structure cuts it or it holds the
scan's first or last beam. Two cases are added: a missing return beside the end (glass, a black
door), and a wall that goes on beyond it.
"""

import numpy as np
from numpy.typing import NDArray

from graphslam.core.config import FrontEndConfig
from graphslam.core.geometry import Array, wrap
from graphslam.perception.line_fit import LineFits
from graphslam.perception.ordered_scan import Sweep

BEAMS_BESIDE = 2
"""Beams beyond an end that are looked at: the first may be a mixed pixel of an occluding edge."""

SHALLOW_RAD = 0.7
"""Segments that meet at less are pieces of one bent thing; where it was cut depends on the view."""


def fully_visible(
    sweep: Sweep,
    first: NDArray[np.intp],
    last: NDArray[np.intp],
    fits: LineFits,
    config: FrontEndConfig,
) -> NDArray[np.bool_]:
    """Which segments show both of their real ends.

    Args:
        sweep: all beams of the scan.
        first: (m,) beam of each segment's first point, in increasing order.
        last: (m,) beam of its last point.
        fits: the m lines, laser frame.
        config: ``split_m``, ``gap_m`` and ``gap_ratio``.

    Returns:
        (m,) True where neither end is cut off or unknown.
    """
    real = _ends_real(sweep, first, last, fits, config)
    r = sweep.ranges
    meet = np.abs(r[first[1:]] - r[last[:-1]]) < _corner_m(r[last[:-1]], sweep, config)
    meet &= first[1:] - last[:-1] <= BEAMS_BESIDE
    direction = fits.z[:, 2]
    shallow = meet & (np.abs(wrap(direction[1:] - direction[:-1])) < SHALLOW_RAD)
    real[1:] &= ~shallow
    real[:-1] &= ~shallow
    return real


def _corner_m(r: Array, sweep: Sweep, config: FrontEndConfig) -> Array:
    """So much may the range change from one beam to the next where two walls meet.

    Twice the distance between beams there, for the second wall may be seen at 60° incidence.
    """
    return 2 * (config.split_m + r * sweep.step_rad)


def _ends_real(
    sweep: Sweep,
    first: NDArray[np.intp],
    last: NDArray[np.intp],
    fits: LineFits,
    config: FrontEndConfig,
) -> NDArray[np.bool_]:
    """(m,) True where the beams beside both ends show neither an occluder nor more of the wall."""
    outwards = np.arange(BEAMS_BESIDE + 1)
    beams = np.array((first[:, None] - outwards, last[:, None] + outwards))  # (2, m, 1 + beside)
    # a beam beyond the scan's border is as good as a missing return
    known = (beams >= 0) & (beams < len(sweep.ranges))
    beams = np.where(known, beams, 0)
    r = np.where(known, sweep.ranges[beams], np.nan)
    here, after = r[..., :-1], r[..., 1:]
    occluded = here - after > _corner_m(here, sweep, config)
    # one wall at grazing incidence: too far away for the same chain, but on the same line
    x, y, direction = fits.z.T[:, :, None]
    offset = y * np.cos(direction) - x * np.sin(direction)
    from_line = after * np.sin(sweep.angles[beams[..., 1:]] - direction) - offset
    end = r[..., :1]
    far = np.abs(after - end) > config.gap_m + config.gap_ratio * end
    goes_on = far & (np.abs(from_line) < 2 * config.split_m)
    cut = np.isnan(after) | occluded | goes_on
    return np.asarray(~cut.any(axis=(0, 2)))
