"""Sightings as observations: what a camera or another detector has already made of its image."""

import numpy as np

from graphslam.core.records import Observation, Sighting


def sighting_observation(message: Sighting) -> Observation:
    """A sighting as an observation: a point, or with a direction a pose on the thing seen."""
    if len(message.z) == 2:
        return Observation("point", message.z, message.cov, None, message.identity)
    bearing, range_m, direction = message.z
    c, s = np.cos(bearing), np.sin(bearing)
    J = np.array([[-range_m * s, c, 0.0], [range_m * c, s, 0.0], [0.0, 0.0, 1.0]])
    z = np.array([range_m * c, range_m * s, direction])
    return Observation("segment", z, J @ message.cov @ J.T, np.zeros(2), message.identity)
