"""The derivative of motions by the calibration of odometry and mount, at the estimated motion.

Odometry measures a motion with noise. Were the derivative taken where odometry puts it, that noise
would be in the residual and in the regressor, and scales would come out too small: on a circle,
where nothing but noise tells a scale of turning from a turning per metre, until nothing turns. The
estimated motion makes it total least squares (S. Van Huffel and J. Vandewalle, The Total Least
Squares Problem, 1991, DOI 10.1137/1.9781611971002).
"""

from dataclasses import dataclass

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.config import OdometryConfig, RobotConfig
from graphslam.core.geometry import Array, between, compose, exp, inverse, log, wrap
from graphslam.core.motion_models import (
    MOTION_SOURCES,
    Calibration,
    mounted_motion,
    rows_of_twists,
    several_lasers,
)
from graphslam.core.records import Trajectory
from graphslam.odometry.increment_sums import Motions
from graphslam.odometry.mounted_motions import lever_to
from graphslam.odometry.path_sums import LATENCY_STEP_NS
from graphslam.odometry.preintegration import Track

#: ns: velocities are the motion from so long before to so long after
BASELINE_NS = 250_000_000


@dataclass(frozen=True, slots=True, eq=False)
class CalibratedSource:
    """A source of motion, see `MOTION_SOURCES`, and the calibration that its motions are made with.

    ``parameters``: number p of those of the odometry. ``is_mounted``: those of the mount and the
    latency of a sensor follow.
    """

    source: str
    robot: RobotConfig
    config: OdometryConfig
    calibration: Calibration
    parameters: int
    is_mounted: bool

    @classmethod
    def of(cls, track: Track) -> "CalibratedSource":
        """That of a track, as its calibration is now."""
        return cls(
            track.source, track.robot, track.config, track.calibration,
            track.increment_parameters, track.is_mounted,
        )  # fmt: skip

    @property
    def mount(self) -> Array:
        """See `Track.mount`."""
        where = slice(self.parameters, self.parameters + 3)
        return self.calibration.mean[where] if self.is_mounted else np.zeros(3)

    def derivative(self, twists: Array) -> Array:
        """Derivative (n, 3, p) of motions on arcs, by their twists (n, 3), by the calibration."""
        rows = rows_of_twists(self.source, twists, self.robot)
        known = self.calibration.mean[: self.parameters]
        return MOTION_SOURCES[self.source](rows, known, self.robot, self.config).d_cal


def at_estimated_motion(
    source: CalibratedSource, delta: Array, d_cal: Array, estimated: Array
) -> Array:
    """Derivative (n, 3, p) of motions by the calibration of their source, at the estimated motion.

    That by a latency stays; see `along_estimated_path`.

    Args:
        source: of one robot; with several lasers the derivative stays as it is.
        delta: (n, 3) motions of the frame at the mount, by odometry.
        d_cal: (n, 3, p) their derivative, as measured.
        estimated: (n, 3) the same motions by an estimate.
    """
    p = source.parameters
    if not d_cal.shape[2] or several_lasers(source.calibration):
        return d_cal
    d_cal, mount = d_cal.copy(), np.broadcast_to(source.mount, estimated.shape)
    of_base = [compose(compose(mount, motion), inverse(mount)) for motion in (estimated, delta)]
    if p:
        twists = [log(motion) for motion in of_base]
        change = np.subtract(*(source.derivative(twist) for twist in twists))
        # of two turns by nearly half a circle one may be taken for the other way round
        change[np.abs(twists[0][:, 2] - twists[1][:, 2]) > np.pi] = 0.0
        d_cal[:, :, :p] += lever_to(of_base[1], mount) @ change
    if source.is_mounted:
        d_cal[:, :, p : p + 3] = mounted_motion(of_base[0], mount)[1]
    return d_cal


def along_estimated_path(
    track: Track, start_ns: IntArray, end_ns: IntArray, measured: Motions, states: Trajectory
) -> Array:
    """`at_estimated_motion` between states of a path, by a latency at the estimated velocities.

    Those of noisy odometry are in the residuals too: where a time lies between two readings half of
    the noise of one, so that latencies that put all times there would look likelier. Between states
    of several lasers the derivative stays as it is.

    Args:
        track: the odometry, with the calibration of the motions.
        start_ns: (n,) times of states at which the motions begin.
        end_ns: (n,) the same of their ends.
        measured: motions between them.
        states: the estimated ones, of the frame at the track's mount.
    """
    moved = between(states.at(start_ns), states.at(end_ns))
    source = CalibratedSource.of(track)
    d_cal = at_estimated_motion(source, measured.delta, measured.d_cal, moved)
    if not track.is_mounted or track.has_burst_stamps or several_lasers(track.calibration):
        return d_cal
    d_cal[:, :, -1] = _by_latency(states, start_ns, end_ns, moved)
    return d_cal


def _by_latency(states: Trajectory, start_ns: IntArray, end_ns: IntArray, moved: Array) -> Array:
    """Derivative (n, 3), /s, of motions that ``moved`` so (n, 3) between states."""
    change = between(_earlier(states, start_ns), _earlier(states, end_ns)) - moved
    change[:, 2] = wrap(change[:, 2])
    return np.asarray(change * (1e9 / LATENCY_STEP_NS))


def _earlier(states: Trajectory, times_ns: IntArray) -> Array:
    """Poses (n, 3) `LATENCY_STEP_NS` before times, at the mean velocity around them."""
    first, last = states.stamps_ns[0], states.stamps_ns[-1]
    begin, end = (np.clip(times_ns + dt, first, last) for dt in (-BASELINE_NS, BASELINE_NS))
    moved = log(between(_interpolated(states, begin), _interpolated(states, end)))
    step = -LATENCY_STEP_NS / np.maximum(end - begin, 1)[:, None] * moved
    return compose(states.at(times_ns), exp(step))


def _interpolated(states: Trajectory, times_ns: IntArray) -> Array:
    """Poses (n, 3) on arcs between states."""
    last = len(states.stamps_ns) - 1
    i = np.clip(states.stamps_ns.searchsorted(times_ns), 1, last)
    begin, end = states.stamps_ns[i - 1], states.stamps_ns[i]
    share = np.clip((times_ns - begin) / np.maximum(end - begin, 1), 0.0, 1.0)
    twist = log(between(states.poses[i - 1], states.poses[i]))
    return compose(states.poses[i - 1], exp(share[:, None] * twist))
