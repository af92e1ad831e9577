"""Robots that were in the same places: where one began in the frame of another, by their scans.

Nothing is known of how the frames lie, so every submap of one robot is looked for in the whole map
of the other: at all headings and all positions, against what was seen there and what was looked
through (correlation by Fourier transform; E. Olson, ICRA 2009, DOI 10.1109/ROBOT.2009.5152375, for
the kind of search). The best few poses are matched and verified as loops are (`closing`). Buildings
repeat themselves, so one match proves nothing: the largest set is looked for of which any two say
the same of the frames, within what both robots' estimates may have missed on the way from one
place to the other (J. Mangelson et al., ICRA 2018, DOI 10.1109/ICRA.2018.8460217). It must be of
several places that extend over more than a room, no other set may be worth nearly as much, and
what must then be the same may not differ.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import fft

from graphslam.core.consistency import greedy_max_clique
from graphslam.core.gaussian import chi2_quantile
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
from graphslam.mapping.loop_closure import NEAR_M, TRUST, verify_match
from graphslam.mapping.submaps import SubmapPose, drift_covariance
from graphslam.multi_robot.relative_frames import RelativeFrame
from graphslam.perception.scan_matching import IntArray, Match, match

#: m, rad: steps of the search; of what was looked through, only so near a laser, m
STEP_M, STEP_RAD, CLEAR_M = 0.3, np.radians(2.5), 12.0
#: beside what was seen, and where was looked through; 1 is what was seen
BESIDE, THROUGH = 0.5, -0.5
#: submaps of a robot that are looked for at most, and poses of each that are looked at closely
MOST, LOOKS = 80, 6
#: m: no two of those poses are nearer to each other
APART_M = 1.0
#: half the window (m, m, rad) in which each is matched; visits of the place that it is matched with
WINDOW, VISITS = np.array([0.45, 0.45, 0.06]), 3
#: two matches agree, and one is borne out by the others, up to this probability
AGREE = 0.99
#: an estimate that was not solved again is worse than it says by this factor, in variance: neither
#: noise nor calibration are the final ones
OWN = 4.0
#: fewest matches that must agree, by the search alone and in the end, and m that their places must
#: extend over in both maps
FEWEST_FOUND, FEWEST, EXTENT_M = 2, 4, 6.0
#: what was looked through weighs so many times what is confirmed: many walls are alike
DIFFERS = 5.0
#: a place speaks for another meaning if that shows it with more than this part of its score, and
#: another meaning with more than this part of all scores leaves it undecided
CLEARLY, RIVAL = 0.8, 0.5
#: another way to lay all places on the map that does so nearly as well, farther off than `APART_M`
#: or turned by more than this (rad), leaves it undecided
AS_WELL, ELSEWHERE_RAD = 0.8, np.radians(15.0)
#: places that should be the same are not if this part of what either saw there was looked through
#: by the other; m between them at most; of all matches, how many such places there may be; half the
#: window in which they are matched (m, m, rad)
LOOKED_THROUGH, NEAR_BY_M, AT_MOST = 0.07, 2.0, 0.2
ROUND_THERE = np.array([1.0, 1.0, 0.1])


@dataclass(frozen=True, slots=True, eq=False)
class PlaceMatch:
    """A place of one robot (index ``there``) that was recognised as one of another (``here``).

    ``match`` has the pose of ``there`` as seen from ``here``.
    """

    here: int
    there: int
    match: Match


@dataclass(frozen=True, slots=True, eq=False)
class _OccupancySpectrum:
    """What a map says of each cell, and its Fourier transform; ``low`` (2,) m is the first cell."""

    transformed: Array
    low: Array
    shape: tuple[int, int]


def relate_places(
    a: str, b: str, here: Sequence[SubmapPose], there: Sequence[SubmapPose], P_a: Array, P_b: Array
) -> RelativeFrame | str:
    """Where ``b`` began in the frame of ``a``, or why that is not known ("" if nothing says so).

    Args:
        a: name of a robot.
        b: name of another one.
        here: places of ``a``, in its frame.
        there: places of ``b``, in its frame.
        P_a: (3n, 3n) joint covariance of the poses of ``here``, errors along each one's own axes.
        P_b: the same of ``there``.
    """
    found = match_places(here, there) if here and there else []
    relation = choose_alignment(a, b, found, here, there, P_a, P_b) if found else ""
    if isinstance(relation, RelativeFrame) and any(
        _is_supported(start, here, there)
        for start in alternative_alignments(relation.pose, here, there)
    ):
        return f"{a} and {b} saw places that look alike, but they lie as well in another way"
    return relation


def match_places(here: Sequence[SubmapPose], there: Sequence[SubmapPose]) -> list[PlaceMatch]:
    """All places of one robot that look like one of another's, several of one if need be."""
    field = _occupancy_spectrum(here, CLEAR_M)
    positions = np.array([p.pose[:2] for p in here])
    found = []
    some = np.unique(np.linspace(0, len(there) - 1, min(len(there), MOST)).round().astype(int))
    for k in some:
        for pose in _search_poses(field, there[k].submap.points):
            best: PlaceMatch | None = None
            for j in _nearest_of_each_pass(positions, pose):
                guess = between(here[j].pose, pose)
                seen = verify_match(match(there[k].submap, here[j].submap, guess, WINDOW))
                if seen is not None and (best is None or _score(seen) > _score(best.match)):
                    best = PlaceMatch(j, int(k), seen)
            if best is not None and _score(best.match) > 0:
                found.append(best)
    return found


def _score(m: Match) -> float:
    return m.same - DIFFERS * m.absent


def _nearest_of_each_pass(positions: Array, pose: Array) -> list[int]:
    """Of each stretch of places (n, 2) near a pose (3,) the nearest, `VISITS` at most."""
    distance = np.hypot(*(positions - pose[:2]).T)
    near = np.flatnonzero(distance <= NEAR_M)
    stretches = np.split(near, np.flatnonzero(np.diff(near) > 1) + 1)
    nearest = [int(s[distance[s].argmin()]) for s in stretches if len(s)]
    return sorted(nearest, key=lambda j: float(distance[j]))[:VISITS]


# ---------------------------------------------------------------- the search


def _occupancy_spectrum(places: Sequence[SubmapPose], room_m: float) -> _OccupancySpectrum:
    """A map of all places, with room round it for what is looked for and goes so far."""
    points = np.concatenate([transform(p.pose, p.submap.points) for p in places])
    margin = int(np.ceil(room_m / STEP_M)) + 1
    low = points.min(axis=0) - margin * STEP_M
    size = np.round((points.max(axis=0) - low) / STEP_M).astype(int) + margin + 1
    grid = np.zeros(size, dtype=np.float32)
    for place in places:
        x, y = _cells(_free_points(place), low).T
        inside = (x >= 0) & (y >= 0) & (x < size[0]) & (y < size[1])
        grid[x[inside], y[inside]] = THROUGH
    x, y = _cells(points, low).T
    for weight, reach in ((BESIDE, 1), (1.0, 0)):
        for i in range(-reach, reach + 1):
            for j in range(-reach, reach + 1):
                grid[x + i, y + j] = weight
    shape = (fft.next_fast_len(int(size[0]), real=True), fft.next_fast_len(int(size[1]), real=True))
    return _OccupancySpectrum(fft.rfft2(grid, shape), low, shape)


def _cells(points: Array, low: Array) -> IntArray:
    return np.asarray(np.round((points - low) / STEP_M).astype(np.intp))


def _free_points(place: SubmapPose) -> Array:
    """Points (n, 2) m in the robot's frame that its scans of a place looked through."""
    submap = place.submap
    free = submap.free[:, ::2]
    along = np.arange(0.0, CLEAR_M, STEP_M)
    angle = 2 * np.pi * np.arange(free.shape[1]) / free.shape[1]
    scan, beam, step = np.nonzero(along < free[:, :, None])
    sensors = compose(place.pose, submap.poses)
    direction = sensors[scan, 2] + angle[beam]
    ray = unit_vectors(direction)
    return np.asarray(sensors[scan, :2] + along[step][:, None] * ray)


def _correlate(field: _OccupancySpectrum, points: Array) -> Array:
    """What a map says of points (n, 2) on the mean, with their origin in each of its cells."""
    cells = np.round(points / STEP_M).astype(np.intp)
    image = np.zeros(field.shape, dtype=np.float32)
    np.add.at(image, (cells[:, 0], cells[:, 1]), np.float32(1.0 / len(cells)))
    return np.asarray(fft.irfft2(field.transformed * fft.rfft2(image).conj(), field.shape))


def _search_poses(field: _OccupancySpectrum, points: Array) -> list[Array]:
    """Poses (3,), best first, at which points (n, 2) of a submap lie well in a map."""
    near = points[np.hypot(points[:, 0], points[:, 1]) < CLEAR_M]
    if not len(near):
        return []
    near = np.unique(np.round(near / STEP_M), axis=0) * STEP_M
    turns = np.arange(-np.pi, np.pi, STEP_RAD)
    best = np.full(field.shape, -np.inf, dtype=np.float32)
    turned = np.zeros(field.shape)
    for turn in turns:
        scores = _correlate(field, transform(np.array([0.0, 0.0, turn]), near))
        better = scores > best
        best[better], turned[better] = scores[better], turn
    found: list[Array] = []
    x, y = (np.arange(n) for n in field.shape)
    while len(found) < LOOKS and best.max() > 0:
        i, j = np.unravel_index(int(best.argmax()), best.shape)
        at = field.low + STEP_M * np.array([i, j])
        found.append(np.array([*at, turned[i, j]]))
        best[(x[:, None] - i) ** 2 + (y - j) ** 2 < (APART_M / STEP_M) ** 2] = -np.inf
    return found


def alternative_alignments(
    start: Array, here: Sequence[SubmapPose], there: Sequence[SubmapPose]
) -> list[Array]:
    """Other starts (3,), at which all places together lie on a map nearly as well as at ``start``.

    A hall looks the same the other way round, and of all its places few need show that.

    Args:
        start: (3,) where a robot began in the frame of another one.
        here: places of the other one, in its frame.
        there: places of the one, in its frame; what is not where the other one was says nothing.
    """
    positions = np.array([p.pose[:2] for p in here])
    shared = [p for p in there if len(_nearest_of_each_pass(positions, compose(start, p.pose)))]
    points = np.concatenate([transform(p.pose, p.submap.points) for p in shared])
    middle = np.array([*points.mean(axis=0), 0.0])
    points = np.unique(np.round((points - middle[:2]) / STEP_M), axis=0) * STEP_M
    field = _occupancy_spectrum(here, float(np.hypot(*points.T).max()))
    own = compose(start, middle)
    x, y = (field.low[k] + STEP_M * np.arange(field.shape[k]) for k in (0, 1))
    close = (x[:, None] - own[0]) ** 2 + (y - own[1]) ** 2 < APART_M**2
    at_start, beside = 0.0, []
    for turn in np.arange(0.0, 2 * np.pi, STEP_RAD):
        heading = own[2] + turn
        scores = _correlate(field, transform(np.array([0.0, 0.0, heading]), points))
        if min(turn, 2 * np.pi - turn) < ELSEWHERE_RAD:
            at_start = max(at_start, float(scores[close].max()))
            scores = np.where(close, 0.0, scores)
        i, j = np.unravel_index(int(scores.argmax()), scores.shape)
        beside.append((float(scores[i, j]), np.array([x[i], y[j], heading])))
    found: list[Array] = []
    for score, pose in sorted(beside, key=lambda one: -one[0]):
        if score <= AS_WELL * at_start or len(found) == LOOKS:
            break
        off = [between(other, pose) for other in found]
        if all(np.hypot(d[0], d[1]) > APART_M or abs(d[2]) > ELSEWHERE_RAD for d in off):
            found.append(pose)
    return [compose(pose, inverse(middle)) for pose in found]


def _is_supported(start: Array, here: Sequence[SubmapPose], there: Sequence[SubmapPose]) -> bool:
    """Whether a start (3,) is borne out by some places, and by few contradicted."""
    same, differing = verify_places(start, here, there)
    return bool(same) and differing <= AT_MOST * len(same)


# ---------------------------------------------------------------- which of the matches to believe


def choose_alignment(
    a: str,
    b: str,
    found: Sequence[PlaceMatch],
    here: Sequence[SubmapPose],
    there: Sequence[SubmapPose],
    P_a: Array,
    P_b: Array,
) -> RelativeFrame | str:
    """What meetings say of where ``b`` began in the frame of ``a``; see `relate_places`.

    Which of them to believe is decided by what the estimates may have missed at worst; what these
    say together, by what the estimates say of themselves, times `OWN`.

    Args:
        a: name of a robot.
        b: name of another one.
        found: at least one, see `meetings`.
        here: places of ``a``.
        there: places of ``b``.
        P_a: joint covariance of ``here``.
        P_b: the same of ``there``.
    """
    worst = TRUST * P_a + drift_covariance(here), TRUST * P_b + drift_covariance(there)
    T, C, agree = _pairwise_agreement(found, here, there, *worst)
    best = greedy_max_clique(agree, _scores(found))
    if len(best) < FEWEST_FOUND:
        return ""
    # the search may have overlooked places that are the same, or that should be
    more, differing = verify_places(_together(T, C, best)[0], here, there)
    found = [*found, *more]
    T, C, agree = _pairwise_agreement(found, here, there, *worst)
    worth = _scores(found)
    best = greedy_max_clique(agree, worth)
    if len(best) < FEWEST:
        return ""
    sides = (here, [m.here for m in found]), (there, [m.there for m in found])
    if min(_extent([places[index[k]] for k in best]) for places, index in sides) < EXTENT_M:
        return f"{a} and {b} saw nothing alike but what is no larger than a room"
    # a place that shows the best clearly better than another meaning does not speak for that
    shown = {found[k].there: worth[k] for k in best}
    as_well = np.array([
        score > CLEARLY * shown.get(m.there, 0.0) for m, score in zip(found, worth, strict=True)
    ])  # fmt: skip
    unlike = _together(T, C, best)[2] > chi2_quantile(AGREE, 3)
    rest = np.flatnonzero(unlike & as_well)
    rival = rest[greedy_max_clique(agree[np.ix_(rest, rest)], worth[rest])]
    if worth[rival].sum() > RIVAL * worth[best].sum():
        return (
            f"{a} and {b} saw places that look alike, {len(best)} as if one began here, "
            f"{len(rival)} as if there: that has two meanings"
        )
    if differing > AT_MOST * len(best):
        return f"{a} and {b} saw places that look alike, but what is beside them differs"
    pose, cov, _ = _together(*_start_estimates(found, here, there, OWN * P_a, OWN * P_b), best)
    return RelativeFrame(b, a, pose, cov, float(len(best)))


def verify_places(
    start: Array, here: Sequence[SubmapPose], there: Sequence[SubmapPose]
) -> tuple[list[PlaceMatch], int]:
    """Places of a robot that are what another one saw there, if it began at ``start``.

    Args:
        start: (3,) where the one began in the frame of the other.
        here: places of the other one, in its frame.
        there: places of the one, in its frame.

    Returns:
        Those that are verified, and how many are of something else.
    """
    positions = np.array([p.pose[:2] for p in here])
    same: list[PlaceMatch] = []
    differing = 0
    for k, place in enumerate(there):
        pose = compose(start, place.pose)
        looked = []
        for j in _nearest_of_each_pass(positions, pose):
            guess = between(here[j].pose, pose)
            if np.hypot(guess[0], guess[1]) <= NEAR_BY_M:
                matches = match(place.submap, here[j].submap, guess, ROUND_THERE)
                looked += [(_score(matches[0]), j, matches)] if matches else []
        if not looked:
            continue
        _, j, matches = max(looked, key=lambda one: one[0])
        best = verify_match(matches)
        if best is not None and _score(best) > 0:
            same.append(PlaceMatch(j, k, best))
        seen = matches[0].same + matches[0].absent
        differing += matches[0].absent > LOOKED_THROUGH * seen
    return same, differing


def _scores(found: Sequence[PlaceMatch]) -> Array:
    return np.array([_score(m.match) for m in found])


def _pairwise_agreement(
    found: Sequence[PlaceMatch],
    here: Sequence[SubmapPose],
    there: Sequence[SubmapPose],
    D_a: Array,
    D_b: Array,
) -> tuple[Array, Array, Array]:
    """What `_starts` says, and which of n meetings agree (n, n); of one place no two do."""
    T, C = _start_estimates(found, here, there, D_a, D_b)
    off = T[:, None] - T
    off[..., 2] = wrap(off[..., 2])
    own = C[np.arange(len(T)), np.arange(len(T))]
    S = own[:, None] + own - C - C.transpose(1, 0, 2, 3)
    place = np.array([m.there for m in found])
    other = place[:, None] != place
    S[~other] = np.eye(3)
    return T, C, other & (_squared(off, S) <= chi2_quantile(AGREE, 3))


def _start_estimates(
    found: Sequence[PlaceMatch],
    here: Sequence[SubmapPose],
    there: Sequence[SubmapPose],
    D_a: Array,
    D_b: Array,
) -> tuple[Array, Array]:
    """Where the other robot began by each of n meetings, (n, 3), and their covariance (n, n, 3, 3).

    They share the errors ``D_a``, ``D_b`` of both robots' ways, see `relate_places`.
    """
    j, i = np.array([m.here for m in found]), np.array([m.there for m in found])
    A = np.array([p.pose for p in here])[j]
    B = np.array([p.pose for p in there])[i]
    h = np.array([m.match.pose for m in found])
    X = compose(A, h)
    T = compose(X, inverse(B))
    # of the start, by errors of where the other's place lies; of that, by errors of both places
    lever = np.broadcast_to(np.eye(3), (len(T), 3, 3)).copy()
    lever[:, :2, 2] = -_across(X - T)
    G_h = lever @ rotation3(A[:, 2])
    G_a = rotation3(A[:, 2])
    G_a[:, :2, 2] += _across(X - A)
    G_a, G_b = lever @ G_a, -lever @ rotation3(X[:, 2])
    C = np.zeros((len(T), len(T), 3, 3))
    for G, places, D, k in ((G_a, here, D_a, j), (G_b, there, D_b, i)):
        blocks = D.reshape(len(places), 3, len(places), 3).transpose(0, 2, 1, 3)
        C += G[:, None] @ blocks[np.ix_(k, k)] @ G.mT
    R = np.array([m.match.cov for m in found])
    C[np.arange(len(T)), np.arange(len(T))] += G_h @ R @ G_h.mT
    return T, C


def _across(v: Array) -> Array:
    """Vectors (n, 2) turned to the left by a right angle, of the first two columns of (n, 3)."""
    return np.column_stack([-v[:, 1], v[:, 0]])


def _squared(off: Array, S: Array) -> Array:
    """Squared distances (...) of (..., 3), normalised by covariances (..., 3, 3)."""
    return np.asarray((off * np.linalg.solve(S, off[..., None])[..., 0]).sum(axis=-1))


def _together(T: Array, C: Array, members: IntArray) -> tuple[Array, Array, Array]:
    """What members (k,) of n starts (n, 3) say together, see `_starts`, by least squares.

    Returns:
        The start (3,), its covariance (3, 3), scaled up where members differ by more than theirs
        says, and how far off every one of all n is from what the members say, squared and
        normalised (n,).
    """
    n, k = len(T), len(members)
    first = T[members[0]]
    off = T - first
    off[:, 2] = wrap(off[:, 2])
    whole = C.transpose(0, 2, 1, 3).reshape(3 * n, 3 * n)
    rows = (3 * members[:, None] + np.arange(3)).ravel()
    information = np.linalg.inv(whole[np.ix_(rows, rows)])
    one = np.tile(np.eye(3), (k, 1))
    cov = np.linalg.inv(one.T @ information @ one)
    W = cov @ one.T @ information
    mean = W @ off[members].ravel()
    left = (off[members] - mean).ravel()
    scale = max(1.0, float(left @ information @ left) / max(3 * k - 3, 1))
    with_it = (W @ whole[rows]).reshape(3, n, 3).transpose(1, 0, 2)
    own = C[np.arange(n), np.arange(n)]
    S = own + scale * cov - with_it - with_it.mT
    S[members] = own[members]  # they are in it themselves
    miss = _squared(off - mean, S)
    pose = first + mean
    pose[2] = wrap(pose[2])
    miss[members] = 0.0
    return pose, np.asarray(scale * cov), miss


def _extent(places: Sequence[SubmapPose]) -> float:
    """The longest distance between any two places, m."""
    points = np.array([p.pose[:2] for p in places])
    return float(np.linalg.norm(points[:, None] - points, axis=-1).max())
