"""The relative pose of two robots' frames, from landmarks and sightings that both have in common.

Each robot has been estimated by itself, in a separate frame. Correspondences are pairs of points
that are one point: a named landmark in both maps, or a robot where it was seen and where it
estimated itself to be. A rigid transform keeps distances, so two correspondences agree if their
points are as far apart in one frame as in the other.

The largest set of correspondences that agree in pairs is found (J. Mangelson et al., Pairwise
consistent measurement set maximization, ICRA 2018, DOI 10.1109/ICRA.2018.8460217; distances as the
invariant: P. Lusk et al., CLIPPER, ICRA 2021, DOI 10.1109/ICRA48506.2021.9561069). It must
determine the transform, and no set that contradicts it may have much more than half of its size.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from graphslam.core.arrays import BoolArray, IntArray
from graphslam.core.config import Config
from graphslam.core.consistency import (
    FIT_PROBABILITY,
    fit_rigid_transform,
    greedy_max_clique,
    has_rival,
    poses_differ,
    rival_set,
)
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import (
    Array,
    between,
    compose,
    compose_cov,
    inverse,
    inverse_cov,
    transform,
)
from graphslam.core.observation_models import MODELS
from graphslam.core.records import Sighting, Trajectory
from graphslam.odometry.increment_sums import Motions
from graphslam.odometry.preintegration import Track

#: probability of the chi-square test by which two distances agree
AGREE = 0.99
#: least evidence; a landmark counts twice, since it is an average over many sightings
MIN_EVIDENCE, LANDMARK_EVIDENCE = 4, 2
#: rad: larger sigmas of the heading mean that a set does not determine how the frames are turned
MAX_HEADING_SIGMA_RAD = 0.2
#: rad²: variance of a heading of which nothing is known
UNKNOWN_HEADING = np.pi**2 / 3
#: sightings of one robot by another that are used at most, evenly over the log: bounds the O(n²)
MAX_SIGHTINGS = 100
UNTIMED = -1


@dataclass(frozen=True, slots=True, eq=False)
class RobotEstimate:
    """Estimate of one robot from its own data, in the frame in which it begins at the origin.

    ``landmarks``: identity -> mean (2,), covariance (2, 2); ``anonymous_points``: means (n, 2) and
    covariances (n, 2, 2) of points without identity. ``sees``: whether the robot has scans or
    sightings; of one that has neither, and stands, nothing can tell the heading.
    """

    states: Trajectory
    track: Track
    landmarks: Mapping[str, tuple[Array, Array]]
    anonymous_points: tuple[Array, Array] = (np.zeros((0, 2)), np.zeros((0, 2, 2)))
    sees: bool = True

    def at(self, times_ns: IntArray) -> tuple[Array, Array]:
        """Poses (n, 3) and covariances (n, 3, 3): the last state before, propagated by odometry."""
        states = self.states
        i = states.index_before(times_ns)
        moved = self.motions(states.stamps_ns[i], times_ns)
        covs = compose_cov(states.poses[i], states.covs[i], moved.delta, moved.cov)
        return compose(states.poses[i], moved.delta), covs

    def motions(self, start_ns: IntArray, end_ns: IntArray) -> Motions:
        """Motions (n) by odometry between times (n,) and (n,)."""
        return self.track.motions(start_ns, end_ns)

    def known_at(self, times_ns: IntArray) -> "RobotEstimate":
        """The same, for questions about these times (n,) alone: odometry is summed up once."""
        first_ns = self.states.stamps_ns[self.states.index_before(times_ns)]
        among = self.track.motions_among(np.union1d(first_ns, times_ns))
        return _EstimateAtTimes(
            self.states, self.track, self.landmarks, self.anonymous_points, self.sees, among=among
        )


@dataclass(frozen=True, slots=True, eq=False)
class _EstimateAtTimes(RobotEstimate):
    """See `RobotEstimate.known_at`."""

    among: Callable[[IntArray, IntArray], Motions] = field(kw_only=True)

    def motions(self, start_ns: IntArray, end_ns: IntArray) -> Motions:
        """See `RobotEstimate`."""
        return self.among(start_ns, end_ns)


@dataclass(frozen=True, slots=True, eq=False)
class CorrespondenceSide:
    """The points of n correspondences in one robot's frame.

    ``points`` (n, 2) m; ``variance`` (n,) m² of the robot's own estimate of them; ``times_ns`` (n,)
    of the robot's pose, or `UNTIMED` for landmarks; ``range_m`` (n,) from the robot to the point.
    """

    points: Array
    variance: Array
    times_ns: IntArray
    range_m: Array

    def relative_variance(self, estimate: RobotEstimate, i: IntArray, j: IntArray) -> Array:
        """Variances (k,) m² of points j (k,) relative to i (k,), by the estimate or by odometry.

        Estimates of nearby times share most of their error, which a sum of marginals ignores:
        odometry between the two times may bound it better, so the smaller one is taken.
        """
        variance = self.variance[i] + self.variance[j]
        timed = np.flatnonzero((self.times_ns[i] != UNTIMED) & (self.times_ns[j] != UNTIMED))
        if len(timed):
            seen_from, to = i[timed], j[timed]
            cov = estimate.motions(self.times_ns[seen_from], self.times_ns[to]).cov
            odometry = cov[:, 0, 0] + cov[:, 1, 1] + self.range_m[to] ** 2 * cov[:, 2, 2]
            variance[timed] = np.minimum(variance[timed], odometry)
        return variance


@dataclass(frozen=True, slots=True, eq=False)
class RelativeFrame:
    """Start pose of ``robot`` in the frame of ``other``.

    ``pose`` (3,), ``cov`` (3, 3) along the axes of ``other``'s frame; ``weight`` is the evidence.
    """

    robot: str
    other: str
    pose: Array
    cov: Array
    weight: float

    def reversed(self) -> "RelativeFrame":
        """The inverse relation: the start of ``other`` in the frame of ``robot``."""
        cov = inverse_cov(self.pose, self.cov)
        return RelativeFrame(self.other, self.robot, inverse(self.pose), cov, self.weight)


def estimate_relative_frame(
    a: str,
    b: str,
    estimates: Mapping[str, RobotEstimate],
    sightings: Iterable[Sighting],
    config: Config,
) -> RelativeFrame | str:
    """Start of ``b`` in the frame of ``a``, or why it is unknown ("" without enough evidence).

    Args:
        a: name of a robot.
        b: name of another one.
        estimates: of each robot by itself.
        sightings: of robots by robots, any of them.
        config: settings; sightings closer than `multi_robot.sampling_m` are skipped.

    Where ``b`` sees nothing its heading may be unknown, as that of a robot that only stands and is
    seen; its place is not. Then there is no start of ``a`` in the frame of ``b``.
    """
    sides, noise, weight = _correspondences(a, b, estimates, sightings, config)
    if weight.sum() < MIN_EVIDENCE:
        return ""
    p, q = sides
    agree = _agree(sides, (estimates[a], estimates[b]), noise)
    variance = p.variance + q.variance + noise
    best = _remove_outliers(greedy_max_clique(agree, weight), p.points, q.points, variance)
    if weight[best].sum() < MIN_EVIDENCE:
        return f"too few consistent correspondences between {a} and {b}"
    unknown = np.inf if estimates[b].sees else UNKNOWN_HEADING
    pose, cov = fit_rigid_transform(p.points[best], q.points[best], variance[best], unknown)
    if estimates[b].sees and cov[2, 2] > MAX_HEADING_SIGMA_RAD**2:
        return f"what {a} and {b} saw in common does not determine their relative heading"
    rest = np.setdiff1d(np.arange(len(weight)), best)
    rival = _remove_outliers(rival_set(agree, weight, rest), p.points, q.points, variance)
    if len(rival) > 1:
        other, other_cov = fit_rigid_transform(
            p.points[rival], q.points[rival], variance[rival], unknown
        )
        determined = other_cov[2, 2] < MAX_HEADING_SIGMA_RAD**2 or not estimates[b].sees
        if determined and poses_differ(pose, cov, other, other_cov):
            # a correspondence may support both
            support, support_other = (
                weight[
                    _squared_residuals(x, p.points, q.points, variance)
                    <= chi2_quantile(FIT_PROBABILITY, 2)
                ]
                .sum()
                for x in (pose, other)
            )  # fmt: skip
            if has_rival(support, [support_other]):
                return f"what {a} and {b} saw in common allows two relative poses"
    floor = config.association.floor_m**2, config.association.floor_rad**2
    cov = cov + np.diag([floor[0], floor[0], floor[1]])
    cov += _drift_covariance(pose, estimates[a], estimates[b], p, q, best)
    return RelativeFrame(b, a, pose, cov, float(weight[best].sum()))


def _agree(
    sides: tuple[CorrespondenceSide, CorrespondenceSide],
    estimates: tuple[RobotEstimate, RobotEstimate],
    noise: Array,
) -> BoolArray:
    """Which of n correspondences are as far apart on either side (n, n), but for errors.

    ``noise`` (n,) m²: of each by itself. How well robots know the distances matters to few pairs:
    it is at most what marginals say, and most agree, or not, whatever it is.
    """
    distance = [np.linalg.norm(e.points[:, None] - e.points, axis=-1) for e in sides]
    off = (distance[0] - distance[1]) ** 2 / chi2_quantile(AGREE, 1)
    least, both = noise[:, None] + noise, sides[0].variance + sides[1].variance
    agree = np.asarray(off <= least)
    i, j = np.nonzero(~agree & (off <= least + both[:, None] + both))
    spread = least[i, j]
    for side, estimate in zip(sides, estimates, strict=True):
        spread = spread + side.relative_variance(estimate, i, j)
    agree[i, j] = off[i, j] <= spread
    np.fill_diagonal(agree, False)
    return agree


def _correspondences(
    a: str,
    b: str,
    estimates: Mapping[str, RobotEstimate],
    sightings: Iterable[Sighting],
    config: Config,
) -> tuple[tuple[CorrespondenceSide, CorrespondenceSide], Array, Array]:
    """Both sides of n correspondences, their measurement noise (n,) m² and their weights (n,)."""
    floor_m, floor_rad = config.association.floor_m, config.association.floor_rad
    shared = sorted({*estimates[a].landmarks} & {*estimates[b].landmarks})
    sides: list[list[CorrespondenceSide]] = [[], []]
    for side, name in zip(sides, (a, b), strict=True):
        marks = [estimates[name].landmarks[identity] for identity in shared]
        side.append(
            CorrespondenceSide(
                np.array([mean for mean, _ in marks]).reshape(-1, 2),
                np.array([np.linalg.eigvalsh(cov)[-1] for _, cov in marks]),
                np.full(len(marks), UNTIMED, dtype=np.int64),
                np.zeros(len(marks)),
            )
        )
    noises = [np.full(len(shared), floor_m**2)]
    for observer, target, order in ((a, b, (0, 1)), (b, a, (1, 0))):
        seen = [s for s in sightings if s.robot == observer and s.seen_robot == target]
        if not seen:
            continue
        times = np.array([s.time_ns for s in seen], dtype=np.int64)
        x, P = estimates[observer].at(times)
        y, P_y = estimates[target].at(times)
        cov = np.array([s.cov[:2, :2] for s in seen])
        z = np.array([s.z[:2] for s in seen])
        points = MODELS["point"].invert(z, compose(x, np.array([s.mount for s in seen])))
        use = _subsample(points, y[:, :2], config.multi_robot.sampling_m)
        r = z[use, 1]
        bearing = cov[use, 0, 0] + floor_rad**2
        noises.append(np.maximum(cov[use, 1, 1], r**2 * bearing) + floor_m**2)
        variance = P[use, 0, 0] + P[use, 1, 1] + r**2 * P[use, 2, 2]
        variance_y = P_y[use, 0, 0] + P_y[use, 1, 1]
        sides[order[0]].append(CorrespondenceSide(points[use], variance, times[use], r))
        sides[order[1]].append(
            CorrespondenceSide(y[use, :2], variance_y, times[use], np.zeros(len(use)))
        )
    noise = np.concatenate(noises)
    weight = np.where(np.arange(len(noise)) < len(shared), float(LANDMARK_EVIDENCE), 1.0)
    return (_concatenate(sides[0]), _concatenate(sides[1])), noise, weight


def _concatenate(sides: Sequence[CorrespondenceSide]) -> CorrespondenceSide:
    return CorrespondenceSide(
        *(
            np.concatenate([getattr(side, name) for side in sides])
            for name in ("points", "variance", "times_ns", "range_m")
        )
    )


def _subsample(p: Array, q: Array, spacing_m: float) -> IntArray:
    """Which of n point pairs to use: one per ``spacing_m`` of either, `MAX_SIGHTINGS` at most."""
    kept = [0]
    for k in range(1, len(p)):
        last = kept[-1]
        if max(np.hypot(*(p[k] - p[last])), np.hypot(*(q[k] - q[last]))) >= spacing_m:
            kept.append(k)
    return evenly_spaced(np.array(kept, dtype=np.int64), MAX_SIGHTINGS)


def evenly_spaced(numbers: IntArray, most: int) -> IntArray:
    """At most ``most`` of ``numbers`` (n,), evenly spread, with the first and the last."""
    if len(numbers) <= most:
        return numbers
    return numbers[np.linspace(0, len(numbers) - 1, most).round().astype(np.int64)]


def _remove_outliers(members: IntArray, p: Array, q: Array, variance: Array) -> IntArray:
    """Members that fit the rigid transform of all; a mirror image keeps distances but does not."""
    while len(members) > 1:
        pose, _ = fit_rigid_transform(p[members], q[members], variance[members])
        d2 = _squared_residuals(pose, p[members], q[members], variance[members])
        if d2.max() <= chi2_quantile(FIT_PROBABILITY, 2):
            break
        members = np.delete(members, d2.argmax())
    return members


def _squared_residuals(pose: Array, p: Array, q: Array, variance: Array) -> Array:
    """Normalised squared distances (n,) of points p from points q transformed by ``pose``."""
    return np.asarray(((p - transform(pose, q)) ** 2).sum(axis=1) / variance)


def _drift_covariance(
    pose: Array,
    a: RobotEstimate,
    b: RobotEstimate,
    p: CorrespondenceSide,
    q: CorrespondenceSide,
    members: IntArray,
) -> Array:
    """Covariance (3, 3) that both robots' own drift adds to ``pose``.

    All correspondences share the drift of both robots from their starts to where they lie; that of
    the best-known one is taken.
    """
    timed = members[p.times_ns[members] != UNTIMED]
    if len(timed) < len(members):
        return np.zeros((3, 3))  # both maps hold landmarks: their covariances are in the weights
    k = timed[np.argmin(p.variance[timed] + q.variance[timed])]
    return encounter_covariance(pose, a, b, int(p.times_ns[k]), int(q.times_ns[k]))


def encounter_covariance(
    pose: Array, a: RobotEstimate, b: RobotEstimate, a_ns: int, b_ns: int
) -> Array:
    """Covariance (3, 3) of ``pose`` from both robots' estimates between start and an encounter.

    Args:
        pose: (3,) start of ``b`` in the frame of ``a``.
        a: one robot.
        b: the other.
        a_ns: time of the encounter by the clock of ``a``.
        b_ns: the same by the clock of ``b``.
    """
    (x,), (P,) = a.at(np.array([a_ns]))
    (y,), (P_y,) = b.at(np.array([b_ns]))
    relative = between(x, compose(pose, y))
    back = inverse(y)
    cov = compose_cov(relative, np.zeros((3, 3)), back, inverse_cov(y, P_y))
    return compose_cov(x, P, compose(relative, back), cov)
