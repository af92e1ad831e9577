"""What nav_msgs/Odometry says about its own noise: the covariance of its velocities.

Many drivers fill these fields with numbers that mean nothing. The covariance of the pose grows from
the start of the log and seldom follows from that of the velocity; it is not used.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from graphslam.core.geometry import Array, between, log
from graphslam.logs import schemas
from graphslam.logs.cdr import CdrError
from graphslam.logs.decoders import TopicContext, odometry
from graphslam.logs.recording import Recording, sample_messages
from graphslam.logs.topics import Topic

#: rows of x, y and heading in the covariance of a velocity in space
_PLANE = (0, 1, 5)
#: parts of the log that are looked at; readings in a row in each, at most
_BLOCKS, _PER_BLOCK = 8, 500
#: and those that show whether there is anything to look at
_FEW = 20
#: m²/s², rad²/s²: variances beyond are placeholders (1e-9, 1e3, 1e6): sigmas of 0.1 mm/s, of 10 m/s
_LEAST, _MOST = 1e-8, 1e2
#: share of the readings in motion that must state their noise; how many there must be
_MOST_OF, _ENOUGH = 0.9, 20
#: readings farther apart than so many usual intervals do not follow each other
_GAP = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class StatedNoise:
    """Intervals (n) in which a robot moved, and the noise of their motions as stated.

    ``twists`` (n, 3) m and rad from one reading to the next; ``seconds`` (n,); ``variances``
    (n, 3) along x, y and of turning: those of the velocity, times the interval squared.
    """

    twists: Array
    seconds: Array
    variances: Array


def stated_noise(files: Sequence[Recording], topic: Topic) -> StatedNoise | None:
    """The noise that ``topic``, of `OdometryPose`, states; None if it is not filled in sensibly.

    It is if the covariances of most velocities in motion are positive definite along x, y and
    heading, no variance is a placeholder, and not all of them are the same number (metres and
    radians are not alike).
    """
    parts = [part for file in files for part in _sampled(file, topic)]
    if not parts:
        return None
    twists, seconds, covs = map(np.concatenate, zip(*parts, strict=True))
    moved = twists.any(axis=1) & (seconds <= _GAP * np.median(seconds))
    if np.count_nonzero(moved) < _ENOUGH:
        return None
    variances = np.diagonal(covs, axis1=1, axis2=2)
    sensible = moved & np.all((variances > _LEAST) & (variances < _MOST), axis=1)
    sensible &= variances[:, 0] != variances[:, 2]
    sensible[sensible] &= np.linalg.eigvalsh(covs[sensible])[:, 0] > 0.0
    if np.count_nonzero(sensible) < _MOST_OF * np.count_nonzero(moved):
        return None
    dt = seconds[sensible]
    return StatedNoise(twists[sensible], dt, variances[sensible] * dt[:, None] ** 2)


def _sampled(file: Recording, topic: Topic) -> list[tuple[Array, Array, Array]]:
    """Motions (n, 3) between readings in a row, seconds (n,), covariances (n, 3, 3) of velocity.

    Empty if none of some messages states any, as most do not: then no more is read. The first of
    them may be from before the driver has its covariances.
    """
    few = list(sample_messages(file, topic.name, _BLOCKS, _FEW))
    context = TopicContext(topic.robot)
    try:
        if not few or not _covariances(few).any():
            return []
        data = list(sample_messages(file, topic.name, _BLOCKS, _PER_BLOCK))
        readings = odometry(schemas.odometry_table(data), context)
        covs = _covariances(data)
    except CdrError:
        return []
    rows = []
    for (a, b), cov in zip(pairwise(readings), covs[1:], strict=True):
        if isinstance(a, str) or isinstance(b, str) or not np.isfinite(cov).all():
            continue
        if a.stamp_ns < b.stamp_ns:
            rows.append((a.pose, b.pose, 1e-9 * (b.stamp_ns - a.stamp_ns), cov))
    if not rows:
        return []
    before, after, seconds, used = (np.array(column) for column in zip(*rows, strict=True))
    return [(log(between(before, after)), seconds, used)]


def _covariances(data: Sequence[bytes]) -> Array:
    """Covariances (n, 3, 3) of the velocities of messages along x, y and heading."""
    covs = schemas.odometry_table(data)["twist_covariance"].reshape(-1, 6, 6)
    return np.asarray(covs[:, _PLANE][:, :, _PLANE])
