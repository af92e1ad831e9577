"""The keys of summary.json, and the warnings about a run that went through."""

import hashlib
import math
import platform
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from importlib.metadata import version
from typing import Any

import numpy as np

from graphslam import __version__
from graphslam.core.allocation import peak_memory_mb
from graphslam.core.config import RobotConfig
from graphslam.core.config_io import dump_config
from graphslam.core.geometry import compose
from graphslam.core.records import Estimate
from graphslam.core.suggestions import start_option
from graphslam.estimation.clock_calibration import ClockEstimate
from graphslam.estimation.motion_noise import understated_noise
from graphslam.logs import LogSet
from graphslam.odometry.several_lasers import SeveralLasersTrack
from graphslam.pipeline.log_pass import LogPass
from graphslam.pipeline.robot_settings import robot_settings
from graphslam.pipeline.robot_state import RobotState, span_warnings

FORMAT = "graphslam-result-1"

#: counts of what `reoptimise_scans` may change
REOPTIMISED = (
    "closures_verified",
    "closures_across",
    "closures_refused",
    "closures_refused_between",
    "closures_kept",
    "landmarks_merged",
    "landmarks_moved",
    "landmarks_removed",
    "visits_displaced",
    "observations_reassociated",
    "observations_dropped",
    "observations_by_loose_returns",
)

#: share of the scans without odometry from which on there is a warning
UNPLACED = 0.02


def summarise(
    pipeline: LogPass,
    estimate: Estimate,
    plain_error: float,
    landmarks: int,
    clocks: Mapping[str, ClockEstimate],
) -> dict[str, Any]:
    """The keys of summary.json (see docs/formats.md).

    Args:
        pipeline: the last pass, its ``seconds`` complete.
        estimate: the final one.
        plain_error: its error without robust kernels.
        landmarks: how many there are.
        clocks: of the robots, as found.
    """
    log, counts, known = pipeline.log, pipeline.counts, pipeline.known
    runs = pipeline.started
    spans_ns = [pipeline.last_ns - pipeline.first_ns]
    if pipeline.given_config.logs.same_place:  # without the time between the sessions
        spans_ns = [run.track.last_ns - run.track.first_ns for run in runs.values()]
    log_s = 1e-9 * sum(spans_ns)
    scans, total = counts["scans"], max(pipeline.seconds["all"], 1e-9)
    all_dropped = Counter(log.dropped) + pipeline.dropped + pipeline.removed_returns
    left_out = sum(len(run.repeats.left_out) for run in runs.values())
    if left_out:
        all_dropped["scan: repeats an earlier one while odometry moves"] += left_out
    if pipeline.landmarks.deleted:
        all_dropped["tentative landmark: not seen often enough"] += pipeline.landmarks.deleted
    if pipeline.landmarks.forgotten:
        all_dropped["landmark: not seen again for association.delete_s"] += (
            pipeline.landmarks.forgotten
        )
    lasers = {robot: lasers_used(log, robot, run) for robot, run in runs.items()}
    return {
        "format": FORMAT,
        "versions": {
            "graphslam": __version__,
            "gtsam": version("gtsam"),
            "numpy": version("numpy"),
            "opencv": version("opencv-python-headless"),
            "python": platform.python_version(),
        },
        "logs": [
            {
                "path": str(file.path.resolve()),
                "sha256": file.sha256,
                "messages": file.messages,
                "lost": file.lost,
            }
            for file in log.files
        ],
        "notes": dict(log.notes),
        "config_sha256": hashlib.sha256(dump_config(pipeline.given_config).encode()).hexdigest(),
        "backend": pipeline.config.backend.name,
        "stages": {name: round(value, 4) for name, value in sorted(pipeline.seconds.items())},
        "scans_per_s": round(scans / total, 2),
        # invented stamps have no real time to compare with
        "real_time_factor": None if has_invented_stamps(log.notes) else round(log_s / total, 2),
        "peak_memory_mb": round(peak_memory_mb(), 1),
        "counts": {
            "messages": counts["messages"],
            "scans": scans,
            "keyframes": counts["keyframes"],
            "observations": counts["observations"],
            "landmarks": landmarks,
            "loop_closures": counts["loop_closures"] + counts["closures_verified"],
        },
        "consolidated": {name: counts[name] for name in REOPTIMISED if name in counts},
        "closures": known.recorded.to_summary(),
        **known_map_summary(pipeline),
        **_moved_points(pipeline, estimate),
        "world": known.frame_assignment.world,
        "frames": dict(sorted(known.frame_assignment.frames.items())),
        "starts_found": known.frame_assignment.to_summary(),
        "starts_better": known.frame_assignment.better_to_summary(),
        **_sessions(pipeline),
        "rejected": dict(sorted(pipeline.rejected.items())),
        "dropped": dict(sorted(all_dropped.items())),
        "repaired": dict(sorted(log.repaired.items())),
        "graph": {
            "error": estimate.error,
            "error_without_kernels": plain_error,
            "dof": estimate.dof,
            "kernel_scale": pipeline.kernel.scale,
        },
        "noise": pipeline.noise,
        "calibration": {
            f"{robot}.{name}": {"value": value, "sigma": sigma, "observable": observable}
            for robot, run in runs.items()
            for name, (value, sigma, observable) in run.calibration_found(
                {one["name"]: np.array(one["mount_in_log"]) for one in lasers[robot]}
            ).items()
        }
        | {
            name: {"value": value, "sigma": sigma, "observable": observable}
            for name, (value, sigma, observable) in pipeline.sensor_errors.items()
        },
        "lasers": lasers,
        "odometry": {
            robot: {
                "source": "scans" if robot in log.without_odometry else run.track.source,
                "motions": run.motions,
                "contradicted": run.contradicted,
                "resets": run.track.resets,
                "bridged": run.track.bridged,
                "gaps": run.track.missing.gaps,
                "overlaps": run.track.missing.overlaps,
            }
            for robot, run in runs.items()
        },
        "clocks": {
            robot: {
                "offset_s": clock.clock.offset_s,
                "offset_sigma_s": clock.offset_sigma_s,
                "drift_ppm": 1e6 * clock.clock.drift,
                "drift_sigma_ppm": 1e6 * clock.drift_sigma,
                "observable": clock.observable,
                "applied": clock.applied.offset_s != 0.0,
            }
            for robot, clock in sorted(clocks.items())
        },
        "warnings": [
            *dict.fromkeys([*pipeline.given_config.warnings, *log.warnings]),
            *run_warnings(pipeline),
            *(understated_noise(pipeline.steps, estimate) if is_relative(pipeline) else ()),
        ],
    }


def known_map_summary(pipeline: LogPass) -> dict[str, Any]:
    """What became of a known map: how many of its landmarks were seen, and how many are new."""
    known_map = pipeline.known.known_map
    if known_map is None:
        return {}
    seen = {a.target for step in pipeline.steps for a in step.associations}
    earlier = known_map.known.means.keys()
    return {
        "known_map": {
            "name": known_map.name,
            "sha256": known_map.sha256,
            "verdict": known_map.verdict,
            "doubt": pipeline.map_doubt,
            "parents": [{"name": name, "sha256": sha256} for name, sha256 in known_map.parents],
            "world_given": known_map.is_world_given,
            "updated": pipeline.given_config.known_map.update,
            "landmarks": len(earlier),
            "seen": len(earlier & seen),
            "unseen": sorted(earlier - seen),
            "new": len(pipeline.landmarks.entries.keys() - earlier),
            "closures": pipeline.counts["closures_to_map"],
            "widening": known_map.known.root.widening,
            "retired": [],
        }
    }


def _moved_points(pipeline: LogPass, estimate: Estimate) -> dict[str, Any]:
    """The key ``moved_points``, of sightings: points that stood elsewhere in an earlier session."""
    marks, entries = estimate.landmarks, pipeline.landmarks.entries
    found = [
        {
            "id": new,
            "was": old,
            "name": entries[old].identity,
            "moved_m": float(np.hypot(*(marks[new][0] - marks[old][0])[:2])),
        }
        for new, old in sorted(pipeline.moved.items())
        if {new, old} <= marks.keys() and entries[new].kind == "point"
    ]
    return {"moved_points": found} if found else {}


def lasers_used(log: LogSet, robot: str, run: RobotState) -> list[dict[str, Any]]:
    """The lasers of a robot, the first one first: how they are mounted, as found and as told."""
    lasers = []
    for topic, sensor in log.sensors(robot).items():
        if sensor and not isinstance(run.track, SeveralLasersTrack):
            continue
        error, late_ns = run.track.laser(sensor)
        told, no_return_m = log.mount(topic), log.no_return_m(topic)
        noise = log.range_noise(topic)
        lasers.append(
            {
                "topic": topic,
                "name": sensor,
                "mount": compose(error, told).tolist(),
                "mount_in_log": told.tolist(),
                "latency_s": 1e-9 * late_ns,
                "no_return_m": no_return_m if np.isfinite(no_return_m) else None,
                "range_sigma_m": None if noise is None else noise.sigma_m,
                "range_sigma_ratio": None if noise is None else noise.ratio,
            }
        )
    return lasers


#: factor on a stated variance from which the log contradicts it
CONTRADICTED = 2.0


#: observation model -> of what the noise is
_SEEN = {"point": " of points", "robot-point": " of robots", "robot-pose": " of robots' poses"}


def noise_warnings(noise: Mapping[str, Any]) -> list[str]:
    """Noise that the log contradicts, a line for each; ``noise`` as in summary.json."""
    lines = []
    for source, found in noise.items():
        robot, _, model = source.rpartition(" ")
        of = _SEEN.get(model, "")
        if not found.get("stated", True):
            lines.append(_unstated_noise(robot, of, found["sigmas"]))
            continue
        for name, factor in found.get("measured", {}).items():
            if not 1 / CONTRADICTED < factor < CONTRADICTED:
                digits = _two_digits(max(factor, 1 / factor))
                more = f"{digits} times" if factor > 1 else f"1/{digits} of"
                lines.append(f"{robot}: the variance of {name}{of} is {more} what is stated")
    return lines


def _unstated_noise(robot: str, of: str, sigmas: Mapping[str, float]) -> str:
    """What the log says of sightings that state no noise."""
    return (
        f"{robot}: its sightings{of} state no covariances; sigmas of "
        f"{math.degrees(sigmas['bearing_rad']):.2g}° of bearings, and of ranges "
        f"{sigmas['range_m']:.2g} m and {100 * sigmas['range_share']:.2g} % of the range were used"
    )


def _sessions(pipeline: LogPass) -> dict[str, Any]:
    """The key ``sessions``, of logs of one place: those apart, and doubts about others."""
    if not pipeline.config.logs.same_place:
        return {}
    known = pipeline.known.frame_assignment
    apart = {name: _why_apart(pipeline, name) for name in _apart(pipeline)}
    return {"sessions": {"apart": apart, "doubts": dict(known.remarks)}}


def _apart(pipeline: LogPass) -> list[str]:
    """Robots with poses in frames of their own."""
    known, of = pipeline.known.frame_assignment, pipeline.frames.of
    runs = pipeline.runs.items()
    return [name for name, run in runs if run.started and name == of[name] != known.world]


def _unplaced_warnings(pipeline: LogPass) -> list[str]:
    """Scans without odometry, of which nothing is in the result: mostly where that is missing."""
    count, used = pipeline.dropped["scan: no odometry near it"], pipeline.counts["scans"]
    if count <= UNPLACED * (count + used):
        return []
    return [
        f"{count} of {count + used} scans were left out: no odometry is near them, as where it "
        "begins late or ends early"
    ]


def _why_apart(pipeline: LogPass, robot: str) -> str:
    undecided = pipeline.known.frame_assignment.undecided
    return undecided.get(robot, "nothing in the log tells its start pose")


def _two_digits(value: float) -> str:
    """Two significant digits, without an exponent: 2.2, 2200."""
    return f"{float(f'{value:.2g}'):g}"


def has_invented_stamps(notes: Mapping[str, str]) -> bool:
    """Whether an importer had to make up the stamps: the source had none."""
    return notes.get("stamps", "").startswith("invented")


def is_relative(pipeline: LogPass) -> bool:
    """Whether a log has relative poses only, whose noise is used as it is stated."""
    given = all(run.track.source == "given" for run in pipeline.runs.values())
    return given and not any(step.associations for step in pipeline.steps)


def run_warnings(pipeline: LogPass) -> list[str]:
    """What a user should know about a run although it went through."""
    known = pipeline.known
    warnings = [
        f"{name}: its odometry jumped {run.track.resets} times; bridged at the previous speed"
        for name, run in pipeline.runs.items()
        if run.track.resets
    ]
    warnings += [
        f"{name}: its odometry {text}"
        for name, run in pipeline.runs.items()
        if len(run.track) and (text := run.track.missing.to_text(run.track.first_ns))
    ]
    warnings += [
        f"{name}: its odometry is silent while {run.track.bridged} scans were measured; "
        "they tell how it moved"
        for name, run in pipeline.runs.items()
        if run.track.bridged
    ]
    warnings += pipeline.sensor_warnings
    warnings += [
        f"{name}: {len(run.repeats.left_out)} scans repeat an earlier one while its odometry "
        "moves; they were left out"
        for name, run in pipeline.runs.items()
        if run.repeats.left_out
    ]
    warnings += [
        f"{name}: scans contradict its odometry in {run.contradicted} of {run.motions} motions; "
        "these were taken from the scans"
        for name, run in pipeline.runs.items()
        if run.contradicted and name not in pipeline.log.without_odometry
    ]
    warnings += [
        f"{name}: its wheel radii and axle are not set; the defaults of robots.{name}.* were used"
        for name, run in pipeline.runs.items()
        if run.track.source == "wheels"
        and replace(robot_settings(name, pipeline.config, pipeline.log.notes), outline=())
        == RobotConfig()
    ]
    warnings += _unplaced_warnings(pipeline)
    if not pipeline.config.tracks_scans:
        warnings += [
            f"{topic.robot}: {topic.name} is not used: of several lasers only backend batch uses "
            "more than one"
            for topic in pipeline.log.further_lasers
        ]
    warnings += [
        f"{a} and {b}: their identities were swapped in all sightings; corrected"
        for a, b in known.identities.items()
        if a < b
    ]
    # of a robot without odometry nothing is stated: its motions are those of its scans
    scans_alone = {f"{name} motion" for name in pipeline.log.without_odometry}
    stated = {k: v for k, v in pipeline.noise.items() if k not in scans_alone}
    warnings += noise_warnings(stated)
    if not pipeline.config.logs.same_place:  # sessions are of different times
        warnings += span_warnings(
            {name: run.track for name, run in pipeline.runs.items()},
            unplaced=pipeline.dropped["sighting: no odometry near it"] > 0,
        )
    warnings += [
        f"the back end could not use {count} x {reason}"
        for reason, count in sorted(pipeline.skipped.items())
    ]
    warnings += [
        f"{robot}: {_why_apart(pipeline, robot)}; "
        "its poses are in a separate frame with its origin at its first pose; "
        f"{start_option(robot)} places it"
        for robot in _apart(pipeline)
    ]
    warnings += [f"{name}: {said}" for name, said in known.frame_assignment.remarks.items()]
    if known.recorded.refused:
        warnings.append(
            f"{len(known.recorded.refused)} recorded closures were rejected as inconsistent; "
            "closures.refused in summary.json lists them"
        )
    if not any(step.associations or step.closures for step in pipeline.steps):
        warnings.append("no observation entered the estimate: this is dead reckoning")
    return warnings
