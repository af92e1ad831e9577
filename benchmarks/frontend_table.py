"""Front ends against simulated truth, and their time: one table.

Precision: share of the lines (and cylinders) that lie on a face (circle) of the simulated world
which beams of that scan met. Recall: share of the faces (circles) seen well that some
observation lies on; seen well is by at least 8 beams over at least 0.5 m (a circle: 5 beams).
NIS: squared error in sigmas per degree of freedom, of (normal offset, direction) or (bearing,
range); 1 is honest, less is cautious. Mean and spread over seeds.

The time is CPU time per scan on one core; on a real log too, if there is one.

A second table is of whole runs, median and worst over seeds: error of the final positions, end pose
and walls at the start laid on themselves (see `thesis_experiments.py`); on a real log the mean over
its reference relations (all, and loops) of the final ones; the landmarks in the map, and CPU time
of the front end per scan. The last line is the error of each front end relative to `segments`,
mean over seeds and logs. Real logs are those given, else Intel and ACES if they are there.

`hough, thesis` counts votes with `front_end.hough_votes = "thesis"`. `hough, raster` is OpenCV's
transform of a raster with the weights as pixels, which is in no release: it is here to be compared.

Run: python benchmarks/frontend_table.py [--seeds 20] [--no-scans] [--no-runs]
     [LOG.mcap=RELATIONS ...]
"""

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from common import (
    FREIBURG,
    FREIBURG_LOGS,
    best_cpu_s,
    import_freiburg,
    parser,
    simulated_log,
)
from numpy.typing import NDArray

from graphslam.core.config import Config, FrontEndConfig
from graphslam.core.geometry import Array, between, rotate_cov, transform, wrap
from graphslam.core.records import Observation, Scan
from graphslam.evaluation import thesis_experiments
from graphslam.evaluation.metrics import evaluate
from graphslam.evaluation.relation_metrics import read_relations
from graphslam.logs import open_logs
from graphslam.perception.front_ends import FRONT_ENDS
from graphslam.perception.hough_votes import HOUGH_VOTES, PROPOSALS, OpenCvVotes
from graphslam.simulation import load_scenario, simulate
from graphslam.simulation.scene import prepare_visits
from graphslam.slam.smooth import smooth

SCANS = 30
"""Of each recording, evenly taken."""

NEAR_M, NEAR_RAD = 0.1, 0.1
"""Farther from every face an observation is false. Many sigmas: it must not trim the NIS."""

RUNS = ("lab", "corridor")
SCENARIOS = ("lab", "office-loop", "corridor", "forest", "fleet")
WHOLE = {
    "segments": FrontEndConfig(),
    "hough": FrontEndConfig(name="hough"),
    "hough, thesis": FrontEndConfig(name="hough", hough_votes="thesis"),
    "both": FrontEndConfig(name="both"),
}
FRONT = {
    **WHOLE,
    # not one of the votes that a user may choose, so the type does not have it
    "hough, raster": FrontEndConfig(name="hough", hough_votes="raster"),  # type: ignore[arg-type]
    "both + cylinders": FrontEndConfig(name="both", cylinders=True),
}


class RasterVotes(OpenCvVotes):
    """Lines proposed by `cv2.HoughLines` of a cropped raster whose pixels are the weights."""

    def _proposals(self) -> tuple[Array, Array]:
        points, cell = self._points[self._voting], self._config.hough_delta_d_m
        if not len(points):
            return np.zeros(0), np.zeros(0)
        weights = self._weights[self._voting]
        low = points.min(axis=0)
        x, y = np.rint((points - low) / cell).astype(np.intp).T
        image = np.zeros((y.max() + 1, x.max() + 1))
        np.add.at(image, (y, x), weights)
        pixels = np.minimum(np.ceil(255 * image / weights.max()), 255).astype(np.uint8)
        step = 2 * np.pi / self._config.hough_gamma_steps
        found = cv2.HoughLines(pixels, 1, step, 1, use_edgeval=True)
        if found is None:
            return np.zeros(0), np.zeros(0)
        rho, gamma = found.reshape(-1, 2)[:PROPOSALS].T.astype(np.float64)
        d = rho * cell + low[0] * np.cos(gamma) + low[1] * np.sin(gamma)
        near = np.abs(d) <= self._config.hough_d_max_m
        return d[near], gamma[near]


HOUGH_VOTES["raster"] = RasterVotes


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
    return f"{np.mean(values):.3f} ±{np.std(values):.3f}"


def row(label: str, kind: str, scores: Sequence[Score], scans: int, ms: float | None) -> None:
    precision = [s.right / s.found for s in scores if s.found]
    recall = [s.recalled / s.visible for s in scores if s.visible]
    nis = [float(np.mean(s.nis)) for s in scores if s.nis]
    if not precision and not recall:
        return
    per_scan = sum(s.found for s in scores) / scans
    again = sum(s.repeated for s in scores) / max(sum(s.found for s in scores), 1)
    shown = [spread(values) if values else "-" for values in (precision, recall, nis)]
    time = f"{ms:.2f}" if ms is not None else "-"
    print(
        f"| {label} | {kind} | {' | '.join(shown)} | {again:.3f} | {per_scan:.2f} | {time} |",
        flush=True,
    )


def worst(values: Sequence[float]) -> str:
    return f"{np.median(values):.4f}, {max(values):.4f}"


def simulated_runs(folder: Path, seeds: int) -> dict[str, list[float]]:
    """Errors of whole runs in simulation over seeds; front end -> those relative to segments."""
    relative: dict[str, list[float]] = {label: [] for label in WHOLE}
    for name in RUNS:
        errors: dict[str, list[float]] = {}
        for label, front in WHOLE.items():
            config = replace(Config(), front_end=front)
            rows = []
            for seed in range(seeds):
                done = thesis_experiments.run(simulated_log(name, seed, folder), config)
                own = done.aligned("vehicle", thesis_experiments.WITH)
                moved = transform(own, done.laser("vehicle", thesis_experiments.WITH)[:, :2])
                off = moved - done.laser("vehicle", thesis_experiments.TRUE)[:, :2]
                row = [float(np.sqrt(np.mean(np.sum(off**2, axis=1))))]
                if name == "corridor":
                    row.append(thesis_experiments.end_error(done, thesis_experiments.WITH))
                    row.append(thesis_experiments.wall_overlay(done, thesis_experiments.WITH))
                rows.append((*row, float(done.result.summary["counts"]["landmarks"])))
            *found, landmarks = map(list, zip(*rows, strict=True))
            ms = ms_per_scan(front, done.scans["vehicle"][::5])
            columns = [worst(values) for values in found]
            columns += ["-"] * (3 - len(columns))
            shown = " | ".join([*columns, f"{np.median(landmarks):.0f}", f"{ms:.2f}"])
            print(f"| {name}, {label} | {shown} |", flush=True)
            errors[label] = found[0]
        for label, own_errors in errors.items():
            relative[label].append(float(np.mean(own_errors) / np.mean(errors["segments"])))
    return relative


def real_runs(path: Path, relations: Path) -> dict[str, float]:
    """Errors over relations of one real log; front end -> the error relative to segments."""
    errors = {}
    for label, front in WHOLE.items():
        config = replace(Config(), front_end=front)
        log = open_logs([path], config)
        result = smooth(log, config)
        found = evaluate(result, relations=read_relations(relations))["relations"]
        scans = [m for m in log.messages() if isinstance(m, Scan)][::20]
        both = " | ".join(f"{found[group]['trans_mean_m']:.4f}" for group in ("all", "loops"))
        landmarks, ms = result.summary["counts"]["landmarks"], ms_per_scan(front, scans)
        print(f"| {path.stem}, {label} | {both} | - | {landmarks} | {ms:.2f} |", flush=True)
        errors[label] = found["all"]["trans_mean_m"]
    return {label: error / errors["segments"] for label, error in errors.items()}


def scan_table(folder: Path, seeds: int) -> None:
    """Precision, recall, NIS and time of every front end on every scenario."""
    print("| | what | precision | recall | NIS / dof | again | per scan | ms per scan |")
    for name in SCENARIOS:
        truths = [list(true_scans(name, seed, folder)) for seed in range(seeds)]
        scans = [t.scan for t in truths[0]]
        count = sum(map(len, truths))
        for label, config in FRONT.items():
            pairs = [score(name, config, t) for t in truths]
            ms = ms_per_scan(config, scans)
            row(f"{name}, {label}", "lines", [a for a, _ in pairs], count, ms)
            if config.cylinders:
                row(f"{name}, {label}", "points", [b for _, b in pairs], count, None)


def real_logs(given: Sequence[str], folder: Path) -> list[tuple[Path, Path]]:
    """Logs with their relations."""
    if given:
        pairs = [pair.partition("=") for pair in given]
        return [(Path(log), Path(relations)) for log, _, relations in pairs]
    return [
        (import_freiburg(name, folder), FREIBURG / f"{name}.relations")
        for name in FREIBURG_LOGS
        if (FREIBURG / f"{name}.relations").exists()
    ]


def main() -> None:
    options = parser(__doc__)
    options.add_argument("logs", nargs="*", metavar="LOG.mcap=RELATIONS")
    options.add_argument("--seeds", type=int, default=20, help="of simulated logs")
    options.add_argument("--no-scans", action="store_true", help="leave out the first table")
    options.add_argument("--no-runs", action="store_true", help="leave out runs of logs not given")
    arguments = options.parse_args()
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as folder:
        if not arguments.no_scans:
            scan_table(Path(folder), arguments.seeds)
        if arguments.no_runs and not arguments.logs:
            return
        print("| | error (real: all) | end pose (real: loops) | walls | landmarks | ms per scan |")
        relative: dict[str, list[float]] = {label: [] for label in WHOLE}
        if not arguments.no_runs:
            relative = simulated_runs(Path(folder), arguments.seeds)
        for log, relations in real_logs(arguments.logs, Path(folder)):
            for label, share in real_runs(log, relations).items():
                relative[label].append(share)
        shares = [f"{label} {np.mean(v):.3f}" for label, v in relative.items() if v]
        print("error relative to segments, mean over logs:", ", ".join(shares))


if __name__ == "__main__":
    main()
