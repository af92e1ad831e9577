"""Scans between two keyframes that have little in common become keyframes too.

Keyframes follow odometry. If the wheels do not show how a robot turns (they slip, it is pushed),
the next keyframe may see nothing of what the last one saw, and no match of the two is found. Each
of the scans between still lies on the one before it.
"""

from collections.abc import Iterable, Sequence

import numpy as np

from graphslam.core.records import Scan

#: scans between two such keyframes that become keyframes, at most
MOST_BETWEEN = 20
#: scans since the last keyframe that are kept for it, at most: some MB
HELD = 200


def scans_to_add(spans_ns: Iterable[tuple[int, int]], scans: Sequence[Scan]) -> list[Scan]:
    """The scans that become keyframes, in their order; evenly spread where there are many.

    Args:
        spans_ns: times of two consecutive keyframes, see `ComparedScans.lost`.
        scans: of the same laser, in the order of time, that are no keyframes.
    """
    times = np.array([scan.time_ns for scan in scans], dtype=np.int64)
    added: list[Scan] = []
    for begin_ns, end_ns in spans_ns:
        inside = np.flatnonzero((times > begin_ns) & (times < end_ns))
        if len(inside) > MOST_BETWEEN:
            inside = inside[np.linspace(0, len(inside) - 1, MOST_BETWEEN).astype(np.int64)]
        added += [scans[k] for k in inside.tolist()]
    return added
