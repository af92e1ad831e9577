"""Points once a log is solved: which sightings are of which, and which landmarks are one.

Points are told apart by the noise of single sightings, so the states must be far more accurate.
The states stay as they are: points move to where their sightings show them, as in k-means
clustering, but two sightings of one image are of two points.
"""

from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from graphslam.core.arrays import IntArray
from graphslam.core.gaussian import mahalanobis_squared
from graphslam.core.geometry import Array
from graphslam.core.observation_models import MODELS
from graphslam.core.record import replace
from graphslam.core.records import Association, Estimate, Step
from graphslam.mapping.gating import assign
from graphslam.mapping.landmark_map import observed_from

#: points nearest to where a sighting lies that it is compared with
CANDIDATES = 6
#: points nearer to each other than so many sigmas of a sighting may be one
SAME_SIGMAS = 3.0
#: share of the images of the rarer one in which a wrong association may show both
STRAY_SHARE = 0.05
#: squared distance beyond which a sighting fits no point, and stays with the one it was of
FITS_NONE = 100.0
#: how often sightings go to the nearest point after the last merge
ROUNDS = 3


@dataclass(frozen=True, slots=True, eq=False)
class PointSightings:
    """Sightings (n) of points: where each shows one (n, 2), and its covariance (n, 2, 2) there.

    World frame; the covariance contains that of the state, if it is known. ``image`` (n,): number
    of the image that it was in; ``target`` (n,): of the point.
    """

    at: Array
    cov: Array
    information: Array
    image: IntArray
    target: IntArray

    @classmethod
    def of(
        cls, steps: Sequence[Step], estimate: Estimate, points: Collection[int]
    ) -> "PointSightings":
        """Those of ``points`` in steps with states where sightings were made, in their order."""
        seen = [a for step in steps for a in step.associations if is_point(a, points)]
        x, z = observed_from(seen, estimate.states), np.array([a.z for a in seen]).reshape(-1, 2)
        G_x, G_z = MODELS["point"].invert_jacobians(z, x)
        cov = G_z @ np.array([a.cov for a in seen]).reshape(-1, 2, 2) @ G_z.mT
        cov += G_x @ _state_covs(seen, estimate) @ G_x.mT
        return cls(
            MODELS["point"].invert(z, x),
            cov,
            np.linalg.inv(cov),
            image_numbers(seen)[1],
            np.array([a.target for a in seen], dtype=np.int64),
        )

    def distances(self, means: Array) -> tuple[IntArray, Array]:
        """Indices (n, k) of the points ``means`` (m, 2) near each, and squared distances (n, k)."""
        _, near = cKDTree(means).query(self.at, k=range(1, min(CANDIDATES, len(means)) + 1))
        off = means[near] - self.at[:, None]
        return near, np.einsum("nki,nij,nkj->nk", off, self.information, off)


def _state_covs(seen: Sequence[Association], estimate: Estimate) -> Array:
    """Covariances (n, 3, 3) of the states that associations were made from; 0 if unknown."""
    covs = np.zeros((len(seen), 3, 3))
    robots, times = np.array([a.robot for a in seen]), np.array([a.time_ns for a in seen])
    for robot, states in estimate.states.items():
        own = robots == robot
        covs[own] = np.nan_to_num(states.covs[states.index(times[own])])
    return covs


def image_numbers(seen: Sequence[Association]) -> tuple[IntArray, IntArray]:
    """The first (m,) of the associations of each image, and the image (n,) of each association.

    Sightings of one robot at one time are one image.
    """
    robots = {robot: k for k, robot in enumerate(sorted({a.robot for a in seen}))}
    images = np.array([(robots[a.robot], a.time_ns) for a in seen], dtype=np.int64)
    _, first, image = np.unique(
        images.reshape(-1, 2), axis=0, return_index=True, return_inverse=True
    )
    return first, image.ravel()


def is_point(a: Association, points: Collection[int]) -> bool:
    """Whether an association is of one of the ``points``."""
    return a.model == "point" and a.target in points


def reassociated(seen: PointSightings, means: Mapping[int, Array]) -> IntArray:
    """Number (n,) of the point that each sighting is of; merged ones are the oldest of theirs.

    Points are one if single sightings cannot tell them apart and no image shows them side by side.
    An image that could as well show one of them and a third does not: the sightings of points that
    are in the map several times are shared among these. So in each round at most one pair per
    neighbourhood is merged. The work grows with the number of sightings, times that of rounds,
    which is the largest number of duplicates.

    Args:
        seen: the sightings, of at least one point.
        means: number -> estimate (2,) of every point.
    """
    numbers, of = np.unique(seen.target, return_inverse=True)
    at = np.array([means[i] for i in numbers.tolist()])
    while True:
        at, near, d2 = _distances(seen, at, of)
        pairs = _same(seen, at, of, near, d2)
        if not pairs:
            break
        kept = np.arange(len(numbers))
        kept[[gone for _, gone in pairs]] = [kept for kept, _ in pairs]
        left, of = np.unique(kept[of], return_inverse=True)
        numbers, at = numbers[left], at[left]
        at, near, d2 = _distances(seen, at, of)
        of = _nearest(seen, of, near, d2)
        left, of = np.unique(of, return_inverse=True)
        numbers, at = numbers[left], at[left]
    for _ in range(ROUNDS):
        before, of = of, _nearest(seen, of, near, d2)
        if np.array_equal(of, before):
            break
        left, of = np.unique(of, return_inverse=True)
        numbers, at = numbers[left], at[left]
        at, near, d2 = _distances(seen, at, of)
    return np.asarray(numbers[of])


def _distances(seen: PointSightings, at: Array, of: IntArray) -> tuple[Array, IntArray, Array]:
    """Points (m, 2) where their sightings show them, and `PointSightings.distances` from there.

    One step of iterative reweighting from ``at`` (m, 2), with Cauchy weights; ``of`` (n,) are
    indices.
    """
    off = seen.at - at[of]
    d2 = np.einsum("ni,nij,nj->n", off, seen.information, off)
    W = seen.information / (1.0 + d2 / SAME_SIGMAS**2)[:, None, None]
    total, change = np.zeros((len(at), 2, 2)), np.zeros((len(at), 2))
    np.add.at(total, of, W)
    np.add.at(change, of, (W @ off[:, :, None])[:, :, 0])
    at = at + np.linalg.solve(total, change[:, :, None])[:, :, 0]
    return at, *seen.distances(at)


def _same(
    seen: PointSightings, at: Array, of: IntArray, near: IntArray, d2: Array
) -> list[tuple[int, int]]:
    """Pairs of points (index of the older, of the younger) that are one, not near each other."""
    count = np.bincount(of)
    total = np.zeros((len(at), 2, 2))
    np.add.at(total, of, seen.cov)
    cloud = total / count[:, None, None]
    reach = SAME_SIGMAS * float(np.sqrt(np.linalg.eigvalsh(cloud)[:, 1].max()))
    pairs = cKDTree(at).query_pairs(reach, output_type="ndarray")
    if not len(pairs):
        return []
    i, j = np.sort(pairs, axis=1).T
    apart = mahalanobis_squared(at[j] - at[i], 0.5 * (cloud[i] + cloud[j]))
    # in an image of both, none of the two sightings may be of a third that is not in it
    key = seen.image * len(at) + of
    free = ~np.isin(seen.image[:, None] * len(at) + near, key) & (d2 < SAME_SIGMAS**2)
    bound = np.flatnonzero(~free.any(axis=1))
    shape = (int(seen.image.max()) + 1, len(at))
    shown = csr_matrix((np.ones(len(bound)), (seen.image[bound], of[bound])), shape=shape)
    both = np.asarray((shown.T @ shown)[i, j]).ravel()
    same = (apart < SAME_SIGMAS**2) & (both <= STRAY_SHARE * np.minimum(count[i], count[j]))
    neighbours: dict[int, set[int]] = defaultdict(set)
    for a, b in pairs.tolist():
        neighbours[a].add(b)
        neighbours[b].add(a)
    found, changed = [], set[int]()
    for k in np.flatnonzero(same)[np.argsort(apart[same], kind="stable")].tolist():
        a, b = int(i[k]), int(j[k])
        if not changed & {a, b}:
            changed |= {a, b} | neighbours[a] | neighbours[b]
            found.append((a, b))
    return found


def _nearest(seen: PointSightings, now: IntArray, near: IntArray, d2: Array) -> IntArray:
    """Index (n,) of the point that each fits best, those of one image all different ones.

    ``now`` (n,) where it fits none that is left.
    """
    first = d2.argmin(axis=1)
    rows = np.arange(len(now))
    best = np.where(d2[rows, first] < FITS_NONE, near[rows, first], now)
    key = seen.image * (int(near.max()) + 1) + best
    _, of, count = np.unique(key, return_inverse=True, return_counts=True)
    order = np.argsort(seen.image, kind="stable")
    images = np.unique(seen.image[count[of.ravel()] > 1])
    ends = np.searchsorted(seen.image[order], np.append(images, images + 1))
    for begin, end in ends.reshape(2, -1).T.tolist():
        own = order[begin:end]
        points, column = np.unique(near[own], return_inverse=True)
        cost = np.full((len(own), len(points)), np.inf)
        cost[np.arange(len(own))[:, None], column.reshape(near[own].shape)] = d2[own]
        best[own] = now[own]
        for row, col in assign(cost, np.full_like(cost, FITS_NONE), "optimal"):
            best[own[row]] = points[col]
    return np.asarray(best)


def retargeted(steps: Sequence[Step], targets: Mapping[int | None, int | str]) -> tuple[Step, ...]:
    """Steps whose sightings are of other landmarks; ``targets`` by `Association.source`."""
    return tuple(
        replace(
            step,
            associations=tuple(
                replace(a, target=targets[a.source]) if a.source in targets else a
                for a in step.associations
            ),
        )
        for step in steps
    )
