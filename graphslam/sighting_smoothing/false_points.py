"""Points of a map without names that are none: false detections that happened to agree.

A few sightings of nothing lie near each other by chance, and become a point like any other. It fits
what was seen of it, so only what was not seen tells: a point is in sight of hundreds of images that
show others beside it and behind it, but not it.
"""

from collections.abc import Collection, Sequence

import numpy as np
from scipy.special import bdtr

from graphslam.core.arrays import BoolArray, IntArray
from graphslam.core.geometry import Array
from graphslam.core.records import Estimate, Step
from graphslam.mapping.landmark_map import observed_from
from graphslam.mapping.point_reassociation import image_numbers, is_point
from graphslam.mapping.points_in_sight import points_in_sight

#: a point that is seen by less than this share of what is usual of points in sight is none, if one
#: in a hundred of such points were seen as seldom
SELDOM, CHANCE = 0.25, 0.01
#: and with fewer sightings than this share of those of a usual point: one that walls or other
#: points hide from most places is seen as often as others from where it is not hidden
FEW = 0.05
#: sightings of a point that was there for a while, or that one place alone shows, which is passed
#: now and then: so many in stays of at least so many each. A stay has ended when so many images in
#: a row do not show the point
FOR_A_WHILE, STAY, GONE = 10, 3, 10


def find_false_points(
    steps: Sequence[Step], estimate: Estimate, points: Collection[int]
) -> set[int]:
    """Those of ``points`` that most images do not show that should.

    The work grows with the number of images times that of the points in sight of each.

    Args:
        steps: with states where sightings were made.
        estimate: of them, and of the points.
        points: numbers of landmarks without names.
    """
    seen = [a for step in steps for a in step.associations if is_point(a, points)]
    if not seen:
        return set()
    x, z = observed_from(seen, estimate.states), np.array([a.z for a in seen])
    numbers, point = np.unique([int(a.target) for a in seen], return_inverse=True)
    first, image = image_numbers(seen)
    places = np.array([estimate.landmarks[i][0][:2] for i in numbers.tolist()])
    names = {name: k for k, name in enumerate(sorted(estimate.states))}
    robot = np.array([names[seen[k].robot] for k in first.tolist()])
    false = _are_false(places, x[first], robot, image, point, z)
    return set(numbers[false].tolist())


def _are_false(
    places: Array, poses: Array, robot: IntArray, image: IntArray, point: IntArray, z: Array
) -> Array:
    """Whether points (n,) are seen too seldom.

    Args:
        places: (n, 2) m of the points.
        poses: (m, 3) of the images, of each robot in the order of time.
        robot: (m,) whose they are.
        image: (s,) of each sighting.
        point: (s,) that it is of.
        z: (s, 2) rad, m.
    """
    n = len(places)
    count = np.bincount(point, minlength=n)
    usual_count = np.median(count[point])  # of points that most sightings are of
    pairs = points_in_sight(places, poses, image, z)
    shows = np.isin(pairs[:, 0] * n + pairs[:, 1], image * n + point)
    times, hits = (np.bincount(pairs[of, 1], minlength=n) for of in (slice(None), shows))
    rates = hits / np.maximum(times, 1)
    often = count >= FEW * usual_count
    usual = np.median(np.repeat(rates[often], count[often]))
    seldom = bdtr(hits, times, SELDOM * usual) < CHANCE
    suspect = seldom & ~often
    asked = suspect[pairs[:, 1]]
    pairs, shows = pairs[asked], shows[asked]
    stayed = _in_stays(pairs[:, 1], robot[pairs[:, 0]], shows, SELDOM * usual, n) >= FOR_A_WHILE
    return np.asarray(suspect & ~stayed)


def _in_stays(point: IntArray, robot: IntArray, shows: BoolArray, rate: float, n: int) -> IntArray:
    """How many sightings each of n points has in stays, in which it is seen at a ``rate`` or more.

    Args:
        point: (k,) of images that should show it, of each robot in the order of time.
        robot: (k,) whose image it is.
        shows: (k,) whether it does.
        rate: least share of the images of a stay.
        n: number of points.
    """
    order = np.lexsort((robot, point))  # images of each stay in their order
    at = np.flatnonzero(shows[order])
    if not len(at):
        return np.zeros(n, dtype=np.int64)
    whose = np.column_stack([point, robot])[order][at]
    begins = np.append(True, (np.diff(whose, axis=0) != 0).any(axis=1) | (np.diff(at) > GONE))
    first = np.flatnonzero(begins)
    hits = np.diff(np.append(first, len(at)))
    images = at[first + hits - 1] - at[first] + 1
    counts = (hits >= STAY) & (hits >= rate * images)
    return np.bincount(whose[first, 0], hits * counts, minlength=n).astype(np.int64)
