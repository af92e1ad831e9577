"""False loop closures in a pose graph: which are believed, and what they cost.

The CSAIL pose graph with 250 false closures added, once as one robot and once cut into two robots
of which the second one's start is unknown. Our result with default settings is evaluated with the
factors of the graph without them: GTSAM's error, with a prior of 1e-3 on pose 0. The files of two
robots lack one of these factors, the odometry from the last pose of one to the first of the other:
errors are of the factors in the files, and in another column of all. For comparison: the optimum,
the results of Levenberg-Marquardt and of GTSAM's graduated non-convexity (`GncLMOptimizer`, with
odometry as known inliers) for one robot, and the same runs without false closures.

Run: python benchmarks/outlier_closures.py [FOLDER]   (default: graphs/ of the data)
"""

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import gtsam
import numpy as np
from common import DATA, parser, pose_graph_values, smooth_log

from graphslam.core.records import Result
from graphslam.importers import IMPORTERS, pose_stamp_ns
from graphslam.importers.import_pose_graph import PoseGraphEdge, read_pose_graph, split_odometry

PRIOR_SIGMA = 1e-3
#: the graph without false closures; one robot with them; two robots with them, and without
CLEAN = "CSAIL.g2o"
ONE = ("CSAIL_outliers.g2o",)
ROBOTS = ("CSAIL_robot1.g2o", "CSAIL_robot2.g2o")
TWO = (*ROBOTS, "CSAIL_interrobot_loop_closures_outliers.g2o")
TRUE = "CSAIL_interrobot_loop_closures.g2o"


def smoothed(sources: list[Path]) -> Result:
    """The lines of files as one pose graph, imported and smoothed by default settings."""
    with tempfile.TemporaryDirectory() as folder:
        whole, log = Path(folder) / "whole.g2o", Path(folder) / "log.mcap"
        whole.write_text("\n".join(source.read_text() for source in sources))
        IMPORTERS["g2o"](whole, log)
        return smooth_log(log)


def ends(edge: PoseGraphEdge) -> tuple[int, int]:
    """Stamps of a closure's ends, the earlier first."""
    a, b = sorted((edge.start, edge.end))
    return pose_stamp_ns(a), pose_stamp_ns(b)


@dataclass(frozen=True, slots=True)
class Run:
    """True closures, of them kept; false closures, of them believed; GTSAM's errors; seconds.

    ``error`` at our result and ``best`` at the optimum are of the factors that the files have in
    common with the graph without false closures; ``whole`` is that of all of its factors.
    """

    true: int
    kept: int
    false: int
    believed: int
    error: float
    best: float
    whole: float
    seconds: float
    values: gtsam.Values


def run(folder: Path, names: tuple[str, ...]) -> Run:
    """Smooth files of a folder together, and judge which closures were kept and what came out.

    What is listed as refused has the ends of exactly one closure, or of several that all are.
    """
    began = time.perf_counter()
    result = smoothed([folder / name for name in names])
    seconds = time.perf_counter() - began
    edges = [e for name in names for e in read_pose_graph(folder / name).edges]
    _, closures = split_odometry(edges, sorted({pose for e in edges for pose in (e.start, e.end)}))
    true = {(*ends(e), *e.delta) for e in read_pose_graph(folder / TRUE).edges}
    refused = [(c["other_time_ns"], c["time_ns"]) for c in result.summary["closures"]["refused"]]
    is_true = np.array([(*ends(e), *e.delta) in true for e in closures])
    is_kept = np.array([ends(e) not in refused for e in closures])
    values, whole = pose_graph_values(result), clean_graph(folder)
    linked = {ends(e) for e in edges}
    common = gtsam.NonlinearFactorGraph()
    for factor in (whole.at(n) for n in range(whole.size())):
        if len(factor.keys()) == 1 or tuple(map(pose_stamp_ns, factor.keys())) in linked:
            common.add(factor)
    best = gtsam.LevenbergMarquardtOptimizer(common, values).optimize()
    return Run(
        int(is_true.sum()),
        int((is_true & is_kept).sum()),
        int((~is_true).sum()),
        int((~is_true & is_kept).sum()),
        common.error(values),
        common.error(best),
        whole.error(values),
        seconds,
        values,
    )


def clean_graph(folder: Path) -> gtsam.NonlinearFactorGraph:
    """The factors without false closures, with the prior."""
    graph, _ = gtsam.readG2o(str(folder / CLEAN), False)
    graph.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(), prior()))
    return graph


def prior() -> gtsam.noiseModel.Base:
    """On pose 0."""
    return gtsam.noiseModel.Isotropic.Sigma(3, PRIOR_SIGMA)


def by_gtsam(folder: Path) -> tuple[gtsam.Values, gtsam.Values]:
    """Levenberg-Marquardt and graduated non-convexity from odometry, false closures included."""
    graph, start = gtsam.readG2o(str(folder / ONE[0]), False)
    graph.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(), prior()))
    first = {}
    for n in range(graph.size()):
        keys = graph.at(n).keys()
        if len(keys) == 1 or keys[1] == keys[0] + 1:
            first.setdefault(tuple(keys), n)
    least = gtsam.LevenbergMarquardtOptimizer(graph, start).optimize()
    parameters = gtsam.GncLMParams(gtsam.LevenbergMarquardtParams())
    parameters.setKnownInliers(list(first.values()))
    return least, gtsam.GncLMOptimizer(graph, start, parameters).optimize()


def main() -> None:
    options = parser(__doc__)
    options.add_argument("folder", nargs="?", type=Path, default=DATA / "graphs")
    folder: Path = options.parse_args().folder
    columns = ("true", "false", "error", "optimum", "all factors", "s")
    print(f"{'':32}" + "".join(f"{column:>12}" for column in columns))
    runs = {
        "one robot, no false closure": (CLEAN,),
        "one robot": ONE,
        "two robots, no false closure": (*ROBOTS, TRUE),
        "two robots, one start unknown": TWO,
    }
    for label, names in runs.items():
        done = run(folder, names)
        kept, believed = f"{done.kept}/{done.true}", f"{done.believed}/{done.false}"
        errors = "".join(f"{e:12.3f}" for e in (done.error, done.best, done.whole))
        print(f"{label:32}{kept:>12}{believed:>12}{errors}{done.seconds:12.1f}")
    graph, began = clean_graph(folder), time.perf_counter()
    for label, values in zip(("Levenberg-Marquardt", "GNC"), by_gtsam(folder), strict=True):
        print(f"{'one robot, GTSAM: ' + label:56}{graph.error(values):12.3f}")
    print(f"GTSAM: {time.perf_counter() - began:.1f} s")


if __name__ == "__main__":
    main()
