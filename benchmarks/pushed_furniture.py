"""Does furniture that was pushed between two sessions drag the second one?

The simulated lab on two days. On the second all furniture stands a little aside, in one direction,
which is drawn. Biases of surfaces are drawn once for both days, as they are the building's. Both
starts are told, with 2 cm and 0.3 degrees, which are stated, or with --loose are not, so that they
have the default sigmas. The drag is how far the second day lies off in that direction, as the first
day is right: mean over its poses, m. Of several seeds the mean and the largest, without sign, the
number of runs in which the two days are one map, of those that are off by more than 5 cm with a
good verdict, and of those that are not, with a doubtful one.

Run: python benchmarks/pushed_furniture.py [--seeds N] [--first SEED] [--push M ...] [--loose]
"""

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from common import parser
from sessions import DAY_S, SAME_PLACE, later

import graphslam
from graphslam.core.geometry import Array, transform
from graphslam.evaluation.trajectory_metrics import align, pair_poses
from graphslam.logs import read_truth
from graphslam.simulation import load_scenario, simulate

#: m, rad: sigmas of the told starts
START_M, START_RAD = 0.02, 0.005
#: m: who is off by more should not be called good
OFF_M = 0.05


class Drag(NamedTuple):
    """How far the second day lies off where things were pushed to, m; whether it was joined."""

    off_m: float
    is_joined: bool
    is_good: bool

    @property
    def is_silent(self) -> bool:
        """Whether it is wrong, and called good."""
        return self.is_joined and self.is_good and abs(self.off_m) > OFF_M

    @property
    def is_falsely_doubted(self) -> bool:
        """Whether it is right, and not called good."""
        return self.is_joined and not self.is_good and abs(self.off_m) <= OFF_M


def drag(folder: Path, seed: int, push_m: float, *, loose: bool = False) -> Drag:
    """Two days, joined; ``loose``: with the default sigmas of the starts."""
    rng = np.random.default_rng(seed)
    turn = rng.uniform(-np.pi, np.pi)
    direction = np.array([np.cos(turn), np.sin(turn)])
    days = [day(folder, seed, k, k * push_m * direction) for k in range(2)]
    truth = read_truth(days, SAME_PLACE).trajectories
    sigmas = [START_M, START_M, START_RAD]
    told = {
        f"start.poses.{name}": (truth[name].poses[0] + rng.normal(0.0, sigmas)).tolist()
        for name in ("day0", "day1")
    }
    settings = {"start.given_sigma_m": START_M, "start.given_sigma_rad": START_RAD}
    if loose:
        settings = {}
    result = graphslam.smooth(days, config=SAME_PLACE, **told, **settings)
    first, second = (pair_poses(result.robots[d].final, truth[d]) for d in ("day0", "day1"))
    onto: Array = align(first.estimate[:, :2], first.truth[:, :2])
    off = transform(onto, second.estimate[:, :2]) - second.truth[:, :2]
    is_joined = len(set(result.summary["frames"].values())) == 1
    is_good = result.summary["verdict"]["verdict"] == "good"
    return Drag(float(off.mean(axis=0) @ direction), is_joined, is_good)


def day(folder: Path, seed: int, number: int, pushed: Array) -> Path:
    """The log of a day, all boxes and boards ``pushed`` (2,), m."""
    scenario = load_scenario("lab")
    world = scenario.world
    moved = {
        kind: tuple(
            replace(one, center_m=aside(one.center_m, pushed), may_cross=True)
            for one in getattr(world, kind)
        )
        for kind in ("boxes", "boards")
    }
    (robot,) = scenario.robots.values()
    made = replace(scenario, world=replace(world, **moved), robots={"robot": robot})
    simulated = folder / "simulated.mcap"
    simulate(made, simulated, seed=2 * seed + number, materials_seed=seed)
    path = folder / f"day{number}.mcap"
    path.unlink(missing_ok=True)
    later(simulated, path, DAY_S * number)
    simulated.unlink()
    return path


def aside(place: tuple[float, float], pushed: Array) -> tuple[float, float]:
    """A place (2,), pushed by (2,)."""
    x, y = (np.array(place) + pushed).tolist()
    return x, y


def main() -> None:
    """Print a row for each distance."""
    options = parser(__doc__)
    options.add_argument("--seeds", type=int, default=8)
    options.add_argument("--first", type=int, default=0)
    options.add_argument(
        "--push", type=float, nargs="*", default=[0.0, 0.02, 0.05, 0.1, 0.15, 0.25, 0.4]
    )
    options.add_argument("--loose", action="store_true", help="default sigmas of the starts")
    chosen = options.parse_args()
    print("| pushed, mm | mean drag, mm | largest, mm | one map | silent | right, doubted |")
    print("|---|---|---|---|---|---|")
    for push_m in chosen.push:
        with tempfile.TemporaryDirectory() as name:
            seeds = range(chosen.first, chosen.first + chosen.seeds)
            found = [drag(Path(name), seed, push_m, loose=chosen.loose) for seed in seeds]
        sizes = 1e3 * np.abs([one.off_m for one in found])
        joined = sum(one.is_joined for one in found)
        silent = sum(one.is_silent for one in found)
        doubted = sum(one.is_falsely_doubted for one in found)
        row = f"{1e3 * push_m:.0f} | {sizes.mean():.1f} | {sizes.max():.1f}"
        print(f"| {row} | {joined} of {len(found)} | {silent} | {doubted} |", flush=True)


if __name__ == "__main__":
    main()
