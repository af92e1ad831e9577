"""What a visit both met and looked through is not solid, so no beam past it is a change.

Glass throws some beams back and lets others pass, by the angle; thin or patchy things do so by
chance, and what came or went during the visit by the time.
"""

from dataclasses import replace

import cv2
import numpy as np

from graphslam.change_detection.beam_evidence import crossings, inner_windows
from graphslam.change_detection.grid import window_sums
from graphslam.change_detection.surface_map import WINDOW, Surface
from graphslam.change_detection.visit import Bools, Visit
from graphslam.core.config import ChangesConfig

#: fewest beams that went through a window, and their least share of those that reached it: a few
#: are mislocated scans
_FEWEST, _LEAST_SHARE = 3, 0.1
#: what was looked through reaches this many cells farther: two visits' pieces of one pane lie
#: beside each other, and its rim is met too seldom to tell
_REACH_CELLS = 2 * WINDOW


def seen_through(surface: Surface, visit: Visit, config: ChangesConfig) -> Bools:
    """Pieces (n,) of a visit's own surfaces through which its own beams went.

    Args:
        surface: what the visit saw.
        visit: its beams, in the same frame.
        config: settings.
    """
    used = np.nonzero(visit.surface & (visit.range_m <= config.max_range_m))[0]
    through = crossings(surface, visit, used, config.gate_m)[0]
    met = surface.beams[surface.beams >= 0]
    counts = [np.bincount(row, minlength=len(surface.cells)) for row in (through, met)]
    passed, stopped = window_sums(np.column_stack(counts).astype(float), inner_windows(surface)).T
    enough = passed >= np.maximum(_FEWEST, _LEAST_SHARE * (passed + stopped))
    return np.asarray(surface.good & enough)


def without_transparent(
    surfaces: tuple[Surface, Surface], visits: tuple[Visit, Visit], config: ChangesConfig
) -> tuple[Surface, Surface]:
    """The surfaces of two visits without what either of them looked through.

    Args:
        surfaces: of the two visits, on one grid.
        visits: aligned.
        config: settings.
    """
    grid = surfaces[0].nearest.grid
    mask = np.zeros(grid.shape, dtype=np.uint8)
    for surface, visit in zip(surfaces, visits, strict=True):
        mask.reshape(-1)[surface.cells[seen_through(surface, visit, config)]] = 1
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * _REACH_CELLS + 1,) * 2)
    glass = cv2.dilate(mask, disk).reshape(-1)
    a, b = (replace(s, good=s.good & (glass[s.cells] == 0)) for s in surfaces)
    return a, b
