"""Whether the end of a segment is the end of the wall, or only of the part that was seen.

Thesis 4.7.8: a segment is completely visible unless a nearer structure occludes a part of it or it
holds the scan's first or last beam. Two cases are added: a missing return next to the end (glass, a
black door), and a wall that continues beyond it.
"""

import numpy as np

from graphslam.core.config import FrontEndConfig
from graphslam.core.geometry import Array, wrap
from graphslam.perception.beam_noise import largest_deviation
from graphslam.perception.line_fit import LineFits
from graphslam.perception.ordered_scan import Indices, Mask, Sweep

BEAMS_BESIDE = 2
"""Beams beyond an end that are tested: the first may be a mixed pixel of an occluding edge."""

SHALLOW_RAD = 0.7
"""Segments that meet at a smaller angle are of one curved object, split at an arbitrary place."""


def fully_visible(
    sweep: Sweep, first: Indices, last: Indices, fits: LineFits, config: FrontEndConfig
) -> Mask:
    """Which of m segments show both ends of their wall: neither is occluded or unknown.

    ``first`` and ``last`` (m,) are the beams of each segment's first and last point, in increasing
    order.
    """
    real = _ends_real(sweep, np.array((first, last)), fits, config)
    r = sweep.ranges
    meet = np.abs(r[first[1:]] - r[last[:-1]]) < _corner_m(r[last[:-1]], sweep, config)
    meet &= first[1:] - last[:-1] <= BEAMS_BESIDE
    meet &= sweep.scan_of_beam[first[1:]] == sweep.scan_of_beam[last[:-1]]
    direction = fits.z[:, 2]
    shallow = meet & (np.abs(wrap(direction[1:] - direction[:-1])) < SHALLOW_RAD)
    real[1:] &= ~shallow
    real[:-1] &= ~shallow
    return real


def _corner_m(r: Array, sweep: Sweep, config: FrontEndConfig) -> Array:
    """Largest change of range from one beam to the next at a corner of two walls, m.

    Twice the distance between beams there, as the second wall may be seen at 60° incidence.
    """
    return np.asarray(2 * (largest_deviation(config, r * r) + r * sweep.step_rad))


def _ends_real(sweep: Sweep, ends: Indices, fits: LineFits, config: FrontEndConfig) -> Mask:
    """(m,) True where the beams beyond both ``ends`` (2, m) show no occluder and no more wall."""
    outwards = np.arange(BEAMS_BESIDE + 1) * np.array((-1, 1))[:, None, None]
    beams = ends[:, :, None] + outwards  # (2, m, 1 + beside)
    # a beam outside of the scan counts as a missing return
    known = (beams >= 0) & (beams < len(sweep.ranges))
    beams = np.where(known, beams, 0)
    known &= sweep.scan_of_beam[beams] == sweep.scan_of_beam[ends][:, :, None]
    r = np.where(known, sweep.ranges[beams], np.nan)
    here, after = r[..., :-1], r[..., 1:]
    occluded = here - after > _corner_m(here, sweep, config)
    # one wall at grazing incidence: in another chain, but on the same line
    x, y, direction = fits.z.T[:, :, None]
    offset = y * np.cos(direction) - x * np.sin(direction)
    from_line = after * np.sin(sweep.angles[beams[..., 1:]] - direction) - offset
    end = r[..., :1]
    far = np.abs(after - end) > config.gap_m + config.gap_ratio * end
    goes_on = far & (np.abs(from_line) < 2 * largest_deviation(config, after * after))
    cut = np.isnan(after) | occluded | goes_on
    return np.asarray(~cut.any(axis=(0, 2)))
