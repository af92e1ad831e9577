"""Loops that are closed while a robot drives: places are recognised beside the estimation.

Landmarks are recognised where the estimate says that they are. Where it has drifted by more than it
knows, a place that is passed again would be mapped a second time. So scans are compared as well: a
state every few metres is kept with the scans around it, as a *place*, and each new one is searched
for in those that may be the same (`mapping.loop_closure`), pair by pair with the next scans. What
two searches agree on becomes a closure between two kept states. The estimate then moves at once,
and says so. It only has to come near enough for landmarks to be recognised, which tell more and
come from the same scans: so a closure enters far less certain than its match (`CLOSURE_INFLATION`).

Places stay, one where several are near each other; of each of the others three dormant variables
may be left.
"""

from collections import defaultdict, deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from graphslam.core.config import Config
from graphslam.core.geometry import Array, adjoint, between, compose
from graphslam.core.records import Closure, KeyframeScan
from graphslam.estimation.fixed_lag import FixedLagBackend
from graphslam.mapping.loop_closure import (
    COV_INFLATION,
    MARGIN,
    NEAR_M,
    SIGMAS,
    SubmapPair,
    Verified,
    consistent_closures,
    fix_position,
    known_part,
    verify_pairs,
)
from graphslam.mapping.submap_graph import relative_jacobian
from graphslam.mapping.submaps import MIN_POINTS, State, SubmapPose, submaps_around

#: places that a new one is compared with, at most
MOST_COMPARED = 4
#: comparisons that wait, at most: where all scans are keyframes, older ones are given up
MOST_WAITING = 16
#: ns between comparisons, at least: scans that come all at once do not wait for many of them. One
#: takes 5 ms in the median and 35 ms at most (Intel, ACES), less than to have a second process do
#: it, whose answer would come sooner or later from run to run
APART_NS = 100_000_000
#: places that must agree, at least: if the estimate may be as far off as they say, and if its
#: covariance denies that; m: the last ones are so far back
AGREEING, AGAINST, RECENT_M = 2, 3, 40.0
#: factor on the covariance of a match where it enters as a closure; sigmas are 9 cm and 0.02 rad
#: mostly then. Scans around a place are laid by the path as it was estimated there: drift within
#: its 6 m bends both sides of a match (chi-square up to 66 and 190 where odometry turns by 0.02 and
#: 0.03 rad a metre too much). And the places that agree see the same walls, which their landmarks
#: count once more. Mean errors of live relations of Intel without its first 20 and 300 s by 1 and
#: 16: 0.088, 0.077 and 0.077, 0.054 m, without any closure 0.077 and 0.053; loops of ACES with two
#: draws of noise on its odometry 0.74, 0.75 and 0.84, 0.71 m, without closures 1.9 and 1.3
CLOSURE_INFLATION = 16.0
#: m, m, rad: sigmas of a drift that the covariance does not know of, common to the last places
UNKNOWN_DRIFT = np.array([3.0, 3.0, 0.2])
#: m, rad: a closure that moves the estimate by less only confirms it
CONFIRMED = (0.3, 0.05)
#: m, rad: a place that is recognised so near an earlier one is the same
SAME_M, SAME_RAD = 1.5, 0.8


@dataclass(slots=True, eq=False)
class _Trail:
    """The last metres of a robot's path, without the jumps of the estimate.

    ``poses`` (3,) follow each other as the estimate had them when the later one was new; ``path_m``
    driven there. ``places`` are the times of places that the robot has not left yet.
    """

    scans: list[KeyframeScan] = field(default_factory=list)
    poses: list[Array] = field(default_factory=list)
    path_m: list[float] = field(default_factory=list)
    places: list[int] = field(default_factory=list)

    def add(self, scan: KeyframeScan, moved: Array) -> None:
        """A scan, and how the robot moved (3,) since the one before."""
        last = self.poses[-1] if self.poses else np.zeros(3)
        driven = self.path_m[-1] if self.path_m else 0.0
        self.scans.append(scan)
        self.poses.append(compose(last, moved))
        self.path_m.append(driven + float(np.hypot(moved[0], moved[1])))

    def index(self, time_ns: int) -> int:
        """The number of the scan of a state."""
        return next(k for k, scan in enumerate(self.scans) if scan.time_ns == time_ns)

    def forget_before(self, path_m: float) -> None:
        """Drop what is farther back."""
        first = int(np.searchsorted(self.path_m, path_m))
        for each in (self.scans, self.poses, self.path_m):
            del each[:first]


class LoopCloser:
    """The places of all robots, and the loops that they close."""

    def __init__(self, config: Config, backend: FixedLagBackend, frames: Mapping[str, str]) -> None:
        """No place yet; ``frames``: robot -> its frame. What is in another one closes no loop."""
        self._config, self._backend, self._frames = config, backend, frames
        self._trails: dict[str, _Trail] = defaultdict(_Trail)
        self._places: list[SubmapPose] = []
        self._waiting: deque[SubmapPair] = deque(maxlen=MOST_WAITING)
        self._compared_ns = -APART_NS
        self._found: list[Closure] = []  # of recent places
        self._repeated: set[State] = set()  # places that are earlier ones

    def add(self, scans: Iterable[KeyframeScan]) -> None:
        """Take in the scans of new states, in the order of time."""
        settings = self._config.loop_closure
        for scan in scans:
            trail = self._trails[scan.robot]
            moved = np.zeros(3)
            if trail.scans:
                ends = (trail.scans[-1].time_ns, scan.time_ns)
                moved = between(*(self._backend.pose_of(scan.robot, t) for t in ends))
            trail.add(scan, moved)
            last = trail.places[-1] if trail.places else None
            since = np.inf if last is None else trail.path_m[-1] - trail.path_m[trail.index(last)]
            if since >= settings.submap_spacing_m:
                self._backend.keep(scan.robot, scan.time_ns)
                trail.places.append(scan.time_ns)
            while (
                len(trail.places) > 1
                and trail.path_m[-1] - trail.path_m[trail.index(trail.places[0])]
                >= settings.submap_reach_m
            ):
                self._complete(scan.robot, trail, trail.places.pop(0))
                first = trail.path_m[trail.index(trail.places[0])]
                trail.forget_before(first - settings.submap_reach_m)
                self._drop_repeated()

    def _complete(self, robot: str, trail: _Trail, time_ns: int) -> None:
        """A place that its robot has left is searched for in the earlier ones."""
        shown = [k for k, scan in enumerate(trail.scans) if len(scan.points) >= MIN_POINTS]
        own = trail.index(time_ns)
        if own not in shown:  # nothing is in reach there
            self._backend.drop(robot, time_ns)
            return
        scans, poses = [trail.scans[k] for k in shown], np.array(trail.poses)[shown]
        stamps = np.array([scan.time_ns for scan in scans], dtype=np.int64)
        clouds = {(robot, scan.time_ns): scan for scan in scans}
        middle = np.array([shown.index(own)], dtype=np.int64)
        (made,) = submaps_around(robot, poses, stamps, middle, clouds, self._config)
        place = replace(made, path_m=trail.path_m[own])
        self._waiting += self._candidates(place)
        self._places.append(place)

    def _drop_repeated(self) -> None:
        """Keep the first of places that are one, once no closure waits for the others."""
        gone = [p for p in self._places if p.state in self._repeated and not self._is_recent(p)]
        for place in gone:
            if self._backend.drop(*place.state):
                self._places.remove(place)
                self._repeated.discard(place.state)

    def _is_recent(self, place: SubmapPose) -> bool:
        """Whether its robot has not driven far since."""
        return self._trails[place.state[0]].path_m[-1] - place.path_m <= RECENT_M

    def _candidates(self, place: SubmapPose) -> list[SubmapPair]:
        """Earlier places that it may show, and where: the nearest ones."""
        settings = self._config.loop_closure
        others = [
            other
            for other in self._places
            if self._frames[other.state[0]] == self._frames[place.state[0]]
            and (
                other.state[0] != place.state[0]
                or place.path_m - other.path_m >= settings.revisit_path_m
            )
        ]
        if not others:
            return []
        limit = np.array([settings.search_max_m, settings.search_max_m, settings.search_max_rad])
        poses = np.array([self._backend.pose_of(*other.state) for other in others])
        here = self._backend.pose_of(*place.state)
        distance = np.hypot(*(poses[:, :2] - here[:2]).T)
        pairs = []
        for k in np.argsort(distance)[:MOST_COMPARED].tolist():
            if distance[k] > NEAR_M + limit[0]:
                break
            both, cov = self._backend.poses([others[k].state, place.state])
            guess = between(both[0], both[1])
            H = relative_jacobian(guess)
            sigma = np.sqrt(COV_INFLATION * np.diag(H @ cov @ H.T))
            window = np.minimum(SIGMAS * sigma + MARGIN, limit)
            if distance[k] <= NEAR_M + window[:2].max():
                pairs.append(SubmapPair(place, others[k], guess, window))
        return pairs

    def closures(self, time_ns: int) -> tuple[Closure, ...]:
        """The closures that are to enter the estimate now, at ``time_ns``; one pair is compared."""
        if not self._waiting or time_ns - self._compared_ns < APART_NS:
            return ()
        self._compared_ns = time_ns
        pair = self._waiting.popleft()
        (found,) = verify_pairs([pair], along=True)
        if found is None:
            return ()
        self._take(pair, found)
        return self._agreed()

    def _take(self, pair: SubmapPair, found: Verified) -> None:
        """Note what was found."""
        images = min(len(pair.later.submap.clouds), len(pair.earlier.submap.clouds))
        ends = *pair.later.state, *pair.earlier.state
        closure = Closure(*ends, found.pose, found.cov, verified=True, scan_count=images)
        self._found.append(closure)
        # along a corridor a match tells nothing, unless the estimate says the same
        is_told = not found.is_searched or fix_position([closure])[0]
        x, y, turn = np.abs(found.pose).tolist()
        if is_told and np.hypot(x, y) <= SAME_M and turn <= SAME_RAD:
            self._repeated.add(pair.later.state)

    def _agreed(self) -> tuple[Closure, ...]:
        """Of the closures so far, those that agree and move the estimate; they are spent."""
        if not self._found:
            return ()
        at = {place.state: place for place in self._places}
        self._found = [
            c for c in self._found if at.keys() >= set(c.pair) and self._is_recent(at[c.pair[0]])
        ]
        closures = self._found
        if _count_places(closures) < AGREEING:
            return ()
        states = list(dict.fromkeys(s for c in closures for s in c.pair))
        poses, cov = self._backend.poses(states)
        placed = [replace(at[s], pose=pose) for s, pose in zip(states, poses, strict=True)]
        agreed = consistent_closures(closures, placed, cov)
        if _count_places(agreed) < AGREEING:
            later = {c.pair[0] for c in closures}
            last = np.array([s in later for s in states])
            agreed = consistent_closures(closures, placed, cov + _drift(poses, last))
            if _count_places(agreed) < AGAINST:
                return ()
        pose_of = dict(zip(states, poses, strict=True))
        off = np.array([
            between(c.delta, between(pose_of[c.pair[1]], pose_of[c.pair[0]])) for c in agreed
        ])  # fmt: skip
        off = known_part(off, agreed)
        moves = (np.hypot(off[:, 0], off[:, 1]) > CONFIRMED[0]) | (np.abs(off[:, 2]) > CONFIRMED[1])
        used = {id(c) for c in agreed}
        self._found = [c for c in self._found if id(c) not in used]
        if not moves.any():
            return ()
        return tuple(replace(c, cov=CLOSURE_INFLATION * c.cov) for c in agreed)


def _count_places(closures: Sequence[Closure]) -> int:
    """How many places are said to be earlier ones."""
    return len({(c.robot, c.time_ns) for c in closures})


def _drift(poses: Array, last: Array) -> Array:
    """Covariance (3n, 3n) of `UNKNOWN_DRIFT`, by which the ``last`` of poses (n, 3) moved together.

    It is that of a move of all of them about the first; errors are along each one's own axes.
    """
    moved = np.zeros((len(poses), 3, 3))
    moved[last] = adjoint(between(poses[last], poses[last][0]))
    J = moved.reshape(-1, 3) * UNKNOWN_DRIFT
    return np.asarray(J @ J.T)
