"""Odometry from tf: the pose of a robot's base in its odometry frame, where no topic has it.

Between the two frames there may be several transforms, static and moving ones.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import reduce

import numpy as np

from graphslam.core.geometry import Array
from graphslam.logs import schemas
from graphslam.logs.cdr import CdrError
from graphslam.logs.cdr_writing import odometry_bytes
from graphslam.logs.recording import Derived, Recording, raw_messages
from graphslam.logs.tf_tree import TransformEdge, matrix_of, moving_topics, transforms_of


@dataclass(frozen=True, slots=True)
class Chain:
    """Frames from the base up to the odometry frame; ``edges`` has each transform on the way.

    ``topic``: on which the moving transforms are. A static transform (4, 4) is parent from child;
    None is one that moves.
    """

    topic: str
    frames: tuple[str, ...]
    static: tuple[Array | None, ...] = field(repr=False, compare=False)

    @property
    def base(self) -> str:
        """Frame whose motion it is."""
        return self.frames[0]

    @property
    def odometry(self) -> str:
        """Frame in which it moves."""
        return self.frames[-1]


def find_chain(
    sensor: str, edges: Mapping[str, TransformEdge], static: Mapping[str, tuple[str, Array]]
) -> Chain | None:
    """The odometry of the robot that carries the frame ``sensor``; None if nothing above moves.

    ``edges`` and ``static`` transforms (4, 4) are by their child, see `sampled_edges` and
    `static_tree`.

    The base is the frame below the lowest transform that moves. The odometry frame is the next
    above it that is called ``odom`` (REP 105), or else the one right above the base: what is above
    may be a map, in which a robot jumps.
    """
    frames = [sensor]
    while (parent := _parent(frames[-1], edges, static)) and parent not in frames:
        frames.append(parent)
    moving = [k for k, frame in enumerate(frames[:-1]) if frame in edges and edges[frame].moves]
    if not moving:
        return None
    first = moving[0]
    named = [k for k in range(first + 1, len(frames)) if "odom" in frames[k].rsplit("/", 1)[-1]]
    last = named[0] if named else first + 1
    topics = {edges[frames[k]].topic for k in moving if k < last}
    if len(topics) > 1:
        return None
    own = tuple(frames[first : last + 1])
    steps = tuple(
        None if k in moving else matrix_of(edges[frames[k]].first) if frames[k] in edges
        else static[frames[k]][1]
        for k in range(first, last)
    )  # fmt: skip
    return Chain(topics.pop(), own, steps)


def _parent(
    frame: str, edges: Mapping[str, TransformEdge], static: Mapping[str, tuple[str, Array]]
) -> str | None:
    if frame in edges:
        return edges[frame].parent
    return static[frame][0] if frame in static else None


class TfOdometry:
    """Turns messages of /tf into nav_msgs/Odometry, as they come.

    A message is made when the lowest transform that moves has come; of others that move, the
    latest is taken.
    """

    def __init__(self, chain: Chain) -> None:
        """``chain``: of the robot."""
        self._children = chain.frames[:-1]
        self._links = set(zip(chain.frames[1:], chain.frames, strict=False))
        self._steps = dict(zip(self._children, chain.static, strict=True))
        self._frames = (chain.odometry, chain.base)

    def __call__(self, data: bytes, _log_time_ns: int) -> list[bytes]:
        """The odometry in a message of /tf, none to several."""
        try:
            found = [t for t in transforms_of(data) if (t.parent, t.child) in self._links]
        except CdrError:
            return []
        if len(self._children) == 1:  # as they are, to the bit
            return [self._message(t.stamp_ns, t.values) for t in found]
        # all of a message first: which of them comes first means nothing
        self._steps |= {t.child: matrix_of(t.values) for t in found}
        stamps = [t.stamp_ns for t in found if t.child == self._children[0]]
        steps = [step for step in map(self._steps.get, self._children[::-1]) if step is not None]
        if not stamps or len(steps) < len(self._children):
            return []
        return [self._message(stamps[-1], _pose(steps))]

    def _message(self, stamp_ns: int, values: Sequence[float]) -> bytes:
        frame, child = self._frames
        return odometry_bytes(stamp_ns, frame, values[:3], values[3:], child)


def _pose(steps: Sequence[Array]) -> list[float]:
    """Position and quaternion of the product of transforms (4, 4)."""
    matrix = reduce(np.matmul, steps)
    # the heading to the last digit, and what leans, which is little
    heading = math.atan2(matrix[1, 0], matrix[0, 0])
    c, s = math.cos(heading), math.sin(heading)
    lean = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) @ matrix[:3, :3]
    w = math.sqrt(max(1.0 + float(np.trace(lean)), 1.0)) / 2
    x, y, z = ((lean[i, j] - lean[j, i]) / (4 * w) for i, j in ((2, 1), (0, 2), (1, 0)))
    c, s = math.cos(heading / 2), math.sin(heading / 2)
    turn = [c * x - s * y, s * x + c * y, s * w + c * z, c * w - s * z]
    return [*matrix[:3, 3].tolist(), *map(float, turn)]


def with_odometry(recording: Recording, chain: Chain) -> tuple[Recording, Derived | None]:
    """The recording with the odometry of ``chain`` as a topic; None if it has none of it."""
    if chain.topic not in moving_topics(recording):
        return recording, None
    make = TfOdometry(chain)
    messages = raw_messages(recording, {chain.topic})
    count = sum(len(make(raw.data, raw.log_time_ns)) for raw in messages)
    name = f"{chain.topic} ({chain.odometry} to {chain.base})"
    derived = Derived(name, schemas.ODOMETRY, chain.topic, count, TfOdometry, (chain,))
    return recording.with_derived(derived), derived
