"""Start poses and frames of robots whose start is unknown, from relative poses of two at a time.

1. A robot is placed relative to placed robots, by all relations to them that agree.
2. Robots without relation to a placed robot get a separate frame.
"""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from types import MappingProxyType
from typing import Any

import numpy as np

from graphslam.core.config import Config
from graphslam.core.consistency import has_rival, poses_differ
from graphslam.core.frame_forest import PRIOR_INFLATION, grow_frame_forest
from graphslam.core.geometry import Array, compose, compose_cov
from graphslam.core.records import Sighting, Start
from graphslam.core.worker import parallel_map
from graphslam.multi_robot.relative_frames import (
    MAX_HEADING_SIGMA_RAD,
    RelativeFrame,
    RobotEstimate,
    estimate_relative_frame,
)

#: ms that a sighting of one robot by another takes for the relation of the two
SIGHTING_MS = 0.15


@dataclass(frozen=True, slots=True, eq=False)
class FrameAssignment:
    """Start pose of every robot, and its frame, named after the robot that begins at its origin.

    ``world`` is the frame of the world. ``found``: robot -> the relation by which it was placed,
    with the covariance of all that it hangs on. ``undecided``: robot -> why it has a separate frame
    although it shares observations with others. ``remarks``: robot -> what is to be known about
    where it was placed. ``better``: robot whose start was told -> base pose (3,) in its frame at
    which it would begin if it were where its log fits a map clearly better.
    """

    starts: Mapping[str, Start]
    frames: Mapping[str, str]
    world: str
    found: Mapping[str, RelativeFrame] = field(default_factory=dict)
    undecided: Mapping[str, str] = field(default_factory=dict)
    remarks: Mapping[str, str] = field(default_factory=dict)
    better: Mapping[str, Array] = field(default_factory=dict)

    @classmethod
    def one_frame(cls, starts: Mapping[str, Start]) -> "FrameAssignment":
        """All robots in one frame, the starts of all of them given."""
        world = min(starts, default="")
        return cls(starts, dict.fromkeys(starts, world), world)

    @classmethod
    def separate_frames(cls, robots: Iterable[str], origin: Start) -> "FrameAssignment":
        """Every robot at the ``origin`` of a separate frame."""
        frames = {robot: robot for robot in robots}
        return cls(dict.fromkeys(frames, origin), frames, min(frames, default=""))

    def to_summary(self) -> dict[str, dict[str, Any]]:
        """For summary.json: robot -> the start that was found, and from what."""
        summary = {}
        for robot, relation in sorted(self.found.items()):
            x, y, phi = self.starts[robot].pose.tolist()
            sigmas = np.sqrt(np.diag(relation.cov))
            summary[robot] = {
                "x": x,
                "y": y,
                "phi": phi,
                "sigma_m": float(np.hypot(sigmas[0], sigmas[1]) / np.sqrt(2)),
                "sigma_rad": float(sigmas[2]),
                "seen_with": relation.other,
                "evidence": relation.weight,
            }
        return summary

    def better_to_summary(self) -> dict[str, dict[str, float]]:
        """For summary.json: robot -> the start at which it would fit clearly better."""
        return {
            robot: dict(zip(("x", "y", "phi"), pose.tolist(), strict=True))
            for robot, pose in sorted(self.better.items())
        }


def build_frame_tree(
    robots: Sequence[str],
    estimates: Mapping[str, RobotEstimate],
    sightings: Sequence[Sighting],
    starts: Mapping[str, Start],
    config: Config,
    origin: Start,
    more: Sequence[RelativeFrame] = (),
    doubts: Mapping[str, str] = MappingProxyType({}),
    *,
    nobody_told: bool = False,
) -> FrameAssignment:
    """Place robots whose start is unknown relative to the others, by what they saw in common.

    Args:
        robots: all of them.
        estimates: of each robot by itself, of those that have any.
        sightings: all sightings of robots by robots.
        starts: of the robots whose start is known, at least one.
        config: settings.
        origin: start of a robot in a separate frame.
        more: relations that were found in other ways.
        doubts: robot -> why those ways do not determine its start.
        nobody_told: ``starts`` is one robot at the origin because none was given. If it only stands
            and is seen, the world begins at the robot that sees it most instead.
    """
    by_pair: dict[tuple[str, str], list[Sighting]] = defaultdict(list)
    for s in sightings:
        by_pair[min(s.robot, str(s.seen_robot)), max(s.robot, str(s.seen_robot))].append(s)
    times_ns: dict[str, list[int]] = defaultdict(list)
    for pair, seen in by_pair.items():
        for name in pair:
            times_ns[name] += [s.time_ns for s in seen]
    relations = [either for relation in more for either in (relation, relation.reversed())]
    undecided = dict(doubts)
    pairs = [pair for pair in combinations(sorted(estimates), 2) if not {*pair} <= set(starts)]

    known = {
        name: own.known_at(np.unique(times_ns[name])) if name in times_ns else own
        for name, own in estimates.items()
    }

    def relate(pair: tuple[str, str]) -> RelativeFrame | str:
        # the start of one that sees nothing may be known in the other's frame alone
        a, b = sorted(pair, key=lambda name: not known[name].sees)
        return estimate_relative_frame(a, b, known, by_pair[pair], config)

    efforts = [1.0 + len(by_pair[pair]) for pair in pairs]
    related = parallel_map(relate, pairs, efforts=efforts, unit_ms=SIGHTING_MS)
    for pair, relation in zip(pairs, related, strict=True):
        if isinstance(relation, RelativeFrame):
            relations.append(relation)
            if not _is_turned_anyhow(relation, known):
                relations.append(relation.reversed())
        elif relation:
            undecided |= dict.fromkeys(pair, relation)
    if nobody_told:
        turned = [r for r in relations if r.robot in starts and _is_turned_anyhow(r, known)]
        if turned:
            starts = {max(turned, key=lambda r: r.weight).other: origin}
    world = min(starts, default="")
    found: dict[str, RelativeFrame] = {}

    def next_edge(placed: Mapping[str, Start]) -> tuple[str, str, Start] | None:
        edges = [
            edge
            for name in robots
            if name not in placed
            and (edge := _strongest_relation(name, relations, placed, undecided)) is not None
        ]
        if not edges:
            return None
        relation, start = max(edges, key=lambda edge: edge[0].weight)
        found[relation.robot] = relation
        return relation.robot, relation.other, start

    placed, frames = grow_frame_forest(robots, starts, world, origin, next_edge)
    priors = {
        name: Start(start.pose, _inflated(start.cov, _is_turned_anyhow(found[name], known)))
        if name in found
        else start
        for name, start in placed.items()
    }
    alone = {name: why for name, why in undecided.items() if frames[name] == name != world}
    remarks = {
        name: "where it is is known by those that see it; its heading is not, as it stands and "
        "sees nothing"
        for name, relation in found.items()
        if _is_turned_anyhow(relation, known)
    }
    found = {name: replace(relation, cov=placed[name].cov) for name, relation in found.items()}
    return FrameAssignment(priors, frames, world, found, alone, remarks)


def _inflated(cov: Array, is_turned_anyhow: bool) -> Array:
    """Covariance (3, 3) of a start with larger sigmas, as its measurements enter again.

    A heading of which nothing is known was not measured.
    """
    factors = np.array(
        [PRIOR_INFLATION, PRIOR_INFLATION, 1.0 if is_turned_anyhow else PRIOR_INFLATION]
    )
    return np.asarray(factors[:, None] * cov * factors)


def _is_turned_anyhow(relation: RelativeFrame, known: Mapping[str, RobotEstimate]) -> bool:
    """Whether a relation places a robot that sees nothing, but leaves its heading open."""
    name = relation.robot
    is_unsure = relation.cov[2, 2] > MAX_HEADING_SIGMA_RAD**2
    return is_unsure and name in known and not known[name].sees


def _strongest_relation(
    name: str,
    relations: Sequence[RelativeFrame],
    placed: Mapping[str, Start],
    undecided: dict[str, str],
) -> tuple[RelativeFrame, Start] | None:
    """The best supported relation of a robot to placed ones, unless too much contradicts it.

    Returns:
        The relation, its weight that of all that agree with it, and the start that it gives.
    """
    edges = []
    for r in relations:
        if r.robot == name and r.other in placed:
            at = placed[r.other]
            cov = compose_cov(at.pose, at.cov, r.pose, r.cov)
            edges.append((r, Start(compose(at.pose, r.pose), cov)))
    if not edges:
        return None
    support = [
        sum(r.weight for r, s in edges if not poses_differ(s.pose, s.cov, start.pose, start.cov))
        for _, start in edges
    ]
    k = max(range(len(edges)), key=lambda n: (support[n], edges[n][0].weight))
    if has_rival(support[k], [sum(r.weight for r, _ in edges) - support[k]]):
        others = ", ".join(r.other for r, _ in edges)
        undecided[name] = f"what {name} has in common with {others} contradicts itself"
        return None
    r, start = edges[k]
    return RelativeFrame(name, r.other, r.pose, r.cov, support[k]), start
