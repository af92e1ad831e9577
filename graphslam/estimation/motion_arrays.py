"""The motions of a log as arrays: of one robot all at once."""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.geometry import Array, adjoint, between, inverse, log, rotation3, wrap
from graphslam.core.motion_models import Calibration, Increments
from graphslam.core.record import replace
from graphslam.core.records import Motion, Step


def increments_of(steps: Sequence[Step]) -> dict[str, Increments]:
    """Robot -> its n motions in steps, as arrays; robots without motions are left out."""
    own: dict[str, list[Motion]] = defaultdict(list)
    for step in steps:
        for robot, motion in step.motions.items():
            own[robot].append(motion)
    return {
        robot: Increments(
            np.array([motion.delta for motion in motions]),
            np.array([motion.cov for motion in motions]),
            np.array([motion.d_delta_d_calibration for motion in motions]),
        )
        for robot, motions in own.items()
    }


def moved_by(made: Increments, change: Array) -> Increments:
    """Motions (n) by a calibration that has changed by (p,)."""
    delta = made.delta + made.d_cal @ change
    delta[:, 2] = wrap(delta[:, 2])
    return Increments(delta, made.cov, made.d_cal)


def linear_motions(
    made: Increments, poses: Array, use: IntArray
) -> Iterator[tuple[Array, Array, Array, Array]]:
    """Motions of a robot as A_x x + R y + A_c c = b around ``poses`` (n + 1, 3): A_x, R, A_c, b.

    Error log(delta(c)⁻¹ x⁻¹ y) along the axes of the measured end, whitened; ``use`` (p,) are the
    indices of the parameters that are not held.
    """
    delta, D = made.delta, made.d_cal[:, :, use]
    back = rotation3(-delta[:, 2])
    R = np.linalg.cholesky(np.linalg.inv(back @ made.cov @ back.mT)).mT
    h = between(poses[: len(delta)], poses[1 : len(delta) + 1])
    b = -(R @ log(between(delta, h))[:, :, None])[:, :, 0]
    return zip(R @ -adjoint(inverse(h)), R, R @ (-back @ D), b, strict=True)


def at_calibration(
    steps: Sequence[Step],
    now: Mapping[str, Calibration],
    found: Mapping[str, Calibration],
) -> tuple[Step, ...]:
    """Steps whose motions, computed with ``now``, are as the solution has them with ``found``."""
    moved = {
        robot: iter(moved_by(made, found[robot].mean - now[robot].mean).delta)
        for robot, made in increments_of(steps).items()
        if robot in found and (found[robot].mean != now[robot].mean).any()
    }
    return tuple(
        replace(
            step,
            motions={
                robot: replace(motion, delta=next(moved[robot])) if robot in moved else motion
                for robot, motion in step.motions.items()
            },
        )
        for step in steps
    )
