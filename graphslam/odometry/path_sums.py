"""Sums over the readings of several tracks, up to many times of each, and motions between these.

Tracks that are alike (`Track.batch_key`) are summed together: with few readings each, what NumPy
takes for a call counts more than what it computes.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.geometry import Array, between, inverse, inverse_cov, inverse_jacobian, wrap
from graphslam.core.motion_models import RATES, rates_of_config, unit_error_covs
from graphslam.odometry.increment_sums import IncrementSums, Motions, PathSums
from graphslam.odometry.mounted_motions import calibration_covs, of_mount

if TYPE_CHECKING:
    from graphslam.odometry.preintegration import Track

#: ns: step of the difference quotient by latency; about one period of common odometry
LATENCY_STEP_NS = 50_000_000


def numbered_times(
    start_ns: Sequence[IntArray], end_ns: Sequence[IntArray]
) -> tuple[list[IntArray], IntArray, IntArray]:
    """The times of each track's motions, ascending, and the numbers among all of these.

    The latter (n,) of the starts and of the ends, track after track.
    """
    times, starts, ends, passed = [], [], [], 0
    for start, end in zip(start_ns, end_ns, strict=True):
        needed, at = np.unique(np.concatenate([start, end]), return_inverse=True)
        times.append(needed)
        starts.append(passed + at[: len(start)])
        ends.append(passed + at[len(start) :])
        passed += len(needed)
    return times, np.concatenate(starts), np.concatenate(ends)


class SumsAtStates:
    """Sums of tracks with one `Track.batch_key` up to times of states, and motions between them.

    The tracks keep their calibration as long as they are asked for motions.
    """

    def __init__(self, tracks: Sequence["Track"], times_ns: Sequence[IntArray]) -> None:
        """Sum up; times (n,) of each track, ascending. They are numbered track after track."""
        self._tracks = tracks
        late = [times - track.latency_ns for track, times in zip(tracks, times_ns, strict=True)]
        self._track_of = np.repeat(np.arange(len(tracks)), [len(times) for times in late])
        self._sums, self._earlier = path_sums(tracks, late)

    def motions(self, start: IntArray, end: IntArray) -> Motions:
        """The motions (m) between times of the same track, by their numbers (m,)."""
        a, b, which = np.minimum(start, end), np.maximum(start, end), self._track_of[start]
        found, tracks = self._sums.motions_between(a, b), self._tracks
        delta, cov, d_cal, length = found.delta, found.cov, found.d_cal, found.length_m
        if tracks[0].is_mounted:
            mount = np.array([track.mount for track in tracks])[which]
            change = between(self._earlier[a], self._earlier[b]) - delta
            change[:, 2] = wrap(change[:, 2])
            observable = np.array([not track.has_burst_stamps for track in tracks])
            by_latency = change * np.where(observable, 1e9 / LATENCY_STEP_NS, 0.0)[which, None]
            delta, cov, d_cal = of_mount(delta, cov, d_cal, mount, by_latency)
        known = np.array([track.calibration.cov for track in tracks])
        cov = (cov + cov.mT) / 2 + calibration_covs(d_cal, known, which)
        moved, floor = (length > 0) | (delta[:, 2] != 0), tracks[0].floor_cov
        cov = cov + np.where(moved[:, None, None], floor, tracks[0].floor_cov_of(False))
        back = end < start
        if back.any():
            cov[back] = inverse_cov(delta[back], cov[back])
            d_cal[back] = inverse_jacobian(delta[back]) @ d_cal[back]
            delta[back] = inverse(delta[back])
        return Motions(delta, cov, d_cal, length)


def path_sums(
    tracks: Sequence["Track"], times: Sequence[IntArray], *, by_rate: bool = False
) -> tuple[PathSums, Array]:
    """Sums up to times (n,) of each track's clock, from a reading before all of them.

    The tracks have one `Track.batch_key`; their sums follow each other, and so do the poses (n, 3)
    at times `LATENCY_STEP_NS` earlier. Covariances are those of the tracks, or ``by_rate`` (n, 9,
    3, 3), see `unit_error_covs`.
    """
    p, counts = tracks[0].increment_parameters, [len(t) for t in times]
    n = sum(counts)
    if len(tracks[0]) < 2:
        zeros, covs = np.zeros((n, 3)), np.zeros((n, *(len(RATES),) * by_rate, 3, 3))
        of = np.zeros(n, dtype=np.int64)
        return PathSums(
            zeros, covs, np.zeros((n, 3, p)), np.zeros(n), covs, covs, of, zeros
        ), zeros  # fmt: skip
    spans = [
        track.span(np.array([when, when - LATENCY_STEP_NS]))
        for track, when in zip(tracks, times, strict=True)
    ]
    sizes = [len(span.whole) for span in spans]
    firsts, w = np.cumsum([0, *sizes[:-1]], dtype=np.int64), sum(sizes)
    # all whole rows, then the parts at the times, then the parts at the earlier times
    parts = np.hstack([span.part for span in spans])
    rows = np.concatenate([*(span.whole for span in spans), *parts])
    of_whole, of_time = (np.repeat(np.arange(len(tracks)), each) for each in (sizes, counts))
    mean = np.array([track.calibration.mean[:p] for track in tracks])
    of = np.concatenate([of_whole, of_time, of_time])
    if len(tracks) == 1:
        made = tracks[0].increments(rows, mean[0])
    else:
        rates = np.array([rates_of_config(track.config) for track in tracks])
        made = tracks[0].increments(rows, mean[of], rates[of])
    if by_rate:
        covs = unit_error_covs(tracks[0].source, rows, mean[0], tracks[0].robot)
        made = replace(made, cov=covs)
    first = firsts[of_time]
    index, index_earlier = np.hstack([span.index for span in spans]) + first
    sums = IncrementSums(made.part(0, w), firsts[of_whole])
    earlier = sums.poses(index_earlier, first, made.delta[w + n :])
    return sums.query(index, first, made.part(w, w + n)), earlier
