"""The last solution of logs of scans, with the calibration of odometry and mount as unknowns.

A wrong wheel radius is one constant of the whole run, so along a corridor that shows nothing but
its walls the uncertainty grows with the path, not with its root. What `calibration` learns on the
way is where this begins; here it becomes a variable of the graph, and its uncertainty a part of
every covariance.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from graphslam.core.config import Config
from graphslam.core.motion_models import Calibration
from graphslam.core.records import Estimate, Motion, Step
from graphslam.estimation.calibration_graph import solve_calibrated
from graphslam.odometry.preintegration import Track

#: times that motions are made anew; after the first the calibration moves by a tenth of its sigma
ROUNDS = 2

#: steps with motions as noisy as an estimate shows them
Loosen = Callable[[Sequence[Step], Estimate], tuple[Step, ...]]


@dataclass(frozen=True, slots=True, eq=False)
class Calibrated:
    """The estimate and the steps behind it; the tracks have the calibration found with it."""

    estimate: Estimate
    steps: tuple[Step, ...]


def calibrate(
    steps: Sequence[Step],
    estimate: Estimate,
    tracks: Mapping[str, Track],
    loosen: Loosen,
    config: Config,
) -> Calibrated:
    """Solve for states, landmarks and calibrations together.

    Args:
        steps: all steps.
        estimate: of all their states and landmarks.
        tracks: odometry of every robot; their calibration is set to what is found.
        loosen: for motions whose covariance leaves out the calibration.
        config: settings.

    Raises:
        EstimationError: the estimate is indeterminate.
    """
    priors = {name: track.nominal for name, track in tracks.items()}
    made = tuple(steps)
    for k in range(ROUNDS):
        now = {name: track.calibration for name, track in tracks.items()}
        for name, track in tracks.items():
            still = np.diag(np.full(len(now[name].mean), 1e-18))
            track.calibration = Calibration(now[name].names, now[name].mean, still)
        made = loosen(recompute_motions(steps, tracks), estimate)
        solved = solve_calibrated(made, estimate, priors, now, config.robust, rough=k < ROUNDS - 1)
        estimate = solved.estimate
        for name, track in tracks.items():
            track.calibration = solved.calibrations[name]
    return Calibrated(estimate, made)


def recompute_motions(steps: Sequence[Step], tracks: Mapping[str, Track]) -> tuple[Step, ...]:
    """Steps with motions by the calibration that the tracks have, but those from scans.

    With the latency held a motion at the edge of the odometry would be sure of what it does not
    cover.
    """
    motions: list[dict[str, Motion]] = [dict(step.motions) for step in steps]
    for robot, track in tracks.items():
        which = [
            n
            for n, step in enumerate(steps)
            if robot in step.motions and not step.motions[robot].matched
        ]
        recomputed = _recomputed([steps[n].motions[robot] for n in which], track)
        for n, motion in zip(which, recomputed, strict=True):
            motions[n][robot] = motion
    return tuple(replace(step, motions=made) for step, made in zip(steps, motions, strict=True))


def _recomputed(motions: Sequence[Motion], track: Track) -> list[Motion]:
    """Motions of one robot by its track's calibration."""
    if not motions:
        return []
    ends = np.array([(m.start_ns, m.end_ns) for m in motions], dtype=np.int64)
    new = track.motions(ends[:, 0], ends[:, 1])
    for k in np.flatnonzero(track.uncovered(ends[:, 0], ends[:, 1])):
        new.cov[k] += np.diag(track.unseen(*ends[k].tolist()) ** 2)
    return [new.one(k, m.start_ns, m.end_ns) for k, m in enumerate(motions)]
