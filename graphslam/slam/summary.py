"""What a run adds up to: the map's landmarks as records, and the keys of summary.json."""

import hashlib
import platform
import resource
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import Any

import numpy as np

from graphslam import __version__
from graphslam.core.config import Config
from graphslam.core.config_io import dump_config
from graphslam.core.geometry import Array, transform, unit_vectors
from graphslam.core.records import Estimate, Landmark
from graphslam.estimation.clock_calibration import ClockEstimate
from graphslam.logs import LogSet
from graphslam.mapping.landmark_map import Entry, LandmarkMap
from graphslam.multi_robot.frame_tree import FrameAssignment

FORMAT = "graphslam-result-1"

#: what solving the whole log again may change, see `graphslam.slam.reoptimise_scans`
CONSOLIDATED = (
    "closures_verified",
    "closures_refused",
    "closures_kept",
    "landmarks_merged",
    "observations_reassociated",
    "observations_dropped",
)


def line_parameters(pose: Array, cov: Array) -> tuple[float, float, Array]:
    """Normal direction (rad), offset (m) and their covariance (2, 2) of the line through a pose.

    The line's direction is the pose's x axis; its normal points to the left of it. The offset is
    that of the line from the world's origin along the normal.
    """
    normal = float(pose[2] + np.pi / 2)
    n = unit_vectors(normal)
    along = float(-n[1] * pose[0] + n[0] * pose[1])
    # offset = n·p: turning the normal by e moves it by (dn/de)·p = along * e
    J = np.array([[0.0, 0.0, 1.0], [n[0], n[1], along]])
    return normal, float(n @ pose[:2]), J @ cov @ J.T


def make_landmark(entry: Entry, mean: Array, cov: Array) -> Landmark:
    """Bookkeeping and estimate (``mean`` (2,) or (3,), ``cov``; world axes) as one record."""
    if entry.kind == "point":
        position = np.array([mean[0], mean[1], np.nan])
        extent = np.array([mean, mean])
        line = None
    else:
        position = mean
        low, high = entry.extent_at(mean)
        ends = np.array([[low, 0.0], [high, 0.0]])
        extent = transform(mean, ends)
        line = line_parameters(mean, cov)
    return Landmark(
        entry.id,
        entry.kind,
        position,
        cov,
        extent,
        line,
        entry.sightings,
        entry.first_ns,
        entry.last_ns,
        entry.identity,
    )


def make_landmarks(landmarks: LandmarkMap, estimate: Estimate) -> tuple[Landmark, ...]:
    """The final map: every landmark that the back end estimated; both in the same world frame."""
    return tuple(
        make_landmark(landmarks.entries[number], mean, cov)
        for number, (mean, cov) in sorted(estimate.landmarks.items())
    )


def summarise(
    *,
    log: LogSet,
    config: Config,
    estimate: Estimate,
    counts: Counter[str],
    rejected: Counter[str],
    dropped: Counter[str],
    tentative_deleted: int,
    line_closures: int,
    landmarks: int,
    seconds: Mapping[str, float],
    calibration: Mapping[str, Mapping[str, tuple[float, float, bool]]],
    odometry: Mapping[str, Mapping[str, int]],
    closures: Mapping[str, Any],
    joined: FrameAssignment,
    clocks: Mapping[str, ClockEstimate],
    warnings: Sequence[str],
    log_s: float,
) -> dict[str, Any]:
    """The keys of summary.json (see docs/formats.md)."""
    scans, total = counts["scans"], max(seconds["all"], 1e-9)
    all_dropped = Counter(log.dropped) + dropped
    if tentative_deleted:
        all_dropped["tentative landmark: not seen often enough"] += tentative_deleted
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
        "config_sha256": hashlib.sha256(dump_config(config).encode()).hexdigest(),
        "backend": config.backend.name,
        "stages": {name: round(value, 4) for name, value in sorted(seconds.items())},
        "scans_per_s": round(scans / total, 2),
        # invented stamps have no real time to compare with
        "real_time_factor": None if has_invented_stamps(log.notes) else round(log_s / total, 2),
        "peak_memory_mb": round(_peak_memory_mb(), 1),
        "counts": {
            "messages": counts["messages"],
            "scans": scans,
            "keyframes": counts["keyframes"],
            "observations": counts["observations"],
            "landmarks": landmarks,
            "loop_closures": counts["loop_closures"] + line_closures + counts["closures_verified"],
        },
        "consolidated": {name: counts[name] for name in CONSOLIDATED if name in counts},
        "closures": dict(closures),
        "world": joined.world,
        "frames": dict(sorted(joined.frames.items())),
        "starts_found": joined.to_summary(),
        "rejected": dict(sorted(rejected.items())),
        "dropped": dict(sorted(all_dropped.items())),
        "repaired": dict(sorted(log.repaired.items())),
        "graph": {"error": estimate.error, "dof": estimate.dof},
        "calibration": {
            f"{robot}.{name}": {"value": value, "sigma": sigma, "observable": observable}
            for robot, found in sorted(calibration.items())
            for name, (value, sigma, observable) in found.items()
        },
        "odometry": {robot: dict(counts) for robot, counts in sorted(odometry.items())},
        "clocks": {
            robot: {
                "offset_s": found.clock.offset_s,
                "offset_sigma_s": found.offset_sigma_s,
                "drift_ppm": 1e6 * found.clock.drift,
                "drift_sigma_ppm": 1e6 * found.drift_sigma,
                "observable": found.observable,
                "applied": found.applied.offset_s != 0.0,
            }
            for robot, found in sorted(clocks.items())
        },
        "warnings": [*log.warnings, *warnings],
    }


def has_invented_stamps(notes: Mapping[str, str]) -> bool:
    """Whether an importer had to make up the stamps: the source had none."""
    return notes.get("stamps", "").startswith("invented")


def _peak_memory_mb() -> float:
    """Largest resident size of this process; macOS counts bytes, Linux kilobytes."""
    peak = float(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
    return peak / 1e6 if sys.platform == "darwin" else peak / 1e3
