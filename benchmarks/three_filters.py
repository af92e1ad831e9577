"""The thesis' filter as printed, our best EKF, the smoother: final and causal, simulated and real.

Every row gets the same log and the same start. Each has its own data association and keyframes: the
comparison is of whole systems. Simulated logs (20 seeds): position errors against the truth, and
in `lab` the scatter of the corner as in docs/experiments.md; a run is lost if its final trajectory
is ever more than 1 m off, and how long it took until then. Intel and ACES: the reference relations,
mean error of position and heading. Victoria Park: distance of every position from the optimum of
the file's own factors.

With --repairs instead: the thesis' filter turned into our EKF, one repair after another.

Run: python benchmarks/three_filters.py [lab corridor two-robots intel aces victoria]
     [--seeds 20] [--rows "thesis;EKF"] [--repairs]     prints one table per log
"""

import sys
import tempfile
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from common import FREIBURG, FREIBURG_LOGS, START_FROM_TRUTH, import_freiburg, parser, simulated_log

from graphslam.core.config import Config
from graphslam.core.config_io import load_config
from graphslam.core.errors import GraphSlamError
from graphslam.core.geometry import Array, compose, polar_points, transform
from graphslam.core.records import Result, Scan, Trajectory
from graphslam.evaluation.ground_truth import truth_of_logs
from graphslam.evaluation.metrics import evaluate
from graphslam.evaluation.relation_metrics import read_relations
from graphslam.evaluation.trajectory_metrics import align, pair_poses
from graphslam.importers import IMPORTERS
from graphslam.logs import GroundTruth, LogSet, open_logs
from graphslam.slam.smooth import smooth

#: name of a row -> preset, settings
ROWS: dict[str, tuple[str | None, tuple[str, ...]]] = {
    "thesis": ("thesis", ()),
    "thesis, Hough": ("thesis", ("front_end.name=hough",)),
    "thesis, ends may be hidden": ("thesis", ("front_end.hidden_ends=line",)),
    "thesis, nothing deleted": ("thesis", ("association.delete_s=inf",)),
    "thesis, unnamed": ("thesis", ("association.identities=ignore",)),
    "EKF": (None, ("backend.name=ekf",)),
    "EKF, unnamed": (None, ("backend.name=ekf", "association.identities=ignore")),
    "EKF, no kernel": (None, ("backend.name=ekf", "robust.kernel=none")),
    "smoother": (None, ("backend.causal=true",)),
    "smoother, no kernel": (None, ("backend.causal=true", "robust.kernel=none")),
    "smoother, unnamed": (None, ("backend.causal=true", "association.identities=ignore")),
}
#: log -> rows
LOGS = {
    "lab": ("thesis", "EKF", "smoother"),
    "two-robots": ("thesis", "EKF", "smoother"),
    "corridor": ("thesis", "thesis, Hough", "thesis, ends may be hidden", "EKF", "smoother"),
    "intel": ("thesis", "thesis, Hough", "thesis, ends may be hidden", "EKF", "smoother"),
    "aces": ("thesis", "thesis, Hough", "thesis, ends may be hidden", "EKF", "smoother"),
    "victoria": (
        *("thesis", "thesis, nothing deleted", "EKF", "EKF, no kernel"),
        *("smoother", "smoother, no kernel"),
    ),
}
#: from the thesis' filter to our EKF, one repair after another
REPAIRS = {
    "+ hidden ends make lines": ("front_end.hidden_ends=line",),
    "+ no row along lines": ("ekf.lines=model",),
    "+ nearness across walls": (
        *("association.nearness=across", "association.floor_m=0.05", "association.floor_rad=0.03"),
        *("association.method=optimal", "association.directed=true"),
    ),
    "+ promoted at the third sighting": (
        *("association.sightings_to_promote=3", "ekf.past_states=20"),
        *("association.delete_s=inf", "association.reacquire_m=10.0"),
    ),
    "+ robust kernel": ("robust.kernel=cauchy",),
    "+ covariances with floors": (
        *("front_end.covariance=incidence", "front_end.floor_normal_m=0.01"),
        *("front_end.floor_angle_rad=0.005", "front_end.split_rule=deviation"),
    ),
    "+ constant parameters, estimated": (
        *("odometry.parameter_noise=constant", "odometry.calibrate=true"),
        *("odometry.fixed_calibration=[]", "odometry.floor_sigma_m=0.005"),
        "odometry.floor_sigma_rad=0.005",
    ),
}
for _number, _name in enumerate(REPAIRS, 1):
    _settings = (setting for name in list(REPAIRS)[:_number] for setting in REPAIRS[name])
    ROWS[_name] = ("thesis", tuple(_settings))
LOST_M = 1.0
#: the corner of docs/experiments.md that the vehicle sees most of the time
CORNER_M, CORNER_RADIUS_M = np.array([0.0, 8.0]), 0.5


def settings_of_row(row: str, *more: str) -> Config:
    """The configuration of a row."""
    preset, settings = ROWS[row]
    return load_config(None, [*settings, *more], preset)


def lost_after(off_m: Array, stamps_ns: Array) -> float:
    """Seconds until a trajectory is first more than `LOST_M` off; NaN if it never is."""
    far = np.flatnonzero(off_m > LOST_M)
    return float(1e-9 * (stamps_ns[far[0]] - stamps_ns[0])) if len(far) else float("nan")


def distance(found: Trajectory, known: Trajectory) -> tuple[Array, Array]:
    """Distances (n,), m, of positions, and their stamps (n,)."""
    pairs = pair_poses(found, known)
    return np.hypot(*(pairs.estimate - pairs.truth)[:, :2].T), pairs.stamps_ns


def simulated(job: tuple[str, str, int]) -> dict[str, float]:
    """One seed of a scenario through one row."""
    name, row, seed = job
    config = settings_of_row(row, START_FROM_TRUTH)
    with tempfile.TemporaryDirectory() as folder:
        path = simulated_log(name, seed, Path(folder))
        log = open_logs([path], config)
        result = smooth(log, config)
        known = truth_of_logs(log)
        errors = evaluate(result, known.trajectories, known.landmarks)
        out = {kind: errors["joint"][kind]["ate_rmse_m"] for kind in ("final", "causal")} | {
            "nees": errors["joint"]["final"]["nees_per_dof"]
        }
        off = {
            robot: distance(own.final, known.trajectories[robot])
            for robot, own in result.robots.items()
        }
        out["lost"] = float(np.nanmin([np.inf, *(lost_after(*one) for one in off.values())]))
        if name == "lab":
            out["corner"] = corner_scatter(result, log, known)
    return out


def corner_scatter(result: Result, log: LogSet, known: GroundTruth) -> float:
    """RMS distance, m, from the nearest true wall of all points within 0.5 m of the true corner.

    After one SE(2) alignment of the whole run, as in docs/experiments.md.
    """
    ((robot, own),) = result.robots.items()
    assert own.scan_final is not None  # its landmarks are from scans
    scans = {m.stamp_ns: m for m in log.messages() if isinstance(m, Scan)}
    pairs = pair_poses(own.final, known.trajectories[robot])
    used = [scans[int(stamp)] for stamp in pairs.stamps_ns]
    laser = own.scan_final.at(pairs.stamps_ns)
    frame = align(laser[:, :2], compose(pairs.truth, used[0].mount)[:, :2])
    points = np.concatenate(
        [
            transform(compose(frame, pose), polar_points(scan.ranges, scan.angles))
            for pose, scan in zip(laser, used, strict=True)
        ]
    )
    near = points[np.linalg.norm(points - CORNER_M, axis=1) < CORNER_RADIUS_M]
    ends = np.array([mark.extent for mark in known.landmarks if mark.kind == "segment"])
    start, along = ends[:, 0], ends[:, 1] - ends[:, 0]
    share = np.sum((near[:, None] - start) * along, axis=-1) / np.sum(along**2, axis=-1)
    foot = start + np.clip(share, 0, 1)[..., None] * along
    off = np.linalg.norm(near[:, None] - foot, axis=-1).min(axis=1)
    return float(np.sqrt(np.mean(off**2)))


def relations(job: tuple[str, str, str]) -> dict[str, Any]:
    """A log with reference relations through one row."""
    name, row, path = job
    config = settings_of_row(row)
    result = smooth(open_logs([Path(path)], config), config)
    known = read_relations(FREIBURG / f"{name}.relations")
    found = evaluate(result, {}, (), known)["relations"]
    out = {"final": found["all"], "causal": found["causal"]["all"]}
    return out | {"trajectory": scans_of(result), "landmarks": len(result.landmarks)}


def scans_of(result: Result) -> Trajectory:
    """The final trajectory of the only robot."""
    (own,) = result.robots.values()
    return own.final


def against_optimum(job: tuple[str, str]) -> dict[str, Any]:
    """Victoria Park through one row: its final and causal trajectory."""
    row, path = job
    config = settings_of_row(row)
    result = smooth(open_logs([Path(path)], config), config)
    (own,) = result.robots.values()
    assert own.causal is not None  # always there for sightings
    return {"final": own.final, "causal": own.causal, "landmarks": len(result.landmarks)}


def attempt(function: Any, job: Any) -> dict[str, Any] | str:
    """What a run found, or why it failed."""
    try:
        return dict(function(job))
    except GraphSlamError as error:
        return str(error)


@dataclass(frozen=True)
class Table:
    """A table that is printed row by row."""

    head: Sequence[str]

    def begin(self) -> None:
        """Print the head."""
        print("| " + " | ".join(self.head) + " |")
        print("|" + "---|" * len(self.head), flush=True)

    def row(self, *cells: str) -> None:
        """Print a row."""
        print("| " + " | ".join(cells) + " |", flush=True)


def spread(values: Sequence[float]) -> str:
    """Median and largest."""
    return f"{np.median(values):.3g} ({np.max(values):.3g})"


def simulated_table(name: str, rows: Sequence[str], seeds: int, pool: ProcessPoolExecutor) -> None:
    """Median and worst over seeds of the runs that are not lost, and the share that is."""
    corner = name == "lab"
    head = ["", "lost", "lost after, s", "final, m", "causal, m", "NEES/dof"]
    table = Table([*head, *["corner, cm"] * corner])
    print(f"\n{name}, {seeds} seeds: median (largest) of the runs that are not lost")
    table.begin()
    for row in rows:
        jobs = [(name, row, seed) for seed in range(seeds)]
        found = list(pool.map(attempt, [simulated] * seeds, jobs))
        runs = [one for one in found if isinstance(one, dict)]
        lost = [one for one in runs if np.isfinite(one["lost"])]
        good = [one for one in runs if not np.isfinite(one["lost"])]
        count = len(lost) + len(found) - len(runs)
        cells = [row, f"{count} of {seeds}"]
        cells.append(spread([one["lost"] for one in lost]) if lost else "-")
        keys = ["final", "causal", "nees"]
        shown = good or lost
        cells += [spread([one[key] for one in shown]) if shown else "-" for key in keys]
        if not good:
            cells[3:5] = [f"all lost: {cell}" for cell in cells[3:5]]
        if corner:
            cells.append(spread([100 * one["corner"] for one in shown]) if shown else "-")
        table.row(*cells)


def relations_table(name: str, rows: Sequence[str], path: str, pool: ProcessPoolExecutor) -> None:
    """Mean error of all relations."""
    print(f"\n{name}: mean error of all reference relations")
    head = ["", "final, m", "final, °", "causal, m", "causal, °", "landmarks"]
    table = Table([*head, "off the smoother by 1 m after, s"])
    table.begin()
    jobs = [(name, row, path) for row in rows]
    found = dict(zip(rows, pool.map(attempt, [relations] * len(rows), jobs), strict=True))
    for row, one in found.items():
        if isinstance(one, str):
            table.row(row, f"failed: {one}", *[""] * 5)
            continue
        cells = [
            f"{one[kind][key]:.3g}"
            for kind in ("final", "causal")
            for key in ("trans_mean_m", "rot_mean_deg")
        ]
        best = found.get("smoother")
        after = float("nan")
        if isinstance(best, Mapping):
            after = lost_after(*distance(one["trajectory"], best["trajectory"]))
        table.row(
            row, *cells, str(one["landmarks"]), "never" if np.isnan(after) else f"{after:.0f}"
        )


def victoria_table(rows: Sequence[str], path: str, pool: ProcessPoolExecutor) -> None:
    """Root mean square and largest distance of positions from the optimum."""
    config = load_config(None, ["keyframe.mode=all", "robust.kernel=none"])
    optimum = scans_of(smooth(open_logs([Path(path)], config), config))
    print("\nvictoria: distance of positions from the optimum of the file's factors")
    table = Table(["", "final, m", "largest, m", "causal, m", "largest, m", "landmarks"])
    table.begin()
    found = pool.map(attempt, [against_optimum] * len(rows), [(row, path) for row in rows])
    for row, one in zip(rows, found, strict=True):
        if isinstance(one, str):
            table.row(row, f"failed: {one}", *[""] * 4)
            continue
        cells = []
        for kind in ("final", "causal"):
            off, _ = distance(one[kind], optimum)
            cells += [f"{np.sqrt(np.mean(off**2)):.3g}", f"{off.max():.3g}"]
        table.row(row, *cells, str(one["landmarks"]))


def main() -> int:
    """Print the tables."""
    options = parser(__doc__)
    options.add_argument("names", nargs="*", default=list(LOGS), metavar="LOG")
    options.add_argument("--seeds", type=int, default=20)
    options.add_argument("--jobs", type=int, default=2)
    options.add_argument("--rows", help="instead of those of each log, separated by semicolons")
    options.add_argument("--repairs", action="store_true", help="rows from the thesis to our EKF")
    given = options.parse_args()
    with (
        ProcessPoolExecutor(given.jobs, mp_context=get_context("spawn")) as pool,
        tempfile.TemporaryDirectory() as folder,
    ):
        for name in given.names:
            rows = given.rows.split(";") if given.rows else LOGS[name]
            rows = ("thesis", *REPAIRS, "EKF") if given.repairs else rows
            if name in FREIBURG_LOGS:
                path = str(import_freiburg(name, Path(folder)))
                relations_table(name, rows, path, pool)
            elif name == "victoria":
                log = Path(folder) / "victoria.mcap"
                IMPORTERS["isam"](Path(gtsam.findExampleDataFile("victoria_park.txt")), log)
                victoria_table(rows, str(log), pool)
            else:
                simulated_table(name, rows, given.seeds, pool)
    return 0


if __name__ == "__main__":
    sys.exit(main())
