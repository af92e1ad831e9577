"""The final landmarks as records: estimate and bookkeeping of the map in one."""

import numpy as np

from graphslam.core.geometry import Array, transform, unit_vectors
from graphslam.core.records import Estimate, Landmark
from graphslam.mapping.landmark_map import Entry, LandmarkMap

#: by how much the biases at both ends of a wall differ, in sigmas of a bias; and how far these ends
#: are apart at least, m
ALONG, SHORTEST_M = 0.5, 0.3


def line_parameters(pose: Array, cov: Array) -> tuple[float, float, Array]:
    """Normal direction (rad), offset (m) and their covariance (2, 2) of the line through a pose.

    The line's direction is the pose's x axis; its normal points to the left of it. The offset is
    that of the line from the world's origin along the normal.
    """
    normal = float(pose[2] + np.pi / 2)
    n = unit_vectors(normal)
    along = float(-n[1] * pose[0] + n[0] * pose[1])
    # offset = n·p: turning the normal by e moves it by (dn/de)·p = along * e
    J = np.array([[0.0, 0.0, 1.0], [n[0], n[1], along]])
    return normal, float(n @ pose[:2]), J @ cov @ J.T


def make_landmark(entry: Entry, mean: Array, cov: Array, bias_m: float = 0.0) -> Landmark:
    """Bookkeeping and estimate (``mean`` (2,) or (3,), ``cov``; world axes) as one record.

    ``bias_m``: see `LandmarkMap`.
    """
    if entry.kind == "point":
        position, line = np.array([mean[0], mean[1], np.nan]), None
        extent = np.array([mean, mean])
    else:
        n = np.append(unit_vectors(float(mean[2] + np.pi / 2)), 0.0)
        low, high = entry.extent_at(mean)
        cov = cov + bias_m**2 * np.outer(n, n)
        cov[2, 2] += (ALONG * bias_m / max(high - low, SHORTEST_M)) ** 2
        position, line = mean, line_parameters(mean, cov)
        extent = transform(mean, np.array([[low, 0.0], [high, 0.0]]))
    history = entry.sightings, entry.first_ns, entry.last_ns, entry.identity
    return Landmark(entry.id, entry.kind, position, cov, extent, line, *history)


def make_landmarks(landmarks: LandmarkMap, estimate: Estimate) -> tuple[Landmark, ...]:
    """The final map: every landmark that was estimated and not deleted; in one world frame."""
    return tuple(
        make_landmark(landmarks.entries[number], mean, cov, landmarks.bias_m)
        for number, (mean, cov) in sorted(estimate.landmarks.items())
        if number in landmarks.entries
    )
