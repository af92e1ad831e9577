"""Things as surfaces: the straight faces and circles that a beam can meet."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from graphslam.core.geometry import Array, compose, rotation, transform
from graphslam.simulation.scenario import Box, Move, StaticObjects


@dataclass(frozen=True, slots=True, eq=False)
class Outline:
    """One thing: a polyline ``points`` (k, 2) m, or a circle of ``radius_m`` about its one point.

    ``closed`` joins the last point to the first; nothing fits inside a ``solid`` one.
    """

    name: str
    points: Array
    radius_m: float = 0.0
    closed: bool = False
    solid: bool = False
    may_cross: bool = False

    @property
    def faces(self) -> Array:
        """Its straight faces (k, 2, 2): from point to point."""
        if self.radius_m:
            return np.zeros((0, 2, 2))
        ends = np.roll(self.points, -1, axis=0)
        return np.stack([self.points, ends], axis=1)[: None if self.closed else -1]

    def moved(self, pose: Array) -> "Outline":
        """The same thing after the rigid motion ``pose`` (3,) of the world frame."""
        return replace(self, points=transform(pose, self.points))


@dataclass(frozen=True, slots=True, eq=False)
class Shapes:
    """What a beam can meet: ``segments`` (..., k, 2, 2) m, then ``circles`` (..., m, 3) x y r.

    Leading axes, where there are any, are those of the scans: shapes that move. Surfaces are
    numbered in this order, segments first.
    """

    segments: Array
    circles: Array

    @property
    def count(self) -> int:
        """Number of surfaces."""
        return int(self.segments.shape[-3] + self.circles.shape[-2])


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """Outlines and their surfaces.

    ``names`` and ``things`` (the outline's number) are per surface, segments first.
    """

    outlines: tuple[Outline, ...]
    shapes: Shapes
    names: tuple[str, ...]
    things: np.ndarray[tuple[int], np.dtype[np.int64]]

    @property
    def circle_names(self) -> tuple[str, ...]:
        """Names of the circles, in the order of ``shapes.circles``."""
        return self.names[len(self.shapes.segments) :]


def outlines_of(things: StaticObjects) -> Iterator[Outline]:
    """The outline of everything in a scenario's list of things."""
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
    """Number the surfaces: faces first, then circles; a face is named after its thing.

    A thing with several faces names them NAME/1, NAME/2, ...
    """
    outlines = tuple(outlines)
    faces, circles, names, round_names, things, round_things = [], [], [], [], [], []
    for number, outline in enumerate(outlines):
        count = len(outline.faces)
        faces.append(outline.faces)
        things += [number] * count
        names += [f"{outline.name}/{i + 1}" if count > 1 else outline.name for i in range(count)]
        if outline.radius_m:
            circles.append([*outline.points[0], outline.radius_m])
            round_names.append(outline.name)
            round_things.append(number)
    shapes = Shapes(
        np.concatenate([np.zeros((0, 2, 2)), *faces]), np.array(circles, dtype=float).reshape(-1, 3)
    )
    everything = np.array([*things, *round_things], dtype=np.int64)
    return World(outlines, shapes, (*names, *round_names), everything)


def displacement(move: Move) -> Array:
    """The rigid motion (3,) of the world frame that a move makes: a turn about a point, a shift."""
    about = np.array([*move.about_m, 0.0])
    back = np.array([-move.about_m[0], -move.about_m[1], 0.0])
    turn = np.array([0.0, 0.0, np.radians(move.turn_deg)])
    return compose(np.array([*move.shift_m, 0.0]), compose(about, compose(turn, back)))


def find_crossing(world: World) -> tuple[str, str] | None:
    """Names of two faces that cut through each other; None where none do.

    Touching is allowed (a wall that ends on another one, a cupboard against a wall), and so is
    what one of the two things was told that it may.
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
    # a millimetre of overlap is how people write things that touch
    margin = 1e-3 / length
    inside = (on_first > margin[:, None]) & (on_first < 1 - margin[:, None])
    inside &= (on_second > margin[None, :]) & (on_second < 1 - margin[None, :])
    allowed = np.array([world.outlines[t].may_cross for t in world.things[:n]], dtype=bool)
    found = np.argwhere(inside & ~parallel & ~allowed[:, None] & ~allowed[None, :])
    return (world.names[found[0, 0]], world.names[found[0, 1]]) if len(found) else None


def _cross(a: Array, b: Array) -> Array:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def find_degenerate(outlines: Sequence[Outline]) -> str | None:
    """Name of a thing with a face of no length, or a wall of less than two points."""
    for outline in outlines:
        along = outline.faces[:, 1] - outline.faces[:, 0]
        if not outline.radius_m and not (len(along) and np.hypot(*along.T).min() > 1e-6):
            return outline.name
    return None
