"""sensor_msgs/Imu: the rate of turning of a robot, by its gyroscope.

Orientation and acceleration are not read: the one has a compass in it or comes from the gyroscope,
the other says nothing of a heading.
"""

from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from itertools import islice
from typing import Any

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.geometry import Array
from graphslam.logs import schemas
from graphslam.logs.cdr import HEADER, CdrError, Layout, byte_order, u32
from graphslam.logs.mounts import TransformTree, axis_above
from graphslam.logs.recording import Recording, raw_messages
from graphslam.logs.tf_tree import namespace_of

#: messages that are decoded together
_BATCH = 1024


def imu_topics(files: Sequence[Recording], robot: str, robots: int) -> list[str]:
    """Topics with the gyroscopes of ``robot``, one of so many: that with most messages first."""
    counts: dict[str, int] = {}
    for file in files:
        for raw in file.topics:
            if raw.schema == schemas.IMU and raw.encoding == "cdr" and raw.count:
                counts[raw.name] = counts.get(raw.name, 0) + raw.count
    own = [name for name in counts if robots == 1 or namespace_of(name) == robot]
    return sorted(own, key=lambda name: (-counts[name], len(name), name))


def turn_rates(
    files: Sequence[Recording], topic: str, tree: TransformTree, base: str
) -> tuple[IntArray, Array]:
    """Times (n,) ns, ascending, and rates of turning (n,) rad/s about the vertical of ``base``.

    Frames of which ``tree`` knows nothing are taken to be level. Messages that cannot be read, and
    those that say that they have no rate, are left out.
    """
    axes: dict[bytes, Array] = {}
    times, rates = [np.empty(0, dtype=np.int64)], [np.empty(0)]
    for file in files:
        for rows, log_times in _tables(file, topic):
            frame = bytes(rows["frame"][0])
            if frame not in axes:
                axes[frame] = axis_above(tree, base, frame.decode(errors="replace").lstrip("/"))
            stamps = schemas.stamps_ns(rows)
            axis = axes[frame]
            # what it does not measure may be no number
            rate = np.where(axis == 0.0, 0.0, rows["rate"].astype(float)) @ axis
            known = np.isfinite(rate) & (rows["rate_covariance"][:, 0] != -1.0)
            times.append(np.where(stamps == 0, log_times, stamps)[known])
            rates.append(rate[known])
    all_times, first = np.unique(np.concatenate(times), return_index=True)
    return all_times, np.concatenate(rates)[first]


def _tables(file: Recording, topic: str) -> Iterator[tuple[Mapping[str, Any], IntArray]]:
    """Rows of messages that are decoded together, and their log times (n,) ns."""
    raws = raw_messages(file, {topic})
    while batch := list(islice(raws, _BATCH)):
        try:
            groups = [(_table([raw.data for raw in batch]), batch)]
        except CdrError:  # not all of them alike
            groups = []
            for raw in batch:
                try:
                    groups.append((_table([raw.data]), [raw]))
                except CdrError:
                    continue
        for rows, own in groups:
            yield rows, np.array([raw.log_time_ns for raw in own], dtype=np.int64)


def _table(data: Sequence[bytes]) -> Any:
    order = byte_order(data[0])
    layout = _layout(order, u32(data[0], HEADER + 8, order))
    return layout.table(data, ("frame_size", "frame"))


@lru_cache
def _layout(order: str, frame_size: int) -> Layout:
    layout = schemas.with_header(order, frame_size)
    layout.number("rotation", "d", 4)
    layout.number("rotation_covariance", "d", 9)
    layout.number("rate", "d", 3)
    layout.number("rate_covariance", "d", 9)
    layout.skip(8 * (3 + 9))  # acceleration
    return layout
