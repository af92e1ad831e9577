"""Front ends against simulated truth, and their time: one table.

Precision: share of the lines (and cylinders) that lie on a face (circle) of the simulated world
which beams of that scan met. Recall: share of the faces (circles) seen well that some
observation lies on; seen well is by at least 8 beams over at least 0.5 m (a circle: 5 beams).
NIS: squared error in sigmas per degree of freedom, of (normal offset, direction) or (bearing,
range); 1 is honest, less is cautious. Mean and spread over seeds.

The time is CPU time per scan on one core; on a real log too, if there is one.

A second table is of whole runs: mean error of the final positions and of the causal ones over
seeds, on a real log the mean over its reference relations (all, and loops) of the final ones, the
landmarks in the map, and CPU time of the front end per scan.

Run: python benchmarks/frontend_table.py [--no-scans] [--no-runs] [LOG.mcap=RELATIONS ...]
"""

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from common import best_cpu_s, parser, simulated_log
from numpy.typing import NDArray

from graphslam.core.config import BackendConfig, Config, FrontEndConfig, StartConfig
from graphslam.core.geometry import Array, between, rotate_cov, transform, wrap
from graphslam.core.records import Observation, Result, Scan
from graphslam.evaluation.ground_truth import truth_of_logs
from graphslam.evaluation.metrics import evaluate
from graphslam.evaluation.relation_metrics import read_relations
from graphslam.logs import open_logs
from graphslam.perception.front_ends import FRONT_ENDS
from graphslam.simulation import load_scenario, simulate
from graphslam.simulation.scene import prepare_visits
from graphslam.slam.smooth import smooth

SEEDS = (0, 1, 2, 3)
SCANS = 120
"""Of each recording, evenly taken."""

NEAR_M, NEAR_RAD = 0.1, 0.1
"""Farther from every face an observation is false. Many sigmas: it must not trim the NIS."""

RUNS = ("lab", "office-loop", "corridor")
RUN_SEEDS = (0, 1)
CAUSAL = BackendConfig(causal=True)

SCENARIOS = ("lab", "office-loop", "corridor", "forest", "fleet")
FRONT = {
    "segments": FrontEndConfig(cylinders=False),
    "hough": FrontEndConfig(name="hough", cylinders=False),
    "both": FrontEndConfig(name="both", cylinders=False),
    "both + cylinders": FrontEndConfig(name="both", cylinders=True),
}

WHOLE = {label: front for label, front in FRONT.items() if not front.cylinders}


@dataclass(frozen=True)
class TrueScan:
    """A noisy scan, and its truth in the laser frame.

    ``faces`` (k, 2, 2) and ``circles`` (m, 3) of the world; ``part[face]``: where on the face, m
    from its first end, beams met it, and how many; ``hit[circle]``: beams.
    """

    scan: Scan
    faces: Array
    circles: Array
    part: dict[int, tuple[float, float, int]]
    hit: dict[int, int]
    hits: Array
    surface: NDArray[np.int64]


@dataclass
class Score:
    """Counts of one front end on one recording."""

    found: int = 0
    right: int = 0
    visible: int = 0
    recalled: int = 0
    repeated: int = 0
    nis: list[float] = field(default_factory=list)


def true_scans(name: str, seed: int, folder: Path, scans: int = SCANS) -> Iterator[TrueScan]:
    """Scans of all robots of a scenario, with their truth."""
    scenario = load_scenario(name)
    world = prepare_visits(scenario)[0].world
    recording = simulate(scenario, folder / f"{name}.mcap", seed).recordings[0]
    log = open_logs([recording.path], Config())
    by_robot: dict[str, list[Scan]] = {}
    for message in log.messages():
        if isinstance(message, Scan):
            by_robot.setdefault(message.robot, []).append(message)
    faces, circles = world.shapes.segments, world.shapes.circles
    for robot, sweep in recording.scans.items():
        noisy = by_robot[robot]
        assert len(noisy) == len(sweep.poses)
        for i in np.unique(np.linspace(0, len(noisy) - 1, scans // len(by_robot)).astype(int)):
            inverse = between(sweep.poses[i], np.zeros(3))
            mine = transform(inverse, faces.reshape(-1, 2)).reshape(-1, 2, 2)
            round_ = np.column_stack((transform(inverse, circles[:, :2]), circles[:, 2]))
            surfaces, r = sweep.hits.surfaces[i], sweep.hits.ranges[i]
            angles = noisy[i].angles
            met = np.flatnonzero(surfaces >= 0)
            surfaces = surfaces[met]
            hits = r[met, None] * np.column_stack((np.cos(angles), np.sin(angles)))[met]
            part: dict[int, tuple[float, float, int]] = {}
            hit: dict[int, int] = {}
            for surface in np.unique(surfaces).tolist():
                here = surfaces == surface
                if surface < len(mine):
                    along = (hits[here] - mine[surface, 0]) @ unit(mine[surface])
                    part[surface] = (along.min(), along.max(), np.count_nonzero(here))
                elif surface < len(mine) + len(round_):
                    hit[surface - len(mine)] = np.count_nonzero(here)
            yield TrueScan(noisy[i], mine, round_, part, hit, hits, surfaces)


def unit(face: Array) -> Array:
    along = face[1] - face[0]
    return np.asarray(along / np.hypot(*along))


def faces_of(o: Observation, truth: TrueScan) -> tuple[Array | None, list[int]]:
    """Error (offset m, direction rad) of a line against the face it is mostly made of.

    None where it lies on no face; and all faces of which beams met it. What it is made of are the
    true hits inside its extent and at most NEAR_M beside it.
    """
    local = transform(between(o.z, np.zeros(3)), truth.hits)
    on = (np.abs(local[:, 1]) < NEAR_M) & (local[:, 0] > o.extent[0]) & (local[:, 0] < o.extent[1])
    number, beams = np.unique(truth.surface[on], return_counts=True)
    flat = (number >= 0) & (number < len(truth.faces))
    number, beams = number[flat], beams[flat]
    errors = {}
    for k in number.tolist():
        face = truth.faces[k]
        along = unit(face)
        turn = wrap(o.z[2] - np.arctan2(along[1], along[0]))
        normal = np.array([-along[1], along[0]])
        if abs(turn) > np.pi / 2:
            turn, normal = wrap(turn - np.pi), -normal
        there = local[on & (truth.surface == k), 0].mean()  # offset where the face is
        offset = normal @ (o.z[:2] - face[0])
        if abs(offset + there * np.sin(turn)) < NEAR_M / 2 and abs(turn) < NEAR_RAD:
            errors[k] = np.array([offset, float(turn)])
    if not len(number) or (main := int(number[np.argmax(beams)])) not in errors:
        return None, []
    return errors[main], [
        k for k, n in zip(number.tolist(), beams, strict=True) if k in errors and n >= 3
    ]


def score(name: str, config: FrontEndConfig, scans: Sequence[TrueScan]) -> tuple[Score, Score]:
    """Lines and cylinders of one front end."""
    lines, points = Score(), Score()
    for truth in scans:
        observations = FRONT_ENDS[config.name](truth.scan, config)
        covered: dict[int, int] = {}
        round_ = set()
        for o in observations:
            if o.kind == "point":
                points.found += 1
                centre = o.z[1] * np.array([np.cos(o.z[0]), np.sin(o.z[0])])
                away = np.hypot(*(truth.circles[:, :2] - centre).T)
                k = int(np.argmin(away)) if len(away) else -1
                if k < 0 or away[k] > 0.3 or k not in truth.hit:
                    continue
                points.right += 1
                round_.add(k)
                x, y = truth.circles[k, :2]
                e = np.array([wrap(o.z[0] - np.arctan2(y, x)), o.z[1] - np.hypot(x, y)])
                points.nis.append(float(e @ np.linalg.solve(o.cov, e)) / 2)
                continue
            lines.found += 1
            e, on = faces_of(o, truth)
            if e is None:
                continue
            lines.right += 1
            for k in on:
                covered[k] = covered.get(k, 0) + 1
            V = rotate_cov(o.cov, -o.z[2])[1:, 1:]
            lines.nis.append(float(e @ np.linalg.solve(V, e)) / 2)
        good = {k for k, (a, b, n) in truth.part.items() if n >= 8 and b - a >= 0.5}
        lines.visible += len(good)
        lines.recalled += len(good & set(covered))
        lines.repeated += sum(n - 1 for n in covered.values())
        trees = {k for k, n in truth.hit.items() if n >= 5}
        points.visible += len(trees)
        points.recalled += len(trees & round_)
    return lines, points


def ms_per_scan(config: FrontEndConfig, scans: Sequence[Scan]) -> float:
    front_end = FRONT_ENDS[config.name]
    return 1e3 * best_cpu_s(lambda: [front_end(scan, config) for scan in scans], 3) / len(scans)


def spread(values: Sequence[float]) -> str:
    return f"{np.mean(values):6.3f} ±{np.std(values):5.3f}"


def row(label: str, kind: str, scores: Sequence[Score], scans: int, ms: float | None) -> None:
    precision = [s.right / s.found for s in scores if s.found]
    recall = [s.recalled / s.visible for s in scores if s.visible]
    nis = [float(np.mean(s.nis)) for s in scores if s.nis]
    if not precision and not recall:
        return
    per_scan = sum(s.found for s in scores) / scans
    again = sum(s.repeated for s in scores) / max(sum(s.found for s in scores), 1)
    print(
        f"{label:30} {kind:6} {spread(precision) if precision else '-':>14}"
        f" {spread(recall) if recall else '-':>14} {spread(nis) if nis else '-':>14}"
        f" {again:7.3f} {per_scan:9.2f}" + (f" {ms:8.3f}" if ms is not None else "")
    )


def run_row(label: str, errors: str, result: Result, ms: float) -> None:
    landmarks = result.summary["counts"]["landmarks"]
    print(f"{label:34} {errors} {landmarks:10d} {ms:9.3f}", flush=True)


def simulated_runs(folder: Path) -> None:
    """Position errors (RMSE) in simulation over seeds; the landmarks are those of the last."""
    for name in RUNS:
        for label, front in WHOLE.items():
            config = replace(
                Config(), front_end=front, start=StartConfig(from_truth=True), backend=CAUSAL
            )
            final, causal = [], []
            for seed in RUN_SEEDS:
                log = open_logs([simulated_log(name, seed, folder)], config)
                result = smooth(log, config)
                found = evaluate(result, truth_of_logs(log, config).trajectories)["joint"]
                final.append(found["final"]["ate_rmse_m"])
                causal.append(found["causal"]["ate_rmse_m"])
            scans = [m for m in log.messages() if isinstance(m, Scan)][::10]
            errors = f"{spread(final)} {spread(causal)}"
            run_row(f"{name}: {label}", errors, result, ms_per_scan(front, scans))


def real_runs(path: Path, relations: Path) -> None:
    """Errors over relations of one real log."""
    for label, front in WHOLE.items():
        config = replace(Config(), front_end=front)
        log = open_logs([path], config)
        result = smooth(log, config)
        found = evaluate(result, relations=read_relations(relations))["relations"]
        scans = [m for m in log.messages() if isinstance(m, Scan)][::20]
        both = (found[group]["trans_mean_m"] for group in ("all", "loops"))
        errors = " ".join(f"{value:13.4f}" for value in both)
        run_row(f"{path.stem}: {label}", errors, result, ms_per_scan(front, scans))


def scan_table(folder: Path) -> None:
    """Precision, recall, NIS and time of every front end on every scenario."""
    print(
        f"{'':30} {'':6} {'precision':>14} {'recall':>14} {'NIS / dof':>14} {'again':>7}"
        f" {'per scan':>9} {'ms/scan':>8}"
    )
    for name in SCENARIOS:
        truths = [list(true_scans(name, seed, folder)) for seed in SEEDS]
        scans = [t.scan for t in truths[0]]
        count = sum(map(len, truths))
        for label, config in FRONT.items():
            pairs = [score(name, config, t) for t in truths]
            ms = ms_per_scan(config, scans)
            row(f"{name}: {label}", "lines", [a for a, _ in pairs], count, ms)
            if config.cylinders:
                row(f"{name}: {label}", "points", [b for _, b in pairs], count, None)


def main() -> None:
    options = parser(__doc__)
    options.add_argument("logs", nargs="*", metavar="LOG.mcap=RELATIONS")
    options.add_argument("--no-scans", action="store_true", help="leave out the first table")
    options.add_argument("--no-runs", action="store_true", help="leave out simulated runs")
    arguments = options.parse_args()
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as folder:
        if not arguments.no_scans:
            scan_table(Path(folder))
        print(
            f"{'':34} {'final, all':>13} {'causal, loops':>13} {'landmarks':>10} {'ms/scan':>9}",
            flush=True,
        )
        if not arguments.no_runs:
            simulated_runs(Path(folder))
        for pair in arguments.logs:
            log, _, relations = pair.partition("=")
            real_runs(Path(log), Path(relations))


if __name__ == "__main__":
    main()
