"""Motions between consecutive times of odometry that brings its own covariances.

Prefix sums (`increment_sums`) lose what is small beside what lies before it: where stated variances
span ten decades, the difference of two sums is rounding. Here only the increments of each interval
are added up, and an increment by itself stays as it was recorded.
"""

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.geometry import Array, compose, rotation3
from graphslam.odometry.increment_sums import Motions
from graphslam.odometry.preintegration import Track


def consecutive_motions(track: Track, times_ns: IntArray) -> Motions:
    """The motions (n - 1) between neighbours of sorted times (n,).

    What `Track.motions` gives, for odometry with its own covariances without its rounding.
    """
    begin_ns, end_ns = times_ns[:-1], times_ns[1:]
    if track.source != "given" or not len(begin_ns):
        return track.motions(begin_ns, end_ns)
    n, readings = len(begin_ns), track.times
    delta, cov, length_m = np.zeros((n, 3)), np.zeros((n, 3, 3)), np.zeros(n)
    whole = np.isin(begin_ns, readings) & np.isin(end_ns, readings)
    for k in np.flatnonzero(~whole).tolist():  # a time cuts a reading
        one = track.motion(int(begin_ns[k]), int(end_ns[k]))
        delta[k], cov[k], length_m[k] = one.delta, one.cov, one.length_m
    first, last = (np.searchsorted(readings, times[whole]) for times in (begin_ns, end_ns))
    if len(first):
        delta[whole], cov[whole], length_m[whole] = _compounded(track, first, last)
    return Motions(delta, cov, np.zeros((n, 3, 0)), length_m)


def _compounded(track: Track, first: IntArray, last: IntArray) -> tuple[Array, Array, Array]:
    """Motions (m, 3) from readings ``first`` to ``last`` (m,), covariances, lengths (m,).

    `graphslam.core.motion_models.compound` for many intervals, none of which overlap.
    """
    readings = track.times
    rows = track.rows_between(int(readings[first[0]]), int(readings[last[-1]]))
    parts = track.increments(rows, np.zeros(0))
    counts = last - first
    starts = np.cumsum(counts) - counts  # of each interval among its own rows
    of = np.repeat(np.arange(len(counts)), counts)
    inside = first[of] - first[0] + np.arange(len(of)) - starts[of]
    step, white = parts.delta[inside], parts.cov[inside]
    before, after = np.zeros((len(of), 3)), step.copy()
    for depth in range(1, int(counts.max())):
        now = starts[counts > depth] + depth
        before[now] = after[now - 1]
        after[now] = compose(before[now], step[now])
    delta = after[starts + counts - 1]
    E = rotation3(before[:, 2])
    E[:, 0, 2] = -(delta[of, 1] - after[:, 1])
    E[:, 1, 2] = delta[of, 0] - after[:, 0]
    length_m = np.add.reduceat(np.hypot(step[:, 0], step[:, 1]), starts)
    return delta, np.add.reduceat(E @ white @ E.mT, starts), length_m
