"""Where a robot's places lie in a known map: hypotheses, and how well each explains all of them.

Places of the robot are recognised in the map one by one (`place_recognition`). Those that imply one
start form a hypothesis; buildings repeat themselves, so there are several. Each is judged with the
whole path laid into the map as it says: every place is compared with all that the map has around
it, from wherever it was seen. Which one is believed is up to `hypothesis_choice`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from graphslam.core.arrays import BoolArray
from graphslam.core.config import MultiRobotConfig
from graphslam.core.consistency import greedy_max_clique
from graphslam.core.geometry import Array, between, compose, inverse, transform
from graphslam.mapping.loop_closure import COV_INFLATION, MIN_CONFIRMED
from graphslam.mapping.submaps import SubmapPose, drift_covariance
from graphslam.multi_robot.place_recognition import (
    ABSENT_WEIGHT,
    MAX_ABSENT_SHARE,
    PlaceMap,
    consensus,
    match_places,
    pairwise_agreement,
    start_estimates,
)
from graphslam.multi_robot.place_search import alternative_alignments
from graphslam.perception.scan_matching import (
    Submap,
    align_pairs,
    compare_with_scans,
    make_submap,
)

#: hypotheses that are judged at most, the best supported first
MAX_HYPOTHESES = 5
#: share of the confirmed places that may contradict a hypothesis: what changed, or is seen badly
MAX_CONTRADICTED_SHARE = 0.3
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
    ``poses`` (n, 3): where the places are laid. ``absent`` (n,): the share that contradicts.
    """

    poses: Array
    scores: Array
    confirmed: BoolArray
    contradicted: BoolArray
    absent: Array

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


def support(
    known: Sequence[SubmapPose], places: Sequence[SubmapPose], pushed: Sequence[Array] = ()
) -> Support:
    """How well places (n), laid into the map as a hypothesis says, agree with its places.

    ``pushed``: motions (2,) m in the world by which much was pushed alike since. What lies on
    something if one of them is undone contradicts nothing; the places lie where they are laid.
    """
    n = len(places)
    every = np.ones((n, len(known)), dtype=bool)
    beside, same, absent = _agreements(known, places, every, pushed)
    confirmed, of_all = np.zeros(n, dtype=bool), np.zeros((2, n))
    confirmed[beside] = same >= MIN_CONFIRMED
    of_all[:, beside] = same, absent
    scores = np.where(confirmed, np.maximum(of_all[0] - ABSENT_WEIGHT * of_all[1], 0.0), 0.0)
    poses = np.array([p.pose for p in places])
    return Support(poses, scores, confirmed, of_all[1] > MAX_ABSENT_SHARE, of_all[1])


def self_contradictions(places: Sequence[SubmapPose], apart_m: float) -> Array:
    """Share that contradicts free space of each place (m,) that the same path passes again.

    Legs of tables, glass and people contradict the right place too.

    Args:
        places: of one path, as estimated.
        apart_m: path between two visits, at least.
    """
    path_m = np.array([place.path_m for place in places])
    apart = np.abs(path_m[:, None] - path_m) >= apart_m
    return _agreements(places, places, apart)[2]


def _agreements(
    known: Sequence[SubmapPose],
    places: Sequence[SubmapPose],
    allowed: BoolArray,
    pushed: Sequence[Array] = (),
) -> tuple[list[int], Array, Array]:
    """Which places lie among known ones, m of them, and the shares (m,) of `_agreement`.

    ``allowed`` (n, number of ``known``): which of these a place is compared with. ``pushed`` as in
    `support`: then places are not aligned, as that would lay them on what was pushed.
    """
    positions = np.array([p.pose[:2] for p in known]).reshape(-1, 2)
    beside: list[int] = []
    around: list[Submap] = []
    guesses: list[Array] = []
    undone: list[list[Array]] = []
    for k, place in enumerate(places):
        distance = np.where(allowed[k], np.hypot(*(positions - place.pose[:2]).T), np.inf)
        nearest = int(distance.argmin()) if len(distance) else 0
        if len(distance) and distance[nearest] < AROUND_M / 2:
            beside.append(k)
            origin = known[nearest].pose
            near = np.flatnonzero(distance < AROUND_M).tolist()
            around.append(surroundings([known[j] for j in near], origin))
            guesses.append(between(origin, place.pose))
            undone.append([between(origin, place.pose - np.append(by, 0.0)) for by in pushed])
    aligned = np.array(guesses).reshape(-1, 3)
    if not pushed:
        aligned, _, _ = align_pairs([places[k].submap for k in beside], around, guesses)
    shares = np.zeros((2, len(beside)))
    for n, (k, target, guess, pose) in enumerate(
        zip(beside, around, guesses, aligned, strict=True)
    ):
        off = between(guess, pose)
        at = pose if np.hypot(off[0], off[1]) < OFF_M and abs(off[2]) < OFF_RAD else guess
        shares[:, n] = _agreement(places[k].submap, target, [at, *undone[n]])
    return beside, shares[0], shares[1]


def surroundings(places: Sequence[SubmapPose], origin: Array) -> Submap:
    """All scans of some places as one submap, in the frame of ``origin`` (3,)."""
    poses = [compose(between(origin, p.pose), p.submap.poses) for p in places]
    clouds = [cloud for p in places for cloud in p.submap.clouds]
    return make_submap(np.concatenate(poses), clouds, places[0].submap.config)


def _agreement(source: Submap, target: Submap, poses: Sequence[Array]) -> tuple[float, float]:
    """Share of the points of ``source`` that the target confirms, and that contradict free space.

    The latter also of the points of the target that the source saw; it is in no way complete. Of
    ``poses`` the first one is where the source lies; what others confirm contradicts nothing.
    """
    n = len(source.points)
    same, _, absent = _compared([transform(pose, source.points) for pose in poses], target)
    back = [transform(inverse(pose), target.points) for pose in poses]
    _, seen, missing = _compared(back, source)
    return same / n, max(absent / n, missing / max(seen + missing, 1))


def _compared(points: Sequence[Array], submap: Submap) -> tuple[int, int, int]:
    """How many points (n, 2) a submap confirms where they lie first, and at any of some places.

    The last number is of those that it does not, and that lie in its free space at first.
    """
    found = [compare_with_scans(at, submap) for at in points]
    first, free = found[0]
    confirmed = np.logical_or.reduce([at for at, _ in found])
    return int(first.sum()), int(confirmed.sum()), int((free & ~confirmed).sum())
