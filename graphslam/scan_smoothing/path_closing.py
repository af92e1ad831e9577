"""Tracked paths whose loops are closed on a pose graph of submaps, and what it says about them."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.geometry import Array, between, compose, exp, log, path_length, rotate_cov
from graphslam.core.records import Closure, Step, Trajectory
from graphslam.mapping.doubled_walls import ON_M
from graphslam.mapping.known_map import MAP_ROBOT, KnownMap
from graphslam.mapping.loop_closure import Pair, Tamper
from graphslam.mapping.redundant_closures import Span
from graphslam.mapping.sequential_closing import close_loops
from graphslam.mapping.submap_graph import SubmapConstraints, SubmapGraph
from graphslam.mapping.submaps import State, SubmapPose, submaps_at
from graphslam.scan_smoothing.scan_tracking import TrackedLog, TrackedPath

#: factor on the covariance of the chain of submaps: tracking knows only what is around the robot,
#: and takes its errors for independent. Of Intel and ACES, errors are 1 to 2 sigmas of it
CHAIN_INFLATION = 4.0
#: m², m², rad²: of the places of a known map, beside what it has around them. How well the map
#: as a whole lies in the world does not matter here
PLACE_COV = np.diag([0.02, 0.02, 0.005]) ** 2


@dataclass(frozen=True, slots=True, eq=False)
class ClosedPaths:
    """Paths after their loops were closed.

    ``states``: robot -> poses at all its states. ``closures`` are those that corrected the paths,
    ``refused`` the pairs of inconsistent ones; ``spans``: state of a submap -> the time that its
    robot was around there. ``graph`` is that of the submaps, ``times`` and ``first``: robot ->
    times of its nodes in it, and the number of the first. ``places`` are the nodes of a known map,
    ``known`` the numbers of its landmarks; ``to_map``: how many closures are with its places.
    ``by``: robot -> (2,) m, by how much a path is `displaced` since its loops were closed.
    """

    states: Mapping[str, Trajectory]
    closures: Sequence[Closure]
    refused: frozenset[Pair]
    spans: Mapping[State, Span]
    graph: SubmapGraph
    times: Mapping[str, IntArray]
    first: Mapping[str, int]
    places: IntArray
    known: Collection[int] = ()
    to_map: int = 0
    by: Mapping[str, Array] = field(default_factory=dict)

    def node(self, robot: str, time_ns: int) -> int:
        """The node of the graph that was passed last at a time."""
        before = int(np.searchsorted(self.times[robot], time_ns, side="right")) - 1
        return self.first[robot] + max(before, 0)

    def start_covariance(self, robot: str) -> Array:
        """Covariance (3, 3), m and rad, of a robot's first pose, along world axes."""
        first = self.first[robot]
        cov = self.graph.covariance(np.array([first]))
        return np.asarray(rotate_cov(cov, float(self.graph.poses[first, 2])))

    def displaced(self, states: Mapping[str, Trajectory], by: Mapping[str, Array]) -> "ClosedPaths":
        """Paths of which some are displaced ``by`` (2,) m, and the closures that agree with that.

        ``states`` (robot -> poses) are from where. The graph keeps what it knew of the paths.
        """
        moved = dict(states)
        for name, off in by.items():
            moved[name] = replace(states[name], poses=states[name].poses + np.append(off, 0.0))
        stays = np.zeros(2)
        kept = [
            c for c in self.closures
            if np.hypot(*(by.get(c.robot, stays) - by.get(c.other, stays))) < ON_M
        ]  # fmt: skip
        so_far = {**self.by, **{name: self.by.get(name, stays) + off for name, off in by.items()}}
        return replace(self, states=moved, closures=kept, by=so_far)

    def uncertainty(self, steps: Sequence[Step]) -> "LandmarkUncertainty":
        """How well the relative position of landmarks is known that ``steps`` have."""
        seen: dict[int, dict[int, None]] = {}
        for step in steps:
            for a in step.associations:
                if isinstance(a.target, int):
                    seen.setdefault(a.target, {})[self.node(a.robot, a.time_ns)] = None
        nodes = {number: np.array(list(found)) for number, found in seen.items()}
        nodes |= {
            number: np.concatenate([self.places, nodes.get(number, self.places[:0])])
            for number in self.known
        }
        return LandmarkUncertainty(self.graph, nodes)


@dataclass(frozen=True, slots=True, eq=False)
class LandmarkUncertainty:
    """What the graph of submaps says about the relative position of landmarks.

    ``nodes``: landmark -> the submaps where it was seen. Called as `PairUncertainty`. A wall may be
    as long as the path: where it is at a place is known by the submap nearest to that place, not
    by the one, far away, where it was seen first.
    """

    graph: SubmapGraph
    nodes: Mapping[int, IntArray]

    def _nearest(self, landmarks: IntArray, at: Array) -> IntArray:
        """Of the submaps where each landmark (m,) was seen, the nearest to a place (m, 2)."""
        out = np.empty(len(landmarks), dtype=np.int64)
        for k, number in enumerate(landmarks.tolist()):
            nodes = self.nodes[number]
            d = self.graph.poses[nodes, :2] - at[k]
            out[k] = nodes[np.argmin(d[:, 0] ** 2 + d[:, 1] ** 2)]
        return out

    def __call__(self, a: IntArray, b: IntArray, at: Array, normals: Array) -> Array:
        """Sigmas (m, 2): across at a place (m, 2) with normals (m, 2), and of the direction."""
        if not len(a):
            return np.zeros((0, 2))
        i, j = self._nearest(a, at), self._nearest(b, at)
        h, cov = self.graph.relative(i, j)
        cov = CHAIN_INFLATION * cov
        base = self.graph.poses[j]
        c, s = np.cos(base[:, 2]), np.sin(base[:, 2])
        d = at - base[:, :2]
        # everything in the frame of submap j, in which errors of submap i are given
        x, y = c * d[:, 0] + s * d[:, 1] - h[:, 0], c * d[:, 1] - s * d[:, 0] - h[:, 1]
        nx, ny = c * normals[:, 0] + s * normals[:, 1], c * normals[:, 1] - s * normals[:, 0]
        g = np.column_stack([nx, ny, ny * x - nx * y])
        across = np.einsum("mi,mij,mj->m", g, cov, g)
        variances = np.column_stack([across, cov[:, 2, 2]])
        return np.asarray(np.sqrt(np.maximum(variances, 0.0)))


def unclosed_paths(scan_log: TrackedLog) -> dict[str, Trajectory]:
    """The states of every robot as tracked; their covariances are unknown."""
    return {name: tracked_states(scan_log.paths[name]) for name in scan_log.started}


def tracked_states(path: TrackedPath) -> Trajectory:
    """The states as tracked; their covariances are unknown."""
    unknown = np.full((len(path.times), 3, 3), np.nan)
    return Trajectory(np.array(path.times, dtype=np.int64), np.array(path.poses), unknown)


def close_paths(
    scan_log: TrackedLog,
    tamper: Tamper | None = None,
    *,
    match: bool = True,
    known_map: KnownMap | None = None,
) -> ClosedPaths:
    """Loops closed on a pose graph of submaps, and the paths that follow its solution.

    Without ``match`` nothing is closed. The places of a ``known_map``, in which the paths must lie,
    are visits that were before all others.
    """
    config, tracked = scan_log.config, unclosed_paths(scan_log)
    anchors = {name: np.array(scan_log.paths[name].anchors) for name in tracked}
    poses: list[Array] = []
    begin: list[int] = []
    delta, cov, first_nodes, start_covs = [], [], [], []
    starts = {name: start for step in scan_log.steps for name, start in step.starts.items()}
    for name, states in tracked.items():
        path, first = scan_log.paths[name], len(poses)
        first_nodes.append(first)
        start = starts[name]
        start_covs.append(rotate_cov(start.cov, -float(start.pose[2])))
        poses += list(states.poses[anchors[name]])
        begin += range(first, len(poses) - 1)
        steps, noise = path.anchor_steps()
        delta.append(steps)
        cov.append(noise)
    places = np.zeros(0, dtype=np.int64)
    if known_map is not None:  # each place is a path of its own
        places = np.arange(len(poses), len(poses) + len(known_map.places))
        poses += [place.pose for place in known_map.places]
        first_nodes += places.tolist()
        start_covs += [PLACE_COV] * len(places)
    chain = SubmapConstraints(
        np.array(begin, dtype=np.int64),
        np.array(begin, dtype=np.int64) + 1,
        np.concatenate(delta),
        np.concatenate(cov),
    )
    graph = SubmapGraph(np.array(poses), chain, first_nodes, np.array(start_covs))
    submaps: list[SubmapPose] = []
    numbers: IntArray = np.zeros(0, dtype=np.int64)
    if match:
        submaps, numbers = submaps_at(anchors, tracked, scan_log.keyframe_scans, config)
    # earlier visits come first
    earlier = [] if known_map is None else [*known_map.places]
    visited, nodes = [*earlier, *submaps], np.concatenate([places, numbers])
    closed = close_loops(visited, nodes, graph, config.loop_closure, tamper)
    own = tuple(c for c in closed.correcting if MAP_ROBOT not in (c.robot, c.other))
    moved, times, firsts, first = {}, {}, {}, 0
    for name, states in tracked.items():
        at = anchors[name]
        moved[name] = replace(
            states,
            poses=move_between_anchors(states.poses, at, graph.poses[first : first + len(at)]),
        )
        times[name], firsts[name] = states.stamps_ns[at], first
        first += len(at)
    return ClosedPaths(
        moved, own, closed.refused, neighbourhoods(submaps), graph, times, firsts, places,
        () if known_map is None else known_map.known.means.keys(),
        len(closed.correcting) - len(own),
    )  # fmt: skip


def neighbourhoods(submaps: Sequence[SubmapPose]) -> dict[State, Span]:
    """State of each submap -> the time that its robot was around there: also its neighbours'."""
    found = {}
    for k, submap in enumerate(submaps):
        near = [
            other.span_ns
            for other in submaps[max(k - 1, 0) : k + 2]
            if other.state[0] == submap.state[0]
        ]
        found[submap.state] = min(a for a, _ in near), max(b for _, b in near)
    return found


def move_between_anchors(poses: Array, anchors: Array, at: Array) -> Array:
    """A path (n, 3) after its poses ``anchors`` (k,), the first and last included, moved to ``at``.

    In between, the disagreement is spread over the path in proportion to its length.
    """
    i = np.clip(np.searchsorted(anchors, np.arange(len(poses)), side="right") - 1, 0, None)
    j = np.minimum(i + 1, len(anchors) - 1)
    from_last = between(poses[anchors[i]], poses)
    placed = compose(at[i], from_last)
    whole = between(poses[anchors[i]], poses[anchors[j]])
    miss = log(between(compose(at[i], whole), at[j]))
    driven = path_length(poses)
    along, length = driven - driven[anchors[i]], driven[anchors[j]] - driven[anchors[i]]
    share = np.where(length > 0, along / np.where(length > 0, length, 1.0), 0.0)
    return compose(placed, exp(share[:, None] * miss))
