"""Trajectories at any stamps, from the states that an estimator keeps and the odometry between."""

import numpy as np

from graphslam.dead_reckoning import Track
from graphslam.geometry import Array, between, compose, exp, log
from graphslam.records import Trajectory

IntArray = np.ndarray[tuple[int], np.dtype[np.int64]]


def between_states(
    states: Trajectory, track: Track, times_ns: IntArray, stamps_ns: IntArray, *, causal: bool
) -> Trajectory:
    """Poses at ``times_ns``: the last state before it, carried on by odometry.

    Final (``causal`` false): the disagreement between odometry and the *next* state is spread over
    the interval in proportion to the motion in it, and the covariance is that of a bridge between
    both states. Causal: nothing after the time is used, the covariance grows by odometry.

    Args:
        states: the states, stamped with their times.
        track: the robot's odometry.
        times_ns: (n,) when.
        stamps_ns: (n,) what the result is stamped with.
        causal: see above.
    """
    at = states.stamps_ns
    i = np.clip(np.searchsorted(at, times_ns, side="right") - 1, 0, len(at) - 1)
    late = track.latency_ns
    odometry_at_state = compose(track.pose(at - late), track.mount)
    moved = between(odometry_at_state[i], compose(track.pose(times_ns - late), track.mount))
    poses = compose(states.poses[i], moved)
    turn = _rotations(states.poses[i, 2])
    if causal:
        added = _noise_since(track, at[i], times_ns)
    else:
        share = _shares(track, at, i, times_ns)
        noise = _interval_noise(track, at, int(times_ns.max()))[i]
        following = np.minimum(i + 1, len(at) - 1)
        arrived = compose(
            states.poses[i], between(odometry_at_state[i], odometry_at_state[following])
        )
        miss = log(between(arrived, states.poses[following]))
        poses = compose(poses, exp(share[:, None] * np.where((following > i)[:, None], miss, 0.0)))
        inside = (following > i)[:, None, None]
        s = share[:, None, None]
        added = s * np.where(inside, 1 - s, 1.0) * noise
    F = np.broadcast_to(np.eye(3), (len(i), 3, 3)).copy()
    F[:, 0, 2] = -(poses[:, 1] - states.poses[i, 1])
    F[:, 1, 2] = poses[:, 0] - states.poses[i, 0]
    carried = F @ states.covs[i] @ F.mT
    if not causal:
        carried = np.where(inside, (1 - s) * carried + s * states.covs[following], carried)
    return Trajectory(stamps_ns, poses, carried + turn @ added @ turn.mT)


def mounted(base: Trajectory, mounts: Array) -> Trajectory:
    """Trajectory of frames that sit at ``mounts`` (n, 3) or (3,) in the base frame, rigidly."""
    poses = compose(base.poses, mounts)
    F = np.broadcast_to(np.eye(3), base.covs.shape).copy()
    F[:, 0, 2] = -(poses[:, 1] - base.poses[:, 1])
    F[:, 1, 2] = poses[:, 0] - base.poses[:, 0]
    return Trajectory(base.stamps_ns, poses, F @ base.covs @ F.mT)


def _shares(track: Track, at: IntArray, i: IntArray, times_ns: IntArray) -> Array:
    """How much (0..1) of the motion between state i and the next lies before each time."""
    last = max(int(times_ns.max()), int(at[-1]))
    ends = np.append(at[1:], last)
    late = track.latency_ns
    effort_at, effort_end = track.effort(at - late), track.effort(ends - late)
    whole = effort_end - effort_at
    part = (track.effort(times_ns - late) - effort_at[i]) / np.where(whole[i] > 0, whole[i], 1.0)
    return np.clip(np.where(whole[i] > 0, part, 0.0), 0.0, 1.0)


def _noise_since(track: Track, since_ns: IntArray, times_ns: IntArray) -> Array:
    """Odometry covariance (n, 3, 3) from a state to a time, along the state's axes; 0 at it."""
    noise = np.zeros((len(times_ns), 3, 3))
    for n in np.flatnonzero(times_ns > since_ns):
        noise[n] = track.motion(int(since_ns[n]), int(times_ns[n])).cov
    return noise


def _interval_noise(track: Track, at: IntArray, last_ns: int) -> Array:
    """Odometry covariance (n, 3, 3) of the interval after each state, along the state's axes."""
    ends = np.append(at[1:], max(last_ns, int(at[-1])))
    return np.array([track.motion(int(a), int(b)).cov for a, b in zip(at, ends, strict=True)])


def _rotations(headings: Array) -> Array:
    c, s = np.cos(headings), np.sin(headings)
    turn = np.zeros((len(headings), 3, 3))
    turn[:, 0, 0] = turn[:, 1, 1] = c
    turn[:, 0, 1], turn[:, 1, 0] = -s, s
    turn[:, 2, 2] = 1.0
    return turn
