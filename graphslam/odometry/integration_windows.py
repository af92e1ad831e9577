"""Motions of long logs in windows of time, so that what their sums need does not grow with the log.

Sums over increments (`graphslam.odometry.increment_sums`) take some 700 bytes for each reading
between the first and the last time that is asked for.
"""

from collections.abc import Callable, Sequence
from typing import TypeAlias, TypeVar

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.odometry.increment_sums import Motions
from graphslam.odometry.readings import Readings, integrate_pending

_Track = TypeVar("_Track", bound=Readings)
#: a track with the times (n,) and (n,) between which motions are
Asked: TypeAlias = tuple[_Track, IntArray, IntArray]

#: readings of all tracks that are summed at once, at most; and how many times as many may be summed
#: in all where motions of one window reach into the next
MOST_READINGS, MOST_AGAIN = 100_000, 1.5


def in_windows(
    asked: Sequence[Asked[_Track]], integrate: Callable[[Sequence[Asked[_Track]]], list[Motions]]
) -> list[Motions]:
    """What ``integrate`` gives of ``asked``, in as many windows of time as it takes.

    See `graphslam.odometry.preintegration.preintegrate_batch`.
    """
    integrate_pending({track: None for track, _, _ in asked})
    parts = windows(asked)
    if parts is None:
        return integrate(asked)
    found: list[list[tuple[Motions, IntArray]]] = [[] for _ in asked]
    for part in parts:
        some = [k for k, chosen in enumerate(part) if len(chosen)]
        of = [(asked[k][0], asked[k][1][part[k]], asked[k][2][part[k]]) for k in some]
        for k, motions in zip(some, integrate(of) if of else (), strict=True):
            found[k].append((motions, part[k]))
    return [
        Motions.joined(*zip(*own, strict=True)) if own else integrate([one])[0]
        for one, own in zip(asked, found, strict=True)
    ]


def windows(
    asked: Sequence[Asked[_Track]],
) -> list[list[IntArray]] | None:
    """Which motions of each track to integrate together; None: all.

    Args:
        asked: tracks with the times (n,) and (n,) between which motions are.

    Returns:
        For each window, of each of ``asked`` the indices (m,) of its motions. None where these are
        few readings, or where motions are so long that every window would reach over the others.
    """
    spans = [(np.minimum(a, b), np.maximum(a, b)) for _, a, b in asked]
    if not any(len(begin) for begin, _ in spans):
        return None
    tracks = [track for track, _, _ in asked]
    everything = [np.arange(len(begin)) for begin, _ in spans]
    readings = _readings(tracks, spans, everything)
    if readings <= MOST_READINGS:
        return None
    first = min(int(begin.min()) for begin, _ in spans if len(begin))
    last = max(int(end.max()) for _, end in spans if len(end))
    edges = np.linspace(first, last, -(-readings // MOST_READINGS) + 1)[1:-1].astype(np.int64)
    window_of = [np.searchsorted(edges, begin, side="right") for begin, _ in spans]
    found: list[list[IntArray]] = [
        [np.asarray(np.flatnonzero(which == k), dtype=np.int64) for which in window_of]
        for k in range(len(edges) + 1)
    ]
    again = sum(_readings(tracks, spans, chosen) for chosen in found)
    return found if again <= MOST_AGAIN * readings else None


def _readings(
    tracks: Sequence[Readings],
    spans: Sequence[tuple[IntArray, IntArray]],
    chosen: Sequence[IntArray],
) -> int:
    """Readings between the first and the last time of the chosen motions of each track."""
    total = 0
    for track, (begin, end), which in zip(tracks, spans, chosen, strict=True):
        if len(which):
            ends = np.array([begin[which].min(), end[which].max()])
            i, j = np.searchsorted(track.times, ends)
            total += int(j - i)
    return total
