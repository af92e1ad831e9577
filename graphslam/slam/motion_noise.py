"""How noisy the motions of a log are, as its estimate shows them.

One estimator for logs of scans and logs of sightings: the median of normalised residuals, axis by
axis. A few motions that are wrong (slip, jumps) do not move it; they are left to the solution.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from graphslam.core.geometry import Array, between, wrap
from graphslam.core.record import replace
from graphslam.core.records import Estimate, Step

#: motions of a robot from which their noise is estimated at least
MIN_MOTIONS = 50
#: factor on stated sigmas from which a log contradicts them
UNDERSTATED = 2.0
#: median of the absolute value of a standard normal variable
MEDIAN_OF_NORMAL = 0.6745


def noise_scales(
    steps: Sequence[Step], estimate: Estimate, window_ns: int | None = None
) -> dict[str, Array]:
    """Robot -> factor (3,) on the sigmas of its motions; 1 where they are as noisy as stated.

    Stated noise is never reduced. Robots with fewer than `MIN_MOTIONS` motions have none.

    Args:
        steps: with motions as computed.
        estimate: of all their states.
        window_ns: residuals within such a window are added up, which shows correlated errors too;
            None judges each motion by itself.
    """
    scales = {}
    for robot, states in estimate.states.items():
        motions = [step.motions[robot] for step in steps if robot in step.motions]
        if len(motions) < MIN_MOTIONS:
            continue
        first, last = (
            states.at([getattr(m, name) for m in motions]) for name in ("start_ns", "end_ns")
        )
        residuals = between(first, last) - np.array([m.delta for m in motions])
        residuals[:, 2] = wrap(residuals[:, 2])
        normalised = residuals / np.sqrt([np.diag(m.cov) for m in motions])
        if window_ns is not None:
            moving = np.array([m.length_m != 0 or m.delta[2] != 0 for m in motions])
            if not moving.any():
                continue
            windows = np.array([m.end_ns // window_ns for m in motions])[moving]
            _, index, count = np.unique(windows, return_inverse=True, return_counts=True)
            sums = np.zeros((len(count), 3))
            np.add.at(sums, index, normalised[moving])
            normalised = sums / np.sqrt(count)[:, None]
        scales[robot] = np.maximum(1.0, np.median(np.abs(normalised), axis=0) / MEDIAN_OF_NORMAL)
    return scales


def understated_noise(steps: Sequence[Step], estimate: Estimate) -> list[str]:
    """Warnings about robots whose motions are noisier than stated; see `noise_scales`."""
    scales = noise_scales(steps, estimate)
    names = ("along", "across", "in heading")
    return [
        f"{robot}: its odometry is {scale.max():.1f} times as noisy {names[int(scale.argmax())]} "
        "as the log states; what is stated was used"
        for robot, scale in sorted(scales.items())
        if scale.max() > UNDERSTATED
    ]


def scale_motion_noise(steps: Sequence[Step], scales: Mapping[str, Array]) -> tuple[Step, ...]:
    """Steps with the sigmas of each robot's motions times its scales (3,)."""
    return tuple(
        replace(
            step,
            motions={
                robot: replace(m, cov=scales[robot][:, None] * m.cov * scales[robot])
                if robot in scales
                else m
                for robot, m in step.motions.items()
            },
        )
        for step in steps
    )
