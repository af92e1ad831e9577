"""The landmark map: kind, extent, sightings and age of every landmark, beside its estimate.

A landmark is *tentative* until it has been seen often enough. Only then does it enter the graph,
together with its earlier sightings. Estimates are copies, refreshed from the back end when they may
have changed, since reading them is a large part of an incremental smoother's cost.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.errors import LogError
from graphslam.core.geometry import Array, between, compose, rotate_cov
from graphslam.core.observation_models import MODELS
from graphslam.core.record import replace
from graphslam.core.records import (
    Association,
    Estimate,
    KeyframeScan,
    Observation,
    Step,
    Trajectory,
)
from graphslam.core.sensor_config import LimitsConfig
from graphslam.estimation.backend import Backend
from graphslam.mapping.landmark_index import LandmarkIndex

#: m: landmarks of an earlier map that are nearer to each other are known to be different things
KNOWN_NEAR_M = 2.0
#: observations of a wall from which on the one that reaches farthest is not believed; of fewer each
#: may have seen a part of its own
LEAST_SEEN = 10


@dataclass(slots=True, eq=False)
class Entry:
    """One landmark, tentative or in the graph.

    ``mean`` (3,) world frame (heading 0 for points); ``extent`` (2,) along its x axis, m;
    ``cov`` (3, 3) of a tentative one relative to the robot that saw it; ``path_m[robot]`` is how
    far the robot had driven when it last saw it; ``evidence`` the associations of a tentative one.
    """

    id: int
    kind: str
    mean: Array
    cov: Array
    extent: Array
    first_ns: int
    last_ns: int
    identity: str | None
    sightings: int = 0
    in_graph: bool = False
    path_m: dict[str, float] = field(default_factory=dict)
    evidence: list[Association] = field(default_factory=list)

    def extent_at(self, mean: Array) -> Array:
        """The extent (2,) at another estimate (2,) or (3,).

        The extent of a line stays where it is in the world, as the line's origin may slide along it
        by metres; that of a segment moves with it. See `LandmarkMap.update_from` for walls
        that moved.
        """
        return self.extent - between(self.mean, mean)[0] if self.kind == "line" else self.extent

    def extend(self, pose: Array, extent: Array) -> None:
        """Extend to ``extent`` (2,) along the x axis of ``pose`` (3,), in the world frame."""
        relative = between(self.mean, pose)
        ends = relative[0] + np.cos(relative[2]) * extent
        self.extent = np.array([min(self.extent[0], ends.min()), max(self.extent[1], ends.max())])

    def copied(self, number: int) -> "Entry":
        """The same with another number; nothing that changes is shared."""
        return replace(
            self, id=number, mean=self.mean.copy(), extent=self.extent.copy(),
            path_m=dict(self.path_m), evidence=list(self.evidence),
        )  # fmt: skip

    def move(self, mean: Array) -> None:
        """A new estimate (2,) or (3,)."""
        self.extent = self.extent_at(mean)
        self.mean[: len(mean)] = mean


class LandmarkMap:
    """All landmarks by number, with arrays over them for the vectorised gates.

    ``bias_m``: sigma of an error of walls along their normals that all observations of one share.
    A laser's error on a surface (material, flatness) is the same in every scan: no number of scans
    averages it, and no residual shows it. ``most``: landmarks at one time.
    """

    def __init__(self, bias_m: float = 0.0, most: int = LimitsConfig.landmarks) -> None:
        self.bias_m, self.most = bias_m, most
        self.entries: dict[int, Entry] = {}
        #: of an earlier map, as they were
        self.known: dict[int, Entry] = {}
        #: those of them that are near each other, which are different things
        self.known_pairs: set[frozenset[int]] = set()
        self.by_identity: dict[str, int] = {}
        self.deleted = self.forgotten = 0  # tentative ones, and landmarks of the graph
        self._tentative: dict[int, Entry] = {}
        self._unseen: dict[int, Entry] = {}
        self._next = 0
        self._index: tuple[list[Entry], LandmarkIndex] | None = None  # as they were then
        self._changed: set[int] = set()  # added or extended since

    def __len__(self) -> int:
        return len(self.entries)

    def graph_ids(self) -> list[int]:
        """Numbers of the landmarks in the graph."""
        return [i for i, entry in self.entries.items() if entry.in_graph]

    def near(self, box: Array) -> list[Entry]:
        """Landmarks by their numbers, those left out that do not touch a box (2, 2).

        The box, m, is from and to; some of those given may lie outside it. All are looked through
        anew where they moved; that is when their estimates are refreshed.
        """
        if self._index is None:
            every = list(self.entries.values())
            self._index = every, LandmarkIndex(*means_and_extents(every))
        indexed, index = self._index
        found = {indexed[k].id for k in index.touching(*box).tolist()} | self._changed
        return [self.entries[i] for i in sorted(found) if i in self.entries]

    def _note(self, entry: Entry) -> None:
        """The index does not have this landmark, or as it was."""
        if self._index is not None:
            self._changed.add(entry.id)

    def drop_index(self) -> None:
        """Landmarks were moved, taken in or merged, or a pass is over: `near` makes a new one."""
        self._index = None
        self._changed.clear()

    def promote(self, entry: Entry) -> None:
        """A tentative landmark enters the graph."""
        entry.in_graph = True
        self._tentative.pop(entry.id, None)

    def add_all(self, entries: Mapping[int, Entry]) -> None:
        """Take in landmarks with the numbers that they have."""
        self.entries |= entries
        self._tentative |= {n: e for n, e in entries.items() if not e.in_graph}
        self.by_identity |= {e.identity: n for n, e in entries.items() if e.identity is not None}
        self.begin_at(1 + max(entries, default=-1))
        self.drop_index()

    def add_known(self, entries: Mapping[int, Entry]) -> None:
        """Take in landmarks of an earlier map; their numbers are not used yet."""
        self.add_all(entries)
        self.known |= {n: e.copied(n) for n, e in entries.items()}
        self.known_pairs |= _near_each_other(list(entries.values()))

    def begin_at(self, number: int) -> None:
        """New landmarks have this number and those after it."""
        self._next = max(self._next, number)

    @property
    def next_number(self) -> int:
        """Of the next landmark that is new."""
        return self._next

    def without_known(self, into: Mapping[int, int]) -> dict[int, int]:
        """Merges, those of landmarks of an earlier map left out: they are what they were."""
        return {gone: kept for gone, kept in into.items() if gone not in self.known}

    def add(self, seen: Observation, pose: Array, time_ns: int) -> Entry:
        """A new tentative landmark from an observation made at ``pose`` (3,), in its frame.

        Raises:
            LogError: there are as many as there may be.
        """
        if len(self.entries) >= self.most:
            raise LogError(
                f"the log has more landmarks than limits.landmarks ({self.most}); raise it, or see "
                "whether every sighting has a name of its own"
            )
        model = MODELS[seen.kind]
        mean = np.zeros(3)
        state = model.invert(seen.z, pose)
        mean[: len(state)] = state
        cov = np.zeros((3, 3))
        _, G_z = model.invert_jacobians(seen.z, pose)
        cov[: len(state), : len(state)] = G_z @ seen.cov @ G_z.T
        extent = np.zeros(2) if seen.extent is None else seen.extent.copy()
        entry = Entry(self._next, seen.kind, mean, cov, extent, time_ns, time_ns, seen.identity)
        self.entries[entry.id] = self._tentative[entry.id] = entry
        self._note(entry)
        if seen.identity is not None:
            self.by_identity[seen.identity] = entry.id
        self._next += 1
        return entry

    def record_observation(
        self, entry: Entry, seen: Observation, pose: Array, time_ns: int, robot: str, path_m: float
    ) -> None:
        """Record a sighting: count it and extend the landmark to what was seen.

        ``seen`` is in the base frame of the robot's ``pose`` (3,), which is in the world frame;
        ``path_m`` is how far ``robot`` has driven.
        """
        entry.sightings += 1
        entry.last_ns = max(entry.last_ns, time_ns)
        entry.path_m[robot] = path_m
        # a segment keeps its known ends; a line grows
        grows = entry.kind == "line" or (entry.kind == "segment" and entry.sightings == 1)
        if grows and seen.extent is not None:
            entry.extend(compose(pose, seen.z), seen.extent)
            self._note(entry)

    def refresh(self, backend: Backend, ids: list[int]) -> None:
        """Copy the back end's current estimates of these landmarks."""
        for i, mean in zip(ids, backend.landmark_means(ids), strict=True):
            self.entries[i].move(mean)
        self.drop_index()

    def update_from(self, steps: Sequence[Step], estimate: Estimate) -> None:
        """Move to an estimate of the steps; landmarks without observations leave the map.

        Extents of lines are computed again from their observations with the latest estimate:
        closing a loop may move a wall by metres.
        """
        for number, entry in list(self.entries.items()):
            if number in estimate.landmarks:
                entry.move(estimate.landmarks[number][0])
            elif entry.in_graph:
                del self.entries[number]
        for number, extent in seen_extents(steps, estimate).items():
            entry = self.entries[number]
            if entry.kind == "line":  # the ends of a segment move with it
                entry.extent = extent
                if number in self.known:  # what was not seen now is there as well
                    entry.extend(self.known[number].mean, self.known[number].extent)
        self.drop_index()

    def copies(self) -> dict[int, Entry]:
        """All landmarks as they are now, for `return_to`."""
        return {n: entry.copied(n) for n, entry in self.entries.items()}

    def return_to(self, entries: Mapping[int, Entry]) -> None:
        """Have landmarks as they were, and no others."""
        self.entries = {n: entry.copied(n) for n, entry in entries.items()}
        self._tentative = {n: e for n, e in self.entries.items() if not e.in_graph}
        self.drop_index()

    def split(self, number: int, new: int) -> None:
        """Add landmark ``new`` as a copy of ``number``, without its identity."""
        self.entries[new] = replace(self.entries[number].copied(new), identity=None)
        self._next = max(self._next, new + 1)
        self.drop_index()

    def recount(self, number: int, seen: Sequence[Association]) -> None:
        """Landmark ``number`` has these observations, those of an earlier map, and no others."""
        entry, before = self.entries[number], self.known.get(number)
        times = [a.time_ns for a in seen]
        entry.sightings = len(times)
        if before is not None:
            entry.sightings += before.sightings
            times += [before.first_ns, before.last_ns]
            if not seen:
                entry.extent = before.extent - between(before.mean, entry.mean)[0]
        entry.first_ns, entry.last_ns = min(times), max(times)
        self.drop_index()

    def transformed(self, worlds: Mapping[int, Array]) -> "LandmarkMap":
        """The same map after the frame of each landmark was put at ``worlds[id]`` (3,)."""
        moved = LandmarkMap(self.bias_m, self.most)
        for i, entry in self.entries.items():
            moved.entries[i] = replace(entry, mean=compose(worlds[i], entry.mean))
        return moved

    def expire(self, time_ns: int, robot: str, path_m: float, age_ns: int, age_m: float) -> None:
        """Delete tentative landmarks that this robot has not seen for long, in time *and* path."""
        gone = [
            i
            for i, e in self._tentative.items()
            if robot in e.path_m
            and time_ns - e.last_ns > age_ns
            and path_m - e.path_m[robot] > age_m
        ]
        self._delete(gone)
        self.deleted += len(gone)

    def expire_unseen(self, time_ns: int, age_ns: float) -> list[int]:
        """Delete landmarks of the graph that no robot has seen for long; returns their numbers."""
        gone = [i for i, e in self.entries.items() if e.in_graph and time_ns - e.last_ns > age_ns]
        self._unseen |= {i: replace(self.entries[i], identity=None) for i in gone}
        self._delete(gone)
        self.forgotten += len(gone)
        return gone

    def bring_back(self) -> None:
        """Have those again that `expire_unseen` deleted, without names: a smoother knows them."""
        self.entries |= self._unseen
        self._unseen = {}
        self.drop_index()

    def _delete(self, gone: Sequence[int]) -> None:
        for i in gone:
            identity = self.entries.pop(i).identity
            self._tentative.pop(i, None)
            if identity is not None and self.by_identity.get(identity) == i:
                del self.by_identity[identity]


def means_and_extents(entries: Sequence[Entry]) -> tuple[Array, Array]:
    """Means (m, 3), world frame, and extents (m, 2), m, of landmarks."""
    m = len(entries)
    means, extents = np.empty((m, 3)), np.empty((m, 2))
    for k, e in enumerate(entries):
        means[k], extents[k] = e.mean, e.extent
    return means, extents


def _near_each_other(entries: Sequence[Entry]) -> set[frozenset[int]]:
    middles = np.array([compose(e.mean, np.array([e.extent.mean(), 0.0, 0.0])) for e in entries])
    reach = np.array([np.ptp(e.extent) / 2 for e in entries]) + KNOWN_NEAR_M / 2
    found: set[frozenset[int]] = set()
    for k, e in enumerate(entries):
        far = np.hypot(*(middles[:k, :2] - middles[k, :2]).T)
        found |= {
            frozenset((entries[j].id, e.id))
            for j in np.flatnonzero(far < reach[:k] + reach[k]).tolist()
        }
    return found


def retarget(a: Association, target: int, kind: str) -> Association:
    """An association with another landmark, of ``kind``; a segment may be part of a line."""
    line = a.model == "segment" and kind == "line"
    return replace(a, target=target, model="line" if line else a.model)


def observed_from(
    seen: Sequence[Association | KeyframeScan], of_robots: Mapping[str, Trajectory]
) -> Array:
    """Estimated states (n, 3) from which associations or scans were made."""
    poses = np.empty((len(seen), 3))
    robots, times = np.array([a.robot for a in seen]), np.array([a.time_ns for a in seen])
    for robot, states in of_robots.items():
        own = robots == robot
        poses[own] = states.at(times[own])
    return poses


def seen_extents(steps: Sequence[Step], estimate: Estimate) -> dict[int, Array]:
    """Number of each wall -> extent (2,) of its observations, m along its x axis.

    Of many (`LEAST_SEEN`) it ends where a second one does: one may have a return in it that is of
    the wall beyond an opening.
    """
    seen = [
        a
        for step in steps
        for a in step.associations
        if a.extent is not None and a.target in estimate.landmarks
    ]
    if not seen:
        return {}
    walls, wall = np.unique([int(a.target) for a in seen], return_inverse=True)
    means = np.array([estimate.landmarks[int(number)][0] for number in walls])
    world = compose(observed_from(seen, estimate.states), np.array([a.z for a in seen]))
    relative = between(means[wall], world)
    ends = relative[:, :1] + np.cos(relative[:, 2:]) * np.array([a.extent for a in seen])
    ends.sort(axis=1)  # an observation may have the opposite direction
    count = np.bincount(wall)
    first = np.cumsum(count) - count
    outermost = np.where(count >= LEAST_SEEN, 1, 0)  # of the sorted ends of each wall
    low = ends[np.lexsort((ends[:, 0], wall)), 0][first + outermost]
    high = ends[np.lexsort((-ends[:, 1], wall)), 1][first + outermost]
    # parts that do not overlap have their second ends the other way round
    extents = np.column_stack([np.minimum(low, high), np.maximum(low, high)])
    return dict(zip(walls.tolist(), extents, strict=True))


def mean_landmarks(
    steps: Sequence[Step], states: Mapping[str, Trajectory]
) -> dict[int, tuple[Array, Array]]:
    """Number of each landmark -> the mean of where its observations show it; covariance unknown.

    Mean (2,) or (3,) by the poses of ``states``, which are those of the steps and taken for exact.
    Observations are weighted by their information; along a wall whose ends are not known, the mean
    stays where the first observation shows it.
    """
    seen = [a for step in steps for a in step.associations if isinstance(a.target, int)]
    found: dict[int, tuple[Array, Array]] = {}
    for is_point in (True, False):
        some = [a for a in seen if (a.model == "point") == is_point]
        if not some:
            continue
        numbers, first, which = np.unique(
            [a.target for a in some], return_index=True, return_inverse=True
        )
        mean = _mean_points if is_point else _mean_walls
        means = mean(some, observed_from(some, states), first, which)
        unknown = np.full((means.shape[1],) * 2, np.nan)
        found.update(
            (number, (at, unknown)) for number, at in zip(numbers.tolist(), means, strict=True)
        )
    return found


def _mean_points(seen: Sequence[Association], x: Array, first: IntArray, which: IntArray) -> Array:
    """Means (n, 2) of points, observed from ``x`` (m, 3) as number ``which`` (m,) of n."""
    model = MODELS["point"]
    z = np.array([a.z for a in seen])
    _, G = model.invert_jacobians(z, x)
    information = np.linalg.inv(G @ np.array([a.cov for a in seen]) @ G.mT)
    at = model.invert(z, x)
    total, weighted = np.zeros((len(first), 2, 2)), np.zeros((len(first), 2))
    np.add.at(total, which, information)
    np.add.at(weighted, which, (information @ at[:, :, None])[:, :, 0])
    return np.asarray(np.linalg.solve(total, weighted[:, :, None])[:, :, 0])


def _mean_walls(seen: Sequence[Association], x: Array, first: IntArray, which: IntArray) -> Array:
    """Means (n, 3) of lines and segments, in the same way; ``first`` (n,) of their observations."""
    z = np.array([a.z for a in seen])
    world = compose(x, z)
    middle = world[first]
    off = between(middle[which], world)
    own = rotate_cov(np.array([a.cov for a in seen]), -z[:, 2])
    arm, direction = off[:, 0], own[:, 2, 2]
    # what the observation says about the wall at the origin of the mean
    across = off[:, 1] - arm * np.tan(off[:, 2])
    wall = own[:, 1, 1] - 2.0 * arm * own[:, 1, 2] + arm**2 * direction
    ends = np.array([a.model == "segment" for a in seen])
    along = np.where(ends, 1.0 / own[:, 0, 0], 0.0)

    def mean(value: Array, weight: Array) -> Array:
        total = np.bincount(which, weight)
        return np.bincount(which, weight * value) / np.where(total > 0, total, 1.0)

    change = [mean(arm, along), mean(across, 1.0 / wall), mean(off[:, 2], 1.0 / direction)]
    return compose(middle, np.column_stack(change))
