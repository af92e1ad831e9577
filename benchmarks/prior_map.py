"""A known map: starts found anywhere in it, errors of what is localised, and a map that goes on.

Office: the simulated office is mapped once, its start told with an error drawn from its prior. Then
a robot starts somewhere on the round through the corridors, in either direction, and drives half of
it; nothing is said about where. Errors are in the world, not aligned; bounds of NEES are those of
99 % under the stated joint covariance, of its mean those of all seeds together. Repeated: a row of
equal offices along a corridor, of which only the ends differ; the robot visits some in the middle,
and then drives on to an end. Days: furniture is moved every day, and each day continues the map;
all days are also solved anew, as sessions, and further days are localised in either map: their
errors tell how good the maps are,
where those of the days that made them also depend on what was known by then. By the error of the
told start both maps are moved alike, and either's own error may make it up by chance. So errors
are printed in the world, and in the world as the told start has it. Timed is the CPU time of each
day. The biases of surfaces belong to the building: they are drawn once for all logs of a seed.

Run: python benchmarks/prior_map.py [office] [repeated] [days] [--seeds N] [--first SEED]
"""

import tempfile
import time
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from common import parser, pooled_bounds
from sessions import ROUND, SAME_PLACE, changed, later

import graphslam
from graphslam.core.errors import EstimationError
from graphslam.core.geometry import Array, compose, inverse
from graphslam.core.records import Result, Trajectory
from graphslam.evaluation.metrics import evaluate
from graphslam.logs import read_truth
from graphslam.results.known_map_file import load_known_map
from graphslam.simulation import load_scenario, simulate
from graphslam.simulation.scenario import Leg, Scenario, ScenarioError, Wall

#: m, m, rad: what the start of the first log is known to
START_SIGMA = (0.005, 0.005, 0.001)
#: corners of the round on a visit; share of the first side at which it begins, at most
LEGS, LATEST = 5, 0.7
DAYS, DAY_S = 10, 86_400
#: further days that are localised in the maps of the days before
FURTHER = 5
#: how often seeds are drawn again
RESAMPLED = 2000
#: m: a start farther off is wrong
WRONG_M = 0.5


def main() -> None:
    """Print what was asked for."""
    options = parser(__doc__)
    options.add_argument("which", nargs="*", default=("office", "repeated", "days"))
    options.add_argument("--seeds", type=int, default=20)
    options.add_argument("--first", type=int, default=0)
    chosen = options.parse_args()
    with tempfile.TemporaryDirectory() as name:
        for which in chosen.which:
            folder = Path(name) / which
            folder.mkdir()
            campaign = {"office": office, "repeated": repeated, "days": days}[which]
            for line in campaign(folder, range(chosen.first, chosen.first + chosen.seeds)):
                print(line, flush=True)


def mapped(folder: Path, log: Path, seed: int) -> Path:
    """The result of a log whose start is told, with an error."""
    graphslam.smooth(log, output=folder / "map", force=True, **told_start(log, seed))
    return folder / "map"


def told_start(log: Path, seed: int) -> dict[str, Any]:
    """Settings that tell where a log's robot starts, with an error drawn from their sigmas."""
    rng = np.random.default_rng(seed)
    (robot, truth), *_ = read_truth([log], graphslam.load_config()).trajectories.items()
    told = truth.poses[0] + rng.normal(0.0, START_SIGMA)
    return {
        f"start.poses.{robot}": [float(x) for x in told],
        "start.given_sigma_m": START_SIGMA[0],
        "start.given_sigma_rad": START_SIGMA[2],
    }


def office(folder: Path, seeds: Sequence[int]) -> Iterator[str]:
    """A line for each seed, and one for all."""
    scenario = load_scenario("office-loop")
    errors, nees, bounds, poses, wrong = [], [], [], [], 0
    for seed in seeds:
        simulate(scenario, folder / "first.mcap", 1000 + seed, materials_seed=seed)
        known = mapped(folder, folder / "first.mcap", seed)
        log = visit(folder, scenario, seed)
        (folder / "first.mcap").unlink()
        try:
            result = graphslam.smooth(log, **{"known_map.directory": str(known)})
        except EstimationError as error:
            yield f"office, seed {seed}: {error}"
            continue
        truth = read_truth([log], graphslam.load_config()).trajectories
        found = evaluate(result, truth)["joint"]["final"]
        if far_off(result, truth):
            wrong += 1
            yield f"office, seed {seed}: a wrong start"
            continue
        errors.append(found["ate_rmse_m"])
        nees.append(found["nees_per_dof"])
        bounds.append(found["nees_bounds_99"])
        poses.append(found["effective_poses"])
        yield (
            f"office, seed {seed}: ATE {errors[-1]:.4f} m, NEES/dof {nees[-1]:.2f} in "
            f"{bounds[-1][0]:.2f} to {bounds[-1][1]:.2f}"
        )
    inside = sum(low <= n <= high for n, (low, high) in zip(nees, bounds, strict=True))
    below = sum(n <= high for n, (_, high) in zip(nees, bounds, strict=True))
    least, most = pooled_bounds(poses)
    yield (
        f"office, {len(seeds)} seeds: {len(errors)} found, {wrong} wrong; ATE mean "
        f"{np.mean(errors):.4f} m, worst {np.max(errors):.4f}; NEES/dof mean {np.mean(nees):.2f} "
        f"in {least:.2f} to {most:.2f}, {inside} inside their bounds, {below} not above"
    )


def far_off(result: Result, truth: Mapping[str, Trajectory]) -> bool:
    """Whether the start that was found is a wrong one."""
    ((name, robot),) = result.robots.items()
    off = robot.final.poses[0] - truth[name].poses[0]
    return bool(np.hypot(off[0], off[1]) > WRONG_M)


def visit(
    folder: Path, scenario: Scenario, seed: int, seconds: int = 0, building: int | None = None
) -> Path:
    """The log of half a round from anywhere on it, in either direction, so much later.

    A round on which the robot drives into what has been moved is drawn again. ``building``: the
    seed of the biases of its surfaces, ``seed`` by default.
    """
    building = seed if building is None else building
    rng = np.random.default_rng(seed)
    path, now = folder / f"visit{seconds // DAY_S}.mcap", folder / "now.mcap"
    path.unlink(missing_ok=True)
    while not path.exists():
        now.unlink(missing_ok=True)
        with suppress(ScenarioError):
            simulate(half_a_round(scenario, rng), now, seed, materials_seed=building)
            later(now, path, seconds)
    return path


def half_a_round(scenario: Scenario, rng: np.random.Generator) -> Scenario:
    """The scenario with its robot anywhere on the round, in either direction."""
    ((name, robot),) = scenario.robots.items()
    begin, back = int(rng.integers(len(ROUND))), bool(rng.integers(2))
    corners = np.roll(np.array(ROUND), -begin, axis=0)[:: -1 if back else 1]
    first, second = corners[:2]
    start = first + rng.uniform(0.0, LATEST) * (second - first)
    robot = replace(
        robot,
        start_m=tuple(start.tolist()),
        start_deg=float(np.degrees(np.arctan2(*(second - start)[::-1]))),
        drive=(Leg(through_m=tuple(map(tuple, corners[1:LEGS].tolist()))),),
    )
    return replace(scenario, robots={name: robot})


#: offices along a corridor: number, width and depth, width of the corridor and of doors, m
OFFICES, WIDE_M, DEEP_M, CORRIDOR_M, DOOR_M = 12, 4.0, 4.0, 2.4, 1.2


def row_of_offices() -> Scenario:
    """Equal offices on both sides of a corridor, of which one end is closed by a slanted wall."""
    scenario = load_scenario("office-loop")
    long = OFFICES * WIDE_M
    top = CORRIDOR_M
    walls = [
        Wall("south", ((0.0, -DEEP_M), (long, -DEEP_M))),
        Wall("north", ((0.0, top + DEEP_M), (long, top + DEEP_M))),
        Wall("west", ((0.0, -DEEP_M), (0.0, top + DEEP_M))),
        Wall("east 1", ((long, -DEEP_M), (long, 0.0))),
        Wall("east 2", ((long, 0.0), (long + 4.0, 0.8))),
        Wall("east 3", ((long + 4.0, 0.8), (long + 2.0, top), (long, top))),
        Wall("east 4", ((long, top), (long, top + DEEP_M))),
    ]
    for n in range(OFFICES):
        begin, end = n * WIDE_M, (n + 1) * WIDE_M
        door = begin + 0.4
        for y, back in ((0.0, -DEEP_M), (top, top + DEEP_M)):
            walls += [
                Wall(f"front {n} {y} 1", ((begin, y), (door, y))),
                Wall(f"front {n} {y} 2", ((door + DOOR_M, y), (end, y))),
            ]
            if n:
                walls.append(Wall(f"between {n} {y}", ((begin, y), (begin, back))))
    world = replace(scenario.world, walls=tuple(walls), boxes=(), boards=(), cylinders=(), doors=())
    return replace(scenario, world=world)


def repeated(folder: Path, seeds: Sequence[int]) -> Iterator[str]:
    """How often the start is refused in the middle of the row, and found at its end."""
    scenario = row_of_offices()
    ((name, robot),) = scenario.robots.items()
    middle, end = CORRIDOR_M / 2, OFFICES * WIDE_M - 1.0
    counts = {"middle": [0, 0, 0], "to the end": [0, 0, 0]}  # found, refused, wrong
    for seed in seeds:
        rng = np.random.default_rng(seed)
        whole = replace(
            robot,
            start_m=(2.0, middle),
            start_deg=0.0,
            drive=(
                Leg(through_m=((end, middle),)),
                Leg(turn_deg=180.0),
                Leg(through_m=((2.0, middle),)),
            ),
        )
        log = folder / "first.mcap"
        log.unlink(missing_ok=True)
        simulate(replace(scenario, robots={name: whole}), log, 2000 + seed, materials_seed=seed)
        known = mapped(folder, log, seed)
        begin = WIDE_M * int(rng.integers(3, 5)) + rng.uniform(0.0, WIDE_M)
        for what, until in (("middle", begin + 3 * WIDE_M), ("to the end", end)):
            drive = (Leg(through_m=((until, middle),)),)
            own = replace(robot, start_m=(begin, middle), start_deg=0.0, drive=drive)
            log = folder / "visit.mcap"
            log.unlink(missing_ok=True)
            simulate(replace(scenario, robots={name: own}), log, seed, materials_seed=seed)
            try:
                result = graphslam.smooth(log, **{"known_map.directory": str(known)})
            except EstimationError:
                counts[what][1] += 1
                continue
            truth = read_truth([log], graphslam.load_config()).trajectories
            counts[what][2 if far_off(result, truth) else 0] += 1
    for what, (found, refused, wrong) in counts.items():
        yield f"repeated offices, {what}: {found} found, {refused} refused, {wrong} wrong"


def days(folder: Path, seeds: Sequence[int]) -> Iterator[str]:
    """Lines for the days of each seed, and one for all seeds."""
    means = []
    for seed in seeds:
        own = folder / str(seed)
        own.mkdir()
        found = yield from days_of_seed(own, seed)
        means.append(found)
    each = np.array(means)
    mean = each.mean(axis=0)
    yield (
        f"days, {len(seeds)} seeds: ATE mean of the days {mean[0]:.4f} m as they came, "
        f"{mean[1]:.4f} anew; of further days in the continued map and in that of all days anew:"
    )
    for what, first in (("in the world", 2), ("in the world as told", 4)):
        continued, anew = each[:, first], each[:, first + 1]
        again = np.random.default_rng(0).integers(len(each), size=(RESAMPLED, len(each)))
        ratios = continued[again].mean(axis=1) / anew[again].mean(axis=1)
        low, high = np.percentile(ratios, [2.5, 97.5])
        yield (
            f"  {what} {continued.mean():.4f} and {anew.mean():.4f} m: ratio of means "
            f"{continued.mean() / anew.mean():.2f} (95 % by bootstrap {low:.2f} to {high:.2f}), of "
            f"seeds {(continued / anew).min():.2f} to {(continued / anew).max():.2f}"
        )


def days_of_seed(folder: Path, seed: int) -> Generator[str, None, Array]:
    """Ten days, each of which continues the map of the day before, and all of them anew.

    Returns:
        Mean errors, m: of the days as they came and anew; of further ones in either map, in the
        world, and as the told start has it.
    """
    scenario = load_scenario("office-loop")
    first = folder / "first.mcap"
    simulate(scenario, first, 3000 + seed, materials_seed=seed)
    known = mapped(folder, first, seed)
    logs, continued = [first], []
    for number in range(1, DAYS + 1):
        log = day(folder, scenario, seed, number)
        began = time.process_time()
        try:
            result = graphslam.smooth(
                log,
                output=folder / f"day{number}",
                **{"known_map.directory": str(known), "known_map.update": True},
            )
        except EstimationError as error:
            yield f"days, seed {seed}, day {number}: {error}"
            continue
        took = time.process_time() - began
        logs.append(log)
        known = folder / f"day{number}"
        found = error_in_world(result, log)
        continued.append(found["ate_rmse_m"])
        told, map_now = result.summary["known_map"], load_known_map(known)
        yield (
            f"days, seed {seed}, day {number}: ATE {found['ate_rmse_m']:.4f} m, NEES/dof "
            f"{found['nees_per_dof']:.2f}, {took:.1f} CPU s, {len(map_now.landmarks)} landmarks, "
            f"{len(map_now.places)} places, {told['new']} new, {len(told['retired'])} retired, "
            f"{(known / 'known_map.npz').stat().st_size / 1e6:.2f} MB, widened "
            f"{map_now.known.root.widening:.2f}"
        )
    # sessions are called as their logs
    told = {
        key.replace(".vehicle", ".first"): value for key, value in told_start(first, seed).items()
    }
    truth = read_truth(logs, SAME_PLACE)
    began = time.process_time()
    result = graphslam.smooth(logs, config=SAME_PLACE, output=folder / "anew", **told)
    took = time.process_time() - began
    measured = evaluate(result, truth.trajectories)["robots"]
    anew = [one["final"]["ate_rmse_m"] for name, one in measured.items() if name != "first"]
    frames = len(set(result.summary["frames"].values()))
    off = told_off(first, seed)
    further = np.array([
        [localised(folder / name, log, off) for name in (known.name, "anew")]
        for log in (day(folder, scenario, seed, DAYS + 1 + k) for k in range(FURTHER))
    ])  # fmt: skip
    further = further[~np.isnan(further).any(axis=(1, 2))]
    world, as_told = further.mean(axis=0).T
    means = np.array([np.mean(continued), np.mean(anew), *world, *as_told])
    yield (
        f"days, seed {seed}: {len(continued)} days, ATE mean {means[0]:.4f} m as they came, "
        f"{means[1]:.4f} anew ({frames} frames, {took:.0f} CPU s); {len(further)} further days "
        f"{world[0]:.4f} m in the continued map, {world[1]:.4f} in that of all days anew, as told "
        f"{as_told[0]:.4f} and {as_told[1]:.4f}"
    )
    return means


def day(folder: Path, scenario: Scenario, seed: int, number: int) -> Path:
    """The log of a day on which furniture has been moved."""
    number_of_all = number + 100 * seed
    now = changed(scenario, seed, number)
    return visit(folder, now, number_of_all, DAY_S * number, building=seed)


def told_off(log: Path, seed: int) -> Array:
    """The motion (3,) of the world by which the start that is told is off."""
    ((robot, truth),) = read_truth([log], graphslam.load_config()).trajectories.items()
    told = np.array(told_start(log, seed)[f"start.poses.{robot}"])
    return compose(told, inverse(truth.poses[0]))


def localised(known: Path, log: Path, off: Array) -> tuple[float, float]:
    """Errors of a log in a map, m, in the world and in one moved by ``off`` (3,).

    NaN if where it begins is not found.
    """
    try:
        result = graphslam.smooth(log, **{"known_map.directory": str(known)})
    except EstimationError:
        return float("nan"), float("nan")
    in_world, moved = (float(error_in_world(result, log, by)["ate_rmse_m"]) for by in (None, off))
    return in_world, moved


def error_in_world(result: Result, log: Path, off: Array | None = None) -> Mapping[str, Any]:
    """Errors of a result's final poses, not aligned, in the world or one moved by ``off`` (3,)."""
    truth = read_truth([log], graphslam.load_config()).trajectories
    if off is not None:
        truth = {
            name: replace(one, poses=compose(np.broadcast_to(off, one.poses.shape), one.poses))
            for name, one in truth.items()
        }
    found: Mapping[str, Any] = evaluate(result, truth)["joint"]["final"]
    return found


if __name__ == "__main__":
    main()
