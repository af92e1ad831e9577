"""Relative pose of two robots from places that both saw, recognised by their scans.

The relative pose is unknown, so every submap of one robot is searched for in the whole map of the
other (`place_search`). The best poses are matched and verified like loop closures. Buildings repeat
themselves, so one match proves nothing: the largest set is found in which any two imply the same
relative pose, within what both robots' estimates may have drifted between the places (J. Mangelson
et al., ICRA 2018, DOI 10.1109/ICRA.2018.8460217). It must be of several places that extend over
more than a room, no other set may be supported nearly as well, and places that must then coincide
may not differ.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.config import MultiRobotConfig
from graphslam.core.consistency import (
    generalised_least_squares,
    greedy_max_clique,
    has_rival,
    rival_set,
)
from graphslam.core.gaussian import chi2_quantile, mahalanobis_squared
from graphslam.core.geometry import (
    Array,
    between,
    compose,
    inverse,
    rotation3,
    transform,
    unit_vectors,
    wrap,
)
from graphslam.mapping.loop_closure import COV_INFLATION, verify_match
from graphslam.mapping.submaps import SubmapPose, drift_covariance
from graphslam.multi_robot.place_search import (
    alternative_alignments,
    map_spectrum,
    nearest_of_each_pass,
    search_poses,
)
from graphslam.multi_robot.relative_frames import RelativeFrame, evenly_spaced
from graphslam.perception.scan_matching import Match, match, match_pairs

#: submaps of a robot that are searched for at most
MAX_SUBMAPS = 80
#: half the window in which a pose found by the search is matched: cells of the search, rad
WINDOW_CELLS, WINDOW_RAD = 1.5, 0.06
#: probability of the chi-square test by which two matches agree, and one fits all the others
AGREE = 0.99
#: factor on the covariance of an estimate before reoptimisation, whose noise and calibration are
#: not the final ones
COVARIANCE_INFLATION = 4.0
#: least number of matches that must agree, after the search alone and in the end
MIN_FOUND, MIN_MATCHES = 2, 4
#: a match scores its share of confirmed points less this many times the share that contradicts
#: free space: many walls are alike
ABSENT_WEIGHT = 5.0
#: a match speaks for another alignment if it has more than this share of the score that the best
#: alignment has at its place
EQUIVALENT_SHARE = 0.8
#: places that must coincide differ if more than this share of their points contradicts free space;
#: m between them at most; number of such places at most, as a share of the matches; half the window
#: in which they are matched (m, m, rad)
MAX_ABSENT_SHARE, MAX_OFFSET_M, MAX_DIFFERING_SHARE = 0.07, 2.0, 0.2
VERIFICATION_WINDOW = np.array([1.0, 1.0, 0.1])


@dataclass(frozen=True, slots=True, eq=False)
class PlaceMatch:
    """Place ``index_a`` of one robot and ``index_b`` of another that were recognised as one.

    ``match`` has the pose of the second relative to the first.
    """

    index_a: int
    index_b: int
    match: Match

    @property
    def score(self) -> float:
        """Confirmed share of the points, less the weighted share that contradicts free space."""
        return self.match.same - ABSENT_WEIGHT * self.match.absent


@dataclass(frozen=True, slots=True, eq=False)
class PlaceMap:
    """The n places of a robot in its frame.

    ``cov`` (3n, 3n): joint covariance of their poses, errors along each one's own axes.
    """

    places: Sequence[SubmapPose]
    cov: Array


def relate_places(
    a: str, b: str, map_a: PlaceMap, map_b: PlaceMap, config: MultiRobotConfig
) -> RelativeFrame | str:
    """Start of ``b`` in the frame of ``a``, or why it is unknown ("" without evidence).

    Args:
        a: name of a robot.
        b: name of another one.
        map_a: places of ``a``.
        map_b: places of ``b``.
        config: settings.
    """
    places_a, places_b = map_a.places, map_b.places
    found = match_places(places_a, places_b, config) if places_a and places_b else []
    if not found:
        return ""
    relation = choose_alignment(a, b, found, map_a, map_b, config)
    if isinstance(relation, RelativeFrame) and any(
        _is_supported(start, places_a, places_b)
        for start in alternative_alignments(relation.pose, places_a, places_b, config)
    ):
        return f"{a} and {b} saw places that look alike, but another relative pose fits as well"
    return relation


def match_places(
    places_a: Sequence[SubmapPose], places_b: Sequence[SubmapPose], config: MultiRobotConfig
) -> list[PlaceMatch]:
    """All places of robot b that look like one of robot a's, like several if need be."""
    spectrum = map_spectrum(places_a, config.place_range_m, config)
    positions = np.array([p.pose[:2] for p in places_a])
    window = np.array([WINDOW_CELLS * config.place_cell_m] * 2 + [WINDOW_RAD])
    found = []
    for k in evenly_spaced(np.arange(len(places_b)), MAX_SUBMAPS):
        submap = places_b[k].submap
        poses = search_poses(spectrum, submap.points, config.place_range_m)
        pairs = [
            (n, j) for n, pose in enumerate(poses) for j in nearest_of_each_pass(positions, pose)
        ]
        # all at once: most of the time of a single pair is not in its points
        matched = match_pairs(
            [submap] * len(pairs),
            [places_a[j].submap for _, j in pairs],
            [between(places_a[j].pose, poses[n]) for n, j in pairs],
            [window] * len(pairs),
        )
        verified: list[list[PlaceMatch]] = [[] for _ in poses]
        for (n, j), matches in zip(pairs, matched, strict=True):
            if (best := verify_match(matches)) is not None:
                verified[n].append(PlaceMatch(j, int(k), best))
        for own in verified:
            best_match = max(own, key=lambda m: m.score, default=None)
            if best_match is not None and best_match.score > 0:
                found.append(best_match)
    return found


def _is_supported(
    start: Array, places_a: Sequence[SubmapPose], places_b: Sequence[SubmapPose]
) -> bool:
    """Whether some places confirm a start (3,) and few contradict it."""
    same, differing = verify_places(start, places_a, places_b)
    return bool(same) and differing <= MAX_DIFFERING_SHARE * len(same)


# ---------------------------------------------------------------- choice between matches


def choose_alignment(
    a: str,
    b: str,
    found: Sequence[PlaceMatch],
    map_a: PlaceMap,
    map_b: PlaceMap,
    config: MultiRobotConfig,
) -> RelativeFrame | str:
    """Start of ``b`` in the frame of ``a`` from matches, at least one; see `relate_places`.

    Which matches agree is decided with covariances that allow for undetected drift; the start is
    then estimated with those of the estimates, times `COVARIANCE_INFLATION`.
    """
    places_a, places_b = map_a.places, map_b.places
    wide_a, wide_b = (
        PlaceMap(m.places, COV_INFLATION * m.cov + drift_covariance(m.places))
        for m in (map_a, map_b)
    )
    starts, covs = start_estimates(found, wide_a, wide_b)
    best = greedy_max_clique(pairwise_agreement(found, starts, covs), _scores(found))
    if len(best) < MIN_FOUND:
        return ""
    # the search may have overlooked places that coincide, or that should
    more, differing = verify_places(consensus(starts, covs, best).pose, places_a, places_b)
    found = [*found, *more]
    starts, covs = start_estimates(found, wide_a, wide_b)
    agree, scores = pairwise_agreement(found, starts, covs), _scores(found)
    best = greedy_max_clique(agree, scores)
    if len(best) < MIN_MATCHES:
        return ""
    extents = (
        extent([places_a[found[k].index_a] for k in best]),
        extent([places_b[found[k].index_b] for k in best]),
    )
    if min(extents) < config.min_place_extent_m:
        return (
            f"the places that {a} and {b} have in common extend over {min(extents):.1f} m only, "
            f"{why_too_small(min(extents))}"
        )
    # a match with a clearly lower score at its place does not speak for another alignment
    best_score = {found[k].index_b: scores[k] for k in best}
    equivalent = np.array(
        [m.score > EQUIVALENT_SHARE * best_score.get(m.index_b, 0.0) for m in found]
    )
    unlike = consensus(starts, covs, best).d2 > chi2_quantile(AGREE, 3)
    rival = rival_set(agree, scores, np.flatnonzero(unlike & equivalent))
    if has_rival(scores[best].sum(), [scores[rival].sum()]):
        return (
            f"{a} and {b} saw places that look alike, but {len(best)} matches imply one relative "
            f"pose and {len(rival)} another"
        )
    if differing > MAX_DIFFERING_SHARE * len(best):
        return f"the surroundings of the places common to {a} and {b} contradict each other"
    own = (PlaceMap(m.places, COVARIANCE_INFLATION * m.cov) for m in (map_a, map_b))
    start = consensus(*start_estimates(found, *own), best)
    return RelativeFrame(b, a, start.pose, start.cov, float(len(best)))


def verify_places(
    start: Array, places_a: Sequence[SubmapPose], places_b: Sequence[SubmapPose]
) -> tuple[list[PlaceMatch], int]:
    """Compare the places of two robots that coincide if b began at ``start`` in the frame of a.

    Args:
        start: (3,).
        places_a: places of a, in its frame.
        places_b: places of b, in its frame.

    Returns:
        Matches that are verified, and how many places differ.
    """
    positions = np.array([p.pose[:2] for p in places_a])
    same: list[PlaceMatch] = []
    differing = 0
    for k, place in enumerate(places_b):
        pose = compose(start, place.pose)
        compared = []
        for j in nearest_of_each_pass(positions, pose):
            guess = between(places_a[j].pose, pose)
            if np.hypot(guess[0], guess[1]) <= MAX_OFFSET_M:
                matches = match(place.submap, places_a[j].submap, guess, VERIFICATION_WINDOW)
                compared += [(PlaceMatch(j, k, matches[0]), matches)] if matches else []
        if not compared:
            continue
        best, matches = max(compared, key=lambda one: one[0].score)
        if verify_match(matches) is not None and best.score > 0:
            same.append(best)
        seen = best.match.same + best.match.absent
        differing += best.match.absent > MAX_ABSENT_SHARE * seen
    return same, differing


def _scores(found: Sequence[PlaceMatch]) -> Array:
    return np.array([m.score for m in found])


def start_estimates(
    found: Sequence[PlaceMatch], map_a: PlaceMap, map_b: PlaceMap
) -> tuple[Array, Array]:
    """Start of b in the frame of a by each of n matches.

    A match says that place x_b is at x = x_a h in the frame of a, so b began at t = x x_b⁻¹. Errors
    of t and x are along the axes of a's frame, those of x_a and x_b along their own; that of h has
    covariance R along the axes of x_a. Matches share the errors of x_a and x_b.

    Returns:
        Starts t (n, 3) and their joint covariance (n, n, 3, 3).
    """
    n = np.arange(len(found))
    j, i = np.array([m.index_a for m in found]), np.array([m.index_b for m in found])
    x_a, x_b = (np.array([p.pose for p in m.places])[k] for m, k in ((map_a, j), (map_b, i)))
    x = compose(x_a, np.array([m.match.pose for m in found]))
    t = compose(x, inverse(x_b))
    t_by_x = np.tile(np.eye(3), (len(n), 1, 1))
    t_by_x[:, :2, 2] = _perpendicular(t - x)
    x_by_h = rotation3(x_a[:, 2])
    x_by_a = x_by_h.copy()
    x_by_a[:, :2, 2] += _perpendicular(x - x_a)
    t_by_a, t_by_b, t_by_h = t_by_x @ x_by_a, -t_by_x @ rotation3(x[:, 2]), t_by_x @ x_by_h
    covs = np.zeros((len(n), len(n), 3, 3))
    for J, P, k in ((t_by_a, map_a.cov, j), (t_by_b, map_b.cov, i)):
        blocks = P.reshape(len(P) // 3, 3, len(P) // 3, 3).transpose(0, 2, 1, 3)
        covs += J[:, None] @ blocks[np.ix_(k, k)] @ J.mT
    R = np.array([m.match.cov for m in found])
    covs[n, n] += t_by_h @ R @ t_by_h.mT
    return t, covs


def _perpendicular(v: Array) -> Array:
    """The first two columns of vectors (n, 3), turned to the left by a right angle: (n, 2)."""
    return np.column_stack([-v[:, 1], v[:, 0]])


def pairwise_agreement(found: Sequence[PlaceMatch], starts: Array, covs: Array) -> Array:
    """Which of n matches agree on the start: (n, n) bool. Two of one place never do."""
    n = np.arange(len(starts))
    innovation = starts[:, None] - starts
    innovation[..., 2] = wrap(innovation[..., 2])
    own = covs[n, n]
    S = own[:, None] + own - covs - covs.transpose(1, 0, 2, 3)
    place = np.array([m.index_b for m in found])
    different = place[:, None] != place
    S[~different] = np.eye(3)
    d2 = mahalanobis_squared(innovation, S)
    return np.asarray(different & (d2 <= chi2_quantile(AGREE, 3)))


@dataclass(frozen=True, slots=True, eq=False)
class Consensus:
    """The start by some of n matches together.

    ``pose`` (3,), ``cov`` (3, 3); ``d2`` (n,): squared Mahalanobis distance of each other match's
    start from it, 0 for its own members.
    """

    pose: Array
    cov: Array
    d2: Array


def consensus(starts: Array, covs: Array, members: IntArray) -> Consensus:
    """Generalised least squares over members (k,) of n starts, see `start_estimates`."""
    n = len(starts)
    reference = starts[members[0]]
    off = starts - reference
    off[:, 2] = wrap(off[:, 2])
    joint = covs.transpose(0, 2, 1, 3).reshape(3 * n, 3 * n)
    rows = (3 * members[:, None] + np.arange(3)).ravel()
    A = np.tile(np.eye(3), (len(members), 1))
    fit = generalised_least_squares(A, off[members].ravel(), joint[np.ix_(rows, rows)])
    # each start's covariance with the consensus
    cross = (fit.gain @ joint[rows]).reshape(3, n, 3).transpose(1, 0, 2)
    own = covs[np.arange(n), np.arange(n)]
    S = own + fit.cov - cross - cross.mT
    S[members] = own[members]
    d2 = mahalanobis_squared(off - fit.x, S)
    d2[members] = 0.0
    pose = reference + fit.x
    pose[2] = wrap(pose[2])
    return Consensus(pose, fit.cov, d2)


def why_too_small(extent_m: float) -> str:
    """Why places that extend over so little, m, are not enough, and what accepts them."""
    accepted = max(np.floor(20.0 * extent_m) / 20.0 - 0.05, 0.0)
    return f"and rooms look alike (--set multi_robot.min_place_extent_m={accepted:.3g} accepts it)"


def seen_extent(*maps: Sequence[SubmapPose]) -> float:
    """The longest distance, m, between any two points that are seen from places of one map."""
    return max(map(_seen_extent, maps))


def _seen_extent(places: Sequence[SubmapPose]) -> float:
    points = np.concatenate(
        [np.zeros((0, 2)), *(transform(place.pose, place.submap.points) for place in places)]
    )
    if not len(points):
        return 0.0
    across = points @ unit_vectors(np.linspace(0.0, np.pi, 36, endpoint=False)).T
    return float(np.ptp(across, axis=0).max())


def extent(places: Sequence[SubmapPose]) -> float:
    """The longest distance between any two places, m."""
    points = np.array([p.pose[:2] for p in places])
    return float(np.linalg.norm(points[:, None] - points, axis=-1).max())
