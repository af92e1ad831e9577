"""The tree of frames of tf: static transforms, and those that are repeated or that move.

Transforms on ``/tf_static`` are static. On ``/tf`` there are those that move (odometry) and, from
old publishers of static ones, some that never do.
"""

import math
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from graphslam.core.geometry import Array
from graphslam.logs import schemas
from graphslam.logs.cdr import HEADER, CdrError, byte_order
from graphslam.logs.mounts import transforms_in
from graphslam.logs.recording import Recording, raw_messages, sample_messages
from graphslam.logs.schemas import DEFAULT_ROBOT, TF_MESSAGE

#: messages of /tf that are looked at: enough for every edge to be seen, and to be seen to move
_BLOCKS, _PER_BLOCK = 64, 32
#: m, or a number of a quaternion: a transform that changes by less is static
_AT_REST = 1e-6
#: m, rad: a transform that is nearly always so near the first one is taken to be that one
WOBBLE_M, WOBBLE_RAD, WOBBLE_SHARE = 0.05, np.deg2rad(3.0), 0.9
#: m, rad: static transforms that differ by less are one, as it was rounded
_ROUNDING_M, _ROUNDING_RAD = 0.005, np.deg2rad(0.3)
#: transforms of a child that are kept beside the last one: of one that moves there are many
_MOST_REPLACED = 16


class Transform(NamedTuple):
    """A transform of a TFMessage: stamp ns, frames, and x y z, then the quaternion x y z w."""

    stamp_ns: int
    parent: str
    child: str
    values: tuple[float, ...]


class StaticTransform(NamedTuple):
    """A static transform on ``topic``: ``matrix`` (4, 4) is parent from child."""

    topic: str
    parent: str
    child: str
    matrix: Array

    def is_near(self, other: "StaticTransform") -> bool:
        """Whether it has the same parent as ``other`` and is the same but for rounding."""
        return self.parent == other.parent and not differ(self.matrix, other.matrix)


def differ(one: Array, other: Array) -> tuple[float, float] | None:
    """By how much two transforms (4, 4) differ, m and rad; None if that is no more than rounding.

    Heights are left out: they mean nothing in the plane.
    """
    apart_m = float(np.hypot(*(one - other)[:2, 3]))
    cosine = (np.trace(one[:3, :3].T @ other[:3, :3]) - 1) / 2
    apart_rad = float(np.arccos(np.clip(cosine, -1.0, 1.0)))
    return (apart_m, apart_rad) if apart_m > _ROUNDING_M or apart_rad > _ROUNDING_RAD else None


@dataclass(slots=True)
class TransformEdge:
    """A transform from ``parent`` to ``child`` as seen in several messages of a topic.

    ``first``: its values in the first of them. ``moves``: they differ; ``still``: how many of the
    ``seen`` are within `WOBBLE_M` and `WOBBLE_RAD` of the first.
    """

    topic: str
    parent: str
    child: str
    first: tuple[float, ...]
    moves: bool = False
    seen: int = 0
    still: int = 0

    @property
    def wobbles(self) -> bool:
        """Whether it moves so little that what it carries is at one place: a base on springs."""
        return self.moves and self.still >= WOBBLE_SHARE * self.seen


def transforms_of(data: bytes) -> list[Transform]:
    """The transforms of a TFMessage in CDR; much faster than `schemas.decode`.

    Raises:
        CdrError: the bytes are cut short or are not such a message.
    """
    order = byte_order(data)
    pair, one = struct.Struct(order + "iI"), struct.Struct(order + "I")
    seven = struct.Struct(order + "7d")
    found = []
    try:
        (count,) = one.unpack_from(data, HEADER)
        at = HEADER + 4
        for _ in range(count):
            at += -(at - HEADER) % 4
            sec, nanosec = pair.unpack_from(data, at)
            names = []
            at += 8
            for _ in range(2):
                at += -(at - HEADER) % 4
                (size,) = one.unpack_from(data, at)
                names.append(data[at + 4 : at + 3 + size].decode().lstrip("/"))
                at += 4 + size
            at += -(at - HEADER) % 8
            values = seven.unpack_from(data, at)
            at += 56
            found.append(Transform(sec * 1_000_000_000 + nanosec, names[0], names[1], values))
    except (struct.error, UnicodeDecodeError, OverflowError) as error:
        raise CdrError(str(error)) from error
    return found


def moving_topics(recording: Recording) -> list[str]:
    """Topics with transforms that are not static, or not all."""
    return [
        topic.name
        for topic in recording.topics
        if topic.schema == TF_MESSAGE and not topic.name.endswith("tf_static") and topic.count
    ]


def static_topics(recording: Recording) -> list[str]:
    """Topics with static transforms."""
    return [
        topic.name
        for topic in recording.topics
        if topic.schema == TF_MESSAGE and topic.name.endswith("tf_static")
    ]


def sampled_edges(files: Sequence[Recording], space: str) -> dict[str, TransformEdge]:
    """The edges on the topics ``/tf`` of a namespace (and on those of all), by their child."""
    found: dict[str, TransformEdge] = {}
    for file in files:
        for topic in moving_topics(file):
            if _is_of(topic, space):
                messages = sample_messages(file, topic, _BLOCKS, _PER_BLOCK)
                _add_edges(found, topic, decoded(messages))
    return found


def _add_edges(
    found: dict[str, TransformEdge], topic: str, messages: Iterable[list[Transform]]
) -> None:
    for _, parent, child, values in (one for message in messages for one in message):
        edge = found.setdefault(child, TransformEdge(topic, parent, child, values))
        edge.seen += 1
        edge.still += _is_near(edge.first, values)
        if not edge.moves:
            pairs = zip(edge.first, values, strict=True)
            edge.moves = any(abs(a - b) > _AT_REST for a, b in pairs)


def _is_near(first: Sequence[float], values: Sequence[float]) -> bool:
    if math.dist(first[:3], values[:3]) > WOBBLE_M:
        return False
    same = abs(sum(a * b for a, b in zip(first[3:], values[3:], strict=True)))
    return bool(2 * math.acos(min(same, 1.0)) <= WOBBLE_RAD)


def moving_link(
    edges: Mapping[str, TransformEdge], tree: Mapping[str, tuple[str, Array]], base: str, frame: str
) -> TransformEdge | None:
    """The lowest link between ``base`` and a ``frame`` on it that moves; None if there is none.

    ``edges`` and ``tree``, transforms (4, 4), are by the child: `sampled_edges`, `static_tree`.
    """
    passed, moving = {frame}, None
    while frame != base:
        edge = edges.get(frame)
        if moving is None and edge is not None and frame not in tree:
            moving = edge
        if edge is None and frame not in tree:
            return None  # not on this base
        frame = edge.parent if edge is not None else tree[frame][0]
        if frame in passed:
            return None
        passed.add(frame)
    return moving


def decoded(messages: Iterable[bytes]) -> Iterator[list[Transform]]:
    """The transforms of each message that can be decoded."""
    for data in messages:
        with suppress(CdrError):
            yield transforms_of(data)


def static_tree(
    files: Sequence[Recording],
    space: str,
    edges: dict[str, TransformEdge],
    replaced: dict[str, list[StaticTransform]] | None = None,
) -> dict[str, tuple[str, Array]]:
    """Static transforms of a namespace, and those of ``edges`` that do not move, or hardly.

    Child -> (parent, parent_from_child (4, 4)): the last one of each child. ``replaced`` gets, by
    the child, those of its static ones that another one took the place of.
    """
    tree: dict[str, tuple[str, Array]] = {}
    for child, edge in edges.items():
        matrix = matrix_of(edge.first)
        if (edge.wobbles or not edge.moves) and np.isfinite(matrix).all():
            tree[child] = (edge.parent, matrix)
    latest: dict[str, StaticTransform] = {}
    for file in files:
        own = [n for n in static_topics(file) if _is_of(n, space)]
        for raw in raw_messages(file, own):
            # a mount that is missing because its message is damaged causes a warning
            for found in transforms_in(schemas.decode_all(TF_MESSAGE, [raw.data])):
                one = StaticTransform(raw.topic, *found)
                before = latest.setdefault(one.child, one)
                if replaced is not None and not before.is_near(one):
                    others = replaced.setdefault(one.child, [])
                    if len(others) < _MOST_REPLACED:
                        others.append(before)
                latest[one.child] = one
    return tree | {child: (one.parent, one.matrix) for child, one in latest.items()}


def _is_of(topic: str, space: str) -> bool:
    """Whether a topic of transforms is of a namespace, or of none, so of all."""
    return namespace_of(topic) == DEFAULT_ROBOT or space in topic.strip("/").split("/")[:-1]


def namespace_of(topic: str) -> str:
    """First part of a topic's name: robot1 for ``/robot1/scan``; robot for ``/scan``."""
    first, separator, _ = topic.strip("/").partition("/")
    return first if separator else DEFAULT_ROBOT


def matrix_of(values: Sequence[float]) -> Array:
    """The transform (4, 4) of x y z and a quaternion x y z w; NaN if that is zero."""
    t, (x, y, z, w) = values[:3], values[3:]
    norm = np.sqrt(x * x + y * y + z * z + w * w)
    if not norm > 0:
        return np.full((4, 4), np.nan)
    x, y, z, w = x / norm, y / norm, z / norm, w / norm
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])  # times v: (x, y, z) x v
    matrix = np.eye(4)
    matrix[:3, :3] += 2 * (w * cross + cross @ cross)
    matrix[:3, 3] = t
    return matrix
