"""Sample times of sensors, and their stamps by the robot's clock.

The simulator uses true time in seconds since the start of the scenario. Logs have integer
nanoseconds of the robot's own clock.
"""

import numpy as np

from graphslam.core.geometry import Array
from graphslam.simulation.scenario import RobotClock

Stamps = np.ndarray[tuple[int], np.dtype[np.int64]]

START_NS = 1_054_425_600 * 10**9  # 1 June 2003, the year of the thesis


def sample_times(duration_s: float, period_s: float, phase_s: float = 0.0) -> Array:
    """True times (n,) s of a sensor's samples up to and including the end of the scenario."""
    count = int(np.floor((duration_s - phase_s) / period_s + 1e-9)) + 1
    return np.asarray(phase_s + period_s * np.arange(max(count, 0)), dtype=float)


def stamps(time_s: Array, clock: RobotClock, latency_s: float = 0.0) -> Stamps:
    """Stamps (n,) ns of samples at true times (n,) s that arrive ``latency_s`` later."""
    true_ns = np.round((time_s + latency_s) * 1e9).astype(np.int64)
    drift_ns = np.round(true_ns * (clock.drift_ppm * 1e-6)).astype(np.int64)
    return np.asarray(START_NS + true_ns + drift_ns + round(clock.offset_s * 1e9))
