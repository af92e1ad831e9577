"""Front ends: landmark observations from one scan. A new one is a function and a row here.

A front end is a pure function of the scan and the settings. It returns its observations in the
frame of the LASER; the caller transforms them to the base frame with ``scan.mount``.
"""

import itertools
from collections.abc import Callable, Sequence

import numpy as np

from graphslam.core.config import FrontEndConfig
from graphslam.core.observation_arrays import ObservationArrays
from graphslam.core.records import Observation, Scan
from graphslam.perception.cylinders import cylinders
from graphslam.perception.hough import hough_lines
from graphslam.perception.line_fit import observation_arrays
from graphslam.perception.ordered_scan import Sweep, join_sweeps, make_sweep
from graphslam.perception.segments import find_segments, segments
from graphslam.perception.segments_and_hough import segments_and_hough

#: angles between beams that differ by no more than this factor count as one
ALIKE_STEPS = 1.2

FrontEnd = Callable[[Scan, FrontEndConfig], tuple[Observation, ...]]


def _front_end(lines: Callable[[Sweep, FrontEndConfig], tuple[Observation, ...]]) -> FrontEnd:
    """A front end from an extractor of lines: cylinders come first, without their returns.

    Otherwise a thick tree would be a point and a short segment at once.
    """

    def front_end(scan: Scan, config: FrontEndConfig) -> tuple[Observation, ...]:
        sweep = make_sweep(scan, config.max_range_m)
        points: tuple[Observation, ...] = ()
        if config.cylinders:
            points, sweep = cylinders(sweep, config)
        return (*lines(sweep, config), *points)

    return front_end


def _none(scan: Scan, config: FrontEndConfig) -> tuple[Observation, ...]:
    """No observations: for logs whose landmarks come as sightings."""
    return ()


def observe_block(
    scans: Sequence[Scan], sweeps: Sequence[Sweep], config: FrontEndConfig
) -> list[ObservationArrays]:
    """What the configured front end finds in each of many scans, in the frame of the laser.

    Segments are extracted from all scans at once, unless their angles between beams differ by more
    than the turning of a robot during a sweep changes them. ``sweeps`` are those of ``scans``.
    """
    steps = [sweep.step_rad for sweep in sweeps]
    if config.name != "segments" or config.cylinders or max(steps) > ALIKE_STEPS * min(steps):
        front_end = FRONT_ENDS[config.name]
        return [ObservationArrays.of(front_end(scan, config)) for scan in scans]
    joined = join_sweeps(sweeps)
    found = find_segments(joined, config)
    valid = found.valid
    seen = observation_arrays(found.fits[valid], found.whole[valid], config)
    scan = joined.scan[found.rows[found.starts[valid]]]
    border = np.searchsorted(scan, np.arange(len(sweeps) + 1))
    return [seen.part(int(a), int(b)) for a, b in itertools.pairwise(border)]


FRONT_ENDS: dict[str, FrontEnd] = {
    "segments": _front_end(segments),
    "hough": _front_end(hough_lines),
    "both": _front_end(segments_and_hough),
    "none": _none,
}
