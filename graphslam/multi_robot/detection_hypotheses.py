"""Hypotheses where a robot of known outline began, from what might be it in another one's scans.

One scan does not tell a robot from furniture, people or a robot that looks the same. A drive does:
odometry predicts along which path, and when, its outline must show. Whatever stands free, has about
the right size and does not always stand there is a *candidate detection*; most are false. Over each
stretch of the robot's path, two candidates that are as far apart as odometry says place the whole
stretch on the observer's map. The placements that most other candidates support are extended as far
as both robots' estimates allow, for several offsets of their clocks.

This takes the place of the search for a largest consistent set in `relative_frames` where nearly
all correspondences are false: by votes over short stretches.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from graphslam.core.arrays import IntArray
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
from graphslam.multi_robot.robot_detection import MARGIN_M, MAX_POSITION_SIGMA_M
from graphslam.perception.dynamic_objects import MIN_SHARE as STANDING_SHARE
from graphslam.perception.dynamic_objects import returns_present_before
from graphslam.perception.ordered_scan import Sweep, make_sweep
from graphslam.perception.robot_outlines import (
    MIN_RETURNS,
    cluster_centres,
    free_standing_clusters,
    outline_radius,
)

#: share of an outline's least width that must be visible
MIN_VISIBLE_SHARE = 0.5
#: mean depth of an outline's middle behind its returns, as a share of its mean radius: pi/4 for a
#: circle, a little more or less for a box
DEPTH_SHARE = 0.78
#: m: sigma of that middle, beyond what the outline's shape leaves open
MIDDLE_SIGMA_M = 0.04
#: m: length of the stretches of the path that are placed: short enough for odometry to keep its
#: shape, long enough to turn; from one to the next; least distance of the two candidates
STRETCH_M, STRETCH_STEP_M, MIN_BASE_M = 4.0, 2.0, 1.0
#: pairs of candidates per stretch, placements per stretch, and in all, at most: bound the run time
MAX_PAIRS, MAX_PER_STRETCH, MAX_EXTENDED = 2000, 3, 30
#: candidates that must support a placement; m: placements of a stretch nearer together are one,
#: about the size of a robot
MIN_SUPPORT, SAME_M = 5, 0.4
#: sigmas: gate of a candidate around the predicted position
GATE_SIGMAS = 3.0
#: rad: sigma of the heading of a stretch before it is fitted; rounds of gating and fitting
HEADING_SIGMA_RAD, ROUNDS = 0.06, 4
#: hypotheses that share more than this part of their inliers are one
SAME_SHARE = 0.8
#: clock offsets that are tried, in sigmas of the prior
OFFSET_SIGMAS = np.linspace(-2.0, 2.0, 11)


@dataclass(frozen=True, slots=True, eq=False)
class ScanSequence:
    """The m scans of one robot and where they were taken, in its own frame.

    ``times_ns`` (m,); ``poses`` (m, 3) of the base with ``covs`` (m, 3, 3); ``lasers`` (m, 3).
    """

    estimate: RobotEstimate
    scans: Sequence[Scan]
    sweeps: Sequence[Sweep]
    times_ns: IntArray
    poses: Array
    covs: Array
    lasers: Array

    @classmethod
    def of(
        cls, estimate: RobotEstimate, scans: Sequence[Scan], max_range_m: float
    ) -> "ScanSequence":
        """From scans in order of time."""
        times = np.array([scan.time_ns for scan in scans], dtype=np.int64)
        poses, covs = estimate.at(times)
        lasers = compose(poses, np.array([scan.mount for scan in scans]))
        sweeps = [make_sweep(scan, max_range_m) for scan in scans]
        return cls(estimate, scans, sweeps, times, poses, covs, lasers)

    def subset(self, use: IntArray) -> "ScanSequence":
        """Only scans number ``use``."""
        return ScanSequence(
            self.estimate,
            [self.scans[k] for k in use],
            [self.sweeps[k] for k in use],
            self.times_ns[use],
            self.poses[use],
            self.covs[use],
            self.lasers[use],
        )


@dataclass(frozen=True, slots=True, eq=False)
class PredictedPath:
    """Poses of a robot at the times of another one's m scans, in its own frame.

    ``poses`` (s, m, 3) for each of the clock offsets ``offsets_s`` (s,), by which its own clock is
    ahead; ``covs`` (m, 3, 3); ``length_m`` (m,) of the path up to each scan.
    """

    estimate: RobotEstimate
    offsets_s: Array
    poses: Array
    covs: Array
    length_m: Array

    @classmethod
    def of(
        cls, estimate: RobotEstimate, times_ns: IntArray, clock_sigma_s: float
    ) -> "PredictedPath":
        """At times (m,), for clock offsets of sigma ``clock_sigma_s``."""
        offsets = clock_sigma_s * OFFSET_SIGMAS
        at = [estimate.at(times_ns + round(1e9 * offset)) for offset in offsets]
        poses = np.array([found for found, _ in at])
        middle = len(offsets) // 2
        return cls(estimate, offsets, poses, at[middle][1], path_length(poses[middle]))

    @property
    def nominal(self) -> Array:
        """Poses (m, 3) if the clocks agree."""
        return np.asarray(self.poses[len(self.offsets_s) // 2])


@dataclass(frozen=True, slots=True, eq=False)
class CandidateDetections:
    """The n things that may be the robot, in order of the scan numbers ``scan`` (n,).

    ``points`` (n, 2) m: where the outline's middle would be, in the observer's frame, with
    ``variance`` (n,) m² along each axis.
    """

    scan: IntArray
    points: Array
    variance: Array


@dataclass(frozen=True, slots=True, eq=False)
class StartHypothesis:
    """Start of a robot in the frame of its observer.

    ``pose`` (3,); the robot's clock is ahead by ``clock_offset_s``. ``inliers``: indices of the
    candidates that support it, ``score``: how well. ``spread`` (m,) m²: variance of the predicted
    position in each scan, along each axis; ``heading_sigma`` rad. ``drift``, m²: least variance of
    both robots' drift from their starts to an inlier.
    """

    pose: Array
    clock_offset_s: float
    inliers: IntArray
    score: float
    spread: Array
    heading_sigma: float
    drift: float

    @property
    def rank(self) -> tuple[int, float]:
        """Sort key: better supported first, among about equals those with less drift."""
        return _support_rank(self.score), self.drift


def _support_rank(count: float) -> int:
    """Smaller for larger counts, the same for counts within about a fifth."""
    return -round(2 * float(np.log2(count)))


def scans_with_robot_away(poses: Array, k: int, distance_m: float) -> list[int]:
    """The last scan before and the first after scan ``k`` with the robot farther than a distance.

    ``poses`` (m, 3) of the robot at all scans.
    """
    far = np.hypot(*(poses[:, :2] - poses[k, :2]).T) > distance_m
    before, after = np.flatnonzero(far[:k]), np.flatnonzero(far[k + 1 :])
    return [*before[-1:].tolist(), *(after[:1] + k + 1).tolist()]


def candidate_detections(
    watch: ScanSequence, path: PredictedPath, outline: Array
) -> CandidateDetections:
    """Everything in the scans that has about the size of ``outline`` (k, 2) and does not stay."""
    size, (_, thin, wide) = outline_radius(outline), outline_extent(outline)
    depth, elongation = DEPTH_SHARE * (thin + wide) / 2, (wide - thin) / 2
    number, points, variance = [], [], []
    for k, sweep in enumerate(watch.sweeps):
        found = free_standing_clusters(sweep, 2 * size + MARGIN_M)
        if not len(found):
            continue
        standing = np.zeros(len(found), dtype=np.bool_)
        count = found.last - found.first + 1
        for j in scans_with_robot_away(path.nominal, k, 2 * size):
            relative = between(watch.lasers[j], watch.lasers[k])
            same = returns_present_before(sweep.points, watch.sweeps[j], relative)
            sums = np.concatenate([[0], np.cumsum(same)])
            standing |= sums[found.last + 1] - sums[found.first] >= STANDING_SHARE * count
        at = cluster_centres(sweep, found)
        r = np.hypot(*at.T)
        width = np.hypot(*(sweep.points[found.last] - sweep.points[found.first]).T)
        width += sweep.step_rad * r
        use = ~standing & (count >= MIN_RETURNS) & (width >= MIN_VISIBLE_SHARE * 2 * thin)
        behind = at[use] * (1 + depth / np.maximum(r[use], depth))[:, None]
        points.append(transform(watch.lasers[k], behind))
        variance.append(MIDDLE_SIGMA_M**2 + elongation**2 + (sweep.step_rad * r[use]) ** 2)
        number.append(np.full(int(use.sum()), k))
    if not number:
        return CandidateDetections(np.zeros(0, dtype=np.int64), np.zeros((0, 2)), np.zeros(0))
    return CandidateDetections(*map(np.concatenate, (number, points, variance)))


def outline_extent(outline: Array) -> tuple[Array, float, float]:
    """Middle (2,) of an outline's corners (k, 2), and least and greatest distance of it to them."""
    low, high = outline.min(axis=0), outline.max(axis=0)
    middle = (low + high) / 2
    a, b = outline - middle, np.roll(outline, -1, axis=0) - middle
    side = b - a
    distance = np.abs(a[:, 0] * side[:, 1] - a[:, 1] * side[:, 0]) / np.hypot(*side.T)
    return middle, float(distance.min()), float(np.hypot(*a.T).max())


def start_hypotheses(
    watch: ScanSequence, path: PredictedPath, outline: Array, seen: CandidateDetections
) -> list[StartHypothesis]:
    """Where the robot of ``outline`` (k, 2) may have begun, the best supported first.

    No two are supported by the same candidates.
    """
    middle, _, _ = outline_extent(outline)
    # of equals the earlier: less drift before it
    seeds = sorted(_path_seeds(path, middle, seen), key=lambda s: (_support_rank(s[0]), s[1]))
    found = []
    for _, k, pose in seeds[:MAX_EXTENDED]:
        fitter = _PathFitter(watch, path, middle, seen, k)
        fits = [fitter.fit(pose, n) for n in range(len(path.offsets_s))]
        best = max((fit for fit in fits if fit), key=lambda fit: fit.score, default=None)
        if best is not None:
            found.append(best)
    kept: list[StartHypothesis] = []
    for one in sorted(found, key=lambda one: -one.score):
        if not any(_share_inliers(one, better) for better in kept):
            kept.append(one)
    return sorted(kept, key=lambda one: one.rank)


def _share_inliers(one: StartHypothesis, better: StartHypothesis) -> bool:
    shared = len(np.intersect1d(one.inliers, better.inliers))
    return shared > SAME_SHARE * min(len(one.inliers), len(better.inliers))


def _middles(poses: Array, middle: Array) -> Array:
    """Positions (m, 2) of an outline's middle (2,) with the base at poses (m, 3)."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    x, y = middle
    return np.asarray(poses[:, :2] + np.column_stack([c * x - s * y, s * x + c * y]))


def _path_seeds(
    path: PredictedPath, middle: Array, seen: CandidateDetections
) -> list[tuple[int, int, Array]]:
    """Placed stretches: number of votes, a scan in the middle of it, the robot's pose then (3,)."""
    q = _middles(path.nominal, middle)
    seeds = []
    last_start = max(path.length_m[-1] - STRETCH_STEP_M, STRETCH_STEP_M)
    for begin in np.arange(0.0, last_start, STRETCH_STEP_M):
        first, last = np.searchsorted(path.length_m, [begin, begin + STRETCH_M])
        low, high = np.searchsorted(seen.scan, [first, last])
        if len(np.unique(seen.scan[low:high])) < MIN_SUPPORT:
            continue
        k = int((first + min(last, len(q) - 1)) // 2)
        part = CandidateDetections(
            seen.scan[low:high], seen.points[low:high], seen.variance[low:high]
        )
        for votes, turn, at in _place_stretch(part, q[part.scan], q[k]):
            heading = path.nominal[k, 2] + turn
            seeds.append((votes, k, np.array([*(at - rotation(heading) @ middle), heading])))
    return seeds


def _place_stretch(
    seen: CandidateDetections, q: Array, pivot: Array
) -> list[tuple[int, float, Array]]:
    """Rigid transforms of predicted positions ``q`` (n, 2) to n candidates, by votes.

    Returns:
        Number of scans with a candidate in the gate, turn (rad), where the transform takes
        ``pivot`` (2,).
    """
    p, variance = seen.points, seen.variance
    i, j = np.triu_indices(len(p), 1)
    u, v = p[j] - p[i], q[j] - q[i]
    length = np.hypot(*v.T)
    off = np.abs(np.hypot(*u.T) - length)
    gate = GATE_SIGMAS * np.sqrt(variance[i] + variance[j])
    use = np.flatnonzero((length >= MIN_BASE_M) & (off < gate))
    use = use[:: 1 + len(use) // MAX_PAIRS]
    i, j, u, v = i[use], j[use], u[use], v[use]
    turn = np.arctan2(u[:, 1], u[:, 0]) - np.arctan2(v[:, 1], v[:, 0])
    c, s = np.cos(turn)[:, None], np.sin(turn)[:, None]
    about, to = (q[i] + q[j]) / 2, (p[i] + p[j]) / 2

    def transformed(points: Array) -> Array:
        """(h, n, 2): n points by every transform."""
        x, y = (points[None] - about[:, None]).transpose(2, 0, 1)
        return np.stack([c * x - s * y, s * x + c * y], axis=2) + to[:, None]

    close = ((p - transformed(q)) ** 2).sum(axis=2) < GATE_SIGMAS**2 * variance
    first_of_scan = np.flatnonzero(np.diff(seen.scan, prepend=-1))
    votes = np.logical_or.reduceat(close, first_of_scan, axis=1).sum(axis=1)
    at = transformed(pivot[None])[:, 0]
    placed: list[tuple[int, float, Array]] = []
    while len(placed) < MAX_PER_STRETCH and len(votes) and votes.max() >= MIN_SUPPORT:
        best = int(votes.argmax())
        placed.append((int(votes[best]), float(turn[best]), at[best]))
        same = (np.hypot(*(at - at[best]).T) < SAME_M) & (np.cos(turn - turn[best]) > 0.95)
        votes = np.where(same, 0, votes)
    return placed


class _PathFitter:
    """Extends the placement of a stretch, from its middle scan k, as far as the path is known."""

    def __init__(
        self,
        watch: ScanSequence,
        path: PredictedPath,
        middle: Array,
        seen: CandidateDetections,
        k: int,
    ) -> None:
        self._path, self._middle, self._seen, self._k = path, middle, seen, k
        lever = np.hypot(*(seen.points - watch.poses[seen.scan, :2]).T)
        own, own_heading = _relative_variance(watch.estimate, watch.times_ns, watch.covs, k)
        other, _ = _relative_variance(path.estimate, watch.times_ns, path.covs, k)
        self._drift = own + other
        self._drift_from_start = (watch.covs + path.covs).trace(axis1=1, axis2=2)
        heading = lever**2 * own_heading[seen.scan]
        self._noise = seen.variance + self._drift[seen.scan] + heading

    def fit(self, pose: Array, number: int) -> StartHypothesis | None:
        """The start by clock offset ``number``, with the robot at about ``pose`` (3,) in scan k.

        None if too few candidates support it.
        """
        seen, poses = self._seen, self._path.poses[number]
        q = _middles(poses, self._middle)
        start = compose(pose, inverse(poses[self._k]))
        heading_var, pivot = HEADING_SIGMA_RAD**2, q[self._k]
        inliers, score = np.zeros(0, dtype=np.int64), 0.0
        for _ in range(ROUNDS):
            lever2 = ((q - pivot) ** 2).sum(axis=1)
            spread = self._noise + heading_var * lever2[seen.scan]
            d2 = ((seen.points - transform(start, q)[seen.scan]) ** 2).sum(axis=1) / spread
            near = np.flatnonzero((d2 < GATE_SIGMAS**2) & (spread < MAX_POSITION_SIGMA_M**2))
            # the nearest candidate of each scan
            order = near[np.lexsort((d2[near], seen.scan[near]))]
            inliers = order[np.flatnonzero(np.diff(seen.scan[order], prepend=-1))]
            if len(inliers) < MIN_SUPPORT:
                return None
            score = float((1 - d2[inliers] / GATE_SIGMAS**2).sum())
            at, variance = q[seen.scan[inliers]], self._noise[inliers]
            start, cov = fit_rigid_transform(seen.points[inliers], at, variance)
            heading_var, pivot = float(cov[2, 2]), np.average(at, axis=0, weights=1 / variance)
        spread = self._drift + heading_var * ((q - pivot) ** 2).sum(axis=1)
        offset = float(self._path.offsets_s[number])
        drift = float(self._drift_from_start[seen.scan[inliers]].min())
        heading_sigma = float(np.sqrt(heading_var))
        return StartHypothesis(start, offset, inliers, score, spread, heading_sigma, drift)


def _relative_variance(
    estimate: RobotEstimate, times_ns: IntArray, covs: Array, k: int
) -> tuple[Array, Array]:
    """Variances (m,) of position, m², and heading, rad², relative to the k-th of m times.

    By odometry or by the estimates, whichever is less.
    """
    odometry = estimate.track.motions(np.full_like(times_ns, times_ns[k]), times_ns).cov
    marginals = covs + covs[k]
    position = [c[:, 0, 0] + c[:, 1, 1] for c in (odometry, marginals)]
    return np.minimum(*position), np.minimum(odometry[:, 2, 2], marginals[:, 2, 2])


def scans_by_robot(scans: Sequence[Scan]) -> Mapping[str, list[Scan]]:
    """Scans of each robot, in order of time."""
    by_robot: dict[str, list[Scan]] = {}
    for scan in sorted(scans, key=lambda scan: scan.time_ns):
        by_robot.setdefault(scan.robot, []).append(scan)
    return by_robot
