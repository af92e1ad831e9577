"""Static objects as surfaces: straight faces and circles for ray casting."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from graphslam.core.geometry import Array, compose, rotation, transform
from graphslam.simulation.scenario import Box, Move, StaticObjects


@dataclass(frozen=True, slots=True, eq=False)
class Outline:
    """An object: a polyline ``points`` (k, 2) m, or a circle of ``radius_m`` about its one point.

    ``closed`` joins the last point to the first; no robot fits inside a ``solid`` one.
    """

    name: str
    points: Array
    radius_m: float = 0.0
    closed: bool = False
    solid: bool = False
    may_cross: bool = False

    @property
    def faces(self) -> Array:
        """Straight faces (k, 2, 2) from point to point."""
        if self.radius_m:
            return np.zeros((0, 2, 2))
        ends = np.roll(self.points, -1, axis=0)
        return np.stack([self.points, ends], axis=1)[: None if self.closed else -1]

    def moved(self, pose: Array) -> "Outline":
        """The object after the rigid motion ``pose`` (3,) of the world frame."""
        return replace(self, points=transform(pose, self.points))


@dataclass(frozen=True, slots=True, eq=False)
class Shapes:
    """Surfaces: ``segments`` (..., k, 2, 2) m, then ``circles`` (..., m, 3) x y radius.

    A leading axis, if any, is that of the scans, for moving shapes. Surfaces are numbered in this
    order, segments first.
    """

    segments: Array
    circles: Array

    @property
    def count(self) -> int:
        """Number of surfaces."""
        return int(self.segments.shape[-3] + self.circles.shape[-2])


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """Outlines and their surfaces; ``names`` and ``things`` (outline index) are per surface."""

    outlines: tuple[Outline, ...]
    shapes: Shapes
    names: tuple[str, ...]
    things: np.ndarray[tuple[int], np.dtype[np.int64]]

    @property
    def circle_names(self) -> tuple[str, ...]:
        """Names of the circles, in the order of ``shapes.circles``."""
        return self.names[len(self.shapes.segments) :]


def outlines_of(things: StaticObjects) -> Iterator[Outline]:
    """The outlines of a scenario's static objects."""
    for wall in things.walls:
        yield Outline(wall.name, np.array(wall.points_m), 0.0, wall.closed, False, wall.may_cross)
    for box in things.boxes:
        yield _box(box)
    for board in things.boards:
        along = board.length_m / 2 * _direction(board.angle_deg)
        ends = np.array([board.center_m - along, board.center_m + along])
        yield Outline(board.name, ends, may_cross=board.may_cross)
    for door in things.doors:
        leaf = door.width_m * _direction(door.closed_deg + door.opening_deg)
        ends = np.array([door.hinge_m, door.hinge_m + leaf])
        yield Outline(door.name, ends, may_cross=door.may_cross)
    for cylinder in things.cylinders:
        center = np.array([cylinder.center_m])
        yield Outline(cylinder.name, center, cylinder.radius_m, solid=True)


def _box(box: Box) -> Outline:
    half = np.array(box.size_m) / 2
    corners = half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    pose = np.array([*box.center_m, np.radians(box.angle_deg)])
    return Outline(box.name, transform(pose, corners), 0.0, True, True, box.may_cross)


def _direction(angle_deg: float) -> Array:
    return np.asarray(rotation(float(np.radians(angle_deg)))[:, 0])


def make_world(outlines: Iterable[Outline]) -> World:
    """Number the surfaces: faces first, then circles; a face has the name of its object.

    The faces of an object with several are NAME/1, NAME/2, ...
    """
    outlines = tuple(outlines)
    names, things = [], []
    for number, outline in enumerate(outlines):
        count = len(outline.faces)
        things += [number] * count
        names += [f"{outline.name}/{i + 1}" if count > 1 else outline.name for i in range(count)]
    round_ones = [n for n, outline in enumerate(outlines) if outline.radius_m]
    circles = [[*outlines[n].points[0], outlines[n].radius_m] for n in round_ones]
    shapes = Shapes(
        np.concatenate([np.zeros((0, 2, 2)), *(outline.faces for outline in outlines)]),
        np.array(circles, dtype=float).reshape(-1, 3),
    )
    names += [outlines[n].name for n in round_ones]
    return World(outlines, shapes, tuple(names), np.array(things + round_ones, dtype=np.int64))


def displacement(move: Move) -> Array:
    """Rigid motion (3,) of the world frame by a move: a turn about a point, then a shift."""
    about = np.array([*move.about_m, 0.0])
    back = np.array([-move.about_m[0], -move.about_m[1], 0.0])
    turn = np.array([0.0, 0.0, np.radians(move.turn_deg)])
    return compose(np.array([*move.shift_m, 0.0]), compose(about, compose(turn, back)))


def find_crossing(world: World) -> tuple[str, str] | None:
    """Names of two faces that intersect; None if there are none.

    Touching is allowed (a wall that ends on another one, a cupboard against a wall), and so are
    intersections of objects with ``may_cross``.
    """
    faces, n = world.shapes.segments, len(world.shapes.segments)
    start, along = faces[:, 0], faces[:, 1] - faces[:, 0]
    offset = start[None, :] - start[:, None]  # (i, j): from face i's start to face j's
    denominator = _cross(along[:, None], along[None, :])
    length = np.hypot(along[:, 0], along[:, 1])
    parallel = np.abs(denominator) <= 1e-12 * length[:, None] * length[None, :]
    safe = np.where(parallel, 1.0, denominator)
    on_first = _cross(offset, along[None, :]) / safe
    on_second = _cross(offset, along[:, None]) / safe
    # objects that touch are often given with a millimetre of overlap
    margin = 1e-3 / length
    inside = (on_first > margin[:, None]) & (on_first < 1 - margin[:, None])
    inside &= (on_second > margin[None, :]) & (on_second < 1 - margin[None, :])
    allowed = np.array([world.outlines[t].may_cross for t in world.things[:n]], dtype=bool)
    found = np.argwhere(inside & ~parallel & ~allowed[:, None] & ~allowed[None, :])
    return (world.names[found[0, 0]], world.names[found[0, 1]]) if len(found) else None


def _cross(a: Array, b: Array) -> Array:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def find_degenerate(outlines: Sequence[Outline]) -> str | None:
    """Name of an object with a face of zero length or a wall of less than two points."""
    for outline in outlines:
        along = outline.faces[:, 1] - outline.faces[:, 0]
        if not outline.radius_m and not (len(along) and np.hypot(*along.T).min() > 1e-6):
            return outline.name
    return None
