"""Parts of one image that cannot be of one wall: of a door and of the wall in front of it.

A closed door lies a decimetre behind its wall, less than the pose of a robot may be off, so alone
each of them matches the wall. Seen together they do not: within an image the pose is the same, and
how far apart their lines are is known to the noise of the sensor.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence

import numpy as np

from graphslam.core.geometry import Array, rotate_cov, unit_vectors
from graphslam.core.records import Observation

#: m, sigmas: the middle of one part is so far beside the line of the other one. Noise alone does
#: that to one of 16 000 pairs; what is less bends nothing, and walls are not that flat
APART_M, APART_SIGMAS = 0.04, 4.0


def conflicting_observations(targets: Mapping[int, int], seen: Sequence[Observation]) -> set[int]:
    """Observations that are left out for others of the same wall in the same image.

    Those that fit each other and have the most length together stay.

    Args:
        targets: observation, a place in ``seen`` -> the landmark that it was matched with.
        seen: all observations of one image, from one state.
    """
    parts = defaultdict[int, list[int]](list)
    for n, landmark in targets.items():
        if seen[n].extent is not None:
            parts[landmark].append(n)
    aside: set[int] = set()
    for own in parts.values():
        if len(own) > 1:
            aside |= _left_out(own, seen)
    return aside


def _left_out(own: Sequence[int], seen: Sequence[Observation]) -> set[int]:
    """Of observations ``own`` of one wall those outside the fitting ones of most length."""
    length = np.array([np.ptp(np.asarray(seen[n].extent)) for n in own])
    fits = ~_apart([seen[n] for n in own])
    if fits.all():
        return set()
    best: list[int] = []
    for first in range(len(own)):  # each with those that fit it and each other, longest first
        chosen = [first]
        for other in np.argsort(-length, kind="stable").tolist():
            if other != first and fits[other, chosen].all():
                chosen.append(other)
        if length[chosen].sum() > length[best].sum():
            best = chosen
    return {n for k, n in enumerate(own) if k not in best}


def _apart(walls: Sequence[Observation]) -> np.ndarray[tuple[int, int], np.dtype[np.bool_]]:
    """Whether the middle of one (n, n) lies beside the line of another one, either way round."""
    z = np.array([wall.z for wall in walls])
    own = rotate_cov(np.array([wall.cov for wall in walls]), -z[:, 2])
    middle_m = np.array([np.mean(np.asarray(wall.extent)) for wall in walls])
    middles = z[:, :2] + middle_m[:, None] * unit_vectors(z[:, 2])
    offset = middles[None] - z[:, None, :2]
    sin, cos = np.sin(z[:, 2])[:, None], np.cos(z[:, 2])[:, None]
    along = cos * offset[..., 0] + sin * offset[..., 1]
    across = cos * offset[..., 1] - sin * offset[..., 0]
    variance = _across_variance(own[:, None], along) + _across_variance(own, middle_m)[None]
    apart = np.abs(across) > np.maximum(APART_M, APART_SIGMAS * np.sqrt(variance))
    np.fill_diagonal(apart, False)
    return np.asarray(apart | apart.T)


def _across_variance(cov: Array, along: Array) -> Array:
    """Variance, m², of a line beside itself, ``along`` m from its reference point.

    ``cov`` (..., 3, 3) is along its own axes.
    """
    return np.asarray(cov[..., 1, 1] + 2.0 * along * cov[..., 1, 2] + along**2 * cov[..., 2, 2])
