"""Robots that do not know where the others are: which of them are joined, and to whom.

`relating` says of any two where one began in the frame of the other.

1. Robots are joined to what has a place, by all relations to it that agree.
2. Whatever is not joined keeps a frame of its own.
"""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np

from graphslam.core.config import AssociationConfig
from graphslam.core.consistency import has_rival, poses_differ
from graphslam.core.frame_forest import PRIOR_INFLATION, grow_frame_forest
from graphslam.core.geometry import compose, compose_cov
from graphslam.core.records import Sighting, Start
from graphslam.multi_robot.relative_frames import (
    RelativeFrame,
    RobotEstimate,
    estimate_relative_frame,
)


@dataclass(frozen=True, slots=True, eq=False)
class FrameAssignment:
    """Where robots start, and in whose frame each is: the robot at whose start the frame hangs.

    ``world`` is the one whose frame is the world's. ``found``: robot -> the relation that it was
    placed by. ``undecided``: robot -> why it has a frame of its own although something connects it
    with others.
    """

    starts: Mapping[str, Start]
    frames: Mapping[str, str]
    world: str
    found: Mapping[str, RelativeFrame] = field(default_factory=dict)
    undecided: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def one_frame(cls, starts: Mapping[str, Start]) -> "FrameAssignment":
        """All robots in one frame, the starts of all of them given."""
        world = min(starts, default="")
        return cls(starts, dict.fromkeys(starts, world), world)

    @classmethod
    def separate_frames(cls, robots: Iterable[str], origin: Start) -> "FrameAssignment":
        """Every robot in a frame of its own, at whose ``origin`` it starts."""
        frames = {robot: robot for robot in robots}
        return cls(dict.fromkeys(frames, origin), frames, min(frames, default=""))

    def to_summary(self) -> dict[str, dict[str, Any]]:
        """For summary.json: robot -> the start that was found, and from what."""
        told = {}
        for robot, relation in sorted(self.found.items()):
            x, y, phi = self.starts[robot].pose.tolist()
            sigmas = np.sqrt(np.diag(self.starts[robot].cov)) / PRIOR_INFLATION
            told[robot] = {
                "x": x,
                "y": y,
                "phi": phi,
                "sigma_m": float(np.hypot(sigmas[0], sigmas[1]) / np.sqrt(2)),
                "sigma_rad": float(sigmas[2]),
                "seen_with": relation.other,
                "evidence": relation.weight,
            }
        return told


def build_frame_tree(
    robots: Sequence[str],
    views: Mapping[str, RobotEstimate],
    meetings: Sequence[Sighting],
    starts: Mapping[str, Start],
    config: AssociationConfig,
    origin: Start,
    more: Sequence[RelativeFrame] = (),
    doubts: Mapping[str, str] = MappingProxyType({}),
) -> FrameAssignment:
    """Put robots whose start is unknown where what they saw in common has them.

    Args:
        robots: all of them.
        views: what each knows by itself, of those that know anything.
        meetings: all sightings of robots by robots.
        starts: of the robots whose start is known, at least one.
        config: floors of what is seen.
        origin: start of what has a frame of its own.
        more: relations that were found in other ways.
        doubts: robot -> why those ways do not say where it was.
    """
    names = sorted(views)
    by_pair: dict[tuple[str, str], list[Sighting]] = defaultdict(list)
    for s in meetings:
        by_pair[min(s.robot, str(s.seen_robot)), max(s.robot, str(s.seen_robot))].append(s)
    relations = [way for found in more for way in (found, found.reversed())]
    undecided = dict(doubts)
    for n, a in enumerate(names):
        for b in names[n + 1 :]:
            if a in starts and b in starts:
                continue
            found = estimate_relative_frame(a, b, views, by_pair[a, b], config)
            if isinstance(found, RelativeFrame):
                relations += [found, found.reversed()]
            elif found:
                undecided |= dict.fromkeys((a, b), found)
    world = min(starts, default="")
    by: dict[str, RelativeFrame] = {}

    def next_edge(placed: Mapping[str, Start]) -> tuple[str, str, Start] | None:
        free = [name for name in robots if name not in placed]
        edges = [
            edge
            for name in free
            if (edge := _strongest_relation(name, relations, placed, undecided)) is not None
        ]
        if not edges:
            return None
        relation, start = max(edges, key=lambda edge: edge[0].weight)
        by[relation.robot] = relation
        return relation.robot, relation.other, start

    placed, frames = grow_frame_forest(robots, starts, world, origin, next_edge)
    wide = {
        name: Start(start.pose, PRIOR_INFLATION**2 * start.cov) if name in by else start
        for name, start in placed.items()
    }
    alone = {name: why for name, why in undecided.items() if frames[name] == name != world}
    return FrameAssignment(wide, frames, world, by, alone)


def _strongest_relation(
    name: str,
    relations: Sequence[RelativeFrame],
    placed: Mapping[str, Start],
    undecided: dict[str, str],
) -> tuple[RelativeFrame, Start] | None:
    """The relation that places a robot best, if those to robots with a place do not contradict.

    Returns:
        The relation, its weight that of all that agree with it, and the start that it gives.
    """
    ways = []
    for r in relations:
        if r.robot == name and r.other in placed:
            at = placed[r.other]
            cov = compose_cov(at.pose, at.cov, r.pose, r.cov)
            ways.append((r, Start(compose(at.pose, r.pose), cov)))
    if not ways:
        return None
    support = [
        sum(r.weight for r, s in ways if not poses_differ(s.pose, s.cov, start.pose, start.cov))
        for _, start in ways
    ]
    k = max(range(len(ways)), key=lambda n: (support[n], ways[n][0].weight))
    whole = sum(r.weight for r, _ in ways)
    if has_rival(support[k], [whole - support[k]]):
        others = ", ".join(r.other for r, _ in ways)
        undecided[name] = f"what {name} has in common with {others} contradicts itself"
        return None
    r, start = ways[k]
    return RelativeFrame(name, r.other, r.pose, r.cov, support[k]), start
