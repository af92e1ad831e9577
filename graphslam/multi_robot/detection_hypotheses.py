"""Where a robot of known outline may be in another one's scans, if it can be anywhere.

One scan does not tell a robot from furniture, people or a robot that looks the same. Over a drive
it can be told: odometry says along which path, and when, its outline must show. Whatever stands
free, has about the right size and does not always stand there is *supposed* to be the robot; most
of it is not. Over each stretch of the robot's way, two supposed sightings that are as far apart as
odometry says put the whole stretch on the observer's map. The places that most others confirm are
followed as far as both robots' estimates lead, for several differences of their clocks.

A rigid move keeps distances: see `relating`, whose search for a largest set this replaces where
nearly all pairs are false, by votes over short stretches.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from graphslam.core.consistency import fit_rigid_transform
from graphslam.core.geometry import (
    Array,
    between,
    compose,
    inverse,
    path_length,
    rotation,
    transform,
)
from graphslam.core.records import Scan
from graphslam.multi_robot.relative_frames import RobotEstimate
from graphslam.multi_robot.robot_detection import MARGIN_M
from graphslam.odometry.readings import IntArray
from graphslam.perception.dynamic_objects import MIN_SHARE as STANDING_SHARE
from graphslam.perception.dynamic_objects import returns_present_before
from graphslam.perception.ordered_scan import Sweep, make_sweep
from graphslam.perception.robot_outlines import (
    MIN_RETURNS,
    cluster_centres,
    free_standing_clusters,
    outline_radius,
)

#: of an outline's least width, at least seen
SHARE = 0.5
#: of the way from middle to surface, how deep the middle lies behind the returns on average: pi/4
#: for a circle, a little more or less for a box
DEPTH = 0.78
#: m: sigma of where the middle is, beyond what the outline's shape leaves open
MIDDLE_M = 0.04
#: m: stretches of the robot's way that are put on the map, and from one to the next
STRETCH_M, STEP_M = 4.0, 2.0
#: m: two supposed sightings that put a stretch on the map are so far apart
BASE_M = 1.0
#: pairs per stretch that are tried at most
PAIRS = 2000
#: supposed sightings that must confirm a place, and places per stretch and in all that are followed
CONFIRMED, PER_STRETCH, FOLLOWED = 5, 3, 30
#: m: places of a stretch nearer to each other than this are one
SAME_M = 0.4
#: sigmas: how far supposed sightings lie from where a place has the robot
GATE = 3.0
#: rad: sigma of the turn of a stretch before it was fitted
TURN_RAD = 0.06
#: m: a robot is followed as far as its place is known so well
SURE_M = 0.3
#: rounds of finding supposed sightings and fitting the place to them
ROUNDS = 4
#: shared part of two places' supposed sightings from which on they are one
ALIKE = 0.8
#: differences of clocks that are tried, in sigmas of what they may be
SHIFTS = np.linspace(-2.0, 2.0, 11)


@dataclass(frozen=True, slots=True, eq=False)
class ScanSequence:
    """What one robot's laser saw: m scans with everything that is known of where they were taken.

    ``times_ns`` (m,); ``poses`` (m, 3) of the base in the robot's own frame with ``covs``
    (m, 3, 3), ``lasers`` (m, 3) of the laser.
    """

    view: RobotEstimate
    scans: Sequence[Scan]
    sweeps: Sequence[Sweep]
    times_ns: IntArray
    poses: Array
    covs: Array
    lasers: Array

    @classmethod
    def of(cls, view: RobotEstimate, scans: Sequence[Scan], max_range_m: float) -> "ScanSequence":
        """Scans, in order of time, and where they were taken."""
        times = np.array([scan.time_ns for scan in scans], dtype=np.int64)
        poses, covs = view.at(times)
        lasers = compose(poses, np.array([scan.mount for scan in scans]))
        sweeps = [make_sweep(scan, max_range_m) for scan in scans]
        return cls(view, scans, sweeps, times, poses, covs, lasers)

    def some(self, use: IntArray) -> "ScanSequence":
        """Only scans number ``use``."""
        return ScanSequence(
            self.view,
            [self.scans[k] for k in use],
            [self.sweeps[k] for k in use],
            self.times_ns[use],
            self.poses[use],
            self.covs[use],
            self.lasers[use],
        )


@dataclass(frozen=True, slots=True, eq=False)
class Path:
    """Where a robot says it was when another's m scans were taken.

    ``poses`` (s, m, 3), in its own frame, for each of ``shifts_s`` (s,): so much later by its own
    clock; ``covs`` (m, 3, 3). ``length_m`` (m,) of the way up to there.
    """

    view: RobotEstimate
    shifts_s: Array
    poses: Array
    covs: Array
    length_m: Array

    @classmethod
    def of(cls, view: RobotEstimate, times_ns: IntArray, doubt_s: float) -> "Path":
        """The path at times (m,), for differences of clocks of which ``doubt_s`` is the sigma."""
        shifts = doubt_s * SHIFTS
        at = [view.at(times_ns + round(1e9 * shift)) for shift in shifts]
        poses = np.array([found for found, _ in at])
        middle = len(shifts) // 2
        return cls(view, shifts, poses, at[middle][1], path_length(poses[middle]))

    @property
    def now(self) -> Array:
        """Poses (m, 3) if the clocks agree."""
        return np.asarray(self.poses[len(self.shifts_s) // 2])


@dataclass(frozen=True, slots=True, eq=False)
class CandidateDetections:
    """n things that may be the robot: in scan number ``scan`` (n,), in order, at ``points`` (n, 2).

    Points are where the outline's middle would be, m, in the observer's frame, with ``variance``
    (n,) m² along each axis.
    """

    scan: IntArray
    points: Array
    variance: Array


@dataclass(frozen=True, slots=True, eq=False)
class StartHypothesis:
    """Where a robot may have begun in the frame of its observer.

    ``pose`` (3,); its clock is ``shift_s`` later than the observer's. ``hits``: which supposed
    sightings confirm it, and how well: ``score``. ``spread`` (m,) m²: variance of where it has the
    robot in each scan, along each axis; ``turn_sigma`` rad. ``drift``: the least that both robots'
    ways from their beginnings to a hit add to its covariance, m².
    """

    pose: Array
    shift_s: float
    hits: IntArray
    score: float
    spread: Array
    turn_sigma: float
    drift: float

    @property
    def order(self) -> tuple[int, float]:
        """Sorts places: the better confirmed first, of about equals those with less drift."""
        return _support_rank(self.score), self.drift


def _support_rank(count: float) -> int:
    """Smaller for larger counts, the same for about equal ones."""
    return -round(2 * float(np.log2(count)))


def scans_with_robot_away(poses: Array, k: int, apart_m: float) -> list[int]:
    """The scans next before and after scan ``k`` with the robot, at ``poses`` (m, 3), elsewhere."""
    far = np.hypot(*(poses[:, :2] - poses[k, :2]).T) > apart_m
    before, after = np.flatnonzero(far[:k]), np.flatnonzero(far[k + 1 :])
    return [*before[-1:].tolist(), *(after[:1] + k + 1).tolist()]


def candidate_detections(watch: ScanSequence, path: Path, outline: Array) -> CandidateDetections:
    """Everything in the scans that has about the size of ``outline`` (k, 2) and moves about."""
    size, (_, thin, wide) = outline_radius(outline), outline_extent(outline)
    depth, shaped = DEPTH * (thin + wide) / 2, (wide - thin) / 2
    number, points, variance = [], [], []
    for k, sweep in enumerate(watch.sweeps):
        found = free_standing_clusters(sweep, 2 * size + MARGIN_M)
        if not len(found):
            continue
        standing = np.zeros(len(found), dtype=np.bool_)
        count = found.last - found.first + 1
        for j in scans_with_robot_away(path.now, k, 2 * size):
            then = between(watch.lasers[j], watch.lasers[k])
            same = returns_present_before(sweep.points, watch.sweeps[j], then)
            sums = np.concatenate([[0], np.cumsum(same)])
            standing |= sums[found.last + 1] - sums[found.first] >= STANDING_SHARE * count
        at = cluster_centres(sweep, found)
        r = np.hypot(*at.T)
        width = np.hypot(*(sweep.points[found.last] - sweep.points[found.first]).T)
        width += sweep.step_rad * r
        use = ~standing & (count >= MIN_RETURNS) & (width >= SHARE * 2 * thin)
        behind = at[use] * (1 + depth / np.maximum(r[use], depth))[:, None]
        points.append(transform(watch.lasers[k], behind))
        variance.append(MIDDLE_M**2 + shaped**2 + (sweep.step_rad * r[use]) ** 2)
        number.append(np.full(int(use.sum()), k))
    if not number:
        return CandidateDetections(np.zeros(0, dtype=np.int64), np.zeros((0, 2)), np.zeros(0))
    return CandidateDetections(*map(np.concatenate, (number, points, variance)))


def outline_extent(outline: Array) -> tuple[Array, float, float]:
    """Middle (2,) of an outline's corners (k, 2), and its least and greatest distance to them."""
    low, high = outline.min(axis=0), outline.max(axis=0)
    middle = (low + high) / 2
    a, b = outline - middle, np.roll(outline, -1, axis=0) - middle
    side = b - a
    across = np.abs(a[:, 0] * side[:, 1] - a[:, 1] * side[:, 0]) / np.hypot(*side.T)
    return middle, float(across.min()), float(np.hypot(*a.T).max())


def start_hypotheses(
    watch: ScanSequence, path: Path, outline: Array, seen: CandidateDetections
) -> list[StartHypothesis]:
    """Where the robot of ``outline`` (k, 2) may have begun, the best confirmed first.

    No two are confirmed by the same sightings.
    """
    middle, _, _ = outline_extent(outline)
    # of equals the earlier: less drift is on the way to it
    seeds = sorted(
        _path_seeds(path, middle, seen), key=lambda seed: (_support_rank(seed[0]), seed[1])
    )
    found = []
    for _, k, pose in seeds[:FOLLOWED]:
        follow = _PathFitter(watch, path, middle, seen, k)
        each = [follow.placed(pose, n) for n in range(len(path.shifts_s))]
        best = max((place for place in each if place), key=lambda p: p.score, default=None)
        if best is not None:
            found.append(best)
    kept: list[StartHypothesis] = []
    for place in sorted(found, key=lambda p: -p.score):
        if not any(_share_detections(place, better) for better in kept):
            kept.append(place)
    return sorted(kept, key=lambda p: p.order)


def _share_detections(place: StartHypothesis, better: StartHypothesis) -> bool:
    shared = len(np.intersect1d(place.hits, better.hits))
    return shared > ALIKE * min(len(place.hits), len(better.hits))


def _at(poses: Array, middle: Array) -> Array:
    """Where an outline's middle (2,) is at poses (m, 3)."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    x, y = middle
    return np.asarray(poses[:, :2] + np.column_stack([c * x - s * y, s * x + c * y]))


def _path_seeds(
    path: Path, middle: Array, seen: CandidateDetections
) -> list[tuple[int, int, Array]]:
    """Stretches put on the map: by how many confirmed, a scan amid it, the robot's pose then."""
    q = _at(path.now, middle)
    out = []
    for begin in np.arange(0.0, max(path.length_m[-1] - STEP_M, STEP_M), STEP_M):
        end = begin + STRETCH_M
        first, last = np.searchsorted(path.length_m, [begin, end])
        low, high = np.searchsorted(seen.scan, [first, last])
        if len(np.unique(seen.scan[low:high])) < CONFIRMED:
            continue
        k = int((first + min(last, len(q) - 1)) // 2)
        for votes, turn, at in _vote(
            seen.points[low:high], q[seen.scan[low:high]], q[k], seen, slice(low, high)
        ):
            heading = path.now[k, 2] + turn
            pose = np.array([*(at - rotation(heading) @ middle), heading])
            out.append((votes, k, pose))
    return out


def _vote(
    p: Array, q: Array, pivot: Array, seen: CandidateDetections, part: slice
) -> list[tuple[int, float, Array]]:
    """Ways to put points ``q`` (n, 2) where ``p`` (n, 2) are: votes, turn, where ``pivot`` gets."""
    scan, variance = seen.scan[part], seen.variance[part]
    i, j = np.triu_indices(len(p), 1)
    u, v = p[j] - p[i], q[j] - q[i]
    apart = np.hypot(*v.T)
    off = np.abs(np.hypot(*u.T) - apart)
    use = np.flatnonzero((apart >= BASE_M) & (off < GATE * np.sqrt(variance[i] + variance[j])))
    use = use[:: 1 + len(use) // PAIRS]
    i, j, u, v = i[use], j[use], u[use], v[use]
    turn = np.arctan2(u[:, 1], u[:, 0]) - np.arctan2(v[:, 1], v[:, 0])
    c, s = np.cos(turn)[:, None], np.sin(turn)[:, None]
    about, to = (q[i] + q[j]) / 2, (p[i] + p[j]) / 2

    def moved(points: Array) -> Array:
        """(h, n, 2): n points by every way."""
        x, y = (points[None] - about[:, None]).transpose(2, 0, 1)
        return np.stack([c * x - s * y, s * x + c * y], axis=2) + to[:, None]

    close = ((p - moved(q)) ** 2).sum(axis=2) < GATE**2 * variance
    border = np.flatnonzero(np.diff(scan, prepend=-1))
    votes = np.logical_or.reduceat(close, border, axis=1).sum(axis=1)
    at = moved(pivot[None])[:, 0]
    out: list[tuple[int, float, Array]] = []
    while len(out) < PER_STRETCH and len(votes) and votes.max() >= CONFIRMED:
        best = int(votes.argmax())
        out.append((int(votes[best]), float(turn[best]), at[best]))
        same = (np.hypot(*(at - at[best]).T) < SAME_M) & (np.cos(turn - turn[best]) > 0.95)
        votes = np.where(same, 0, votes)
    return out


class _PathFitter:
    """From one scan, where a robot is supposed to be at a pose, to all others."""

    def __init__(
        self, watch: ScanSequence, path: Path, middle: Array, seen: CandidateDetections, k: int
    ) -> None:
        self._path, self._middle, self._seen, self._k = path, middle, seen, k
        lever = np.hypot(*(seen.points - watch.poses[seen.scan, :2]).T)
        own = _relative_variance(watch.view, watch.times_ns, watch.covs, k)
        theirs = _relative_variance(path.view, watch.times_ns, path.covs, k)
        self._drift = own[0] + theirs[0]
        self._whole = (watch.covs + path.covs).trace(axis1=1, axis2=2)
        self._noise = seen.variance + self._drift[seen.scan] + lever**2 * own[1][seen.scan]

    def placed(self, pose: Array, number: int) -> StartHypothesis | None:
        """The place, with shift ``number`` of the clocks, that has the robot at ``pose`` (3,)."""
        seen, poses = self._seen, self._path.poses[number]
        q = _at(poses, self._middle)
        start, turn_var, pivot = compose(pose, inverse(poses[self._k])), TURN_RAD**2, q[self._k]
        hits, score = np.zeros(0, dtype=np.int64), 0.0
        for _ in range(ROUNDS):
            turned = turn_var * ((q - pivot) ** 2).sum(axis=1)
            spread = self._noise + turned[seen.scan]
            off2 = ((seen.points - transform(start, q)[seen.scan]) ** 2).sum(axis=1) / spread
            near = np.flatnonzero((off2 < GATE**2) & (spread < SURE_M**2))
            order = near[np.lexsort((off2[near], seen.scan[near]))]
            hits = order[np.flatnonzero(np.diff(seen.scan[order], prepend=-1))]
            if len(hits) < CONFIRMED:
                return None
            score = float((1 - off2[hits] / GATE**2).sum())
            at, weight = q[seen.scan[hits]], self._noise[hits]
            start, cov = fit_rigid_transform(seen.points[hits], at, weight)
            turn_var, pivot = float(cov[2, 2]), np.average(at, axis=0, weights=1 / weight)
        spread = self._drift + turn_var * ((q - pivot) ** 2).sum(axis=1)
        shift = float(self._path.shifts_s[number])
        drift = float(self._whole[seen.scan[hits]].min())
        return StartHypothesis(start, shift, hits, score, spread, float(np.sqrt(turn_var)), drift)


def _relative_variance(
    view: RobotEstimate, times_ns: IntArray, covs: Array, k: int
) -> tuple[Array, Array]:
    """Variances (m,) of position, m², and heading, rad², relative to the k-th of m times.

    By odometry or by the estimates, whichever is less.
    """
    moved = view.track.motions(np.full_like(times_ns, times_ns[k]), times_ns).cov
    apart = covs + covs[k]
    place = [c[:, 0, 0] + c[:, 1, 1] for c in (moved, apart)]
    return np.minimum(*place), np.minimum(moved[:, 2, 2], apart[:, 2, 2])


def scans_by_robot(scans: Sequence[Scan]) -> Mapping[str, list[Scan]]:
    """Scans of each robot, in order of time."""
    out: dict[str, list[Scan]] = {}
    for scan in sorted(scans, key=lambda scan: scan.time_ns):
        out.setdefault(scan.robot, []).append(scan)
    return out
