"""How near results come to the optimum of Victoria Park, judged by the file's own factors.

The measure is GTSAM's error (half the weighted squared residual) of the factors that
`gtsam.load2D` reads from the file, plus a prior of 1e-3 on pose 0. A result gives only its
trajectory at the poses' stamps and its landmarks by their identities; our own factors have no say.
Beside it: where Levenberg-Marquardt gets from odometry alone, and the optimum.

Run: python benchmarks/victoria_park.py DIR...   (folders that `graphslam smooth` wrote)
tests/slam/test_real_logs.py holds the bar with the functions below.
"""

import sys
from pathlib import Path

import gtsam
import numpy as np
from common import parser, smooth_log

from graphslam.core.config_io import load_config
from graphslam.core.errors import GraphSlamError, OutputError
from graphslam.importers import IMPORTERS, pose_stamp_ns
from graphslam.results.folder import load, save

SOURCE = gtsam.findExampleDataFile("victoria_park.txt")
PRIOR_SIGMA = 1e-3
ROBOT = "robot"
LANDMARK = ord("l")  # how load2D marks the keys of landmarks; those of poses are numbers
#: 0.1 % above the optimum: the run with every pose and without a robust kernel must reach it
BAR = 2341.6


def file_graph(source: str = SOURCE) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """The factors of a file with the prior, and its own poses (odometry chained up)."""
    if source.endswith(".g2o"):
        graph, odometry = gtsam.readG2o(source, False)
    else:
        graph, odometry = gtsam.load2D(source)
    prior = gtsam.noiseModel.Isotropic.Sigma(3, PRIOR_SIGMA)
    graph.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(), prior))
    return graph, odometry


def smooth_all_poses(source: str, directory: Path) -> Path:
    """Import a file and smooth it, every pose kept and no robust kernel; the result folder."""
    log = directory / "log.mcap"
    IMPORTERS["isam"](Path(source), log)
    config = load_config(overrides=["keyframe.mode=all", "robust.kernel=none"])
    result = smooth_log(log, config)
    save(result, directory / "all_poses", force=False)
    return directory / "all_poses"


def values_of(directory: Path, like: gtsam.Values) -> gtsam.Values:
    """A result's poses and landmarks under the keys of the file."""
    saved = load(directory)
    trajectory = saved.robots[ROBOT].final
    poses = dict(zip(trajectory.stamps_ns.tolist(), trajectory.poses, strict=True))
    landmarks = {landmark.identity: landmark.position[:2] for landmark in saved.landmarks}
    keys = [gtsam.Symbol(key) for key in sorted(like.keys())]
    values = gtsam.Values()
    try:
        for number, key in enumerate(k for k in keys if k.chr() != LANDMARK):
            values.insert(key.key(), gtsam.Pose2(*poses[pose_stamp_ns(number)].tolist()))
        for key in (k for k in keys if k.chr() == LANDMARK):
            values.insert(key.key(), landmarks[str(key.index())])
    except KeyError as error:
        raise OutputError(f"{directory}: has no pose or landmark {error}") from error
    return values


def optimum(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> float:
    """Error at the end of Levenberg-Marquardt with GTSAM's default settings."""
    return graph.error(gtsam.LevenbergMarquardtOptimizer(graph, values).optimize())


def row(label: str, error: float, note: str = "") -> None:
    print(f"{label:42} {error:14,.2f}  {note}".rstrip())


def main() -> None:
    options = parser(__doc__)
    options.add_argument("directories", nargs="*", type=Path, metavar="DIR")
    directories: list[Path] = options.parse_args().directories
    graph, odometry = file_graph()
    print(f"{graph.size()} factors, {odometry.size()} variables: error")
    row("odometry alone", graph.error(odometry))
    row("Levenberg-Marquardt from odometry", optimum(graph, odometry), "a local minimum")
    best = np.inf
    for directory in directories:
        values = values_of(directory, odometry)
        counts = load(directory).summary["counts"]
        row(str(directory), graph.error(values), f"{counts['keyframes']} keyframes")
        best = min(best, optimum(graph, values))
    if directories:
        note = f"the optimum; up to {BAR} counts as found"
        row("Levenberg-Marquardt from the best of these", best, note)


if __name__ == "__main__":
    try:
        main()
    except GraphSlamError as error:
        sys.exit(f"victoria_park: error: {error}")
