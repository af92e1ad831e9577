"""Do posts that were moved between two sessions of sightings, or since a map, drag the second one?

A hall with nine posts, which a robot sights, on two days: bearings and ranges of a sensor, with or
without names. The second day's drive is another one, and some of the posts stand elsewhere. The
first start is told, to 2 mm and 0.2 mrad, the second one is found, or with --told told too. Of
several seeds: sessions that are one map, those of them in which just the moved posts are two
landmarks, the root mean square position error of the second session in the world, m, mean and
largest, its NEES per degree of freedom, and the runs that are off by more than 5 cm with a good
verdict. With --known-map the second day is localised in the result of the first one, with names.

Run: python benchmarks/moved_posts.py [--seeds N] [--first SEED] [--told] [--known-map]
"""

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from common import parser
from sessions import DAY_S, SAME_PLACE, START_SIGMA, later

import graphslam
from graphslam.core.errors import EstimationError
from graphslam.simulation import load_scenario, simulate

#: where the posts stand, m
POSTS = {
    "p1": (2.0, 4.0), "p2": (5.0, 10.5), "p3": (9.0, 7.0), "p4": (12.5, 2.0), "p5": (17.0, 5.0),
    "p6": (15.0, 11.0), "p7": (10.0, 12.5), "p8": (6.0, 0.8), "p9": (1.0, 12.0),
}  # fmt: skip
#: by how much posts are moved, m
MOVES: Sequence[Mapping[str, tuple[float, float]]] = (
    {},
    {"p3": (0.3, -0.2)},
    {"p3": (0.15, -0.1), "p6": (0.15, -0.1)},
    {"p3": (0.3, -0.2), "p6": (0.3, -0.2)},
    {"p3": (0.6, -0.4), "p6": (0.6, -0.4)},
    {"p3": (0.3, -0.2), "p6": (0.3, -0.2), "p9": (0.3, -0.2)},
    {"p1": (-0.2, 0.4), "p5": (-0.2, 0.4), "p8": (-0.2, 0.4)},
)
#: the drives of the two days, through points, m
DRIVES = (
    ((3.0, 2.0), (14.0, 4.0), (16.5, 8.5), (12.0, 10.0), (4.0, 7.0), (3.0, 2.5)),
    ((4.0, 12.3), (4.0, 7.0), (12.0, 10.0), (16.5, 8.5), (14.0, 4.0), (9.0, 4.0)),
)
#: m: who is off by more should not be called good
OFF_M = 0.05
#: what is stated of starts
STATED = {"given_sigma_m": START_SIGMA[0], "given_sigma_rad": START_SIGMA[2]}
SCENARIO = """
[world]
walls = [{{ name = "hall", points_m = [[0, 0], [20, 0], [20, 14], [0, 14]], closed = true }}]
cylinders = [{posts}]
[robots.robot]
start_m = {start}
start_deg = {deg}
body = {{ length_m = 0.5, width_m = 0.4, rear_m = 0.15 }}
drive = [{{ through_m = {through}, speed_m_s = 0.5 }}]
sightings = [{{ of = "landmarks", range_sigma_m = 0.03, identified = {named} }}]
[robots.robot.encoders]
period_s = 0.1
wheel_radius_m = 0.1
axle_m = 0.5
radius_error_left = 0.01
slip_m = 0.003
"""


class Run(NamedTuple):
    """Two days made one map, or not; see the module."""

    is_joined: bool
    is_told_apart: bool
    off_m: float
    nees: float
    is_good: bool


def main(argv: Sequence[str] | None = None) -> None:
    """Print a row for each way in which posts are moved."""
    args = parser(__doc__)
    args.add_argument("--seeds", type=int, default=3)
    args.add_argument("--first", type=int, default=1, metavar="SEED")
    args.add_argument("--told", action="store_true", help="the start of the second day is told")
    args.add_argument(
        "--moves", type=int, default=len(MOVES), help="of the list, the first so many"
    )
    args.add_argument("--known-map", action="store_true", help="in the result of the first day")
    chosen = args.parse_args(argv)
    seeds = range(chosen.first, chosen.first + chosen.seeds)
    print("posts moved     by, m  names  one map  told apart  error, m (largest)   NEES  silent")
    for named in (True,) if chosen.known_map else (True, False):
        for moves in MOVES[: chosen.moves]:
            if chosen.known_map:
                runs = [run_in_map(moves, seed, told=chosen.told) for seed in seeds]
            else:
                runs = [run(moves, seed, named=named, told=chosen.told) for seed in seeds]
            joined = [r for r in runs if r.is_joined]
            by = max((float(np.hypot(*m)) for m in moves.values()), default=0.0)
            off = [r.off_m for r in joined] or [np.nan]
            nees = np.mean([r.nees for r in joined] or [np.nan])
            silent = sum(r.off_m > OFF_M and r.is_good for r in joined)
            told_apart = sum(r.is_told_apart for r in joined)
            print(
                f"{len(moves)} of {len(POSTS)} {by:14.2f}  {'yes' if named else 'no':5}"
                f"  {len(joined)} of {len(runs)}   {told_apart} of {len(joined)}"
                f"      {np.mean(off):.3f} ({max(off):.3f})      {nees:6.2f}  {silent}",
                flush=True,
            )


def run(moves: Mapping[str, tuple[float, float]], seed: int, *, named: bool, told: bool) -> Run:
    """Two days of one hall, of which ``moves`` are in between."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        days = two_days(folder, moves, seed, named=named)
        starts = dict(list(told_starts(seed).items())[: 2 if told else 1])
        result = graphslam.smooth(days, config=SAME_PLACE, start={"poses": starts, **STATED})
        errors = graphslam.evaluate(result)
    found = errors["robots"]["day1"]["final"]
    is_joined = result.summary["frames"]["day1"] == result.summary["world"]
    names = sorted(mark.identity or "" for mark in result.landmarks)
    expected = sorted([*POSTS, *(f"day1.{post}" for post in moves)])
    return Run(
        is_joined,
        names == expected if named else len(names) == len(expected),
        found["ate_rmse_m"] if is_joined else np.nan,
        found["nees_per_dof"] if is_joined else np.nan,
        result.summary["verdict"]["verdict"] == "good",
    )


def run_in_map(moves: Mapping[str, tuple[float, float]], seed: int, *, told: bool) -> Run:
    """The second day of one hall in the result of the first one."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        days = two_days(folder, moves, seed, named=True)
        first, second = told_starts(seed).values()
        known = {"directory": str(folder / "map")}
        start = {"poses": {"robot": first}, **STATED}
        graphslam.smooth(days[0], start=start, output=known["directory"])
        start = {"poses": {"robot": second} if told else {}, **STATED}
        try:
            result = graphslam.smooth(days[1], start=start, known_map=known)
        except EstimationError:  # refused
            return Run(False, False, np.nan, np.nan, False)
        found = graphslam.evaluate(result)["robots"]["robot"]["final"]
    names = sorted(mark.identity or "" for mark in result.landmarks)
    is_told_apart = names == sorted([*POSTS, *(f"robot.{post}" for post in moves)])
    is_good = result.summary["verdict"]["verdict"] == "good"
    return Run(True, is_told_apart, found["ate_rmse_m"], found["nees_per_dof"], is_good)


def two_days(
    folder: Path, moves: Mapping[str, tuple[float, float]], seed: int, *, named: bool
) -> list[Path]:
    """The recordings of both."""
    return [day(folder, k, moves if k else {}, 10 * seed + k, named=named) for k in range(2)]


def told_starts(seed: int) -> dict[str, list[float]]:
    """Where the days begin, as it is told."""
    rng = np.random.default_rng(seed)
    return {
        f"day{k}": (np.array(start_of(drive)) + rng.normal(0.0, START_SIGMA)).tolist()
        for k, drive in enumerate(DRIVES)
    }


def start_of(drive: Sequence[tuple[float, float]]) -> list[float]:
    """Where a drive begins, m, m, rad."""
    (x, y), (to_x, to_y) = drive[:2]
    return [x, y, float(np.arctan2(to_y - y, to_x - x))]


def day(
    folder: Path, k: int, moves: Mapping[str, tuple[float, float]], seed: int, *, named: bool
) -> Path:
    """The recording of one day."""
    posts = ", ".join(
        f'{{ name = "{post}", center_m = [{x}, {y}], radius_m = 0.1 }}'
        for post, (x, y) in POSTS.items()
    )
    x, y, phi = start_of(DRIVES[k])
    path = folder / f"day{k}.toml"
    path.write_text(
        SCENARIO.format(
            posts=posts, start=[x, y], deg=np.degrees(phi), named=str(named).lower(),
            through=[list(point) for point in DRIVES[k][1:]],
        )
    )  # fmt: skip
    scenario = load_scenario(path)
    world = scenario.world
    cylinders = tuple(
        replace(c, center_m=(c.center_m[0] + moves[c.name][0], c.center_m[1] + moves[c.name][1]))
        if c.name in moves
        else c
        for c in world.cylinders
    )
    log, made = folder / "log.mcap", folder / f"day{k}.mcap"
    simulate(replace(scenario, world=replace(world, cylinders=cylinders)), log, seed)
    later(log, made, k * DAY_S)
    log.unlink()
    return made


if __name__ == "__main__":
    main()
