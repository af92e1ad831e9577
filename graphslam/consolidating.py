"""The last word on logs of scans: final calibration, loops closed, duplicate walls merged.

What calibration learned on the way is applied to the motions before it was known; loops that were
missed are closed by what was seen (`closing`); and landmarks that turn out to be one and the same
become one, round after round until nothing changes. Where merged landmarks say what a closure
says, the closure has done its work and goes: both are of the same scans.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from graphslam.backends.isam2 import BatchBackend
from graphslam.closing import (
    BORNE_OUT,
    CLOSED,
    Place,
    agreeing,
    far_off,
    loop_closures,
    moved,
    places,
    slack,
)
from graphslam.config import Config
from graphslam.dead_reckoning import Track
from graphslam.landmark_map import LandmarkMap
from graphslam.merging import duplicates, merge_entries, merged_steps, seen_together, survivors
from graphslam.records import Closure, Estimate, Picture, Step

#: Intel and ACES need three; more only if merging goes on for ever
MAX_ROUNDS = 6


#: rounds of closing loops
MAX_CLOSINGS = 3
#: solutions from slack to tight closures
TIGHTENINGS = 4

#: stands between verifying closures and believing them: for tests, which add false ones
Tamper = Callable[[list[Closure], Sequence[Place]], list[Closure]]


@dataclass(frozen=True, slots=True, eq=False)
class Consolidated:
    """The estimate and the steps behind it, with counts.

    ``merged`` landmarks into others, ``closed`` loops by matching, of which ``kept`` are in the
    steps since no landmark says the same, and ``refused`` closures that do not agree with the rest.
    """

    estimate: Estimate
    steps: tuple[Step, ...]
    merged: int
    closed: int
    kept: int
    refused: int


def consolidate(
    steps: Sequence[Step],
    estimate: Estimate,
    tracks: Mapping[str, Track],
    landmarks: LandmarkMap,
    pictures: Iterable[Picture],
    config: Config,
    tamper: Tamper | None = None,
) -> Consolidated:
    """Solve a log of scans again.

    Args:
        steps: as recorded.
        estimate: of all their states and landmarks.
        tracks: odometry of every robot, with its final calibration.
        landmarks: what is known of landmarks beside; merged ones leave it.
        pictures: what was seen from the states.
        config: settings.
        tamper: for tests, see `Tamper`.

    Raises:
        EstimationError: the estimate is indeterminate.
    """
    steps = tuple(_recalibrated(step, tracks) for step in steps)
    backend = BatchBackend(config)
    estimate = backend.solve(steps, estimate, rough=True)
    closures: list[Closure] = []
    refused = 0
    if config.backend.close_loops:
        found = places(estimate.states, pictures)
        for _ in range(MAX_CLOSINGS):
            P = backend.state_covariance([place.state for place in found])
            new = loop_closures(found, P)
            if tamper is not None:
                new = tamper(new, found)
            agreed = agreeing(new, found, P)
            refused = len(new) - len(agreed)
            if not agreed:
                break
            closures += agreed
            for _ in range(TIGHTENINGS):
                drawn = slack(closures, estimate.states)
                backend = BatchBackend(config)
                estimate = backend.solve(with_closures(steps, drawn), estimate, rough=True)
            found = moved(found, estimate.states)
            gone = far_off(closures, estimate.states, BORNE_OUT)
            refused += sum(gone)
            closures = [c for c, off in zip(closures, gone, strict=True) if not off]
    merged = 0
    tied = with_closures(steps, closures)
    for _ in range(MAX_ROUNDS):
        into = _duplicates(estimate, backend, landmarks, tied)
        if not into:
            break
        kinds = {number: landmarks.entries[number].kind for number in into.values()}
        steps, tied = merged_steps(steps, into, kinds), merged_steps(tied, into, kinds)
        merge_entries(landmarks, into)
        merged += len(into)
        backend = BatchBackend(config)
        estimate = backend.solve(tied, estimate, rough=True)
    kept: list[Closure] = []
    if closures:
        # what the landmarks do not hold together without them
        free = BatchBackend(config).solve(steps, estimate, rough=True)
        missed = far_off(closures, free.states, CLOSED)
        kept = [c for c, off in zip(closures, missed, strict=True) if off]
        steps = with_closures(steps, kept)
    estimate = BatchBackend(config).solve(steps, estimate)
    for number, (mean, _) in estimate.landmarks.items():
        landmarks.entries[number].move(mean)
    return Consolidated(estimate, steps, merged, len(closures), len(kept), refused)


def _recalibrated(step: Step, tracks: Mapping[str, Track]) -> Step:
    """The step with motions by the tracks' calibration."""
    motions = {
        robot: tracks[robot].motion(motion.start_ns, motion.end_ns)
        for robot, motion in step.motions.items()
    }
    return replace(step, motions=motions)


def _duplicates(
    estimate: Estimate, backend: BatchBackend, landmarks: LandmarkMap, steps: Sequence[Step]
) -> dict[int, int]:
    """Landmark that goes -> landmark that it becomes; the map moves to the estimate."""
    for number, (mean, _) in estimate.landmarks.items():
        landmarks.entries[number].move(mean)
    walls = [
        entry
        for entry in landmarks.entries.values()
        if entry.id in estimate.landmarks and entry.kind != "point"
    ]
    joint = backend.joint(min(estimate.states), [entry.id for entry in walls])
    return survivors(duplicates(walls, joint, seen_together(steps)))


def with_closures(steps: Iterable[Step], closures: Iterable[Closure]) -> tuple[Step, ...]:
    """Steps that hold closures too, each in the step of its time."""
    at: dict[int, tuple[Closure, ...]] = {}
    for closure in closures:
        at[closure.time_ns] = (*at.get(closure.time_ns, ()), closure)
    return tuple(
        replace(step, closures=(*step.closures, *at[step.time_ns])) if step.time_ns in at else step
        for step in steps
    )
