"""Logs of a stated length for `speed.py`: rounds of a ring, a building, five robots, a pose graph.

All are deterministic, and all logs have their truth.
"""

import math
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from graphslam.core.geometry import Array, compose, inverse
from graphslam.simulation import Scenario, load_scenario, simulate
from graphslam.simulation.scenario import (
    Body,
    Box,
    Cylinder,
    Door,
    Encoders,
    Leg,
    Point,
    Robot,
    SightingSensor,
    StaticObjects,
    Wall,
)

#: corners of the outer ring of scenario office-loop, where its vehicle starts, m
RING_M = ((6.9, 6.1), (33.1, 6.1), (33.1, 17.9), (6.9, 17.9))


def simulated(scenario: Scenario, name: str, folder: Path) -> Path:
    """The log of a scenario under a name of its own in the folder; simulated once."""
    log = folder / f"{name}.mcap"
    if not log.exists():
        simulate(scenario, log)
    return log


def rings(laps: int) -> Scenario:
    """Scenario office-loop with nothing but rounds of the outer ring, 76 m each."""
    office = load_scenario("office-loop")
    rounds = Leg(through_m=_rounds(RING_M, laps))
    vehicle = replace(office.robots["vehicle"], drive=(rounds,))
    return replace(office, robots={"vehicle": vehicle})


def _rounds(corners: tuple[Point, ...], count: int) -> tuple[Point, ...]:
    """Points through which rounds of a polygon lead, from its first corner."""
    return (corners[1:] + corners[:1]) * count


def _rectangle(x0: float, y0: float, x1: float, y1: float) -> tuple[Point, ...]:
    """Its corners, counter-clockwise."""
    return (x0, y0), (x1, y0), (x1, y1), (x0, y1)


# ---------------------------------------------------------------- a building

#: blocks of rooms between corridors, along x and y; their pitch and the corridors' width, m
BLOCKS, PITCH_M, CORRIDOR_M = (4, 3), (20.0, 14.0), 2.2
DOOR_M, NICHE_M = 0.9, 0.1
#: m: depth of the rooms between the outermost corridors and the facade
OUTER_M = 4.5
#: of the doors, those that are open; of the rooms, those with a desk; of the walls, a cabinet
OPEN_SHARE, DESK_SHARE, CABINET_SHARE = 0.3, 0.7, 0.2

Thing = Wall | Box | Door


def building(
    path_m: float = 2000.0, period_s: float = 0.205, seed: int = 1, pitch_m: Point = PITCH_M
) -> Scenario:
    """A floor of 12 blocks of rooms with 20 crossings, 530 m of corridors, and a drive along them.

    At each crossing the vehicle goes where it has been least, so that rings are closed early and
    all corridors are driven several times. With the defaults there are 17 500 scans.
    """
    rng = np.random.default_rng(seed)
    vehicle = load_scenario("office-loop").robots["vehicle"]
    assert vehicle.laser is not None
    vehicle = replace(
        vehicle,
        start_m=crossing((0, 0), pitch_m),
        drive=(Leg(through_m=tuple(tour(path_m, rng, pitch_m))),),
        laser=replace(vehicle.laser, period_s=period_s),
    )
    return Scenario({"vehicle": vehicle}, _floor(rng, pitch_m), name="building")


def crossing(at: tuple[int, int], pitch_m: Point) -> Point:
    """Where corridors cross, by column and row, m."""
    return at[0] * pitch_m[0], at[1] * pitch_m[1]


def tour(path_m: float, rng: np.random.Generator, pitch_m: Point) -> Iterator[Point]:
    """Crossings at which the drive turns, and its last one."""
    driven: Counter[frozenset[tuple[int, int]]] = Counter()
    before, here, length = (-1, 0), (0, 0), 0.0
    while length < path_m:
        x, y = here
        ways = [
            (i, j)
            for i, j in ((x + 1, y), (x, y + 1), (x - 1, y), (x, y - 1))
            if (i, j) != before and 0 <= i <= BLOCKS[0] and 0 <= j <= BLOCKS[1]
        ]
        fewest = min(driven[frozenset((here, way))] for way in ways)
        ways = [way for way in ways if driven[frozenset((here, way))] == fewest]
        after = ways[rng.integers(len(ways))]
        if (before[0] == x) != (x == after[0]):
            yield crossing(here, pitch_m)
        driven[frozenset((here, after))] += 1
        length += math.dist(crossing(here, pitch_m), crossing(after, pitch_m))
        before, here = here, after
    yield crossing(here, pitch_m)


def _floor(rng: np.random.Generator, pitch_m: Point) -> StaticObjects:
    """Blocks of rooms, rooms around all corridors, and the facade."""
    half = CORRIDOR_M / 2
    (right, top), outer = crossing(BLOCKS, pitch_m), half + OUTER_M
    facade = _rectangle(-outer, -outer, right + outer, top + outer)
    things: list[Thing] = [Wall("facade", facade, closed=True)]
    for column, row in np.ndindex(*BLOCKS):
        x0, y0 = crossing((column, row), pitch_m)
        x1, y1 = crossing((column + 1, row + 1), pitch_m)
        name, y = f"block {column}.{row}", (y0 + y1) / 2
        corners = _rectangle(x0 + half, y0 + half, x1 - half, y1 - half)
        things += _rooms(name, corners, y - y0 - half, rng)
        things.append(Wall(f"{name} middle", ((x0 + half, y), (x1 - half, y)), may_cross=True))
    # clockwise, since there the rooms are outside
    around = _rectangle(-half, -half, right + half, top + half)[::-1]
    things += _rooms("outside", around, OUTER_M, rng)
    return StaticObjects(
        walls=tuple(thing for thing in things if isinstance(thing, Wall)),
        boxes=tuple(thing for thing in things if isinstance(thing, Box)),
        doors=tuple(thing for thing in things if isinstance(thing, Door)),
    )


def _rooms(
    name: str, corners: tuple[Point, ...], depth_m: float, rng: np.random.Generator
) -> Iterator[Thing]:
    """Rooms on the left of a polygon's sides, a door each and a partition between two."""
    for side, (start, end) in enumerate(pairwise((*corners, corners[0]))):
        length = math.dist(start, end)
        heading = math.atan2(end[1] - start[1], end[0] - start[0])
        frame = np.array([*start, heading])

        def at(along: float, depth: float, frame: Array = frame) -> Point:
            x, y, _ = compose(frame, np.array([along, depth, 0.0])).tolist()
            return x, y

        begin = 0.0
        while begin < length:
            door = begin + rng.uniform(2.0, 5.0)
            last, label = door + DOOR_M > length - 1.5, f"{name} side {side} at {begin:.1f} m"
            door, middle = length if last else door, (begin + door) / 2
            wall = [at(begin, 0.0), at(door, 0.0)]
            wall = [at(begin, NICHE_M), *wall] if begin else wall
            yield Wall(label, (*wall, *([] if last else [at(door, NICHE_M)])), may_cross=True)
            if begin:
                partition = (at(middle, 0.0), at(middle, depth_m))
                yield Wall(f"{label} partition", partition, may_cross=True)
            if rng.random() < CABINET_SHARE:
                yield _box(f"{label} cabinet", at(middle, -0.2), (1.0, 0.4), heading)
            if not last:
                opening_deg = rng.uniform(70.0, 88.0) if rng.random() < OPEN_SHARE else 0.0
                yield Door(
                    f"{label} door", at(door, NICHE_M), DOOR_M, math.degrees(heading), opening_deg,
                    may_cross=True,
                )  # fmt: skip
                if rng.random() < DESK_SHARE:
                    place = at(door + rng.uniform(-0.5, 1.4), depth_m * rng.uniform(0.6, 0.9))
                    size = rng.uniform(0.8, 1.8), rng.uniform(0.4, 0.8)
                    yield _box(f"{label} desk", place, size, heading + rng.uniform(0.0, 0.3))
            begin = door + DOOR_M


def _box(name: str, center: Point, size: Point, angle_rad: float) -> Box:
    return Box(name, center, size, math.degrees(angle_rad), may_cross=True)


# ---------------------------------------------------------------- five robots

#: m: lower left corner of the rectangle that each robot drives round, and its size
FLEET_M = {"alpha": (1.0, 1.0), "bravo": (7.0, 1.0), "charlie": (13.0, 1.0), "delta": (4.0, 6.5),
           "echo": (10.0, 6.5)}  # fmt: skip
ROUND_M = (4.0, 3.5)
POSTS = 15


def robots(rounds: int) -> Scenario:
    """Five robots among 15 posts that see posts and each other by name; without lasers."""
    posts = tuple(
        Cylinder(f"post {k}", (0.4 + 1.2 * k, (0.3, 5.5, 10.7)[k % 3]), 0.08) for k in range(POSTS)
    )
    sensors = tuple(
        SightingSensor(of, field_deg=90.0, range_sigma_m=0.04, bearing_sigma_deg=1.0)
        for of in ("landmarks", "robots")
    )
    fleet = {
        name: Robot(
            (x, y),
            drive=(Leg(_rounds(_rectangle(x, y, x + ROUND_M[0], y + ROUND_M[1]), rounds)),),
            body=Body(radius_m=0.2),
            speed_m_s=0.25 + 0.01 * number,
            corner_m=1.0,
            encoders=Encoders(
                axle_m=0.3, radius_error_left=0.004, radius_error_right=-0.003, slip_m=0.004
            ),
            sightings=sensors,
        )
        for number, (name, (x, y)) in enumerate(FLEET_M.items())
    }
    return Scenario(fleet, StaticObjects(cylinders=posts), name="robots")


# ---------------------------------------------------------------- a pose graph

#: of the steps and closures of the pose graph, m and rad
GRAPH_SIGMAS = np.array([0.03, 0.03, 0.015])
#: side of the square that the walk keeps to, m, and the share of steps before which it turns
GRAPH_SIDE_M, TURN_SHARE = 50, 0.3


def grid_pose_graph(poses: int = 3500, seed: int = 1) -> str:
    """A walk over a square grid, with edges to poses at the same place, in g2o's text format.

    Like Olson's Manhattan world of 3500 poses (M3500): steps of 1 m, turns of 90°, and closures
    with the last two poses at a place that were there at least 20 steps ago.
    """
    rng = np.random.default_rng(seed)
    path = np.array(list(_grid_walk(poses, rng)))
    pairs = [(k, k + 1) for k in range(poses - 1)]
    visits: dict[tuple[int, int], list[int]] = defaultdict(list)
    for k, (x, y, _) in enumerate(path.round().astype(int).tolist()):
        pairs += [(past, k) for past in visits[x, y][-2:] if k - past >= 20]
        visits[x, y].append(k)
    delta = compose(inverse(path[[a for a, _ in pairs]]), path[[b for _, b in pairs]])
    measured = delta + GRAPH_SIGMAS * rng.normal(size=delta.shape)
    i, k = GRAPH_SIGMAS[0] ** -2, GRAPH_SIGMAS[2] ** -2
    guess = [np.zeros(3)]
    for step in measured[: poses - 1]:
        guess.append(compose(guess[-1], step))
    lines = [
        f"VERTEX_SE2 {k} {x} {y} {phi}" for k, (x, y, phi) in enumerate(np.array(guess).tolist())
    ]
    lines += [
        f"EDGE_SE2 {a} {b} {x} {y} {phi} {i} 0 0 {i} 0 {k}"
        for (a, b), (x, y, phi) in zip(pairs, measured.tolist(), strict=True)
    ]
    return "\n".join(lines) + "\n"


def _grid_walk(poses: int, rng: np.random.Generator) -> Iterator[tuple[float, ...]]:
    """Poses at the points of the grid, each heading to the next."""
    at, heading = np.zeros(2, int), 0
    for _ in range(poses):
        if rng.random() < TURN_SHARE:
            heading += rng.choice((-1, 1))
        steps = [(1, 0), (0, 1), (-1, 0), (0, -1)]
        while not (
            (at + steps[heading % 4] >= 0) & (at + steps[heading % 4] <= GRAPH_SIDE_M)
        ).all():
            heading += 1
        yield (*at.tolist(), heading % 4 * np.pi / 2)
        at = at + steps[heading % 4]
