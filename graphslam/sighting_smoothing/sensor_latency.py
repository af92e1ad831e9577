"""Whether the clocks of a robot's sightings and of its odometry are taken as one.

An offset of the clocks costs accuracy unless it is there.
"""

from dataclasses import replace

import numpy as np

from graphslam.odometry.preintegration import Track

#: a latency of sightings is applied if it is so many of its sigmas
LATENCY_SIGMAS = 4.0


def has_latency(track: Track) -> bool:
    """Whether the latency of a robot's sightings is one of the parameters that are estimated."""
    return track.is_mounted and not track.has_burst_stamps


def shows_latency(track: Track) -> bool:
    """Whether the log is clearly likelier with the latency in a track's calibration than without.

    The calibration is the one that the log shows, with its covariance.
    """
    mean, cov = track.calibration.mean, track.calibration.cov
    return has_latency(track) and bool(mean[-1] ** 2 > LATENCY_SIGMAS**2 * cov[-1, -1])


def hold_insignificant_latency(track: Track) -> None:
    """Take the clocks of sightings and odometry as one, unless the log clearly shows otherwise.

    Where a robot drives evenly only noise tells of an offset, and its sigma is too small. For
    ``track`` see `shows_latency`.
    """
    if not has_latency(track) or shows_latency(track):
        return
    mean = track.calibration.mean
    last = [len(mean) - 1]
    track.prior = track.prior.at_zero(last)
    track.calibration = replace(track.prior, mean=np.append(mean[:-1], 0.0))
