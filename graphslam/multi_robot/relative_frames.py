"""How two robots' frames relate: where one began in the frame of the other.

Each robot has been estimated by itself, in a frame of its own. What two of them have seen in common
are pairs of points that are one point: a landmark in the map of both, a robot where it was seen and
where it says it was. A rigid move takes the points of one frame to those of the other and keeps
their distances, so two pairs agree if they are as far apart in one frame as in the other.

The largest set of pairs of which all agree with each other is looked for (J. Mangelson et al.,
Pairwise consistent measurement set maximization, ICRA 2018, DOI 10.1109/ICRA.2018.8460217;
distances as the invariant: P. Lusk et al., CLIPPER, ICRA 2021, DOI 10.1109/ICRA48506.2021.9561069).
It must determine the move, and nothing that contradicts it may have much more than half of its
size.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from graphslam.core.config import AssociationConfig
from graphslam.core.consistency import FIT, fit_rigid_transform, greedy_max_clique, poses_differ
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
from graphslam.odometry.preintegration import Track
from graphslam.odometry.readings import IntArray

#: probability up to which two distances agree
AGREE = 0.99
#: fewest pieces of evidence; a landmark counts twice, since it was seen again and again
FEWEST, LANDMARK_COUNTS = 4, 2
#: a contradiction with more than this part of the evidence leaves it undecided
RIVAL = 0.5
#: rad: sigma of the heading beyond which a set does not tell how the frames are turned
MAX_TURN_SIGMA_RAD = 0.2
#: m: a robot is seen anew once it or its observer moved that far; sightings of one robot by another
#: that are used at most, spread over the log
APART_M, MOST = 0.1, 100
UNTIMED = -1


@dataclass(frozen=True, slots=True, eq=False)
class RobotEstimate:
    """What one robot knows by itself, in the frame in which it begins at the origin.

    ``landmarks``: identity -> mean (2,), covariance (2, 2); ``unnamed``: means (n, 2) and
    covariances (n, 2, 2) of points without name.
    """

    states: Trajectory
    track: Track
    landmarks: Mapping[str, tuple[Array, Array]]
    unnamed: tuple[Array, Array] = (np.zeros((0, 2)), np.zeros((0, 2, 2)))

    def at(self, times_ns: IntArray) -> tuple[Array, Array]:
        """Poses (n, 3) and covariances (n, 3, 3): the last state before, carried by odometry."""
        known = self.states
        i = known.index_before(times_ns)
        moved = self.track.motions(known.stamps_ns[i], times_ns)
        covs = compose_cov(known.poses[i], known.covs[i], moved.delta, moved.cov)
        return compose(known.poses[i], moved.delta), covs


@dataclass(frozen=True, slots=True, eq=False)
class CorrespondenceSide:
    """One frame's side of n pairs of points.

    ``points`` (n, 2) m; ``variance`` (n,) m² of what the robot's own estimate adds to it;
    ``times_ns`` (n,) when the robot was where it was, or `UNTIMED` for landmarks; ``reach`` (n,) m
    from the robot to the point.
    """

    points: Array
    variance: Array
    times_ns: IntArray
    reach: Array

    def relative_variance(self, track: Track) -> Array:
        """(n, n) m²: of one point as seen from another, by the estimate or by odometry alone.

        Estimates of nearby times share most of their error, which sums of marginals do not know.
        """
        variance = self.variance[:, None] + self.variance
        timed = np.flatnonzero(self.times_ns != UNTIMED)
        if len(timed):
            t = self.times_ns[timed]
            i, j = (k.ravel() for k in np.meshgrid(range(len(t)), range(len(t)), indexing="ij"))
            cov = track.motions(t[i], t[j]).cov
            reach2 = self.reach[timed][j] ** 2
            odometry = cov[:, 0, 0] + cov[:, 1, 1] + reach2 * cov[:, 2, 2]
            both = np.ix_(timed, timed)
            variance[both] = np.minimum(variance[both], odometry.reshape(len(t), len(t)))
        return variance


@dataclass(frozen=True, slots=True, eq=False)
class RelativeFrame:
    """Where a robot began in the frame of another one.

    ``pose`` (3,), ``cov`` (3, 3) along the axes of ``other``'s frame; ``weight`` is the evidence.
    """

    robot: str
    other: str
    pose: Array
    cov: Array
    weight: float

    def reversed(self) -> "RelativeFrame":
        """The same from the other side."""
        cov = inverse_cov(self.pose, self.cov)
        return RelativeFrame(self.other, self.robot, inverse(self.pose), cov, self.weight)


def estimate_relative_frame(
    a: str,
    b: str,
    views: Mapping[str, RobotEstimate],
    meetings: Iterable[Sighting],
    config: AssociationConfig,
) -> RelativeFrame | str:
    """Where ``b`` began in the frame of ``a``, or why that is not known ("" if nothing connects).

    Args:
        a: name of a robot.
        b: name of another one.
        views: what each robot knows by itself.
        meetings: sightings of robots by robots, any of them.
        config: floors of what is seen.
    """
    ends, noise, worth = _correspondences(a, b, views, meetings, config)
    if worth.sum() < FEWEST:
        return ""
    p, q = ends
    apart = [np.linalg.norm(e.points[:, None] - e.points, axis=-1) for e in ends]
    spread = noise[:, None] + noise
    for end, name in zip(ends, (a, b), strict=True):
        spread = spread + end.relative_variance(views[name].track)
    agree = (apart[0] - apart[1]) ** 2 <= chi2_quantile(AGREE, 1) * spread
    np.fill_diagonal(agree, False)
    variance = p.variance + q.variance + noise
    best = _remove_outliers(greedy_max_clique(agree, worth), p.points, q.points, variance)
    if worth[best].sum() < FEWEST:
        return f"too little of what {a} and {b} saw in common agrees"
    pose, cov = fit_rigid_transform(p.points[best], q.points[best], variance[best])
    if cov[2, 2] > MAX_TURN_SIGMA_RAD**2:
        return f"what {a} and {b} saw in common does not tell how they were turned"
    rest = np.setdiff1d(np.arange(len(worth)), best)
    members = greedy_max_clique(agree[np.ix_(rest, rest)], worth[rest])
    rival = _remove_outliers(rest[members], p.points, q.points, variance)
    if len(rival) > 1:
        other, other_cov = fit_rigid_transform(p.points[rival], q.points[rival], variance[rival])
        turned = other_cov[2, 2] < MAX_TURN_SIGMA_RAD**2
        if turned and poses_differ(pose, cov, other, other_cov):
            # some pairs may fit both
            behind = [
                worth[
                    _normalised_squares(move, p.points, q.points, variance) <= chi2_quantile(FIT, 2)
                ].sum()
                for move in (pose, other)
            ]
            if behind[1] > RIVAL * behind[0]:
                return f"what {a} and {b} saw in common has two meanings"
    floor = np.diag([config.floor_m**2, config.floor_m**2, config.floor_rad**2])
    cov = cov + floor + _drift_covariance(pose, views[a], views[b], p, q, best)
    return RelativeFrame(b, a, pose, cov, float(worth[best].sum()))


def _correspondences(
    a: str,
    b: str,
    views: Mapping[str, RobotEstimate],
    meetings: Iterable[Sighting],
    config: AssociationConfig,
) -> tuple[tuple[CorrespondenceSide, CorrespondenceSide], Array, Array]:
    """Pairs of points that are one, their noise (n,) m², and what they are worth (n,)."""
    shared = sorted({*views[a].landmarks} & {*views[b].landmarks})
    sides: list[list[CorrespondenceSide]] = [[], []]
    for side, name in zip(sides, (a, b), strict=True):
        marks = [views[name].landmarks[identity] for identity in shared]
        count = np.zeros(len(marks))
        side.append(
            CorrespondenceSide(
                np.array([mean for mean, _ in marks]).reshape(-1, 2),
                np.array([np.linalg.eigvalsh(cov)[-1] for _, cov in marks]),
                np.full(len(marks), UNTIMED, dtype=np.int64),
                count,
            )
        )
    noises = [np.full(len(shared), config.floor_m**2)]
    for observer, seen, order in ((a, b, (0, 1)), (b, a, (1, 0))):
        found = [s for s in meetings if s.robot == observer and s.seen_robot == seen]
        if not found:
            continue
        when = np.array([s.time_ns for s in found], dtype=np.int64)
        x, P = views[observer].at(when)
        y, P_y = views[seen].at(when)
        z = np.array([s.z[:2] for s in found])
        cov = np.array([s.cov[:2, :2] for s in found])
        sensor = compose(x, np.array([s.mount for s in found]))
        at = MODELS["point"].invert(z, sensor)
        use = _subsample(at, y[:, :2])
        reach = z[use, 1]
        bearing = cov[use, 0, 0] + config.floor_rad**2
        noises.append(np.maximum(cov[use, 1, 1], reach**2 * bearing) + config.floor_m**2)
        own = P[use, 0, 0] + P[use, 1, 1] + reach**2 * P[use, 2, 2]
        theirs = P_y[use, 0, 0] + P_y[use, 1, 1]
        sides[order[0]].append(CorrespondenceSide(at[use], own, when[use], reach))
        sides[order[1]].append(
            CorrespondenceSide(y[use, :2], theirs, when[use], np.zeros(len(use)))
        )
    noise = np.concatenate(noises)
    worth = np.where(np.arange(len(noise)) < len(shared), float(LANDMARK_COUNTS), 1.0)
    return (_concatenate(sides[0]), _concatenate(sides[1])), noise, worth


def _concatenate(ends: Sequence[CorrespondenceSide]) -> CorrespondenceSide:
    return CorrespondenceSide(
        *(
            np.concatenate([getattr(e, name) for e in ends])
            for name in ("points", "variance", "times_ns", "reach")
        )
    )


def _subsample(p: Array, q: Array) -> IntArray:
    """Which of n pairs of points to use: not what repeats the one before, and not too many."""
    kept = [0]
    for k in range(1, len(p)):
        last = kept[-1]
        if max(np.hypot(*(p[k] - p[last])), np.hypot(*(q[k] - q[last]))) >= APART_M:
            kept.append(k)
    every = np.linspace(0, len(kept) - 1, min(len(kept), MOST)).round().astype(np.int64)
    return np.array(kept, dtype=np.int64)[every]


def _remove_outliers(members: IntArray, p: Array, q: Array, variance: Array) -> IntArray:
    """Those of a set that also lie where a rigid move takes them; a mirror image does not."""
    while len(members) > 1:
        pose, _ = fit_rigid_transform(p[members], q[members], variance[members])
        miss = _normalised_squares(pose, p[members], q[members], variance[members])
        if miss.max() <= chi2_quantile(FIT, 2):
            break
        members = np.delete(members, miss.argmax())
    return members


def _normalised_squares(pose: Array, p: Array, q: Array, variance: Array) -> Array:
    """Squared distances (n,) of points from where a move takes them, normalised."""
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

    However many points there are, they hang on the way from both beginnings to where they lie:
    on the shortest such way, by the estimates.
    """
    timed = members[p.times_ns[members] != UNTIMED]
    if len(timed) < len(members):
        return np.zeros((3, 3))  # both maps hold landmarks: their covariances are in the weights
    k = timed[np.argmin(p.variance[timed] + q.variance[timed])]
    return encounter_covariance(pose, a, b, int(p.times_ns[k]), int(q.times_ns[k]))


def encounter_covariance(
    pose: Array, a: RobotEstimate, b: RobotEstimate, a_ns: int, b_ns: int
) -> Array:
    """Covariance (3, 3) that two robots' ways to a meeting add to where one began.

    Args:
        pose: (3,) where ``b`` began in the frame of ``a``.
        a: one robot.
        b: the other.
        a_ns: when ``a`` was there.
        b_ns: when ``b`` was there.
    """
    (x,), (P,) = a.at(np.array([a_ns]))
    (y,), (P_y,) = b.at(np.array([b_ns]))
    relative = between(x, compose(pose, y))
    back = inverse(y)
    nothing = np.zeros((3, 3))
    cov = compose_cov(relative, nothing, back, inverse_cov(y, P_y))
    return compose_cov(x, P, compose(relative, back), cov)
