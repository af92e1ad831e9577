"""Duplicate landmarks: which landmarks of a map are one, and how they are merged.

A wall or a tree that was not recognised when it was seen again is in the map twice. After all data
is in, the joint covariance of the map says how far apart two landmarks may be if they are one.
Pairs are merged one after another, the most certain first. Each merge conditions the joint, so
later merges must agree with earlier ones. What one image showed as two things is never merged.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from graphslam.core.arrays import BoolArray, IntArray
from graphslam.core.consistency import RIVAL_D2
from graphslam.core.gaussian import chi2_quantile, mahalanobis_squared, whiten
from graphslam.core.geometry import Array, between, rotate_cov, wrap
from graphslam.core.record import replace
from graphslam.core.records import Association, Step
from graphslam.estimation.backend import JointMarginal
from graphslam.mapping.landmark_map import Entry, LandmarkMap, retarget

#: m, rad, m: how much two estimates of one wall may differ beyond their covariance: across it, in
#: direction, and in the position of its ends; of one point the first, along both axes
FLOOR_M, FLOOR_RAD, FLOOR_END_M = 0.02, 0.015, 0.08
#: share of the shorter wall that must overlap the longer one
OVERLAP_SHARE = 0.5
#: m, rad: walls farther apart (across, direction), and points, are not compared
REACH_M, REACH_RAD = 1.5, 0.3
GATE_PROBABILITY = 0.95
#: landmarks whose joint covariance is asked for at once, unless more may all be one
AT_ONCE = 100
#: m: walls are sampled at this distance to find those near each other
SAMPLE_M = 1.0


@dataclass(slots=True, eq=False)
class _Map:
    """All landmarks: means (n, 3), joint covariance (3n, 3n), extents (n, 2).

    ``whole`` (n,): segments whose ends are known; ``point`` (n,): points, whose heading is 0 and
    certain; ``group`` (n,): equal for landmarks that are merged; ``apart`` (n, n): true for pairs
    known to be different things.
    """

    x: Array
    P: Array
    extents: Array
    whole: BoolArray
    point: BoolArray
    group: IntArray
    apart: BoolArray

    def contradict(self, a: int, b: int) -> bool:
        """Whether the groups of two landmarks contain things known to be different."""
        in_a, in_b = self.group == self.group[a], self.group == self.group[b]
        return bool(self.apart[np.ix_(in_a, in_b)].any())


def find_duplicates(
    entries: Sequence[Entry],
    together: Iterable[frozenset[int]],
    joint: Callable[[Sequence[int]], JointMarginal],
) -> dict[int, int]:
    """Duplicate landmark -> the landmark that it is one with, the oldest of its group.

    Merges are judged place by place: at least all landmarks that may be duplicates of each other
    together, see `duplicates`, so that the covariances that are needed grow with the map and not
    with its square.

    Args:
        entries: the map.
        together: pairs that one image showed as two things.
        joint: numbers of landmarks -> their joint marginal; the pose in front is not used.
    """
    others: dict[int, set[int]] = {}
    for pair in together:
        for number in pair:
            others.setdefault(number, set()).update(pair - {number})
    found: list[tuple[int, int]] = []
    for batch in _batches(entries, others):
        numbers = [entry.id for entry in batch]
        apart = {
            frozenset((a, b)) for a in numbers for b in others.get(a, set()).intersection(numbers)
        }
        found += duplicates(batch, joint(numbers), apart)
    return merge_targets(found)


def _batches(entries: Sequence[Entry], others: Mapping[int, set[int]]) -> list[list[Entry]]:
    """Landmarks that may have duplicates, those that may be one never in different batches."""
    if len(entries) < 2:
        return []
    means = np.array([entry.mean for entry in entries])
    points = np.array([entry.kind == "point" for entry in entries])
    means[points, 2] = 0.0
    extents = np.array([entry.extent for entry in entries])
    i, j = near_pairs(means, extents, points, REACH_M)
    identity = [entry.identity for entry in entries]
    may = [
        entries[b].id not in others.get(entries[a].id, ())
        and (identity[a] is None or identity[b] is None or identity[a] == identity[b])
        for a, b in zip(i.tolist(), j.tolist(), strict=True)
    ]
    i, j = i[may], j[may]
    i, j = _comparable(means, extents, points, i, j)
    n = len(entries)
    _, place = connected_components(coo_matrix((np.ones(len(i)), (i, j)), shape=(n, n)), False)
    sizes = np.bincount(place)
    batches: list[list[Entry]] = []
    for members in np.split(np.argsort(place, kind="stable"), np.cumsum(sizes)[:-1]):
        if len(members) < 2:
            continue
        own = [entries[k] for k in members.tolist()]
        if batches and len(batches[-1]) + len(own) <= AT_ONCE:
            batches[-1] += own
        else:
            batches.append(own)
    return batches


def near_pairs(
    x: Array, extents: Array, point: BoolArray, reach_m: float
) -> tuple[IntArray, IntArray]:
    """Pairs (m,), (m,) of landmarks of which some parts may be within ``reach_m``.

    ``x`` (n, 3) are the landmarks, ``extents`` (n, 2) m along each one's x axis, ``point`` (n,).
    Walls are sampled, and samples looked up in a tree: the work grows with the number of landmarks
    and of pairs, not with the square of the former.
    """
    length = np.where(point, 0.0, extents[:, 1] - extents[:, 0])
    count = 2 + np.ceil(length / SAMPLE_M).astype(np.int64)
    of = np.repeat(np.arange(len(x)), count)
    k = np.arange(len(of)) - np.repeat(np.cumsum(count) - count, count)
    along = extents[of, 0] + k / (count[of] - 1) * length[of]
    along[point[of]] = 0.0
    at = x[of, :2] + along[:, None] * np.column_stack([np.cos(x[of, 2]), np.sin(x[of, 2])])
    # half a sample's distance aside, another wall may be as near as the reach
    pairs = cKDTree(at).query_pairs(np.hypot(reach_m, SAMPLE_M / 2), output_type="ndarray")
    i, j = np.sort(of[pairs], axis=1).T
    found = np.unique(i[i != j] * len(x) + j[i != j])
    return found // len(x), found % len(x)


def duplicates(
    entries: Sequence[Entry], joint: JointMarginal, together: Iterable[frozenset[int]]
) -> list[tuple[int, int]]:
    """Pairs of landmarks that are one, the most certain pair first; the older landmark first.

    ``joint`` has the means and covariance of ``entries`` in their order (the pose in front is not
    used). ``together``: pairs that one image showed as two things.
    """
    if len(entries) < 2:
        return []
    marks = _map(entries, *_padded(joint), together)
    i, j = _near(marks)
    found: list[tuple[int, int]] = []
    while len(i):
        r, H_i, H_j, rows = _compare(marks, i, j)
        d2 = _distances(marks, i, j, r, H_i, H_j)
        # pairs outside the gate stay: a merge moves the map and may bring them inside
        fits = d2 <= chi2_quantile(GATE_PROBABILITY, rows)
        k = _next_merge(marks, i, j, d2, fits)
        if k is None:
            break
        a, b = int(i[k]), int(j[k])
        found.append((entries[a].id, entries[b].id))
        _condition(marks, a, b, r[k, : rows[k]], H_i[k, : rows[k]], H_j[k, : rows[k]])
        marks.group[marks.group == marks.group[b]] = marks.group[a]
        open_still = marks.group[i] != marks.group[j]
        i, j = i[open_still], j[open_still]
    return [(min(pair), max(pair)) for pair in found]


def _padded(joint: JointMarginal) -> tuple[Array, Array]:
    """Means (n, 3) and joint covariance (3n, 3n) of landmarks; the heading of points is 0."""
    x = np.zeros((len(joint.landmarks), 3))
    places: list[int] = []
    for k, mean in enumerate(joint.landmarks):
        x[k, : len(mean)] = mean
        places += range(3 * k, 3 * k + len(mean))
    P = np.zeros((x.size, x.size))
    P[np.ix_(places, places)] = joint.cov[3:, 3:]
    return x, P


def _map(entries: Sequence[Entry], x: Array, P: Array, together: Iterable[frozenset[int]]) -> _Map:
    """The landmarks, none merged yet; those with different identities are apart."""
    place = {entry.id: k for k, entry in enumerate(entries)}
    names = np.array([entry.identity or "" for entry in entries])
    named = names != ""
    apart = named[:, None] & named & (names[:, None] != names)
    for pair in together:
        if pair <= place.keys():
            a, b = (place[number] for number in pair)
            apart[a, b] = apart[b, a] = True
    return _Map(
        x,
        P,
        np.array([entry.extent for entry in entries]),
        np.array([entry.kind == "segment" for entry in entries]),
        np.array([entry.kind == "point" for entry in entries]),
        np.arange(len(entries)),
        apart,
    )


def _near(marks: _Map) -> tuple[IntArray, IntArray]:
    """Pairs (m,), (m,) that may be one landmark by their means and extents."""
    i, j = np.triu_indices(len(marks.x), 1)
    may = ~marks.apart[i, j]
    return _comparable(marks.x, marks.extents, marks.point, i[may], j[may])


def _comparable(
    x: Array, extents: Array, point: BoolArray, i: IntArray, j: IntArray
) -> tuple[IntArray, IntArray]:
    """Those pairs of landmarks that may be one by their means (n, 3) and extents (n, 2)."""
    points = point[i]
    near = points == point[j]
    near[points] &= np.hypot(*(x[j] - x[i])[points, :2].T) < REACH_M
    near[~points] &= _beside(x, extents, i[~points], j[~points])
    return i[near], j[near]


def _next_merge(marks: _Map, i: IntArray, j: IntArray, d2: Array, fits: BoolArray) -> int | None:
    """Index of the most certain pair that nothing contradicts; None if there is none."""
    order = np.flatnonzero(fits)
    for k in order[np.argsort(d2[order])]:
        a, b = int(i[k]), int(j[k])
        if marks.contradict(a, b):
            continue
        merged = (marks.group == marks.group[a]) | (marks.group == marks.group[b])
        rival = fits & (merged[i] != merged[j]) & (d2 <= d2[k] + RIVAL_D2)
        outside = np.where(merged[i[rival]], j[rival], i[rival])
        if not any(marks.apart[marks.group == marks.group[o]][:, merged].any() for o in outside):
            return int(k)
    return None


def _relative(
    means: Array, extents: Array, i: IntArray, j: IntArray
) -> tuple[Array, Array, Array, Array]:
    """Wall j in the frame of wall i, (m,) each: along, across, turn; and middle of the overlap."""
    x, y = means[i], means[j]
    c, s, d = np.cos(x[:, 2]), np.sin(x[:, 2]), y[:, :2] - x[:, :2]
    along, across = c * d[:, 0] + s * d[:, 1], -s * d[:, 0] + c * d[:, 1]
    low = np.maximum(extents[i, 0], along + extents[j, 0])
    high = np.minimum(extents[i, 1], along + extents[j, 1])
    return along, across, wrap(y[:, 2] - x[:, 2]), 0.5 * (low + high)


def _beside(means: Array, extents: Array, i: IntArray, j: IntArray) -> BoolArray:
    """Which pairs (m,) are near, nearly parallel, and overlap along much of their length."""
    along, across, turn, middle = _relative(means, extents, i, j)
    a, b = extents[i], extents[j] + along[:, None]
    shared = np.minimum(a[:, 1], b[:, 1]) - np.maximum(a[:, 0], b[:, 0])
    shorter = np.minimum(a[:, 1] - a[:, 0], b[:, 1] - b[:, 0])
    off = across + (middle - along) * turn
    near = (np.abs(turn) < REACH_RAD) & (np.abs(off) < REACH_M)
    return np.asarray(near & (shared >= OVERLAP_SHARE * shorter))


def _compare(marks: _Map, i: IntArray, j: IntArray) -> tuple[Array, Array, Array, IntArray]:
    """Residuals (m, 3) of pairs being one, Jacobians (m, 3, 3) by either, and rows (m,) that count.

    Rows: distance across at the overlap, direction, and for whole segments the distance of their
    middles along the wall; for points the differences in x and y.
    """
    along, across, turn, middle = _relative(marks.x, marks.extents, i, j)
    c, s = np.cos(marks.x[i, 2]), np.sin(marks.x[i, 2])
    zero, one, arm = np.zeros(len(i)), np.ones(len(i)), middle - along
    ends = along + marks.extents[j].mean(axis=1) - marks.extents[i].mean(axis=1)
    r = np.stack([across + arm * turn, turn, ends], axis=1)

    def rows_of(*rows: Sequence[Array]) -> Array:
        return np.stack([np.stack(row, axis=1) for row in rows], axis=1)

    H_i = rows_of(
        [s + turn * c, -c + turn * s, -along - arm - turn * across],
        [zero, zero, -one],
        [-c, -s, across],
    )
    H_j = rows_of([-s - turn * c, c - turn * s, arm], [zero, zero, one], [c, s, zero])
    unknown = ~(marks.whole[i] & marks.whole[j])
    r[unknown, 2] = 0.0  # a row of zeros says nothing
    H_i[unknown, 2] = H_j[unknown, 2] = 0.0
    points = marks.point[i]
    r[points, :2] = (marks.x[j] - marks.x[i])[points, :2]
    H_i[points], H_j[points] = np.diag([-1.0, -1.0, 0.0]), np.diag([1.0, 1.0, 0.0])
    return r, H_i, H_j, np.where(unknown, 2, 3)


#: covariances added to the residuals of walls and of points
_FLOORS = np.array([
    np.diag([FLOOR_M**2, FLOOR_RAD**2, FLOOR_END_M**2]),
    np.diag([FLOOR_M**2, FLOOR_M**2, FLOOR_END_M**2]),
])  # fmt: skip


def _distances(marks: _Map, i: IntArray, j: IntArray, r: Array, H_i: Array, H_j: Array) -> Array:
    """Squared Mahalanobis distances (m,), over the rows that count."""
    P, floor = marks.P, _FLOORS[marks.point[i].astype(np.intp)]
    blocks = P.reshape(len(P) // 3, 3, -1, 3).transpose(0, 2, 1, 3)
    cross = H_i @ blocks[i, j] @ H_j.mT
    S = H_i @ blocks[i, i] @ H_i.mT + H_j @ blocks[j, j] @ H_j.mT + cross + cross.mT + floor
    return mahalanobis_squared(r, S)


def _condition(marks: _Map, a: int, b: int, r: Array, H_a: Array, H_b: Array) -> None:
    """Condition the joint on two landmarks being one: a Kalman update with residual ``r`` (k,)."""
    P, floor = marks.P, _FLOORS[int(marks.point[a])]
    PHt = P[:, 3 * a : 3 * a + 3] @ H_a.T + P[:, 3 * b : 3 * b + 3] @ H_b.T
    S = H_a @ PHt[3 * a : 3 * a + 3] + H_b @ PHt[3 * b : 3 * b + 3] + floor[: len(r), : len(r)]
    B, w, _ = whiten(PHt, S, -r)
    marks.x += (w @ B).reshape(-1, 3)
    P -= B.T @ B


# ---------------------------------------------------------------- merging in steps and map


def seen_together(steps: Iterable[Step]) -> set[frozenset[int]]:
    """Pairs of landmarks that one robot observed from one state as two things.

    Two collinear lines of one image may be parts of one wall, with a door between them. By noise
    some of many images show such parts out of line, so the majority of images decides.
    """
    images: dict[tuple[str, int], int] = {}
    seen, image = [], []
    for step in steps:
        for a in step.associations:
            if isinstance(a.target, int):
                seen.append(a)
                image.append(images.setdefault((a.robot, a.time_ns), len(images)))
    target = np.array([a.target for a in seen], dtype=np.int64)
    pair = _pairs_within(np.array(image, dtype=np.int64))
    pair = pair[target[pair[:, 0]] != target[pair[:, 1]]]
    line = np.array([a.model == "line" for a in seen], dtype=np.bool_)
    both = line[pair].all(axis=1)
    votes = np.full(len(pair), len(pair))  # segments have known ends, so they are two things
    votes[both] = np.where(_in_line(seen, pair[both]), -1, 1)
    # a pair as one number, which is sorted several times as fast
    base = int(target.max(initial=0)) + 1
    low, high = np.sort(target[pair], axis=1).T
    two, of = np.unique(low * base + high, return_inverse=True)
    won = two[np.bincount(of, votes, len(two)) > 0]
    return set(map(frozenset, np.column_stack(np.divmod(won, base)).tolist()))


def _pairs_within(image: IntArray) -> IntArray:
    """Pairs (m, 2) of rows that have the same ``image`` (n,), the earlier row first."""
    order = np.argsort(image, kind="stable")
    image = image[order]
    pairs = [np.zeros((0, 2), dtype=np.int64)]
    for apart in range(1, int(np.bincount(image).max(initial=0))):
        together = np.flatnonzero(image[apart:] == image[:-apart])
        pairs.append(np.column_stack([order[together], order[together + apart]]))
    return np.concatenate(pairs)


def _in_line(seen: Sequence[Association], pairs: IntArray) -> BoolArray:
    """Which ``pairs`` (m, 2) of lines, each of one image, may be collinear given their noise."""
    used, of = np.unique(pairs, return_inverse=True)
    of = of.reshape(pairs.shape)
    z = np.array([seen[n].z for n in used.tolist()]).reshape(-1, 3)
    cov = np.array([seen[n].cov for n in used.tolist()]).reshape(-1, 3, 3)
    # covariances along each line's own axes
    own = rotate_cov(cov, -z[:, 2])[of]
    off = between(z[of[:, 0]], z[of[:, 1]])
    turn = np.arctan(np.tan(off[:, 2]))  # modulo pi
    variance = own[:, :, 2, 2].sum(axis=1) + FLOOR_RAD**2
    across = own[:, :, 1, 1].sum(axis=1) + (off[:, 0] ** 2) * own[:, 0, 2, 2] + FLOOR_M**2
    gate = chi2_quantile(GATE_PROBABILITY, 1)
    return np.asarray((turn**2 <= gate * variance) & (off[:, 1] ** 2 <= gate * across))


def merge_targets(pairs: Iterable[tuple[int, int]]) -> dict[int, int]:
    """Duplicate landmark -> the landmark it is merged into, the oldest of its group."""
    into: dict[int, int] = {}

    def last(i: int) -> int:
        return last(into[i]) if i in into else i

    for pair in pairs:
        a, b = sorted(map(last, pair))
        if a != b:
            into[b] = a
    return {gone: last(gone) for gone in into}


def merged_steps(
    steps: Iterable[Step], into: Mapping[int, int], kinds: Mapping[int, str]
) -> tuple[Step, ...]:
    """Steps with duplicates replaced; observations of a segment merged into a line are lines."""

    def renamed(a: Association) -> Association:
        target = into.get(a.target) if isinstance(a.target, int) else None
        return a if target is None else retarget(a, target, kinds[target])

    return tuple(
        replace(step, associations=tuple(map(renamed, step.associations)))
        if any(a.target in into for a in step.associations)
        else step
        for step in steps
    )


def merged(
    steps: tuple[Step, ...], into: Mapping[int, int], landmarks: LandmarkMap
) -> tuple[Step, ...]:
    """Steps with merged landmarks; the map follows."""
    if not into:
        return steps
    kinds = {number: landmarks.entries[number].kind for number in into.values()}
    merge_entries(landmarks, into)
    return merged_steps(steps, into, kinds)


def merge_entries(landmarks: LandmarkMap, into: Mapping[int, int]) -> None:
    """Merge entries of the map: extents, counts and times."""
    for gone, kept in into.items():
        old, new = landmarks.entries.pop(gone), landmarks.entries[kept]
        if new.kind == "line":
            new.extend(old.mean, old.extent)
        if old.identity is not None and new.identity is None:
            new.identity = old.identity
            landmarks.by_identity[old.identity] = kept
        new.sightings += old.sightings
        new.first_ns = min(new.first_ns, old.first_ns)
        new.last_ns = max(new.last_ns, old.last_ns)
    landmarks.drop_index()
