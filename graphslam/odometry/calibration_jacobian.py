"""The derivative of motions by the calibration of odometry and mount, at the estimated motion.

Odometry measures a motion with noise. Were the derivative taken where odometry puts it, that noise
would be in the residual and in the regressor, and scales would come out too small: on a circle,
where nothing but noise tells a scale of turning from a turning per metre, until nothing turns. The
estimated motion makes it total least squares (S. Van Huffel and J. Vandewalle, The Total Least
Squares Problem, 1991, DOI 10.1137/1.9781611971002).
"""

import numpy as np

from graphslam.core.geometry import Array, compose, inverse, log
from graphslam.core.motion_models import mounted_motion, several_lasers
from graphslam.odometry.increment_sums import Motions
from graphslam.odometry.mounted_motions import lever_to
from graphslam.odometry.preintegration import Track


def at_estimated_motion(track: Track, measured: Motions, estimated: Array) -> Array:
    """Derivative (n, 3, p) of motions by a track's calibration, at the estimated motion.

    That by a latency stays: it is a difference of velocities.

    Args:
        track: of one robot; with several lasers the derivative stays as it is.
        measured: n motions of the frame at the track's mount, by odometry.
        estimated: (n, 3) the same by an estimate.
    """
    d_cal, p = measured.d_cal, track.increment_parameters
    if not d_cal.shape[2] or several_lasers(track.calibration):
        return d_cal
    d_cal, mount = d_cal.copy(), np.broadcast_to(track.mount, estimated.shape)
    of_base = [
        compose(compose(mount, motion), inverse(mount)) for motion in (estimated, measured.delta)
    ]
    if p:
        change = np.subtract(*(track.derivative(log(motion)) for motion in of_base))
        d_cal[:, :, :p] += lever_to(of_base[1], mount) @ change
    if track.is_mounted:
        d_cal[:, :, p : p + 3] = mounted_motion(of_base[0], mount)[1]
    return d_cal
