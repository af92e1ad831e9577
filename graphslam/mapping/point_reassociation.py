"""Points once a log is solved: which sightings are of which, and which landmarks are one."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from graphslam.core.gaussian import mahalanobis_squared
from graphslam.core.observation_models import MODELS
from graphslam.core.records import Association, Estimate, Step
from graphslam.mapping.duplicate_landmarks import merge_targets
from graphslam.mapping.gating import IntArray
from graphslam.mapping.landmark_map import observed_from

#: landmarks nearest to where a sighting lies that it is compared with
CANDIDATES = 4
#: points nearer to each other than so many sigmas of a sighting may be one
SAME_SIGMAS = 3.0
#: share of the images of the rarer one in which a wrong association may show both
STRAY_SHARE = 0.05


def reassociate_points(steps: Sequence[Step], estimate: Estimate) -> tuple[tuple[Step, ...], int]:
    """Steps with every sighting of a point at the one that it fits best, and how many moved.

    Points are told apart by the noise of the sighting alone, so the estimate must be far more
    accurate. Of two sightings in one image that would be of one point both stay as they were. The
    work grows with the number of sightings, times the logarithm of that of points.

    Args:
        steps: with states where the sightings were made.
        estimate: of their states, and of the points that may be one or the other's.
    """
    numbers = np.array(sorted(i for i, (mean, _) in estimate.landmarks.items() if len(mean) == 2))
    seen = [a for step in steps for a in step.associations if _is_point(a, estimate)]
    if len(numbers) < 2 or not seen:
        return tuple(steps), 0
    means = np.array([estimate.landmarks[i][0] for i in numbers.tolist()])
    x, z = observed_from(seen, estimate.states), np.array([a.z for a in seen])
    cov = np.array([a.cov for a in seen])
    model = MODELS["point"]
    _, near = cKDTree(means).query(model.invert(z, x), k=min(CANDIDATES, len(numbers)))
    d2 = np.stack(
        [mahalanobis_squared(model.residual(z, x, means[k]), cov) for k in near.T], axis=1
    )
    best = numbers[near[np.arange(len(seen)), d2.argmin(axis=1)]]
    now = np.array([a.target for a in seen], dtype=np.int64)
    best = _exclusive(seen, now, best)
    following = iter(best.tolist())

    def moved(a: Association) -> Association:
        return replace(a, target=next(following)) if _is_point(a, estimate) else a

    made = tuple(replace(step, associations=tuple(map(moved, step.associations))) for step in steps)
    return made, int(np.count_nonzero(best != now))


def indistinguishable_points(steps: Sequence[Step], estimate: Estimate) -> dict[int, int]:
    """Points that no sighting can tell apart and no image shows as two: duplicate -> the one kept.

    Sightings of one point that is in the map twice are shared between the two by distance, which
    keeps these apart by as much as a sighting is uncertain, however certain their means are. If
    they were two, they would be seen side by side. For arguments see `reassociate_points`; the work
    grows with the number of sightings in images, and of pairs of points near each other.
    """
    seen = [a for step in steps for a in step.associations if _is_point(a, estimate)]
    numbers, of = np.unique([a.target for a in seen], return_inverse=True)
    if len(numbers) < 2:
        return {}
    x, z = observed_from(seen, estimate.states), np.array([a.z for a in seen])
    _, G = MODELS["point"].invert_jacobians(z, x)
    spread = G @ np.array([a.cov for a in seen]) @ G.mT
    count = np.bincount(of)
    total = np.zeros((len(numbers), 2, 2))
    np.add.at(total, of, spread)
    cloud = total / count[:, None, None]
    means = np.array([estimate.landmarks[i][0] for i in numbers.tolist()])
    reach = SAME_SIGMAS * float(np.sqrt(np.linalg.eigvalsh(cloud)[:, 1].max()))
    pairs = cKDTree(means).query_pairs(reach, output_type="ndarray")
    if not len(pairs):
        return {}
    i, j = pairs.T
    d2 = mahalanobis_squared(means[j] - means[i], 0.5 * (cloud[i] + cloud[j]))
    image = _images(seen)
    shown = csr_matrix((np.ones(len(seen)), (image, of)), shape=(image.max() + 1, len(numbers)))
    both = np.asarray((shown.T @ shown)[i, j]).ravel()
    same = (d2 < SAME_SIGMAS**2) & (both <= STRAY_SHARE * np.minimum(count[i], count[j]))
    return merge_targets((int(numbers[a]), int(numbers[b])) for a, b in pairs[same].tolist())


def _images(seen: Sequence[Association]) -> IntArray:
    """Number (n,) of the image that each was in: of one robot at one time."""
    robots = {robot: k for k, robot in enumerate(sorted({a.robot for a in seen}))}
    images = np.array([(robots[a.robot], a.time_ns) for a in seen], dtype=np.int64)
    return np.asarray(np.unique(images, axis=0, return_inverse=True)[1].ravel())


def _is_point(a: Association, estimate: Estimate) -> bool:
    return a.model == "point" and a.target in estimate.landmarks


def _exclusive(seen: Sequence[Association], now: IntArray, best: IntArray) -> IntArray:
    """``best`` (n,), or ``now`` (n,) in images in which two sightings would be of one point."""
    image = _images(seen)
    _, of, count = np.unique(
        np.column_stack([image, best]), axis=0, return_inverse=True, return_counts=True
    )
    twice = np.zeros(image.max() + 1, dtype=bool)
    twice[image[count[of.ravel()] > 1]] = True
    return np.asarray(np.where(twice[image], now, best))
