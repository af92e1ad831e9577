"""Robots placed one by one relative to those that have a pose: a spanning forest of frames."""

from collections.abc import Callable, Mapping, Sequence
from typing import TypeVar

Place = TypeVar("Place")

#: the prior of a robot that was placed by relations has sigmas this many times as large as they
#: give: the same measurements enter the estimate again
PRIOR_INFLATION = 10.0


def grow_frame_forest(
    robots: Sequence[str],
    starts: Mapping[str, Place],
    world: str,
    origin: Place,
    next_edge: Callable[[Mapping[str, Place]], tuple[str, str, Place] | None],
) -> tuple[dict[str, Place], dict[str, str]]:
    """Place every robot: along the best relation to a placed robot, else in a separate frame.

    Args:
        robots: all of them; where no relation is left, the next in this order begins a frame.
        starts: where robots are whose start is known, all in frame ``world``.
        world: name of their frame.
        origin: start pose of a robot in a separate frame.
        next_edge: the best relation to the robots placed so far: the new robot, the placed one, and
            where the new one then is; None if there is none.

    Returns:
        Robot -> its place, in the order of placing; robot -> the robot at whose start its frame is.
    """
    placed, frames = dict(starts), dict.fromkeys(starts, world)
    while len(placed) < len({*robots, *starts}):
        edge = next_edge(placed)
        if edge is None:
            robot = next(robot for robot in robots if robot not in placed)
            placed[robot], frames[robot] = origin, robot
        else:
            robot, parent, place = edge
            placed[robot], frames[robot] = place, frames[parent]
    return placed, frames
