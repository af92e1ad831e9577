"""Batch solution with the calibration of odometry and mount as unknowns beside all states.

A wrong wheel radius is one constant of the whole run, so along a corridor with nothing but
walls the uncertainty grows with the path, not with its root. What `online_calibration` learns
while the log is read is the initial value; here it becomes a variable of the graph, and its
uncertainty a part of every covariance.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.config import RobustConfig
from graphslam.core.geometry import Array
from graphslam.core.motion_models import HELD_SIGMA, Calibration
from graphslam.core.record import replace
from graphslam.core.records import Estimate, Motion, Step, Trajectory
from graphslam.estimation.calibration_graph import (
    CalibratedSolution,
    CalibrationGraph,
    solve_calibrated,
)
from graphslam.estimation.motion_arrays import at_calibration
from graphslam.estimation.optimisation import CONVERGED_ERROR_ROUGH
from graphslam.estimation.recorded_graph import ObservationNoise, Source
from graphslam.odometry.calibration_jacobian import along_estimated_path
from graphslam.odometry.preintegration import Track

#: times that everything is solved: after the first the calibration moves by a tenth of its sigma
ROUNDS = 2

#: of its sigma: by how much a calibration moves at most in the last round, and rounds more for that
SETTLED_SIGMAS, MORE_ROUNDS = 2.0, 6

#: (latest estimate, whether it is the last round) -> steps computed with the tracks' calibration,
#: whose own errors their covariances leave out
Rebuild = Callable[[Estimate, bool], tuple[Step, ...]]


def calibrate(
    rebuild: Rebuild,
    estimate: Estimate,
    tracks: Mapping[str, Track],
    robust: RobustConfig,
    rounds: int = ROUNDS,
    *,
    joint: bool = False,
    rough: bool = False,
    solved_once: Callable[[CalibratedSolution, Sequence[Step]], None] | None = None,
    shared: Mapping[Source, ObservationNoise] | None = None,
    bias_m: float | None = None,
    settle: bool = False,
) -> tuple[Estimate, tuple[Step, ...]]:
    """Solve for states, landmarks and calibrations together, ``rounds`` times.

    ``rebuild`` computes the steps again in every round, the first by ``estimate``. The calibration
    of ``tracks`` is set to the one found. Returns the estimate, with ``joint`` and the root of its
    information, and the steps behind it. All rounds but the last converge roughly, with ``rough``
    that one too. ``solved_once`` is called with every solution and its steps. ``shared``: noise of
    sightings that share errors; covariances are then those of `sandwich_covariance`, if not rough.
    ``bias_m``: of surfaces, see `CalibrationGraph.solution`. ``settle``: the last round, which is
    not rough, is repeated until the calibrations no longer move. What they change in the motions is
    as in the estimate before; where sightings tell little of a scale and the estimate before was by
    another noise, that alone moves it.

    Raises:
        EstimationError: the estimate is indeterminate.
    """
    priors = {name: track.prior for name, track in tracks.items()}
    steps: tuple[Step, ...] = ()
    for k in range(rounds + MORE_ROUNDS * settle):
        last = k >= rounds - 1
        initial = {name: track.calibration for name, track in tracks.items()}
        for track in tracks.values():
            track.calibration = track.calibration.held()
        steps = rebuild(estimate, last)
        solved = solve_calibrated(
            steps,
            estimate,
            priors,
            initial,
            robust,
            rough=rough or not last,
            joint=joint and last,
            mounts=len(tracks) == 1,  # of several robots starts have the errors of the mounts
            bias_m=bias_m if last else None,
        )
        estimate = solved.estimate
        for name, track in tracks.items():
            track.calibration = solved.calibrations[name]
        if solved_once is not None:
            solved_once(solved, steps)
        if last and not _has_moved(initial, solved.calibrations):
            break
    if rounds and shared is not None and not rough:
        estimate = solved.graph.covariance_factors(shared).applied_to(estimate)
    return estimate, at_calibration(steps, initial, solved.calibrations) if rounds else steps


def _has_moved(before: Mapping[str, Calibration], after: Mapping[str, Calibration]) -> bool:
    """Whether a calibration has moved by more than `SETTLED_SIGMAS`; not if these are unknown."""
    for name, found in after.items():
        moved = np.abs(found.mean - before[name].mean)
        sigma = np.sqrt(np.diag(found.cov))
        if np.any(moved[sigma > HELD_SIGMA] > SETTLED_SIGMAS * sigma[sigma > HELD_SIGMA]):
            return True
    return False


def calibrate_roughly(
    steps: Sequence[Step],
    estimate: Estimate,
    tracks: Mapping[str, Track],
    kernel: RobustConfig,
    rounds: int,
) -> Estimate:
    """A rough estimate of states, landmarks and calibrations, from initial values far off.

    First the motions are those of ``steps``, whose covariances contain that of the calibration.
    Then they are computed again and the calibration is solved for, ``rounds`` times. The
    observations are in the graph once. The calibration of ``tracks`` is set to the one found.

    Raises:
        EstimationError: the estimate is indeterminate.
    """
    priors = {name: track.prior for name, track in tracks.items()}
    now = {name: track.calibration for name, track in tracks.items()}
    problem = CalibrationGraph(steps, estimate, priors, now, kernel)
    estimate, _ = problem.solve(CONVERGED_ERROR_ROUGH)
    for _ in range(rounds):
        for name, track in tracks.items():
            track.calibration = now[name].held()
        # with the derivative at the measured motions: the estimated ones are far off in places
        problem.calibrate_motions(recompute_motions(steps, tracks), now)
        estimate, now = problem.solve(CONVERGED_ERROR_ROUGH)
    for name, track in tracks.items():
        track.calibration = now[name]
    return estimate


def calibrate_so_far(
    steps: Sequence[Step], estimate: Estimate, tracks: Mapping[str, Track], kernel: RobustConfig
) -> Estimate:
    """A rough estimate of states, landmarks and calibrations, from one of all but the latter.

    The calibration of ``tracks`` is set to the one found, with its own covariance.

    Raises:
        EstimationError: the estimate is indeterminate.
    """
    now = {name: track.calibration for name, track in tracks.items()}
    priors = {name: track.prior for name, track in tracks.items()}
    try:
        for track in tracks.values():
            track.calibration = track.calibration.held()
        made = recompute_motions(steps, tracks, estimate)
    finally:
        for name, track in tracks.items():
            track.calibration = now[name]
    solved = solve_calibrated(made, estimate, priors, now, kernel, rough=True)
    covs = solved.graph.calibration_covariances()
    for name, track in tracks.items():
        track.calibration = replace(solved.calibrations[name], cov=covs[name])
    return solved.estimate


def recompute_motions(
    steps: Sequence[Step], tracks: Mapping[str, Track], estimate: Estimate | None = None
) -> tuple[Step, ...]:
    """Steps with motions by the tracks' calibration, except those from scan matching.

    What a calibration changes in them is as in the ``estimate`` of all their states, if there is
    one, see `along_estimated_path`. Where odometry does not cover a motion to its end, its
    covariance is that of the missing part, which would be zero with the latency held.
    """
    motions: list[dict[str, Motion]] = [dict(step.motions) for step in steps]
    for robot, track in tracks.items():
        own = [made for made in motions if robot in made and not made[robot].from_scans]
        states = estimate.states[robot] if estimate else None
        recomputed = _recomputed([made[robot] for made in own], track, states)
        for made, motion in zip(own, recomputed, strict=True):
            made[robot] = motion
    return tuple(replace(step, motions=made) for step, made in zip(steps, motions, strict=True))


def _recomputed(motions: Sequence[Motion], track: Track, states: Trajectory | None) -> list[Motion]:
    """Motions of one robot by its track's calibration."""
    if not motions:
        return []
    begin, end = np.array([(m.start_ns, m.end_ns) for m in motions], dtype=np.int64).T
    new = track.motions(begin, end)
    new = dataclasses.replace(new, cov=new.cov + uncovered_covs(track, begin, end))
    if states is not None:
        d_cal = along_estimated_path(track, begin, end, new, states)
        new = dataclasses.replace(new, d_cal=d_cal)
    return [new.one(k, m.start_ns, m.end_ns) for k, m in enumerate(motions)]


def uncovered_covs(track: Track, start_ns: IntArray, end_ns: IntArray) -> Array:
    """Covariances (n, 3, 3) of those parts of motions of which a track has no readings.

    Motions do not have them if the latency is held; see `Track.uncovered_bound`.
    """
    covs = np.zeros((len(start_ns), 3, 3))
    for k in np.flatnonzero(track.is_uncovered(start_ns, end_ns)):
        covs[k] = np.diag(track.uncovered_bound(int(start_ns[k]), int(end_ns[k])) ** 2)
    return covs
