"""The last word on logs of scans: motions by the final calibration, duplicate walls merged.

What calibration learned on the way is applied to the motions before it was known, and landmarks
that turn out to be one and the same become one, round after round until nothing changes.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from graphslam.backends.isam2 import BatchBackend
from graphslam.config import Config
from graphslam.dead_reckoning import Track
from graphslam.landmark_map import LandmarkMap
from graphslam.merging import duplicates, merge_entries, merged_steps, seen_together, survivors
from graphslam.records import Estimate, Step

#: Intel and ACES need three; more only if merging goes on for ever
MAX_ROUNDS = 6


@dataclass(frozen=True, slots=True, eq=False)
class Consolidated:
    """The estimate, the steps behind it, and how many landmarks were merged into others."""

    estimate: Estimate
    steps: tuple[Step, ...]
    merged: int


def consolidate(
    steps: Sequence[Step],
    estimate: Estimate,
    tracks: Mapping[str, Track],
    landmarks: LandmarkMap,
    config: Config,
) -> Consolidated:
    """Solve a log of scans again.

    Args:
        steps: as recorded.
        estimate: of all their states and landmarks.
        tracks: odometry of every robot, with its final calibration.
        landmarks: what is known of landmarks beside; merged ones leave it.
        config: settings.

    Raises:
        EstimationError: the estimate is indeterminate.
    """
    steps = tuple(
        replace(
            step,
            motions={
                robot: tracks[robot].motion(motion.start_ns, motion.end_ns)
                for robot, motion in step.motions.items()
            },
        )
        for step in steps
    )
    merged = 0
    for _ in range(MAX_ROUNDS):
        backend = BatchBackend(config)
        estimate = backend.solve(steps, estimate, rough=True)
        for number, (mean, _) in estimate.landmarks.items():
            landmarks.entries[number].move(mean)
        walls = [
            entry
            for entry in landmarks.entries.values()
            if entry.id in estimate.landmarks and entry.kind != "point"
        ]
        joint = backend.joint(min(estimate.states), [entry.id for entry in walls])
        into = survivors(duplicates(walls, joint, seen_together(steps)))
        if not into:
            break
        steps = merged_steps(steps, into, {entry.id: entry.kind for entry in walls})
        merge_entries(landmarks, into)
        merged += len(into)
    estimate = BatchBackend(config).solve(steps, estimate)
    for number, (mean, _) in estimate.landmarks.items():
        landmarks.entries[number].move(mean)
    return Consolidated(estimate, steps, merged)
