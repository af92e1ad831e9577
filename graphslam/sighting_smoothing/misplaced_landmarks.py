"""Landmarks that are where their first sightings said, though most say that they are elsewhere.

A sighting under a false name puts a landmark into the map before it is seen itself. A kernel whose
influence decreases keeps it there: what is seen of it later, however often, is far off and hardly
counts. The states are right by then, as all other landmarks hold them, and tell where it is.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from graphslam.core.config import RobustConfig
from graphslam.core.gaussian import mahalanobis_squared
from graphslam.core.geometry import Array
from graphslam.core.observation_models import MODELS
from graphslam.core.records import Association, Estimate, Step
from graphslam.estimation.m_estimators import LOSSES
from graphslam.mapping.landmark_map import observed_from

#: cost of a landmark's sightings at another place, as a share of that where it is, below which it
#: is put there: at its minimum no place is much cheaper
CHEAPER = 0.5


def with_landmarks_placed_again(
    steps: Sequence[Step], estimate: Estimate, kernel: RobustConfig
) -> Estimate:
    """The same, with misplaced landmarks where most of their sightings lie.

    Args:
        steps: with a state wherever something was seen.
        estimate: of them.
        kernel: that it was found with.
    """
    seen = [a for step in steps for a in step.associations if isinstance(a.target, int)]
    if not seen or kernel.kernel == "none":
        return estimate
    x = observed_from(seen, estimate.states)
    number = np.array([a.target for a in seen])
    order = np.argsort(number, kind="stable")
    landmarks = dict(estimate.landmarks)
    for own in np.split(order, np.flatnonzero(np.diff(number[order])) + 1):
        theirs, landmark = [seen[k] for k in own.tolist()], int(number[own[0]])
        if landmark not in landmarks:
            continue
        mean, cov = landmarks[landmark]
        place = seen_at(theirs, x[own])
        if _cost(theirs, x[own], place, kernel) < CHEAPER * _cost(theirs, x[own], mean, kernel):
            landmarks[landmark] = (place, cov)
    return replace(estimate, landmarks=landmarks)


def seen_at(seen: Sequence[Association], x: Array) -> Array:
    """Where most sightings of one landmark from poses ``x`` (n, 3) lie: (2,), or (3,) of a wall."""
    found = MODELS[seen[0].model].invert(np.array([a.z for a in seen]), x)
    # the first one's direction: there is no median of angles
    return np.append(np.median(found[:, :2], axis=0), found[0, 2:])


def _cost(seen: Sequence[Association], x: Array, at: Array, kernel: RobustConfig) -> float:
    """Of sightings of one landmark from ``x`` (n, 3) if it is there, under a kernel."""
    z = np.array([a.z for a in seen])
    residual = MODELS[seen[0].model].residual(z, x, np.tile(at, (len(z), 1)))
    d2 = mahalanobis_squared(np.asarray(residual), np.array([a.cov for a in seen]))
    return float(LOSSES[kernel.kernel](np.sqrt(d2), kernel.scale).sum())
