"""The last word on logs of scans: final calibration, loops closed, duplicate walls merged.

What calibration learned on the way is applied to the motions before it was known; loops that were
missed are closed by what was seen (`closing`); and landmarks that turn out to be one and the same
become one, round after round until nothing changes. Where merged landmarks say what a closure
says, the closure has done its work and goes: both are of the same scans.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from graphslam.backends.isam2 import BatchBackend
from graphslam.calibrating import calibrate
from graphslam.closing import (
    BORNE_OUT,
    CLOSED,
    Place,
    State,
    agreeing,
    far_off,
    loop_closures,
    moved,
    places,
    slack,
)
from graphslam.config import Config
from graphslam.dead_reckoning import Track
from graphslam.geometry import Array, between, wrap
from graphslam.landmark_map import LandmarkMap
from graphslam.merging import duplicates, merge_entries, merged_steps, seen_together, survivors
from graphslam.reassociating import reassociate
from graphslam.records import Closure, Estimate, Picture, Step

#: Intel and ACES need three; more only if merging goes on for ever
MAX_ROUNDS = 6


#: m across, rad: how far an observation may lie from a wall, from round to round
GATES = ((0.3, 0.15), (0.15, 0.1))
#: motions from which their noise is told at least; median of the absolute value of a unit normal
FEWEST_MOTIONS, MEDIAN_OF_NORMAL = 50, 0.6745
#: rounds of closing loops
MAX_CLOSINGS = 8
#: solutions from slack to tight closures
TIGHTENINGS = 4

#: stands between verifying closures and believing them: for tests, which add false ones
Tamper = Callable[[list[Closure], Sequence[Place]], list[Closure]]


@dataclass(frozen=True, slots=True, eq=False)
class Consolidated:
    """The estimate and the steps behind it; ``counts`` of what was changed, by name."""

    estimate: Estimate
    steps: tuple[Step, ...]
    counts: Counter[str]


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
    solve = _Solver(config)
    steps = tuple(_recalibrated(step, tracks) for step in steps)
    estimate = solve(steps, estimate)
    steps = _loosened(steps, estimate)
    estimate = solve(steps, estimate)
    counts: Counter[str] = Counter()
    closures: list[Closure] = []
    if config.backend.close_loops:
        closures, estimate = _closed(steps, estimate, pictures, solve, tamper, counts)
    # merged first: what went to either of two walls that are one would move to and fro
    for gates in GATES:
        estimate = solve(with_closures(steps, closures), estimate)
        for _ in range(MAX_ROUNDS):
            into = _duplicates(estimate, solve.backend, landmarks, steps)
            if not into:
                break
            kinds = {number: landmarks.entries[number].kind for number in into.values()}
            steps = merged_steps(steps, into, kinds)
            merge_entries(landmarks, into)
            counts["landmarks_merged"] += len(into)
            estimate = solve(with_closures(steps, closures), estimate)
        again = reassociate(steps, estimate, landmarks.entries, *gates)
        steps = again.steps
        counts["observations_reassociated"] += again.moved
        counts["observations_dropped"] += again.dropped
    if closures:
        # what the landmarks do not hold together without them
        missed = far_off(closures, solve(steps, estimate).states, CLOSED)
        kept = [c for c, off in zip(closures, missed, strict=True) if off]
        counts["closures_kept"] = len(kept)
        steps = with_closures(steps, kept)
    if config.odometry.calibrate:
        done = calibrate(steps, solve(steps, estimate), tracks, _loosened, config)
        estimate, steps = done.estimate, done.steps
    else:
        estimate = BatchBackend(config).solve(steps, estimate)
    _move(landmarks, estimate)
    return Consolidated(estimate, steps, counts)


class _Solver:
    """Solves steps roughly; ``backend`` is the latest one, for its covariances."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self.backend = BatchBackend(config)

    def __call__(self, steps: Sequence[Step], start: Estimate) -> Estimate:
        self.backend = BatchBackend(self._config)
        return self.backend.solve(steps, start, rough=True)


def _closed(
    steps: Sequence[Step],
    estimate: Estimate,
    pictures: Iterable[Picture],
    solve: _Solver,
    tamper: Tamper | None,
    counts: Counter[str],
) -> tuple[list[Closure], Estimate]:
    """Loops closed by matching: the closures that are believed, and the estimate with them."""
    closures: list[Closure] = []
    refused: list[Closure] = []
    found = places(estimate.states, pictures)
    looked: dict[tuple[State, State], Array] = {}
    for _ in range(MAX_CLOSINGS if found else 0):
        P = solve.backend.state_covariance([place.state for place in found])
        # what did not agree before may do so now
        new = refused + loop_closures(found, P, looked)
        if tamper is not None:
            new = tamper(new, found)
        agreed = agreeing(new, found, P)
        refused = [closure for closure in new if closure not in agreed]
        if not agreed:
            break
        closures += agreed
        estimate = _tightened(steps, closures, estimate, solve)
        gone = far_off(closures, estimate.states, BORNE_OUT)
        refused += [c for c, off in zip(closures, gone, strict=True) if off]
        closures = [c for c, off in zip(closures, gone, strict=True) if not off]
        found = moved(found, estimate.states)
    counts["closures_verified"], counts["closures_refused"] = len(closures), len(refused)
    return closures, estimate


def _tightened(
    steps: Sequence[Step], closures: Sequence[Closure], estimate: Estimate, solve: _Solver
) -> Estimate:
    """Solved with closures that are slack first, and the tighter the nearer the estimate comes."""
    for _ in range(TIGHTENINGS):
        drawn = slack(closures, estimate.states)
        estimate = solve(with_closures(steps, drawn), estimate)
        if all(a is b for a, b in zip(drawn, closures, strict=True)):
            break
    return estimate


def _recalibrated(step: Step, tracks: Mapping[str, Track]) -> Step:
    """The step with motions by the tracks' calibration, but for those that scans contradicted."""
    motions = {
        robot: motion if motion.matched else tracks[robot].motion(motion.start_ns, motion.end_ns)
        for robot, motion in step.motions.items()
    }
    return replace(step, motions=motions)


def _loosened(steps: Sequence[Step], estimate: Estimate) -> tuple[Step, ...]:
    """Steps with motions as noisy as the log shows them, if that is noisier than believed.

    By the median of what the estimate makes of them, over all motions of a robot and axis by axis:
    what few motions got wrong is left to them.
    """
    scales = {}
    for robot, states in estimate.states.items():
        motions = [step.motions[robot] for step in steps if robot in step.motions]
        if len(motions) < FEWEST_MOTIONS:
            continue
        first, last = (
            states.poses[np.searchsorted(states.stamps_ns, [getattr(m, name) for m in motions])]
            for name in ("start_ns", "end_ns")
        )
        off = between(first, last) - np.array([m.delta for m in motions])
        off[:, 2] = wrap(off[:, 2])
        sigmas = np.sqrt([np.diag(m.cov) for m in motions])
        scales[robot] = np.maximum(1.0, np.median(np.abs(off) / sigmas, axis=0) / MEDIAN_OF_NORMAL)
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


def _duplicates(
    estimate: Estimate, backend: BatchBackend, landmarks: LandmarkMap, steps: Sequence[Step]
) -> dict[int, int]:
    """Landmark that goes -> landmark that it becomes; the map moves to the estimate."""
    _move(landmarks, estimate)
    walls = [
        entry
        for entry in landmarks.entries.values()
        if entry.id in estimate.landmarks and entry.kind != "point"
    ]
    joint = backend.joint(min(estimate.states), [entry.id for entry in walls])
    return survivors(duplicates(walls, joint, seen_together(steps)))


def _move(landmarks: LandmarkMap, estimate: Estimate) -> None:
    """The map moves to the estimate; what nothing was seen of any more leaves it."""
    for number, entry in list(landmarks.entries.items()):
        if number in estimate.landmarks:
            entry.move(estimate.landmarks[number][0])
        elif entry.in_graph:
            del landmarks.entries[number]


def with_closures(steps: Iterable[Step], closures: Iterable[Closure]) -> tuple[Step, ...]:
    """Steps that hold closures too, each in the step of its time."""
    at: dict[int, tuple[Closure, ...]] = {}
    for closure in closures:
        at[closure.time_ns] = (*at.get(closure.time_ns, ()), closure)
    return tuple(
        replace(step, closures=(*step.closures, *at[step.time_ns])) if step.time_ns in at else step
        for step in steps
    )
