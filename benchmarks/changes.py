"""Change detection over seeds of the `change` scenario and its variants, and its speed.

    python benchmarks/changes.py [--seeds N] [--first N] [--visits FOLDER] [WHAT ...]

WHAT: false-alarms, detection, table, thesis, speed, figures; all if none is named. Smoothing the
visits takes most of the time; they are kept in FOLDER (default: a temporary one). `figures` draws
docs/figures/changes-*.png; the real room's needs GRAPHSLAM_DATA.
"""

import argparse
import json
import pickle
import resource
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.stats import norm

from graphslam.change_detection import Visit, detect_changes, load_visit, visit_from_scans
from graphslam.change_detection.detect import ChangeResult
from graphslam.change_detection.grid import grid_over
from graphslam.change_detection.rigid_registration import Registration, register
from graphslam.change_detection.thesis_method import (
    LaserNoise,
    changed_beams,
    make_dents,
    occlusion_map,
    point_covariances,
    scan_points,
)
from graphslam.core.config import ChangesConfig, Config
from graphslam.core.geometry import Array, between, compose, inverse, transform
from graphslam.logs import open_logs
from graphslam.results.folder import load, save
from graphslam.simulation import load_scenario, simulate
from graphslam.simulation.raycast import BeamFan, cast_beams
from graphslam.simulation.scenario import Box, LaterVisit, Move, Scenario, StaticObjects
from graphslam.simulation.world import Outline, make_world
from graphslam.slam.smooth import smooth

POSE_SIGMAS = np.array([0.05, 0.05, np.radians(1.0)])  # injected


def variants() -> dict[str, Scenario]:
    """The scenarios: what changes between the visits."""
    table = load_scenario("change")
    assert table.later is not None
    nothing = replace(table.later, moved=())

    def with_later(name: str, later: LaterVisit) -> Scenario:
        return replace(table, name=name, later=later)

    box = Box("new box", (3.4, 2.9), (0.5, 0.4), 20.0)
    pallet = Move("pallet", shift_m=(0.5, 0.2), turn_deg=15.0, about_m=(2.0, 5.2))
    far = Move("pallet", shift_m=(1.0, -0.9), turn_deg=15.0, about_m=(2.0, 5.2))
    door = Move("door", turn_deg=50.0, about_m=(7.5, 0.0))
    closes = Move("door", turn_deg=75.0, about_m=(7.5, 0.0))
    return {
        "nothing": with_later("nothing", nothing),
        "table": table,
        "appears": with_later("appears", replace(nothing, appeared=StaticObjects(boxes=(box,)))),
        "vanishes": with_later("vanishes", replace(nothing, vanished=("pallet",))),
        "moves": with_later("moves", replace(nothing, moved=(pallet,))),
        "moves far": with_later("moves far", replace(nothing, moved=(far,))),
        "door turns": with_later("door", replace(nothing, moved=(door,))),
        "door closes": with_later("door closes", replace(nothing, moved=(closes,))),
    }


Case = tuple[Visit, Visit, dict[str, Any], list[Any]]


def case(name: str, seed: int, folder: Path) -> Case:
    """Two smoothed visits, truth.json, and the simulated sweeps.

    "door opens" are the visits of "door closes" the other way round.
    """
    if name == "door opens":
        first, second, truth, sweeps = case("door closes", seed, folder)
        starts = truth["starts"]
        starts = {"reference": starts["later"], "later": starts["reference"]}
        (move,) = truth["changes"]
        back = inverse(np.array([move["displacement"][k] for k in ("x", "y", "phi")]))
        motion = dict(zip(("x", "y", "phi"), back.tolist(), strict=True))
        move = move | {"displacement": motion, "before": move["after"], "after": move["before"]}
        return second, first, truth | {"starts": starts, "changes": [move]}, sweeps[::-1]
    cache = folder / f"{name} {seed}.pickle"
    if cache.exists():
        cached: Case = pickle.loads(cache.read_bytes())  # our own file
        return cached
    with tempfile.TemporaryDirectory(dir=folder) as temporary:
        here = Path(temporary)
        done = simulate(variants()[name], here / "logs", seed)
        visits = []
        for visit in ("reference", "later"):
            log = open_logs([here / "logs" / f"{visit}.mcap"], Config())
            save(smooth(log, Config()), here / visit, force=True)
            visits.append(load_visit(load(here / visit), here / visit))
        truth = json.loads((here / "logs/truth.json").read_text(encoding="utf-8"))
        sweeps = [next(iter(r.scans.values())) for r in done.recordings]
    found = (visits[0], visits[1], truth, sweeps)
    cache.write_bytes(pickle.dumps(found))
    return found


def disturbed(visit: Visit, seed: int) -> Visit:
    """The visit with an independent error added to every pose, and to its covariance."""
    noise = np.random.default_rng(seed).normal(size=visit.poses.shape) * POSE_SIGMAS
    covs = visit.covs + np.diag(POSE_SIGMAS**2)
    return replace(visit, poses=visit.poses + noise, covs=covs, shared=covs)


def true_frame(truth: dict[str, Any]) -> Array:
    """Pose (3,) of the reference's world in the simulator's: where its robot started."""
    (start,) = truth["starts"]["reference"].values()
    return np.array(start)


# ---------------------------------------------------------------- what is asked


def false_alarms(seeds: Sequence[int], folder: Path) -> None:
    """Where nothing changed: beams flagged, and runs that report a change."""
    print("\nno change: beams flagged (asked for), worst run, runs with a change")
    for what, disturb in (("as smoothed", False), ("poses +- 5 cm, 1 deg", True)):
        for rate in (0.01, 0.001):
            rates, poses, runs = [], 0, 0
            for seed in seeds:
                a, b, *_ = case("nothing", seed, folder)
                b = disturbed(b, seed) if disturb else b
                found = detect_changes(a, b, ChangesConfig(false_alarm_rate=rate))
                rates.append(found.flagged.sum() / found.compared.sum())
                runs += bool(found.changes)
                poses += len(b.poses)
            print(
                f"  {what:22s} {100 * np.mean(rates):.3f} % ({100 * rate:g} %), worst "
                f"{100 * max(rates):.2f} %, {runs} of {len(seeds)} runs, {poses} later poses"
            )


def table_beams(truth: dict[str, Any], sweep: Any) -> tuple[Array, Any]:
    """True displacement (k,) m along the table of later beams that met it, and their numbers."""
    names = sweep.hits.surfaces
    move = truth["changes"][0]
    after, before = np.array(move["after"]), np.array(move["before"])
    heading = sweep.poses[:, 2, None] + np.radians(sweep.laser.step_deg) * (
        np.arange(names.shape[1]) - (names.shape[1] - 1) / 2
    )
    ends = sweep.poses[:, None, :2] + sweep.hits.ranges[..., None] * np.stack(
        [np.cos(heading), np.sin(heading)], axis=-1
    )
    ends = np.where(np.isfinite(ends), ends, 1e6)
    along = (after[1] - after[0]) / np.hypot(*(after[1] - after[0]))
    t = (ends - after[0]) @ along
    aside = np.abs((ends - after[0]) @ np.array([-along[1], along[0]]))
    length = float(np.hypot(*(after[1] - after[0])))
    scan, beam = np.nonzero((aside < 1e-6) & (t > 0.02) & (t < length - 0.02))
    # how far the surface itself moved across: what a range can show
    turn = np.arctan2(*along[::-1]) - np.arctan2(*(before[1] - before[0])[::-1])
    return t[scan, beam] * np.sin(abs(turn)), scan * names.shape[1] + beam


BINS = np.array([0, 0.01, 0.02, 0.03, 0.035, 0.045, 0.06, 0.08, 0.12, 0.2, 0.4, 0.6])


def detection(seeds: Sequence[int], folder: Path) -> Array:
    """The tilted table: share of the beams on it that are flagged, by true displacement.

    Returns:
        (bins, 5): middle of the bin, m; shares of the accumulated method, as its stated sigmas
        promise, of the thesis, and of one pair of beams from known poses.
    """
    hits, total = np.zeros(len(BINS) - 1), np.zeros(len(BINS) - 1)
    thesis_hits, thesis_total, promised = hits.copy(), total.copy(), hits.copy()
    for seed in seeds:
        a, b, truth, sweeps = case("table", seed, folder)
        found = detect_changes(a, b, ChangesConfig())
        moved, beams = table_beams(truth, sweeps[1])
        usable = found.compared[beams]
        k = np.digitize(moved[usable], BINS) - 1
        total += np.bincount(k, minlength=len(total))[: len(total)]
        hits += np.bincount(k, found.flagged[beams[usable]], len(total))[: len(total)]
        limit = _promised(found, moved[usable], beams[usable])
        promised += np.bincount(k, limit, len(total))[: len(total)]
        compared, marked, _ = thesis_run(a, b, 9.21)
        usable = compared[beams]
        k = np.digitize(moved[usable], BINS) - 1
        thesis_total += np.bincount(k, minlength=len(total))[: len(total)]
        thesis_hits += np.bincount(k, marked[beams[usable]], len(total))[: len(total)]
    print("\ntilted table: beams flagged by displacement across the surface")
    print("  m            accumulated   as stated   thesis, single scan   one beam, poses known")
    rows = []
    for low, high, h, n, p, th, tn in zip(
        BINS[:-1], BINS[1:], hits, total, promised, thesis_hits, thesis_total, strict=True
    ):
        # the best that one pair of ranges can do: both have the noise of the laser
        limit = norm.sf(norm.isf(0.005) - (low + high) / 2 / (np.sqrt(2) * 0.015))
        row = ((low + high) / 2, h / max(n, 1), p / max(n, 1), th / max(tn, 1), limit)
        rows.append(row)
        print(
            f"  {low:.3f}-{high:.3f}  {100 * row[1]:6.1f} % of {int(n):6d}   {100 * row[2]:6.1f} %"
            f"   {100 * row[3]:6.1f} % of {int(tn):6d}   {100 * limit:6.1f} %"
        )
    return np.array(rows)


def _promised(found: ChangeResult, moved: Array, beams: Array) -> Array:
    """Probability (k,) that a displacement ``moved`` (k,) is flagged, by the stated sigmas."""
    surface, evidence = found.surfaces[1], found.evidence[1]
    cell = surface.cells[np.maximum(surface.beams[beams], 0)]
    row = surface.nearest.member[cell]
    sigma = found.null_sigma * np.sqrt(evidence.variance[row])
    # beams that end farther behind are counted as if they ended at the gate
    return norm.sf(norm.isf(found.rate / 2) - np.minimum(moved, ChangesConfig().gate_m) / sigma)


def table(seeds: Sequence[int], folder: Path) -> None:
    """All variants: what is reported, outlines against changed cells, displacements."""
    print(
        "\nvariants: runs that find the change, median and least intersection over union with the"
        "\nchanged cells, changes elsewhere, NEES / 3 of the displacement, kinds reported"
    )
    for name in (
        "nothing", "nothing, disturbed", "table", "table, disturbed", "appears", "vanishes",
        "moves", "moves far", "door turns", "door closes", "door opens",
    ):  # fmt: skip
        overlaps, kinds, nees, hits, elsewhere = [], [], [], 0, 0
        for seed in seeds:
            a, b, truth, _ = case(name.partition(",")[0], seed, folder)
            b = disturbed(b, seed) if "disturbed" in name else b
            found = detect_changes(a, b, ChangesConfig())
            frame = true_frame(truth)
            kinds += ["+".join(sorted(c.kind for c in found.changes)) or "none"]
            there = [_at_truth(change.polygon, truth, frame) for change in found.changes]
            hits, elsewhere = hits + any(there), elsewhere + len(there) - sum(there)
            if truth["cells"]:
                overlaps.append(_overlap(found, truth, frame))
                nees += _nees(found, truth, frame)
        common = {kind: kinds.count(kind) for kind in sorted(set(kinds), key=kinds.count)[::-1]}
        shown = f"{np.mean(nees):.2f} of {len(nees)}" if nees else "-"
        outlined = f"{np.median(overlaps):.2f} {min(overlaps):.2f}" if overlaps else "-   -   "
        print(
            f"  {name:19s} {hits:3d} of {len(seeds)}  {outlined}  {elsewhere:2d}  {shown:12s} "
            f"{', '.join(f'{n} {kind}' for kind, n in common.items())}"
        )


def _at_truth(polygon: Array, truth: dict[str, Any], frame: Array) -> bool:
    """Whether some changed cell is in or within 10 cm of a polygon."""
    contour = transform(frame, polygon).astype(np.float32)[:, None]
    return any(
        cv2.pointPolygonTest(contour, (float(c["x"]), float(c["y"])), True) > -0.1
        for c in truth["cells"]
    )


def _overlap(found: ChangeResult, truth: dict[str, Any], frame: Array) -> float:
    """IoU of cells with flagged surface and the truth's cells; one cell of tolerance each way.

    A surface near the border of a cell falls into either cell: a cell counts as common if the
    other set has it or a neighbour of it.
    """
    cell = truth["cell_m"]
    true = {(round(c["x"] / cell - 0.5), round(c["y"] / cell - 0.5)) for c in truth["cells"]}
    points = [np.zeros((0, 2))]
    for change in found.changes:
        points.append(_surface_in(found, change.polygon))
        if change.before is not None:
            points.append(_surface_in(found, change.before))
    cells = np.floor(transform(frame, np.concatenate(points)) / cell).astype(int)
    ours = set(map(tuple, cells.tolist()))
    near = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)]

    def matched(these: set[Any], others: set[Any]) -> int:
        return sum(any((x + i, y + j) in others for i, j in near) for x, y in these)

    hit, of_ours = matched(true, ours), matched(ours, true)
    union = len(true) + len(ours) - of_ours
    return hit / union if union else 1.0


def _surface_in(found: ChangeResult, polygon: Array) -> Array:
    """Pieces (k, 2) of flagged surface inside a polygon."""
    parts = []
    for surface, evidence in zip(found.surfaces, found.evidence, strict=True):
        high = evidence.scores(found.null_sigma) > norm.isf(found.rate / 2)
        parts.append(surface.points[high])
    points = np.concatenate(parts)
    contour = polygon.astype(np.float32)[:, None]
    inside = [cv2.pointPolygonTest(contour, (float(x), float(y)), False) >= 0 for x, y in points]
    return points[np.array(inside, dtype=bool)] if len(points) else points


def _nees(found: ChangeResult, truth: dict[str, Any], frame: Array) -> list[float]:
    """NEES / 3 of each displacement, moved to the thing's middle: at the origin levers hide it."""
    out = []
    for change in found.changes:
        if change.displacement is None:
            continue
        move = truth["changes"][0]
        if move["displacement"] is None:
            continue
        true = np.array([move["displacement"][k] for k in ("x", "y", "phi")])
        # the same motion in the reference's frame
        true = between(frame, compose(true, frame))
        d = change.displacement
        error = d.motion - true
        error[2] = (error[2] + np.pi) % (2 * np.pi) - np.pi
        out.append(float(error @ np.linalg.solve(d.cov, error)) / 3)
    return out


# ---------------------------------------------------------------- the thesis' method


def thesis_run(a: Visit, b: Visit, gate: float, consecutive: int = 1) -> tuple[Any, Any, int]:
    """Every 10th later scan against the dents of the nearest reference scan, as in 6.2."""
    registration = register(a.landmarks, b.landmarks)
    b = b.transformed(registration.pose, registration.cov)
    noise = LaserNoise()
    compared, marked = np.zeros(len(b.range_m), bool), np.zeros(len(b.range_m), bool)
    grid = grid_over(np.concatenate([a.ends[a.surface], b.ends[b.surface]]), 0.025, 1_000_000)
    for scan in range(0, len(b.poses), 10):
        away = np.hypot(*(a.poses[:, :2] - b.poses[scan, :2]).T)
        turned = np.abs((a.poses[:, 2] - b.poses[scan, 2] + np.pi) % (2 * np.pi) - np.pi)
        one = int(np.argmin(away + turned))
        beams = a.scan == one
        angles, ranges = a.angle[beams], a.range_m[beams]
        covs = point_covariances(a.poses[one], a.covs[one], angles, np.nan_to_num(ranges), noise)
        dents = make_dents(grid, scan_points(a.poses[one], angles, ranges), covs)
        visible = occlusion_map(grid, a.poses[one], angles, ranges, 0.1)
        beams = b.scan == scan
        compared[beams], marked[beams] = changed_beams(
            dents, visible, b.poses[scan], b.covs[scan], b.angle[beams], b.range_m[beams],
            noise, gate, consecutive,
        )  # fmt: skip
    return compared, marked, 0


def thesis(seeds: Sequence[int], folder: Path) -> None:
    """Its real false-alarm rate: gates are quantiles of two degrees of freedom, as printed."""
    print("\nthesis' method, single scans, nothing changed: beams flagged")
    for asked, gate in ((0.01, 9.21), (0.001, 13.82)):
        for least in (1, 3, 5):
            n = flagged = 0
            for seed in seeds:
                a, b, *_ = case("nothing", seed, folder)
                compared, marked, _ = thesis_run(a, b, gate, least)
                n, flagged = n + compared.sum(), flagged + marked.sum()
            print(f"  gate for {100 * asked:g} %, {least} in a row: {100 * flagged / n:.2f} %")


def speed(seeds: Sequence[int], folder: Path) -> None:
    """1000 + 1000 scans of 361 beams over 40 x 40 m at 2.5 cm."""
    rng = np.random.default_rng(0)
    walls = [Outline("room", np.array([[0, 0], [40, 0], [40, 40], [0, 40]], float), closed=True)]
    for i in range(60):
        x, y = rng.uniform(2, 38, 2)
        w, h = rng.uniform(0.4, 4, 2)
        corners = np.array([[x, y], [x + w, y], [x + w, y + h], [x, y + h]])
        walls.append(Outline(f"box {i}", corners, closed=True))
    visits = []
    for number in range(2):
        world = make_world(walls if number == 0 else walls[:-3])
        t = np.linspace(0, 2 * np.pi, 1000, endpoint=False)
        radius = 12 + number + 4 * np.sin(3 * t)
        poses = np.column_stack([20 + radius * np.cos(t), 20 + radius * np.sin(t), t + np.pi / 2])
        fan = BeamFan(-np.pi / 2, np.pi / 360, 361)
        ranges = cast_beams(poses, fan, world.shapes, 80.0).ranges
        ranges = ranges + 0.015 * rng.normal(size=ranges.shape)
        covs = np.broadcast_to(np.diag([0.01, 0.01, 0.004]) ** 2, (1000, 3, 3)).copy()
        poses = poses + rng.normal(size=poses.shape) * [0.01, 0.01, 0.004]
        stamps = np.arange(1000, dtype=np.int64)
        visits.append(visit_from_scans(stamps, poses, covs, [(fan.angles, r) for r in ranges]))
    known = Registration(np.zeros(3), 1e-6 * np.eye(3), np.zeros((0, 2), int))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    began, cpu = time.perf_counter(), time.process_time()
    found = detect_changes(visits[0], visits[1], ChangesConfig(), known)
    seconds, cpu = time.perf_counter() - began, time.process_time() - cpu
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    cell = found.surfaces[0].nearest.grid.cell_m
    print(
        f"\nspeed: 1000 + 1000 scans of 361 beams, 40 x 40 m at {100 * cell:.1f} cm: "
        f"{seconds:.1f} s ({cpu:.1f} s of CPU), peak {peak:.0f} MB ({before:.0f} MB before), "
        f"{len(found.changes)} changes"
    )


def figures(seeds: Sequence[int], folder: Path) -> None:
    """The pictures of docs/change-detection.md."""
    from changes_figures import draw  # noqa: PLC0415 -- that imports this module

    draw(seeds, folder)


WHAT: dict[str, Callable[[Sequence[int], Path], Any]] = {
    "false-alarms": false_alarms,
    "detection": detection,
    "table": table,
    "thesis": thesis,
    "speed": speed,
    "figures": figures,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", nargs="*", metavar="WHAT")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--visits", type=Path)
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = chosen.visits or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        for name in chosen.what or WHAT:
            WHAT[name](range(chosen.first, chosen.first + chosen.seeds), folder)


if __name__ == "__main__":
    main()
