"""How accurate are the hand-made reference relations themselves, along the way and across it?

Of every relation between scans at most 60 s apart, four poses of the second scan in the frame of
the first are compared along the heading of the second: the reference, that by the odometry as
recorded, that by aligning the two scans with each other (from the estimate, by nothing else), and
that of the final estimate. The relations are divided by the sigma of the alignment along the way:
in a corridor the laser hardly sees how far the robot has gone, and neither did those who aligned
the scans by hand. The wheels measure equally well everywhere. Spreads are 1.4826 times the median
of the absolute differences.

Run: python benchmarks/reference_error.py [intel|aces ...]
"""

import tempfile
from itertools import pairwise
from pathlib import Path

import numpy as np
from common import FREIBURG, FREIBURG_LOGS, import_freiburg, parser

from graphslam.core.config_io import load_config
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array, between, compose
from graphslam.core.records import OdometryPose, Scan
from graphslam.evaluation.error_statistics import nees
from graphslam.evaluation.relation_metrics import (
    REFERENCE_SIGMA_M,
    match_relations,
    read_relations,
)
from graphslam.logs import open_logs
from graphslam.perception.ordered_scan import scan_points
from graphslam.perception.scan_matching import Submap, align_pairs, make_submap
from graphslam.results.joint_file import joint_scans
from graphslam.slam.smooth import smooth

#: m: returns from farther away are not aligned
MAX_RANGE_M = 30.0
#: m: borders between groups of relations, by the sigma of the alignment along the way
SIGMAS_M = (0.0, 0.02, 0.025, 0.03, 0.04, 0.06, np.inf)


def spread(values: Array) -> float:
    """Standard deviation by the median of absolute values: few gross errors do not count."""
    return float(1.4826 * np.median(np.abs(values)))


def submap_of(scan: Scan) -> Submap:
    """One scan as a submap."""
    return make_submap(np.zeros((1, 3)), [scan_points(scan, MAX_RANGE_M)])


def rows_of(name: str, folder: Path) -> list[list[str]]:
    """The rows of one log."""
    config = load_config()
    log = open_logs([import_freiburg(name, folder)], config)
    scans: dict[int, Scan] = {}
    odometry: list[OdometryPose] = []
    for message in log.messages():
        if isinstance(message, Scan):
            scans[message.time_ns] = message
        elif isinstance(message, OdometryPose):
            odometry.append(message)
    times = np.array([one.time_ns for one in odometry])
    path = np.array([one.pose for one in odometry])
    path[:, 2] = np.unwrap(path[:, 2])

    result = smooth(log, config)
    ((robot, found),) = result.robots.items()
    assert found.scan_final is not None
    relations = read_relations(FREIBURG / f"{name}.relations")
    matched = match_relations(
        relations, found.scan_final, joint_scans(result.estimate, result.robots), robot
    )
    here = np.array(list(scans))
    known = np.isin(relations.from_ns, here) & np.isin(relations.to_ns, here)
    local = (relations.local & known)[matched.matched]
    ours = matched.errors[local]
    rows = np.flatnonzero(matched.matched)[local]
    reference = relations.poses[rows]

    def by_odometry(stamps: Array) -> Array:
        return np.column_stack([np.interp(stamps, times, path[:, k]) for k in range(3)])

    driven = between(by_odometry(relations.from_ns[rows]), by_odometry(relations.to_ns[rows]))
    first, second = (
        [submap_of(scans[stamp]) for stamp in stamps[rows].tolist()]
        for stamps in (relations.from_ns, relations.to_ns)
    )
    aligned, covs, _ = align_pairs(second, first, list(compose(reference, ours)))
    heading = aligned[:, 2]
    way = np.column_stack([np.cos(heading), np.sin(heading)])
    sigma = np.sqrt(np.einsum("ni,nij,nj->n", way, covs[:, :2, :2], way))
    odo, laser = between(reference, driven)[:, 0], between(reference, aligned)[:, 0]
    assert matched.covs is not None
    S = matched.covs[local][:, :2, :2] + REFERENCE_SIGMA_M**2 * np.eye(2)
    inside = nees(ours[:, :2], S) <= chi2_quantile(0.95, 2)
    table = []
    for low, high in pairwise(SIGMAS_M):
        k = (sigma >= low) & (sigma < high)
        if k.sum() < 20:
            continue
        differences = (odo - laser, laser, odo, ours[:, 0], ours[:, 0] - laser, ours[:, 1])
        spreads = [f"{100 * spread(one[k]):.2f}" for one in differences]
        group = f"{100 * low:g} to {100 * high:g}" if np.isfinite(high) else f"over {100 * low:g}"
        table.append([f"{name}, {group}", f"{k.sum()}", *spreads, f"{100 * inside[k].mean():.0f}"])
    return table


def main() -> None:
    """Print the table."""
    options = parser(__doc__)
    options.add_argument("logs", nargs="*", default=FREIBURG_LOGS)
    arguments = options.parse_args()
    print(
        "| along the way, cm: sigma of the alignment | relations | odometry - laser "
        "| laser - reference | odometry - reference | ours - reference | ours - laser "
        "| across: ours - reference | ours in 95 %, % |"
    )
    print("|---" * 9 + "|")
    with tempfile.TemporaryDirectory() as folder:
        for name in arguments.logs:
            for row in rows_of(name, Path(folder)):
                print("| " + " | ".join(row) + " |", flush=True)


if __name__ == "__main__":
    main()
