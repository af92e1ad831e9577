"""Points of a map without names that are none: false detections that happened to agree.

A few sightings of nothing lie near each other by chance, and become a point like any other. It fits
what was seen of it, so only what was not seen tells: a point is in sight of hundreds of images that
show others beside it and behind it, but not it.
"""

from collections.abc import Collection, Sequence

import numpy as np
from scipy.special import bdtr

from graphslam.core.arrays import IntArray
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
#: sightings in one go of a point that was there for a while, and then was not
FOR_A_WHILE = 10


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
    false = _are_false(places, x[first], image, point, z)
    return set(numbers[false].tolist())


def _are_false(places: Array, poses: Array, image: IntArray, point: IntArray, z: Array) -> Array:
    """Whether points (n,) are seen too seldom.

    Args:
        places: (n, 2) m of the points.
        poses: (m, 3) of the images.
        image: (s,) of each sighting.
        point: (s,) that it is of.
        z: (s, 2) rad, m.
    """
    n = len(places)
    count = np.bincount(point, minlength=n)
    usual_count = np.median(count[point])  # of points that most sightings are of
    pairs = points_in_sight(places, poses, image, z)
    shows = np.isin(pairs[:, 0] * n + pairs[:, 1], image * n + point)
    begin, end = np.full(n, len(poses)), np.zeros(n, dtype=np.intp)
    np.minimum.at(begin, point, image)
    np.maximum.at(end, point, image)
    meanwhile = (pairs[:, 0] >= begin[pairs[:, 1]]) & (pairs[:, 0] <= end[pairs[:, 1]])
    at = pairs[:, 1]
    times, hits, there, hits_there = (
        np.bincount(at[which], minlength=n)
        for which in (np.ones_like(shows), shows, meanwhile, shows & meanwhile)
    )
    rates = hits / np.maximum(times, 1)
    often = count >= FEW * usual_count
    usual = np.median(np.repeat(rates[often], count[often]))
    seldom = bdtr(hits, times, SELDOM * usual) < CHANCE
    stayed = (hits_there >= FOR_A_WHILE) & (hits_there >= SELDOM * usual * there)
    return np.asarray(seldom & ~often & ~stayed)
