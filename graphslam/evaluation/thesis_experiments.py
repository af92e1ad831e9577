"""The thesis' experiments (chapter 6), one seed each: simulated, smoothed, held against the truth.

Where the thesis knows where its robots start relative to each other, `start.from_truth` is set.
`thesis_chapter` makes tables of many seeds.
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graphslam.change_detection import detect_changes, load_visit
from graphslam.core.arrays import IntArray
from graphslam.core.config import Config
from graphslam.core.config_io import load_config
from graphslam.core.geometry import between, compose, transform
from graphslam.core.records import Result, Scan, TrueLandmark
from graphslam.evaluation.trajectory_metrics import align, pair_poses
from graphslam.logs import open_logs, read_true_associations, read_truth
from graphslam.results.folder import load, save
from graphslam.simulation import Scenario, load_scenario, simulate
from graphslam.simulation.recording import NoiseFreeScans
from graphslam.slam.smooth import smooth

DEFAULTS = load_config()


def with_known_starts(config: Config) -> Config:
    """The same settings with every robot's start known."""
    return replace(config, start=replace(config.start, from_truth=True))


Array = NDArray[np.float64]

#: where a robot's poses are taken from
WITH, WITHOUT, TRUE = "with landmarks", "dead reckoning", "true poses"


@dataclass(frozen=True)
class Run:
    """One visit, simulated and smoothed; where the truth is known (it may end a moment early)."""

    result: Result
    truth: Mapping[str, Array]  # robot -> true base poses (n, 3)
    kept: Mapping[str, NDArray[np.bool_]]  # robot -> which poses of the result have a truth
    scans: Mapping[str, list[Scan]]
    faces: Mapping[str, TrueLandmark]
    met: Mapping[str, list[NDArray[np.str_]]]  # robot -> name of what each beam of each scan met

    def base(self, robot: str, source: str) -> Array:
        """Poses (n, 3) of the base at the stamps of the result."""
        if source == TRUE:
            return self.truth[robot]
        found = self.result.robots[robot]
        poses = {WITH: found.final, WITHOUT: found.dead_reckoning}[source].poses
        return poses[self.kept[robot]]

    def laser(self, robot: str, source: str) -> Array:
        """Poses (n, 3) of the laser at its scans; with landmarks where calibration puts it."""
        if source == WITH:
            scan_final = self.result.robots[robot].scan_final
            assert scan_final is not None
            return scan_final.poses[self.kept[robot]]
        return compose(self.base(robot, source), self.scans[robot][0].mount)

    def points(self, robot: str, source: str, frame: Array | None = None) -> Array:
        """Returns (scans, beams, 2) in the world, NaN where there is none.

        ``frame`` (3,) moves them afterwards.
        """
        scans = self.scans[robot]
        r = np.array([scan.ranges for scan in scans])
        a = scans[0].angles + self.laser(robot, source)[:, 2:]
        where = np.stack([r * np.cos(a), r * np.sin(a)], axis=-1)
        where += self.laser(robot, source)[:, None, :2]
        return where if frame is None else transform(frame, where)

    def aligned(self, robot: str, source: str) -> Array:
        """Pose (3,) that moves the whole run best onto the truth, by the laser's positions."""
        return align(self.laser(robot, source)[:, :2], self.laser(robot, TRUE)[:, :2])


def run(log: Path, config: Config = DEFAULTS) -> Run:
    """Smooth a simulated log and read its truth."""
    result = smooth(open_logs([log], config), config)
    known = read_truth([log], config)
    scans: dict[str, list[Scan]] = {}
    for message in open_logs([log], config).messages():
        if isinstance(message, Scan):
            scans.setdefault(message.robot, []).append(message)
    met = {
        topic.split("/")[1]: [np.array([*m.names, ""])[m.targets] for m in messages]
        for topic, messages in read_true_associations([log], config).items()
        if topic.endswith("/scan")
    }
    truth, kept = {}, {}
    for robot, found in result.robots.items():
        pairs = pair_poses(found.final, known.trajectories[robot])
        truth[robot] = pairs.truth
        kept[robot] = np.isin(found.final.stamps_ns, pairs.stamps_ns)
        if robot in scans:
            scans[robot] = [scans[robot][i] for i in np.flatnonzero(kept[robot])]
            met[robot] = [met[robot][i] for i in np.flatnonzero(kept[robot])]
    faces = {mark.identity: mark for mark in known.landmarks}
    return Run(result, truth, kept, scans, faces, met)


def simulated(scenario: Scenario, seed: int, folder: Path, config: Config = DEFAULTS) -> Run:
    """A scenario of one visit, simulated in ``folder`` and smoothed."""
    log = folder / f"{seed}.mcap"
    simulate(scenario, log, seed=seed)
    return run(log, config)


# ------------------------------------------------------------ lab

CORNER_M = np.array([0.0, 8.0])
CORNER_RADIUS_M = 0.5


def distance_to_faces(points: Array, faces: Mapping[str, TrueLandmark]) -> Array:
    """Distance (n,), m, of points (n, 2) to the nearest true wall."""
    ends = np.array([face.extent for face in faces.values() if face.kind == "segment"])
    start, along = ends[:, 0], ends[:, 1] - ends[:, 0]
    share = np.sum((points[:, None] - start) * along, axis=-1) / np.sum(along**2, axis=-1)
    foot = start + np.clip(share, 0, 1)[..., None] * along
    nearest: Array = np.linalg.norm(points[:, None] - foot, axis=-1).min(axis=1)
    return nearest


def corner_scatter(lab: Run, source: str) -> float:
    """RMS distance, m, from the nearest true wall of all points within 0.5 m of the true corner.

    After one SE(2) alignment of the whole run.
    """
    points = lab.points("vehicle", source, lab.aligned("vehicle", source)).reshape(-1, 2)
    near = points[np.linalg.norm(points - CORNER_M, axis=1) < CORNER_RADIUS_M]
    return float(np.sqrt(np.mean(distance_to_faces(near, lab.faces) ** 2)))


def lab(seed: int, folder: Path, config: Config = DEFAULTS) -> dict[str, float]:
    """Experiment 1, thesis 6.1.1."""
    done = simulated(load_scenario("lab"), seed, folder, config)
    return {source: corner_scatter(done, source) for source in (WITH, WITHOUT, TRUE)}


# ------------------------------------------------------------ corridor

START_RADIUS_M = 8.0
VISIT_M = 10.0
LEAST_POINTS = 100


def visits_of_the_start(corridor: Run) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which scans (n,) belong to the first and to the last 10 m driven."""
    true = corridor.base("vehicle", TRUE)
    driven = np.cumsum(np.hypot(*np.diff(true[:, :2], axis=0, prepend=true[:1, :2]).T))
    return driven < VISIT_M, driven > driven[-1] - VISIT_M


def in_start_frame(corridor: Run, source: str) -> Array:
    """Pose (3,) that moves the run so that it starts where it truly starts."""
    estimate, true = corridor.base("vehicle", source)[0], corridor.base("vehicle", TRUE)[0]
    return compose(true, between(estimate, np.zeros(3)))


def wall_overlay(corridor: Run, source: str) -> float:
    """How far the walls near the start lie from themselves, seen first and last: RMS, m.

    Over the true faces within 8 m of the start that both visits saw with 100 points or more: the
    difference of the mean normal offsets of the points of either visit. The simulation says which
    face each beam met.
    """
    points = corridor.points("vehicle", source, in_start_frame(corridor, source))
    met = np.array(corridor.met["vehicle"])
    start = corridor.base("vehicle", TRUE)[0, :2]
    first, last = visits_of_the_start(corridor)
    gaps = []
    for name, face in corridor.faces.items():
        if face.kind != "segment" or np.linalg.norm(face.pose[:2] - start) > START_RADIUS_M:
            continue
        normal = np.array([-np.sin(face.pose[2]), np.cos(face.pose[2])])
        offsets = np.where(met == name, (points - face.pose[:2]) @ normal, np.nan)
        seen = [offsets[visit][np.isfinite(offsets[visit])] for visit in (first, last)]
        if min(map(len, seen)) >= LEAST_POINTS:
            # the median: mixed pixels and spurious returns are no part of the wall
            gaps.append(float(np.median(seen[0]) - np.median(seen[1])))
    return float(np.sqrt(np.mean(np.square(gaps))))


def end_error(corridor: Run, source: str) -> float:
    """Distance, m, of the last pose from the truth, both seen from where the run starts."""
    estimate, true = corridor.base("vehicle", source), corridor.base("vehicle", TRUE)
    return float(np.hypot(*(between(estimate[0], estimate[-1]) - between(true[0], true[-1]))[:2]))


def corridor(seed: int, folder: Path, config: Config = DEFAULTS) -> dict[str, float]:
    """Experiment 2, thesis 6.1.2."""
    scenario = load_scenario("corridor")
    done = simulated(scenario, seed, folder, config)
    encoders = scenario.robots["vehicle"].encoders
    drift = done.result.summary["calibration"].get("vehicle.drift_rad_per_m", {}).get("value", 0.0)
    return {
        "wheel": abs(drift * encoders.axle_m - encoders.radius_error_right),
        f"end {WITH}": end_error(done, WITH),
        f"end {WITHOUT}": end_error(done, WITHOUT),
        f"overlay {WITH}": wall_overlay(done, WITH),
        f"overlay {TRUE}": wall_overlay(done, TRUE),
    }


# ------------------------------------------------------------ two robots


def alone(scenario: Scenario) -> Scenario:
    """The scenario without sightings; all other noise stays the same."""
    robots = {name: replace(robot, sightings=()) for name, robot in scenario.robots.items()}
    return replace(scenario, robots=robots)


def pioneer_errors(done: Run) -> tuple[float, float]:
    """RMS position error and RMS of its standard deviation over the whole drive, m.

    In the world frame, unaligned: both robots' starts are known.
    """
    errors = done.base("pioneer", WITH)[:, :2] - done.base("pioneer", TRUE)[:, :2]
    covs = done.result.robots["pioneer"].final.covs[done.kept["pioneer"]]
    error = float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))
    return error, float(np.sqrt(np.mean(covs[:, 0, 0] + covs[:, 1, 1])))


def two_robots(seed: int, folder: Path, config: Config = DEFAULTS) -> dict[str, float]:
    """Experiment 3, thesis 6.1.3."""
    scenario, config = load_scenario("two-robots"), with_known_starts(config)
    both = simulated(scenario, seed, folder, config)
    (folder / f"{seed}.mcap").unlink()
    single = simulated(alone(scenario), seed, folder, config)
    (error, sigma), (error_alone, sigma_alone) = pioneer_errors(both), pioneer_errors(single)
    return {
        "error with": error,
        "error without": error_alone,
        "sigma with": sigma,
        "sigma without": sigma_alone,
    }


# ------------------------------------------------------------ change


#: m: edges of the displacements for which the share of beams found is counted
DISPLACEMENTS_M = np.arange(0.0, 0.6001, 0.02)
#: share of the beams on a part of the table that must be found
MOST = 0.5


def table_beams(truth: Mapping[str, Any], scans: NoiseFreeScans) -> tuple[Array, IntArray]:
    """Displacements (k,) m of the turned table where beams met it, and numbers (k,) of the beams.

    The displacement is that of the surface, across it: what a range can show.
    """
    (move,) = truth["changes"]
    after, before = np.array(move["after"]), np.array(move["before"])
    ranges, laser = scans.hits.ranges, scans.laser
    beams = ranges.shape[1]
    heading = scans.poses[:, 2, None] + np.radians(laser.step_deg) * (
        np.arange(beams) - (beams - 1) / 2
    )
    ends = scans.poses[:, None, :2] + ranges[..., None] * np.stack(
        [np.cos(heading), np.sin(heading)], axis=-1
    )
    ends = np.where(np.isfinite(ends), ends, 1e6)
    along, earlier = after[1] - after[0], before[1] - before[0]
    length = float(np.hypot(*along))
    t = (ends - after[0]) @ along / length
    aside = np.abs((ends - after[0]) @ np.array([-along[1], along[0]])) / length
    scan, beam = np.nonzero((aside < 1e-6) & (t > 0.02) & (t < length - 0.02))
    turn = np.arctan2(*along[::-1]) - np.arctan2(*earlier[::-1])
    return t[scan, beam] * np.sin(abs(turn)), scan * beams + beam


def found_from(moved: Array, flagged: NDArray[np.bool_]) -> float:
    """Displacement, m, from which on most beams are found; the largest if they never are.

    ``moved`` (k,) m and ``flagged`` (k,) are of the beams that met the moved surface.
    """
    bins = np.digitize(moved, DISPLACEMENTS_M)
    for k in range(len(DISPLACEMENTS_M), 0, -1):
        here = flagged[bins == k]
        if len(here) and here.mean() < MOST:
            return float(DISPLACEMENTS_M[min(k, len(DISPLACEMENTS_M) - 1)])
    return 0.0


def change(seed: int, folder: Path, config: Config = DEFAULTS) -> dict[str, float]:
    """Experiment 4, thesis 6.2: what the two visits are worth, and which changes are found."""
    recordings = simulate(load_scenario("change"), folder / str(seed), seed=seed).recordings
    out, visits = {}, []
    for name in ("reference", "later"):
        done = run(folder / str(seed) / f"{name}.mcap", config)
        moved = transform(done.aligned("vehicle", WITH), done.laser("vehicle", WITH)[:, :2])
        errors = moved - done.laser("vehicle", TRUE)[:, :2]
        out[name] = float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))
        save(done.result, folder / name, force=True)
        visits.append(load_visit(load(folder / name), folder / name))
    found = detect_changes(visits[0], visits[1], config.changes)
    truth = json.loads((folder / str(seed) / "truth.json").read_text(encoding="utf-8"))
    displaced, beams = table_beams(truth, recordings[1].scans["vehicle"])
    usable = found.compared[beams]
    out["found from"] = found_from(displaced[usable], found.flagged[beams[usable]])
    out["false alarms"] = float(np.mean(np.delete(found.flagged, beams)))
    return out


#: seed, empty folder, settings -> values
Experiment = Callable[[int, Path, Config], dict[str, float]]

EXPERIMENTS: dict[str, Experiment] = {
    "lab": lab,
    "corridor": corridor,
    "two-robots": two_robots,
    "change": change,
}
