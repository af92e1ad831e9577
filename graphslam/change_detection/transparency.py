"""Surfaces that a visit both hit and looked through are not solid; beams past them are no change.

Glass reflects or transmits a beam depending on the angle; thin or perforated objects do so by
chance; what came or left during the visit does so depending on the time.
"""

from dataclasses import replace

import cv2
import numpy as np

from graphslam.change_detection.beam_evidence import crossings, inner_windows
from graphslam.change_detection.grid import window_sums
from graphslam.change_detection.surface_map import WINDOW, Surface
from graphslam.change_detection.visit import Bools, Visit
from graphslam.core.config import ChangesConfig

#: fewest beams through a window, and their least share of those that reached it: a few come from
#: badly localised scans
_MIN_BEAMS, _MIN_SHARE = 3, 0.1
#: cells by which transparent areas are dilated: two visits' pieces of one pane lie beside each
#: other, and its rim is hit too seldom for a test
_DILATION_CELLS = 2 * WINDOW


def seen_through(surface: Surface, visit: Visit, config: ChangesConfig) -> Bools:
    """Which pieces (n,) of a visit's own surfaces its own beams passed through."""
    used = np.nonzero(visit.surface & (visit.range_m <= config.max_range_m))[0]
    through = crossings(surface, visit, used, config.gate_m)[0]
    ended = surface.beams[surface.beams >= 0]
    counts = [np.bincount(row, minlength=len(surface.cells)) for row in (through, ended)]
    passed, stopped = window_sums(np.column_stack(counts).astype(float), inner_windows(surface)).T
    enough = passed >= np.maximum(_MIN_BEAMS, _MIN_SHARE * (passed + stopped))
    return np.asarray(surface.good & enough)


def without_transparent(
    surfaces: tuple[Surface, Surface], visits: tuple[Visit, Visit], config: ChangesConfig
) -> tuple[Surface, Surface]:
    """The surfaces of two aligned visits, on one grid, less those that either looked through."""
    grid = surfaces[0].nearest.grid
    mask = np.zeros(grid.shape, dtype=np.uint8)
    for surface, visit in zip(surfaces, visits, strict=True):
        mask.reshape(-1)[surface.cells[seen_through(surface, visit, config)]] = 1
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * _DILATION_CELLS + 1,) * 2)
    glass = cv2.dilate(mask, disk).reshape(-1)
    a, b = (replace(s, good=s.good & (glass[s.cells] == 0)) for s in surfaces)
    return a, b
