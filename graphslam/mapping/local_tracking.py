"""Tracking of one robot against the landmarks of its last metres of path, image by image.

The landmarks around the robot are kept by a small filter (`robocentric_filter`). Each image is
associated with them by the gates of thesis 3.21-3.25, updates them, and begins new landmarks from
what fits none. A landmark that has not been seen for `association.reacquire_m` of path is retired:
a later visit begins landmarks of its own, which are tied to the old ones when the whole log is
solved. So the cost of an image depends on what is around the robot, not on the length of the log.
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from graphslam.core.arrays import BoolArray, IntArray
from graphslam.core.config import AssociationConfig
from graphslam.core.geometry import Array, between, compose
from graphslam.core.observation_arrays import KINDS, LINE, POINT, ROWS, SEGMENT, ObservationArrays
from graphslam.core.observation_models import MODELS
from graphslam.core.records import Association, Motion
from graphslam.estimation.robocentric_filter import ANCHOR, PREVIOUS, RobocentricFilter
from graphslam.mapping.gating import assign, gate_distance
from graphslam.mapping.landmark_map import Entry
from graphslam.mapping.local_pairs import LocalLandmarks, LocalPairs, candidate_pairs

#: share of the gate's floor (`association.floor_m`, `floor_rad`) by which walls differ from
#: straight ones, as noise of observations: without it the innovations of an image together are
#: larger than their covariance (median of the squared distance per degree of freedom 1.8 on ACES,
#: 1.0 with it), and where a few walls are seen badly the pose jumps by many of its sigmas
UNEVENNESS = 0.3


@dataclass(slots=True, eq=False)
class _Table:
    """Arrays over the local landmarks, in the order of the filter.

    ``id``; ``kind`` code; ``extent`` (n, 2); ``sightings``; ``in_graph``: seen often enough;
    ``mixed``: seen as a line of unknown ends too; ``path_m`` driven and ``time_ns`` when last seen.
    """

    id: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    kind: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    extent: Array = field(default_factory=lambda: np.zeros((0, 2)))
    sightings: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    in_graph: BoolArray = field(default_factory=lambda: np.zeros(0, dtype=bool))
    mixed: BoolArray = field(default_factory=lambda: np.zeros(0, dtype=bool))
    path_m: Array = field(default_factory=lambda: np.zeros(0))
    time_ns: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    def append(self, new: "_Table") -> "_Table":
        """Both tables, one after the other."""
        return _Table(*(
            np.concatenate([getattr(self, name), getattr(new, name)])
            for name in self.__dataclass_fields__
        ))  # fmt: skip

    def only(self, kept: BoolArray) -> "_Table":
        """The rows for which ``kept`` (n,) holds."""
        return _Table(*(getattr(self, name)[kept] for name in self.__dataclass_fields__))


class LocalTracker:
    """Tracks one robot; what it finds is in ``entries`` and in what `track` returns.

    ``entries``: retired landmarks that were seen often enough, by number, where they were left in
    the world frame of the tracked path; `retire_all` adds the last ones. ``rejected`` counts
    observations by the reason why they were not used, ``deleted`` landmarks that were not seen
    often enough. ``innovations``: model -> (time, squared distance per degree of freedom) of
    accepted pairs.
    """

    def __init__(
        self, robot: str, config: AssociationConfig, start: Array, numbers: Iterator[int]
    ) -> None:
        """Begin at the pose ``start`` (3,); ``numbers`` gives the landmarks' numbers."""
        self.pose = np.array(start, dtype=float)
        self._anchor_pose = self.pose
        self.path_m = 0.0
        self._time_ns = 0  # of the latest image
        self.entries: dict[int, Entry] = {}
        self.rejected: Counter[str] = Counter()
        self.deleted = 0
        self.innovations: dict[str, list[tuple[int, float]]] = {}
        self._robot, self._config, self._numbers = robot, config, numbers
        self._gates = gate_distance(config.gate_probability, ROWS)
        self._new_gates = gate_distance(config.new_landmark_probability, ROWS)
        self._filter, self._table = RobocentricFilter(), _Table()
        self._evidence: dict[int, list[Association]] = {}  # of tentative landmarks
        self._first_ns: dict[int, int] = {}
        floor = np.zeros((3, 3, 3))
        m2, rad2 = config.floor_m**2, config.floor_rad**2
        floor[POINT, [0, 1], [0, 1]] = rad2, m2
        floor[LINE, [0, 1], [0, 1]] = m2, rad2
        floor[SEGMENT, [0, 1, 2], [0, 1, 2]] = m2, m2, rad2
        # rows that a model does not have are certain and empty
        floor[POINT, 2, 2] = floor[LINE, 2, 2] = 1.0
        self._floor = floor

    def set_anchor(self) -> None:
        """Measure from here on where the robot is relative to its present pose, see `anchor`."""
        self._filter.set_anchor()
        self._anchor_pose = self.pose

    def anchor(self) -> tuple[Array, Array]:
        """Pose (3,) of the robot in the frame of the latest anchor, and its covariance (3, 3)."""
        return self._filter.reference(ANCHOR)

    def _present_pose(self) -> Array:
        """Pose (3,) of the filter's frame, the robot's after its latest motion, in the world."""
        return compose(self._anchor_pose, self._filter.reference(ANCHOR)[0])

    def move(self, motion: Motion) -> None:
        """The robot moved; must be followed by `track` before the next motion."""
        self._filter.predict(motion.delta, motion.cov)
        self.path_m += motion.length_m

    def track(
        self, time_ns: int, image: ObservationArrays
    ) -> tuple[tuple[Association, ...], Array, Array]:
        """Associate an image with the landmarks around the robot, and update them and the pose.

        Returns:
            Associations that enter the graph: those of landmarks seen often enough, with their
            earlier ones (marked late) when they become so; and the motion (3,) since the image
            before, with its covariance (3, 3) along the axes of its start.
        """
        self._time_ns = time_ns
        self._expire(time_ns)
        known = LocalLandmarks(
            self._filter.landmarks, self._filter.blocks(), self._table.kind, self._table.extent
        )
        pairs = candidate_pairs(image, known, self._floor, self._config)
        chosen = self._choose(pairs, len(image.kind))
        self._update(pairs, chosen)
        moved, cov = self._filter.reference(PREVIOUS)
        # not step by step: what a step leaves of an error is corrected with the next images
        self.pose = self._present_pose()
        used = dict(zip(pairs.observation[chosen].tolist(), chosen.tolist(), strict=True))
        return self._record(image, pairs, used), moved, cov

    def _choose(self, pairs: LocalPairs, observations: int) -> IntArray:
        """The accepted pairs (c,): landmarks of the graph first, then tentative ones."""
        gate = self._gates[pairs.model]
        fits, in_graph = pairs.d2 < gate, self._table.in_graph[pairs.landmark]
        first = self._assigned(pairs, gate, np.flatnonzero(fits & in_graph), observations)
        free = np.ones(observations, dtype=bool)
        free[pairs.observation[first]] = False
        others = fits & ~in_graph & free[pairs.observation]
        if not others.any():
            return first
        second = self._assigned(pairs, gate, np.flatnonzero(others), observations)
        return np.concatenate([first, second])

    def _assigned(
        self, pairs: LocalPairs, gate: Array, which: IntArray, observations: int
    ) -> IntArray:
        """Pairs among ``which``, all within their gates: one per observation and landmark."""
        i, j = pairs.observation[which], pairs.landmark[which]
        if len(set(i.tolist())) == len(set(j.tolist())) == len(which):
            return which
        columns, column = np.unique(j, return_inverse=True)
        cost = np.full((observations, len(columns)), np.inf)
        limit = np.zeros(cost.shape)
        index = np.zeros(cost.shape, dtype=np.int64)
        cost[i, column], limit[i, column] = pairs.d2[which], gate[which]
        index[i, column] = which
        found = assign(cost, limit, self._config.method)
        return np.array([index[pair] for pair in found], dtype=np.int64)

    def _update(self, pairs: LocalPairs, chosen: IntArray) -> None:
        """The landmarks and the pose by the accepted pairs."""
        if not len(chosen):
            return
        table, before = self._table, self._filter.landmarks.copy()
        rows = np.arange(3) < ROWS[pairs.model[chosen], None]
        self._filter.update(
            pairs.landmark[chosen],
            pairs.H[chosen],
            pairs.noise[chosen] + UNEVENNESS**2 * self._floor[pairs.model[chosen]],
            pairs.residual[chosen],
            rows,
        )
        # the part of a wall that was seen stays where it is while its origin slides along it
        slid = between(before, self._filter.landmarks)[:, 0]
        table.extent -= np.where(table.kind == LINE, slid, 0.0)[:, None]

    def _record(
        self, image: ObservationArrays, pairs: LocalPairs, used: dict[int, int]
    ) -> tuple[Association, ...]:
        """Count what was seen, begin new landmarks, and promote; see `track`."""
        table, time_ns = self._table, self._time_ns
        near = pairs.d2 < self._new_gates[pairs.model]
        doubtful = set(pairs.observation[near].tolist()) - used.keys()
        if doubtful:
            reason = "between the thresholds: neither a match nor new"
            self.rejected[reason] += len(doubtful)
        fresh = [n for n in range(len(image.kind)) if n not in used and n not in doubtful]
        out: list[Association] = []
        if used:
            pick = np.fromiter(used.values(), dtype=np.int64, count=len(used))
            rows, seen = pairs.landmark[pick], pairs.observation[pick]
            dof = ROWS[pairs.model[pick]]
            for code, share in zip(
                pairs.model[pick].tolist(), (pairs.d2[pick] / dof).tolist(), strict=True
            ):
                self.innovations.setdefault(KINDS[code], []).append((time_ns, share))
            table.sightings[rows] += 1
            table.path_m[rows], table.time_ns[rows] = self.path_m, time_ns
            self._extend(image, rows, seen)
            table.mixed[rows] |= ~table.in_graph[rows] & (pairs.model[pick] != SEGMENT)
            for k, row in zip(pick.tolist(), rows.tolist(), strict=True):
                out += self._associated(image, pairs, k, row)
        if fresh:
            out += self._begin(image, np.array(fresh))
        return tuple(out)

    def _extend(self, image: ObservationArrays, rows: IntArray, seen: IntArray) -> None:
        """Lines grow to the part of them that was seen."""
        table = self._table
        grows = table.kind[rows] == LINE
        rows, seen = rows[grows], seen[grows]
        relative = between(self._filter.landmarks[rows], image.z[seen])
        ends = relative[:, :1] + np.cos(relative[:, 2:]) * image.extent[seen]
        table.extent[rows, 0] = np.minimum(table.extent[rows, 0], ends.min(axis=1))
        table.extent[rows, 1] = np.maximum(table.extent[rows, 1], ends.max(axis=1))

    def _associated(
        self, image: ObservationArrays, pairs: LocalPairs, k: int, row: int
    ) -> list[Association]:
        """What enters the graph by an accepted pair: nothing, it alone, or all so far."""
        n = int(pairs.observation[k])
        extent = -image.extent[n, ::-1] if pairs.flipped[k] else image.extent[n]
        seen = self._association(image, n, row, int(pairs.model[k]), pairs.z[k], extent)
        return self._entering(seen, row)

    def _association(
        self, image: ObservationArrays, n: int, row: int, model: int, z: Array, extent: Array
    ) -> Association:
        d = 2 if model == POINT else 3
        target = int(self._table.id[row])
        cov = image.cov[n, :d, :d]
        return Association(
            self._robot, self._time_ns, target, KINDS[model], z[:d], cov,
            extent=None if model == POINT else extent,
        )  # fmt: skip

    def _entering(self, seen: Association, row: int) -> list[Association]:
        """An association and its landmark's earlier ones, if the landmark is in the graph now."""
        table, number = self._table, int(self._table.id[row])
        if table.in_graph[row]:
            return [seen]
        waiting = self._evidence[number]
        waiting.append(seen)
        if table.sightings[row] < self._config.sightings_to_promote:
            return []
        del self._evidence[number]
        table.in_graph[row] = True
        if table.kind[row] == SEGMENT and table.mixed[row]:
            table.kind[row] = LINE
        kind = KINDS[table.kind[row]]
        return [_as(kind, e, e.time_ns != seen.time_ns) for e in waiting]

    def _begin(self, image: ObservationArrays, seen: IntArray) -> list[Association]:
        """New landmarks from observations (k,) that fit none."""
        k, at, kind = len(seen), image.poses()[seen], image.kind[seen]
        cov = image.cov[seen].copy()
        points = kind == POINT
        if points.any():
            z, origin = image.z[seen][points, :2], np.zeros((int(points.sum()), 3))
            _, G = MODELS["point"].invert_jacobians(z, origin)
            cov[points, :2, :2] = G @ image.cov[seen][points, :2, :2] @ G.mT
        self._filter.add(at, cov, np.where(points, 0.0, 1.0))
        numbers = np.array([next(self._numbers) for _ in range(k)], dtype=np.int64)
        first = len(self._table.id)
        self._table = self._table.append(_Table(
            numbers, kind, image.extent[seen], np.ones(k, dtype=np.int64), np.zeros(k, dtype=bool),
            np.zeros(k, dtype=bool), np.full(k, self.path_m),
            np.full(k, self._time_ns, dtype=np.int64),
        ))  # fmt: skip
        out: list[Association] = []
        for row, n in enumerate(seen.tolist(), first):
            number = int(self._table.id[row])
            self._evidence[number], self._first_ns[number] = [], self._time_ns
            seen_as = int(self._table.kind[row])
            out += self._entering(
                self._association(image, n, row, seen_as, image.z[n], image.extent[n]), row
            )
        return out

    def _expire(self, time_ns: int) -> None:
        """Retire landmarks that were not seen for long, and delete such tentative ones."""
        table, config = self._table, self._config
        away_m = self.path_m - table.path_m
        age_ns = round(1e9 * config.tentative_s)
        old = np.where(
            table.in_graph,
            away_m > config.reacquire_m,
            (away_m > config.tentative_m) & (time_ns - table.time_ns > age_ns),
        )
        if old.any():
            self._retire(old)

    def retire_all(self) -> None:
        """Retire the landmarks that are still tracked: at the end of the log."""
        self._retire(np.ones(len(self._table.id), dtype=bool))

    def _retire(self, old: BoolArray) -> None:
        """Take rows ``old`` (n,) out; those of the graph become entries of the map."""
        # the filter may have moved since `pose` was set: its landmarks are seen from where it is
        table, pose = self._table, self._present_pose()
        for row in np.flatnonzero(old).tolist():
            number = int(table.id[row])
            first_ns = self._first_ns.pop(number)
            if not table.in_graph[row]:
                self.deleted += 1
                del self._evidence[number]
                continue
            self.entries[number] = Entry(
                number,
                KINDS[table.kind[row]],
                compose(pose, self._filter.landmarks[row]),
                np.zeros((3, 3)),
                table.extent[row].copy(),
                first_ns,
                int(table.time_ns[row]),
                None,
                int(table.sightings[row]),
                in_graph=True,
                path_m={self._robot: float(table.path_m[row])},
            )
        self._table = table.only(~old)
        self._filter.keep(np.flatnonzero(~old))


def _as(kind: str, seen: Association, late: bool) -> Association:
    """An association as one of a landmark of ``kind``, ``late`` or not."""
    return Association(
        seen.robot, seen.time_ns, seen.target, kind, seen.z, seen.cov, late, seen.extent
    )
