"""Front ends: what one scan says about landmarks. A new one is a function and a row here.

A front end is a pure function of the scan and the settings. It returns its observations in the
frame of the LASER; moving them to the base frame through ``scan.mount`` is the caller's business.
"""

from collections.abc import Callable

from graphslam.config import FrontEndConfig
from graphslam.frontend.split_merge import segments
from graphslam.frontend.sweep import scan_points
from graphslam.records import Observation, Scan

__all__ = ["FRONT_ENDS", "scan_points"]

FrontEnd = Callable[[Scan, FrontEndConfig], tuple[Observation, ...]]


def _none(scan: Scan, config: FrontEndConfig) -> tuple[Observation, ...]:
    """No observations: for logs whose landmarks come as sightings."""
    return ()


FRONT_ENDS: dict[str, FrontEnd] = {"segments": segments, "none": _none}
