"""Data association of one image (scan or set of sightings) at a time, and landmark life cycle.

An observation is associated with, in this order: the landmark of its identity; another robot or a
landmark of the graph that was seen recently, whichever is nearest; landmarks not seen for long,
only if enough of them are jointly compatible (a loop closure); a tentative landmark; a new one.
Else it is rejected, with the reason.
"""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from graphslam.core.arrays import BoolArray
from graphslam.core.config import AssociationConfig
from graphslam.core.geometry import Array, compose, rotate_cov
from graphslam.core.records import Association, Motion, Observation
from graphslam.estimation.backend import Backend, JointMarginal
from graphslam.mapping.gating import (
    PairDistances,
    Pairs,
    candidate_pairs,
    compare,
    fixes_pose,
    flip,
    gate_distance,
    gate_floor,
    jointly_compatible,
)
from graphslam.mapping.landmark_index import reach
from graphslam.mapping.landmark_map import Entry, LandmarkMap, means_and_extents
from graphslam.mapping.pair_selection import assign_pairs, known_alone, worth_comparing
from graphslam.mapping.robot_candidates import (
    NOT_THERE,
    RobotTarget,
    predicted_joint,
    robot_associations,
    robot_distances,
)
from graphslam.mapping.wall_parts import conflicting_observations
from graphslam.odometry.preintegration import Track

#: images between two refreshes of all landmark estimates; those compared are always current
REFRESH_EVERY = 50


@dataclass(frozen=True, eq=False)
class Image:
    """One image to associate: the observations ``seen`` in the robot's base frame at one state.

    ``time_ns`` is the time of that state. ``pose`` (3,) estimates the robot's latest state in the
    back end, and ``motion`` leads from there to this one; None if it is it. ``path_m`` is how far
    the robot has driven. ``gathering``: more images follow before the back end takes the step (and
    `Associator.settle` is called). Innovations of sightings with an identity, which need the
    expensive joint marginal, are not recorded then. ``robots``: those that `Observation.robots`
    names and that have a state.
    """

    robot: str
    time_ns: int
    seen: Sequence[Observation]
    pose: Array
    motion: Motion | None
    track: Track
    path_m: float
    gathering: bool = False
    robots: Sequence[RobotTarget] = ()

    @property
    def parts(self) -> list["Image"]:
        """What can be associated one after the other: landmarks, and robots.

        If something may be of either, the two exclude each other and are one part.
        """
        robots = [o for o in self.seen if not o.is_landmark]
        either = any(o.is_landmark and o.robots for o in self.seen)
        if either or not robots:
            return [self]
        landmarks = [o for o in self.seen if o.is_landmark]
        parts = [replace(self, seen=robots)]
        return [replace(self, seen=landmarks, robots=()), *parts] if landmarks else parts

    @cached_property
    def predicted(self) -> Array:
        """Predicted pose (3,) at the image."""
        return self.pose if self.motion is None else compose(self.pose, self.motion.delta)


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """Candidate pairs of an image's observations with landmarks.

    ``entries`` (k) is the landmark of each pair, ``recent`` (k,) whether this robot saw it lately;
    ``joint`` is over the predicted pose, the graph's landmarks among them, ``where[id]`` their
    place in it, and the image's robots. ``robot_pairs`` are with these, ``robots_compared`` their
    distances.
    """

    joint: JointMarginal
    where: dict[int, int]
    pairs: Pairs
    compared: PairDistances
    recent: BoolArray
    entries: tuple[Entry, ...]
    robot_pairs: Pairs
    robots_compared: PairDistances


class Associator:
    """Keeps the landmark map and decides where each observation belongs."""

    def __init__(
        self,
        config: AssociationConfig,
        backend: Backend,
        landmarks: LandmarkMap | None = None,
    ) -> None:
        """``landmarks``: the map, empty; another one by default."""
        self.map = LandmarkMap() if landmarks is None else landmarks
        self.rejected: Counter[str] = Counter()
        self.closures = 0
        self.innovations: dict[str, list[tuple[int, float]]] = {}
        self._config, self._backend = config, backend
        self._images = 0
        self._unsettled: set[int] = set()  # admitted, but not yet in the back end
        self._admitted: set[int] = set()  # see `take_admitted`
        self._deleted: list[int] = []  # of the graph, see `take_deleted`
        self._floor = gate_floor(config)

    def associate(self, image: Image) -> tuple[Association, ...]:
        """What is to enter the graph of an image.

        It includes earlier sightings of landmarks that this image promotes (marked late). Other
        robots come behind landmarks where the two are told apart.
        """
        config = self._config
        if self._images % REFRESH_EVERY == 0:
            ids = [i for i in self.map.graph_ids() if i not in self._unsettled]
            self.map.refresh(self._backend, ids)
        self._images += 1
        age_ns = round(config.tentative_s * 1e9)
        self.map.expire(image.time_ns, image.robot, image.path_m, age_ns, config.tentative_m)
        if math.isfinite(config.delete_s):
            self._deleted += self.map.expire_unseen(image.time_ns, 1e9 * config.delete_s)
        associations: tuple[Association, ...] = ()
        for part in image.parts:
            if part.gathering and all(map(self._has_identity, part.seen)):
                associations += self._associate_identified(part)
                continue
            candidates = self._candidates(part)
            associations += self._apply(part, candidates, *self._choose(part, candidates))
        if not image.gathering:
            self.settle()
        return associations

    def _associate_identified(self, image: Image) -> tuple[Association, ...]:
        """Associations of an image in which every observation has an identity."""
        out: list[Association] = []
        for o in image.seen:
            entry = self._named(o)
            if entry is None:
                entry = self.map.add(o, image.predicted, image.time_ns)
            elif (entry.kind == "point") != (o.kind == "point"):
                self.rejected["identity: known as a landmark of another kind"] += 1
                continue
            out += self._record(image, entry, o.kind, o, True)
        return tuple(out)

    def take_deleted(self) -> tuple[int, ...]:
        """The landmarks of the graph that were deleted since the last call."""
        deleted, self._deleted = tuple(self._deleted), []
        return deleted

    def take_admitted(self) -> set[int]:
        """The landmarks that entered the graph since the last call."""
        admitted, self._admitted = self._admitted, set()
        return admitted

    def settle(self) -> None:
        """Record that the back end has taken the step of all associations so far."""
        self._unsettled.clear()

    def _candidates(self, image: Image) -> Candidates:
        """Candidate pairs of an image and their distances."""
        seen = image.seen
        free = [n for n, o in enumerate(seen) if o.is_landmark and not self._has_identity(o)]
        unnamed, near = [seen[n] for n in free], list[Entry]()
        if free:
            near = self.map.near(reach(unnamed, image.predicted, self._config))
        pairs = candidate_pairs(
            unnamed,
            image.predicted,
            *means_and_extents(near),
            np.array([e.kind == "point" for e in near], dtype=bool),
            np.array([e.kind == "segment" for e in near], dtype=bool),
            self._config,
        )
        entries = [near[j] for j in pairs.landmark]
        last_m = np.array([e.path_m.get(image.robot, -np.inf) for e in entries])
        recent = image.path_m - last_m <= self._config.reacquire_m
        keep = worth_comparing(pairs, entries, recent, self._config.reacquire_min)
        pairs, recent, seen_before = pairs.only(keep), recent[keep], np.isfinite(last_m[keep])
        entries = [e for e, k in zip(entries, keep, strict=True) if k]
        # observations with an identity bring their pair along, ungated
        known = [
            (n, entry)
            for n, o in enumerate(seen)
            if (entry := self._named(o)) and (entry.kind == "point") == (o.kind == "point")
        ]
        pairs = Pairs(
            np.array([free[i] for i in pairs.observation] + [n for n, _ in known], dtype=np.int64),
            np.array([e.id for e in entries] + [e.id for _, e in known], dtype=np.int64),
            pairs.model + tuple(seen[n].kind for n, _ in known),
            np.append(pairs.flipped, np.zeros(len(known), dtype=bool)),
            np.append(pairs.rough_distance, np.zeros(len(known))),
        )
        entries += [e for _, e in known]
        recent = np.append(recent, np.ones(len(known), dtype=bool))
        wanted = entries[: len(entries) - len(known)] if image.gathering else entries
        graph_ids = sorted({e.id for e in wanted if e.in_graph and e.id not in self._unsettled})
        where = {landmark: n for n, landmark in enumerate(graph_ids)}
        joint = predicted_joint(
            self._backend.joint(image.robot, graph_ids, [robot.name for robot in image.robots]),
            image.motion,
            image.robots,
        )
        compared = self._compare(image, pairs, entries, joint, where)
        # named ones are recent
        mine = np.append(seen_before, np.zeros(len(known), dtype=bool))
        mine &= np.array([e.id in where for e in entries], dtype=bool)
        recent |= mine & known_alone(pairs, compared)
        of_robots = robot_distances(seen, image.robots, joint, self._floor)
        return Candidates(joint, where, pairs, compared, recent, tuple(entries), *of_robots)

    def _has_identity(self, o: Observation) -> bool:
        return o.identity is not None and self._config.identities == "use"

    def _named(self, o: Observation) -> Entry | None:
        """The landmark with the observation's identity."""
        if not self._has_identity(o) or o.identity not in self.map.by_identity:
            return None
        return self.map.entries[self.map.by_identity[str(o.identity)]]

    def _compare(
        self,
        image: Image,
        pairs: Pairs,
        entries: Sequence[Entry],
        joint: JointMarginal,
        where: dict[int, int],
    ) -> PairDistances:
        """Distances of all candidate pairs.

        A tentative landmark is known relative to the robot that saw it, so its distance has the
        covariance of its own measurement and of the motion since, not that of the robot's pose.
        """
        k, motion = len(entries), image.motion
        P_xx, P_xt, P_tt = (np.zeros((k, 3, 3)) for _ in range(3))
        states = np.zeros((k, 3))
        since: dict[int, Array] = {}
        if motion is not None:
            since[motion.start_ns] = rotate_cov(motion.cov, joint.pose[2] - motion.delta[2])
        for n, entry in enumerate(entries):
            if entry.id in where:
                block = joint.slices[where[entry.id]]
                size = block.stop - block.start
                states[n, :size] = joint.landmarks[where[entry.id]]
                P_xx[n] = joint.cov[:3, :3]
                P_xt[n, :, :size] = joint.cov[:3, block]
                P_tt[n, :size, :size] = joint.cov[block, block]
            else:
                if entry.last_ns not in since:
                    moved = image.track.motion(entry.last_ns, image.time_ns)
                    start_heading = joint.pose[2] - moved.delta[2]
                    since[entry.last_ns] = rotate_cov(moved.cov, start_heading)
                states[n], P_xx[n], P_tt[n] = entry.mean, since[entry.last_ns], entry.cov
        return compare(image.seen, pairs, joint.pose, states, P_xx, P_xt, P_tt, self._floor)

    def _choose(
        self, image: Image, candidates: Candidates
    ) -> tuple[dict[int, int], dict[int, int]]:
        """Observation -> pair with a landmark, and observation -> pair with a robot."""
        config, pairs, compared = self._config, candidates.pairs, candidates.compared
        entries = candidates.entries
        known = np.array([self._has_identity(image.seen[i]) for i in pairs.observation], dtype=bool)
        in_graph = np.array([e.in_graph for e in entries], dtype=bool)
        every = pairs.joined(candidates.robot_pairs)
        d2 = np.append(compared.d2, candidates.robots_compared.d2)
        dof = np.append(compared.dof, candidates.robots_compared.dof)
        gate = gate_distance(config.gate_probability, np.maximum(dof, 1))

        def best(which: BoolArray, *, robots: bool = False) -> dict[int, int]:
            use = np.append(which, np.full(len(d2) - len(which), robots))
            return assign_pairs(every, d2, gate, use, len(image.seen), config)

        # observations of one image exclude each other: landmarks with an identity are taken
        free = ~known & ~np.isin(pairs.landmark, pairs.landmark[known])
        nearest = best(free & in_graph & candidates.recent, robots=True)
        chosen = {n: k for n, k in nearest.items() if k < len(pairs.observation)}
        robots = {n: k - len(pairs.observation) for n, k in nearest.items() if n not in chosen}
        free &= ~np.isin(pairs.observation, list(robots))
        # a landmark that the back end does not have yet closes no loop
        settled = np.array([e.id in candidates.where for e in entries], dtype=bool)
        old = best(free & in_graph & ~candidates.recent & settled)
        if self._closes_loop(candidates, list(old.values())):
            chosen |= old
            self.closures += 1
        taken = np.array([int(i) in chosen for i in pairs.observation], dtype=bool)
        chosen |= best(free & ~in_graph & ~taken)
        matched = {n: int(pairs.landmark[k]) for n, k in chosen.items()}
        for n in conflicting_observations(matched, image.seen):
            del chosen[n]
        chosen |= {int(pairs.observation[k]): int(k) for k in np.flatnonzero(known)}
        return chosen, robots

    def _closes_loop(self, candidates: Candidates, picks: list[int]) -> bool:
        """Whether pairs with landmarks not seen for long are accepted: enough, and together."""
        if len(picks) < self._config.reacquire_min:
            return False
        compared, joint = candidates.compared, candidates.joint
        slices = [joint.slices[candidates.where[candidates.entries[k].id]] for k in picks]
        return fixes_pose(compared, picks) and jointly_compatible(
            compared, picks, slices, joint.cov, self._config.gate_probability
        )

    def _apply(
        self,
        image: Image,
        candidates: Candidates,
        chosen: dict[int, int],
        robots: dict[int, int],
    ) -> tuple[Association, ...]:
        """Associations of the chosen pairs; other observations make landmarks or are rejected.

        ``chosen`` and ``robots``: see `_choose`.
        """
        config, pairs, compared = self._config, candidates.pairs, candidates.compared
        new_gate = gate_distance(config.new_landmark_probability, np.maximum(compared.dof, 1))
        close = candidates.recent & (compared.d2 < new_gate)
        of_robots, distances = candidates.robot_pairs, candidates.robots_compared
        new_gate = gate_distance(config.new_landmark_probability, np.maximum(distances.dof, 1))
        near_robots = set(of_robots.observation[distances.d2 < new_gate].tolist())
        # a robot takes one sighting of an image
        taken = {image.robots[-1 - of_robots.landmark[k]].name for k in robots.values()}
        out: list[Association] = []
        for n, seen in enumerate(image.seen):
            o = seen
            if n in robots:
                k = robots[n]
                name = image.robots[-1 - of_robots.landmark[k]].name
                self._record_innovation(image, of_robots.model[k], distances, k)
                out += robot_associations(image.robot, image.time_ns, [replace(o, robots=(name,))])
                continue
            if not o.is_landmark:
                # where landmarks have no names the estimate may have taken one for another, and
                # it may be what is wrong: the sighting is used, under the robust kernel. MRCLAM 6
                # without names of landmarks ends 0.6 m off where it is not, 0.094 m where it is
                is_sure = bool(self.map.by_identity) or n not in of_robots.observation
                if not is_sure and len(o.robots) == 1 and o.robots[0] not in taken:
                    taken.add(o.robots[0])
                    out += robot_associations(image.robot, image.time_ns, [o])
                else:
                    self.rejected[NOT_THERE] += 1
                continue
            if n in chosen:
                k = chosen[n]
                entry, model = candidates.entries[k], pairs.model[k]
                o = flip(o) if pairs.flipped[k] else o
                if entry.id in candidates.where or not entry.in_graph:
                    self._record_innovation(image, model, compared, k)
            elif not self._has_identity(o) and (
                n in near_robots or np.any(close & (pairs.observation == n))
            ):
                self.rejected["between the thresholds: neither a match nor new"] += 1
                continue
            elif self._named(o) is not None:
                self.rejected["identity: known as a landmark of another kind"] += 1
                continue
            else:
                o = replace(o, identity=o.identity if self._has_identity(o) else None)
                entry, model = self.map.add(o, image.predicted, image.time_ns), o.kind
            out += self._record(image, entry, model, o, self._has_identity(o))
        return tuple(out)

    def _record_innovation(self, image: Image, model: str, compared: PairDistances, k: int) -> None:
        """Record the squared distance of a pair, per degree of freedom."""
        self.innovations.setdefault(model, []).append(
            (image.time_ns, float(compared.d2[k] / compared.dof[k]))
        )

    def _record(
        self, image: Image, entry: Entry, model: str, o: Observation, certain: bool
    ) -> list[Association]:
        """Record an observation, and what enters the graph with it: none, it alone, all so far."""
        robot, time_ns = image.robot, image.time_ns
        self.map.record_observation(entry, o, image.predicted, time_ns, robot, image.path_m)
        seen = Association(
            robot, time_ns, entry.id, model, o.z, o.cov, extent=o.extent, source=o.source
        )
        if entry.in_graph:
            return [seen]
        entry.evidence.append(seen)
        if not certain and entry.sightings < self._config.sightings_to_promote:
            return []
        self.map.promote(entry)
        self._unsettled.add(entry.id)
        self._admitted.add(entry.id)
        if entry.kind == "segment" and any(e.model != "segment" for e in entry.evidence):
            entry.kind = "line"
        waiting, entry.evidence = entry.evidence, []
        return [replace(e, model=entry.kind, late=e.time_ns != seen.time_ns) for e in waiting]
