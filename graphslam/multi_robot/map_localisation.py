"""Where a robot's places lie in a known map: hypotheses, and how well each explains all of them.

Places of the robot are recognised in the map one by one (`place_recognition`). Those that imply one
start form a hypothesis; buildings repeat themselves, so there are several. Each is judged with the
whole path laid into the map as it says: every place is compared with all that the map has around
it, from wherever it was seen. A hypothesis is believed if it explains enough, is hardly
contradicted, and no other one explains about as much.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from graphslam.core.config import MultiRobotConfig
from graphslam.core.consistency import greedy_max_clique, has_rival
from graphslam.core.geometry import Array, between, compose, inverse, transform
from graphslam.mapping.loop_closure import COV_INFLATION, MIN_CONFIRMED
from graphslam.mapping.submaps import SubmapPose, drift_covariance
from graphslam.multi_robot.place_recognition import (
    ABSENT_WEIGHT,
    MAX_ABSENT_SHARE,
    MIN_MATCHES,
    PlaceMap,
    consensus,
    extent,
    match_places,
    pairwise_agreement,
    start_estimates,
)
from graphslam.multi_robot.place_search import (
    DISTINCT_M,
    DISTINCT_RAD,
    alternative_alignments,
)
from graphslam.perception.scan_matching import (
    BoolArray,
    Submap,
    align_pairs,
    compare_with_scans,
    make_submap,
)

#: hypotheses that are judged at most, the best supported first
MAX_HYPOTHESES = 5
#: share of the confirmed places that may contradict a hypothesis: what changed, or is seen badly
MAX_CONTRADICTED_SHARE = 0.3
#: share of them, and number, from which there is a doubt: of 24 days in the simulated office that
#: were placed right 23 had none, one 0.19; of those in a part that only looks alike 0.2 to 0.3
DOUBT_SHARE, LEAST_DOUBTED = 0.2, 2
#: share of the best one's support from which another hypothesis is a rival whatever contradicts it;
#: others are from half of it on, unless they are contradicted
EQUAL_SHARE = 0.7
#: m: what the map has around a place is from its places within this distance
AROUND_M = 6.0
#: m, rad: a place may be so far off where its hypothesis puts it, which is drift of the path
OFF_M, OFF_RAD = 0.5, 0.06


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """A start (3,) in the map, its covariance (3, 3) along the map's axes."""

    pose: Array
    cov: Array


@dataclass(frozen=True, slots=True, eq=False)
class Support:
    """How a hypothesis explains n places: which are ``confirmed`` and ``contradicted`` (n,) bool.

    A score (n,) is the share of a place's points that the map confirms less the weighted share
    that is in free space; 0 for places where the map has nothing, or that are not confirmed.
    ``poses`` (n, 3): where the places are laid.
    """

    poses: Array
    scores: Array
    confirmed: BoolArray
    contradicted: BoolArray

    @property
    def total(self) -> float:
        """All scores together."""
        return float(self.scores.sum())

    @property
    def is_contradicted(self) -> bool:
        """Whether more places contradict it than a few that changed."""
        return self.contradicted_share > MAX_CONTRADICTED_SHARE

    @property
    def contradicted_share(self) -> float:
        """Places that contradict it for each that confirms it; inf if none does."""
        confirmed, contradicted = int(self.confirmed.sum()), int(self.contradicted.sum())
        if not confirmed:
            return math.inf if contradicted else 0.0
        return contradicted / confirmed


def hypotheses(known: PlaceMap, own: PlaceMap, config: MultiRobotConfig) -> list[Hypothesis]:
    """Starts in a known map by places that are recognised in it, the best supported first."""
    if not (known.places and own.places):
        return []
    found = match_places(known.places, own.places, config)
    if not found:
        return []
    wide = PlaceMap(own.places, COV_INFLATION * own.cov + drift_covariance(own.places))
    starts, covs = start_estimates(found, known, wide)
    agree, scores = pairwise_agreement(found, starts, covs), np.array([m.score for m in found])
    left = np.arange(len(found))
    made: list[Hypothesis] = []
    while len(left) and len(made) < MAX_HYPOTHESES:
        best = left[greedy_max_clique(agree[np.ix_(left, left)], scores[left])]
        if not len(best):
            break
        at = consensus(starts, covs, best)
        made.append(Hypothesis(at.pose, at.cov))
        like = np.asarray(agree[:, best].any(axis=1), dtype=bool)
        like[best] = True
        left = left[~like[left]]
    others = alternative_alignments(made[0].pose, known.places, own.places, config)
    return made + [Hypothesis(pose, made[0].cov) for pose in others]


def support(known: Sequence[SubmapPose], places: Sequence[SubmapPose]) -> Support:
    """How well places (n), laid into the map as a hypothesis says, agree with its places."""
    n = len(places)
    scores, confirmed, contradicted = np.zeros(n), [False] * n, [False] * n
    positions = np.array([p.pose[:2] for p in known])
    beside: list[int] = []
    around: list[Submap] = []
    guesses: list[Array] = []
    for k, place in enumerate(places):
        distance = np.hypot(*(positions - place.pose[:2]).T)
        nearest = int(distance.argmin())
        if distance[nearest] < AROUND_M / 2:
            beside.append(k)
            origin = known[nearest].pose
            around.append(
                surroundings(
                    [known[j] for j in np.flatnonzero(distance < AROUND_M).tolist()], origin
                )
            )
            guesses.append(between(origin, place.pose))
    aligned, _, _ = align_pairs([places[k].submap for k in beside], around, guesses)
    for k, target, guess, pose in zip(beside, around, guesses, aligned, strict=True):
        off = between(guess, pose)
        at = pose if np.hypot(off[0], off[1]) < OFF_M and abs(off[2]) < OFF_RAD else guess
        same, absent = _agreement(places[k].submap, target, at)
        confirmed[k] = same >= MIN_CONFIRMED
        contradicted[k] = absent > MAX_ABSENT_SHARE
        scores[k] = max(same - ABSENT_WEIGHT * absent, 0.0) if confirmed[k] else 0.0
    return Support(
        np.array([p.pose for p in places]), scores, np.array(confirmed), np.array(contradicted)
    )


def surroundings(places: Sequence[SubmapPose], origin: Array) -> Submap:
    """All scans of some places as one submap, in the frame of ``origin`` (3,)."""
    poses = [compose(between(origin, p.pose), p.submap.poses) for p in places]
    clouds = [cloud for p in places for cloud in p.submap.clouds]
    return make_submap(np.concatenate(poses), clouds, places[0].submap.config)


def _agreement(source: Submap, target: Submap, pose: Array) -> tuple[float, float]:
    """Share of the points of ``source`` that the target confirms, and that contradict free space.

    The latter also of the points of the target that the source saw; it is in no way complete.
    """
    confirmed, free = compare_with_scans(transform(pose, source.points), target)
    same, absent = int(confirmed.sum()), int((free & ~confirmed).sum())
    seen, through = compare_with_scans(transform(inverse(pose), target.points), source)
    missing = int((through & ~seen).sum())
    visible = int(seen.sum()) + missing
    n = len(source.points)
    return same / n, max(absent / n, missing / max(visible, 1))


def choose(
    found: Sequence[Support],
    places: Sequence[SubmapPose],
    config: MultiRobotConfig,
    *,
    may_contradict: bool = False,
) -> int | str:
    """Which of several hypotheses, at least one, is right, or why that is not known.

    ``may_contradict``: however many places contradict it, if nothing else is against it.
    """
    totals = [one.total for one in found]
    best = int(np.argmax(totals))
    one = found[best]
    count = int(one.confirmed.sum())
    if count < MIN_MATCHES:
        return f"only {count} of {len(places)} places are recognised"
    if extent([p for p, is_seen in zip(places, one.confirmed, strict=True) if is_seen]) < (
        config.min_place_extent_m
    ):
        return "the places that are recognised extend over less than multi_robot.min_place_extent_m"
    others = [x for x in found if differ(one, x)]
    rivals = [x.total for x in others if not x.is_contradicted]
    if has_rival(one.total, rivals) or has_rival(one.total, [x.total for x in others], EQUAL_SHARE):
        return "it has places that look alike, and the path fits into it in more than one way"
    if one.is_contradicted and not may_contradict:
        return f"{int(one.contradicted.sum())} of {len(places)} places contradict it"
    return best


def contradiction(given: Support) -> str:
    """Why a start that was given cannot be right; empty if it can.

    It is trusted further than one that was found: places outside of the map speak neither for nor
    against it, and furniture that moved in sight of every place is no reason. In another building,
    or turned round in the right one, more places contradict the map than agree with it.
    """
    against, agreeing = int(given.contradicted.sum()), int(given.confirmed.sum())
    if against <= agreeing:
        return ""
    return f"{against} of {len(given.confirmed)} places contradict it, {agreeing} agree with it"


def doubt(placed: Support) -> str:
    """What is to be said of a path that is placed in a map; empty if hardly anything is against it.

    Things that were moved contradict the right place too, so it is no reason to refuse it.
    """
    against = int(placed.contradicted.sum())
    if against < LEAST_DOUBTED or placed.contradicted_share <= DOUBT_SHARE:
        return ""
    return (
        f"{against} of {len(placed.contradicted)} places contradict where it was placed: much was "
        "moved, or it drove elsewhere, where it looks alike"
    )


def differ(one: Support, other: Support) -> bool:
    """Whether two hypotheses, that may have begun apart, end at different paths."""
    off = between(one.poses, other.poses)
    apart = np.hypot(off[:, 0], off[:, 1]) > DISTINCT_M
    return bool(np.median(apart | (np.abs(off[:, 2]) > DISTINCT_RAD)))
