"""Data association of one image (scan or set of sightings) at a time, and the life of a landmark.

Order of decisions for an observation: known identity; a landmark of the graph that was seen
recently; landmarks not seen for long, only when enough of them agree *together* (a loop closure);
a tentative landmark; a new one; else rejected, with the reason.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from graphslam.association import (
    Compared,
    IntArray,
    Pairs,
    assign,
    candidate_pairs,
    compare,
    fixes_pose,
    flip,
    gate_distance,
    jointly_compatible,
)
from graphslam.backends import Backend, Joint
from graphslam.config import AssociationConfig
from graphslam.dead_reckoning import Track
from graphslam.geometry import Array, compose, compose_jacobians, rotate_cov
from graphslam.landmark_map import Entry, LandmarkMap
from graphslam.records import Association, Motion, Observation

#: images between two refreshes of all landmark estimates; those in view are always fresh
REFRESH_EVERY = 50


def predicted_joint(joint: Joint, motion: Motion | None) -> Joint:
    """The joint after the robot moved on: system update of the pose block, thesis 4.4-4.7."""
    if motion is None:
        return joint
    F, W = compose_jacobians(joint.pose, motion.delta)
    P = joint.cov.copy()
    P[:3] = F @ P[:3]
    P[:, :3] = P[:, :3] @ F.T
    P[:3, :3] += W @ motion.cov @ W.T
    return replace(joint, pose=compose(joint.pose, motion.delta), cov=P)


class Associator:
    """Keeps the landmark map and decides where each observation belongs."""

    def __init__(self, config: AssociationConfig, backend: Backend) -> None:
        self.map = LandmarkMap()
        self.rejected: Counter[str] = Counter()
        self.closures = 0
        self.innovations: dict[str, list[tuple[int, float]]] = {}
        self._config, self._backend = config, backend
        self._images = 0
        m2, rad2 = config.floor_m**2, config.floor_rad**2
        self._floor = {
            "line": np.diag([m2, rad2]),
            "point": np.diag([rad2, m2]),
            "segment": np.diag([m2, m2, rad2]),
        }

    def associate(
        self,
        robot: str,
        time_ns: int,
        seen: Sequence[Observation],
        pose: Array,
        motion: Motion | None,
        track: Track,
        path_m: float,
    ) -> tuple[Association, ...]:
        """Associations of one image.

        Args:
            robot: who saw it.
            time_ns: time of the robot's state that the observations belong to.
            seen: observations in the robot's base frame at that state.
            pose: (3,) estimate of the robot's latest state in the back end.
            motion: from the robot's latest state in the back end to this one; None if it is it.
            track: the robot's odometry.
            path_m: how far the robot has driven.

        Returns:
            What is to enter the graph, including earlier sightings of landmarks that this image
            promotes (marked late).
        """
        config = self._config
        if self._images % REFRESH_EVERY == 0:
            self.map.refresh(self._backend, self.map.graph_ids())
        self._images += 1
        self.map.expire(
            time_ns, robot, path_m, round(config.tentative_s * 1e9), config.tentative_m
        )
        if motion is not None:
            pose = compose(pose, motion.delta)
        ids, means, extents, is_point, whole = self.map.arrays()
        pairs = candidate_pairs(seen, pose, means, extents, is_point, whole, config)
        known = self._known(seen)
        graph_ids = sorted(
            {int(ids[j]) for j in pairs.landmark if self.map.entries[int(ids[j])].in_graph}
            | {i for i in known.values() if i is not None}
        )
        joint = predicted_joint(self._backend.joint(robot, graph_ids), motion)
        pose = joint.pose
        compared = self._compare(seen, pairs, ids, joint, graph_ids, track, time_ns)
        chosen = self._choose(seen, pairs, ids, compared, joint, graph_ids, known, robot, path_m)
        return self._book(
            robot, time_ns, seen, pairs, ids, compared, chosen, known, pose, path_m
        )

    def _known(self, seen: Sequence[Observation]) -> dict[int, int | None]:
        """Observation -> landmark for observations with an identity; None for a first sighting."""
        if self._config.identities == "ignore":
            return {}
        return {
            n: self.map.by_identity.get(o.identity)
            for n, o in enumerate(seen)
            if o.identity is not None
        }

    def _compare(
        self,
        seen: Sequence[Observation],
        pairs: Pairs,
        ids: IntArray,
        joint: Joint,
        graph_ids: Sequence[int],
        track: Track,
        time_ns: int,
    ) -> Compared:
        """Distances of all candidate pairs.

        A tentative landmark is known relative to the robot that saw it, so what separates it from
        now is its own measurement noise and the motion since, not the robot's place in the world.
        """
        k = len(pairs.observation)
        P_xx, P_xt, P_tt = (np.zeros((k, 3, 3)) for _ in range(3))
        states = np.zeros((k, 3))
        place = {landmark: n for n, landmark in enumerate(graph_ids)}
        since: dict[int, Array] = {}
        for n, j in enumerate(pairs.landmark):
            entry = self.map.entries[int(ids[j])]
            if entry.in_graph:
                where = joint.slices[place[entry.id]]
                size = where.stop - where.start
                states[n, :size] = joint.landmarks[place[entry.id]]
                P_xx[n] = joint.cov[:3, :3]
                P_xt[n, :, :size] = joint.cov[:3, where]
                P_tt[n, :size, :size] = joint.cov[where, where]
            else:
                if entry.last_ns not in since:
                    moved = track.motion(entry.last_ns, time_ns)
                    since[entry.last_ns] = rotate_cov(
                        moved.cov, float(joint.pose[2] - moved.delta[2])
                    )
                states[n], P_xx[n], P_tt[n] = entry.mean, since[entry.last_ns], entry.cov
        return compare(seen, pairs, joint.pose, states, P_xx, P_xt, P_tt, self._floor)

    def _choose(
        self,
        seen: Sequence[Observation],
        pairs: Pairs,
        ids: IntArray,
        compared: Compared,
        joint: Joint,
        graph_ids: Sequence[int],
        known: dict[int, int | None],
        robot: str,
        path_m: float,
    ) -> dict[int, int]:
        """Observation -> pair, for observations without identity."""
        config = self._config
        entries = [self.map.entries[int(ids[j])] for j in pairs.landmark]
        free = np.array([int(i) not in known for i in pairs.observation], dtype=bool)
        in_graph = np.array([e.in_graph for e in entries], dtype=bool)
        recent = np.array(
            [path_m - e.path_m.get(robot, -np.inf) <= config.reacquire_m for e in entries],
            dtype=bool,
        )
        gate = gate_distance(config.gate_probability, np.maximum(compared.dof, 1))

        def best(which: Array) -> dict[int, int]:
            return _assign_pairs(pairs, compared, gate, which, len(seen), config.method)

        chosen = best(free & in_graph & recent)
        old = best(free & in_graph & ~recent)
        if len(old) >= config.reacquire_min:
            picks = list(old.values())
            place = {landmark: n for n, landmark in enumerate(graph_ids)}
            slices = [joint.slices[place[int(ids[pairs.landmark[k]])]] for k in picks]
            if fixes_pose(compared, picks) and jointly_compatible(
                compared, picks, slices, joint.cov, config.gate_probability
            ):
                chosen |= old
                self.closures += 1
        taken = np.array([int(i) in chosen for i in pairs.observation], dtype=bool)
        chosen |= best(free & ~in_graph & ~taken)
        return chosen

    def _book(
        self,
        robot: str,
        time_ns: int,
        seen: Sequence[Observation],
        pairs: Pairs,
        ids: IntArray,
        compared: Compared,
        chosen: dict[int, int],
        known: dict[int, int | None],
        pose: Array,
        path_m: float,
    ) -> tuple[Association, ...]:
        """Turn the choices into associations; make, promote and reject."""
        config = self._config
        out: list[Association] = []
        new_gate = gate_distance(config.new_probability, np.maximum(compared.dof, 1))
        for n, raw in enumerate(seen):
            o = raw
            if n in known:
                known_id = known[n]
                entry = (
                    self.map.add(o, pose, time_ns)
                    if known_id is None
                    else self.map.entries[known_id]
                )
                model = o.kind
            elif n in chosen:
                k = chosen[n]
                entry = self.map.entries[int(ids[pairs.landmark[k]])]
                model = pairs.model[k]
                o = flip(o) if pairs.flipped[k] else o
                self.innovations.setdefault(model, []).append(
                    (time_ns, float(compared.d2[k] / compared.dof[k]))
                )
            else:
                of_this = pairs.observation == n
                recent = np.array(
                    [
                        path_m - self.map.entries[int(ids[j])].path_m.get(robot, -np.inf)
                        <= config.reacquire_m
                        for j in pairs.landmark
                    ],
                    dtype=bool,
                )
                if np.any(of_this & recent & (compared.d2 < new_gate)):
                    self.rejected["between the thresholds: neither a match nor new"] += 1
                    continue
                entry, model = self.map.add(o, pose, time_ns), o.kind
            self.map.saw(entry, o, pose, time_ns, robot, path_m)
            association = Association(robot, time_ns, entry.id, model, o.z, o.cov)
            out += self._admit(entry, association, o.identity is not None and n in known, pose, o)
        return tuple(out)

    def _admit(
        self, entry: Entry, seen: Association, certain: bool, pose: Array, o: Observation
    ) -> list[Association]:
        """What enters the graph with this sighting: nothing, it alone, or all so far."""
        if entry.in_graph:
            return [seen]
        entry.evidence.append(seen)
        if not certain and entry.sightings < self._config.sightings_to_promote:
            return []
        entry.in_graph = True
        whole = all(e.model == "segment" for e in entry.evidence)
        if entry.kind == "segment" and not whole:
            entry.kind = "line"
        model = entry.kind
        waiting, entry.evidence = entry.evidence, []
        return [replace(e, model=model, late=e.time_ns != seen.time_ns) for e in waiting]


def _assign_pairs(
    pairs: Pairs, compared: Compared, gate: Array, which: Array, n: int, method: str
) -> dict[int, int]:
    """Observation -> pair among the pairs ``which``.

    One-to-one first. Then a line may be seen in several parts (a pillar hides its middle): a
    line observation left alone joins its nearest landmark even if that has one already.
    """
    use = np.flatnonzero(which & (compared.d2 < gate))
    if not len(use):
        return {}
    columns = {int(j): c for c, j in enumerate(np.unique(pairs.landmark[use]))}
    cost = np.full((n, len(columns)), np.inf)
    limit = np.zeros_like(cost)
    number = np.full(cost.shape, -1, dtype=np.int64)
    for k in use:
        cell = int(pairs.observation[k]), columns[int(pairs.landmark[k])]
        cost[cell], limit[cell], number[cell] = compared.d2[k], gate[k], k
    chosen = {i: int(number[i, c]) for i, c in assign(cost, limit, method)}
    for k in use[np.argsort(compared.d2[use], kind="stable")]:
        i = int(pairs.observation[k])
        if i not in chosen and pairs.model[k] == "line":
            chosen[i] = int(k)
    return chosen


__all__ = ["Associator", "predicted_joint"]
