"""Errors of a joint estimate in the frame of its covariance, and their NEES."""

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np

from graphslam.core.geometry import Array, between, log, rotation3, wrap
from graphslam.estimation.backend import JointMarginal

Frame = Literal["body", "world"]


def joint_errors(
    joint: JointMarginal,
    true_pose: Array,
    true_landmarks: Sequence[Array],
    true_others: Sequence[Array],
    frame: Frame,
) -> tuple[Array, Array]:
    """Errors (D,) of a joint marginal and their covariance (D, D), both in ``frame``.

    A pose has three errors: along world axes, or (``body``) those of log(estimate⁻¹ truth) with
    the covariance turned into the estimated body frame. A point has two, along world axes. A line
    has two: normal offset of the true line at the estimated origin, and direction; the position of
    the origin along the line is a gauge, and its row is left out.
    """
    means = [joint.pose, *joint.landmarks, *joint.others]
    truths = [true_pose, *true_landmarks, *true_others]
    blocks = [slice(0, 3), *joint.slices]
    lines = [False, *(len(m) == 3 for m in joint.landmarks), *(False for _ in joint.others)]
    errors, rows = [], []
    for mean, truth, block, is_line in zip(means, truths, blocks, lines, strict=True):
        select = np.zeros((block.stop - block.start, len(joint.cov)))
        select[:, block] = np.eye(block.stop - block.start)
        if is_line:
            line = between(mean, truth)
            # where the true line crosses the estimated normal
            offset = line[1] - line[0] * np.tan(line[2])
            errors.append(np.array([offset, line[2]]))
            rows.append((rotation3(-mean[2]) @ select)[1:])
        elif len(mean) == 3 and frame == "body":
            errors.append(log(between(mean, truth)))
            rows.append(rotation3(-mean[2]) @ select)
        else:
            error = truth - mean
            error[2:] = wrap(error[2:])
            errors.append(error)
            rows.append(select)
    T = np.concatenate(rows)
    return np.concatenate(errors), T @ joint.cov @ T.T


def joint_nees(error: Array, cov: Array) -> float:
    """Normalised estimation error squared of errors (D,) with covariance (D, D).

    NaN where the covariance is not positive definite.
    """
    try:
        L = np.linalg.cholesky(cov)
    except np.linalg.LinAlgError:
        return float("nan")
    return float(np.sum(np.square(np.linalg.solve(L, error))))


def landmark_squares(
    landmarks: Mapping[int, tuple[Array, Array]], truth: Mapping[int, Array]
) -> dict[str, float]:
    """Mean squared errors of points (m²), of lines' offsets (m²) and directions (rad²).

    Kinds without a landmark in the map are left out.
    """
    points, offsets, directions = [], [], []
    for i, (mean, _) in landmarks.items():
        if len(mean) == 2:
            points.append(float(np.sum(np.square(mean - truth[i]))))
        else:
            line = between(mean, truth[i])
            offsets.append(float((line[1] - line[0] * np.tan(line[2])) ** 2))
            directions.append(float(line[2] ** 2))
    found = {"points_m2": points, "lines_m2": offsets, "lines_rad2": directions}
    return {name: float(np.mean(values)) for name, values in found.items() if values}
