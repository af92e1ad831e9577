"""The last word on logs of sightings: calibration, noise and all states, from the whole log.

After the log went by, motions and sightings are made anew with the calibration found so far and
everything is solved together; what the residuals say about the noise of each robot's sightings is
taken in once (again and again it would collapse).
"""

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from graphslam.backends.calibrated import solve_calibrated
from graphslam.config import Config
from graphslam.dead_reckoning import Track
from graphslam.gathering import Sources, carried, met
from graphslam.geometry import Array, between, wrap
from graphslam.models import MODELS
from graphslam.models.motion import Calibration
from graphslam.records import Association, Estimate, Step

#: times that motions and sightings are made anew
ROUNDS = 3
#: ns: residuals of one target's sightings farther apart are taken as independent
WINDOW_NS = 10_000_000_000
#: residuals are cut at this many of their own sigmas when their noise is measured
CUT = 3.0
LARGEST = 20.0
#: smallest factor on a variance: what a log states is not doubted downwards beyond
SMALLEST = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Refined:
    """The estimate and the steps behind it; the tracks have their final calibration."""

    estimate: Estimate
    steps: tuple[Step, ...]


def refine(
    steps: Sequence[Step],
    estimate: Estimate,
    tracks: Mapping[str, Track],
    sources: Sources,
    config: Config,
) -> Refined:
    """Solve a log of sightings again, `ROUNDS` times.

    Args:
        steps: as recorded.
        estimate: of all their states and landmarks.
        tracks: odometry of every robot; their calibration is set to what is found.
        sources: the sightings behind associations.
        config: settings.
    """
    if not config.odometry.calibrate:
        return Refined(estimate, tuple(steps))
    priors = {name: track.nominal for name, track in tracks.items()}
    inflation: dict[str, Array] = {}
    slack: dict[str, Array] = {}
    made = tuple(steps)
    for k in range(ROUNDS):
        now = {name: track.calibration for name, track in tracks.items()}
        for name, track in tracks.items():
            still = np.diag(np.full(len(now[name].mean), 1e-18))
            track.calibration = Calibration(now[name].names, now[name].mean, still)
        made, found = _remade(steps, estimate, tracks, sources)
        if k:
            inflation = variances(found, estimate)
            slack = motion_variances(made, estimate)
        made = tuple(_inflated(step, inflation, slack) for step in made)
        solved = solve_calibrated(made, estimate, priors, now, config.robust)
        estimate = solved.estimate
        for name, track in tracks.items():
            track.calibration = solved.calibrations[name]
    return Refined(estimate, made)


def _remade(
    steps: Sequence[Step], estimate: Estimate, tracks: Mapping[str, Track], sources: Sources
) -> tuple[tuple[Step, ...], list[tuple[Association, int]]]:
    """Steps with the tracks' calibration of now; their associations with times of sighting."""
    made, found = [], []
    for step in steps:
        motions = {
            name: tracks[name].motion(motion.start_ns, motion.end_ns)
            for name, motion in step.motions.items()
        }
        associations = []
        for a in step.associations:
            sighting = sources.get((a.robot, a.time_ns, a.z.tobytes()))
            if sighting is None:
                associations.append(a)
                continue
            o = carried(sighting, a.time_ns, tracks[a.robot])
            if isinstance(a.target, str):
                other = tracks[a.target]
                turn = _heading(estimate, a.target, step.time_ns) - _heading(
                    estimate, a.robot, a.time_ns
                )
                new = met(o, sighting, a.time_ns, step.time_ns, turn, other)
            else:
                new = replace(a, z=o.z, cov=o.cov)
            associations.append(new)
            found.append((new, sighting.time_ns))
        made.append(replace(step, motions=motions, associations=tuple(associations)))
    return tuple(made), found


def _heading(estimate: Estimate, robot: str, time_ns: int) -> float:
    states = estimate.states[robot]
    return float(states.poses[np.searchsorted(states.stamps_ns, time_ns), 2])


def variances(found: Sequence[tuple[Association, int]], estimate: Estimate) -> dict[str, Array]:
    """Robot -> factor (2,) on the variances of its bearings and ranges of points.

    The variance of sums of normalised residuals over windows, per residual: 1 for white noise of
    the stated size, larger where errors are larger or correlated, as several sightings then tell no
    more than one. (Batch means, e.g. G. S. Fishman, Discrete-Event Simulation, 2001, section 6.)
    """
    residuals: dict[str, dict[tuple[int | str, int], list[Array]]] = defaultdict(dict)
    for a, time_ns in found:
        if a.model != "point" or not isinstance(a.target, int):
            continue
        states = estimate.states[a.robot]
        x = states.poses[np.searchsorted(states.stamps_ns, a.time_ns)]
        r = MODELS["point"].residual(a.z, x, estimate.landmarks[a.target][0])
        window = (a.target, time_ns // WINDOW_NS)
        residuals[a.robot].setdefault(window, []).append(r / np.sqrt(np.diag(a.cov)))
    factors = {}
    for robot, windows in residuals.items():
        every = np.concatenate([np.array(w) for w in windows.values()])
        cut = CUT * 1.4826 * np.median(np.abs(every), axis=0)
        sums = np.array([np.clip(w, -cut, cut).sum(axis=0) for w in windows.values()])
        factors[robot] = np.maximum(np.square(sums).sum(axis=0) / len(every), SMALLEST)
    return factors


def motion_variances(steps: Sequence[Step], estimate: Estimate) -> dict[str, Array]:
    """Robot -> factor (3,) on the variances of its motions, as `variances` has it for sightings."""
    sums: dict[str, dict[int, Array]] = defaultdict(dict)
    counts: Counter[str] = Counter()
    for step in steps:
        for robot, motion in step.motions.items():
            if motion.length_m == 0 and motion.delta[2] == 0:
                continue
            states = estimate.states[robot]
            n = int(np.searchsorted(states.stamps_ns, motion.end_ns))
            miss = between(states.poses[n - 1], states.poses[n]) - motion.delta
            miss[2] = wrap(miss[2])
            r = np.clip(miss / np.sqrt(np.diag(motion.cov)), -LARGEST, LARGEST)
            window = motion.end_ns // WINDOW_NS
            sums[robot][window] = sums[robot].get(window, 0.0) + r
            counts[robot] += 1
    factors = {}
    for robot, windows in sums.items():
        f = np.square(list(windows.values())).sum(axis=0) / counts[robot]
        f[:2] = max(f[0], f[1])
        factors[robot] = np.maximum(f, 1.0)
    return factors


def _inflated(step: Step, inflation: Mapping[str, Array], slack: Mapping[str, Array]) -> Step:
    motions = {
        robot: replace(m, cov=m.cov * np.sqrt(np.outer(slack[robot], slack[robot])))
        if robot in slack
        else m
        for robot, m in step.motions.items()
    }
    associations = []
    for a in step.associations:
        wider = a
        if a.robot in inflation and len(a.z) == 2:
            s = np.sqrt(inflation[a.robot])
            wider = replace(a, cov=a.cov * np.outer(s, s))
        associations.append(wider)
    return replace(step, motions=motions, associations=tuple(associations))
