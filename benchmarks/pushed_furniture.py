"""Does furniture that was pushed between two sessions drag the second one?

The simulated lab on two days. On the second all furniture stands a little aside, in one direction,
which is drawn. Biases of surfaces are drawn once for both days, as they are the building's. Both
starts are told, with 2 cm and 0.3 degrees, which are stated, or with --loose are not, so that they
have the default sigmas. The drag is how far the second day lies off in that direction, as the first
day is right: mean over its poses, m. Of several seeds the mean and the largest, without sign, the
number of runs in which the two days are one map, of those that are off by more than 5 cm with a
good verdict, and of those that are not, with a doubtful one. With --known-map the second day is
localised in the result of the first one; days that are refused are no one map with it.

Run: python benchmarks/pushed_furniture.py [--seeds N] [--first SEED] [--push M ...] [--turn DEG]
    [--loose] [--known-map]
"""

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from common import parser
from sessions import DAY_S, SAME_PLACE, later

import graphslam
from graphslam.core.errors import EstimationError
from graphslam.core.geometry import Array, transform
from graphslam.core.records import Trajectory
from graphslam.evaluation.trajectory_metrics import align, pair_poses
from graphslam.logs import read_truth
from graphslam.simulation import load_scenario, simulate

#: m, rad: sigmas of the told starts
START_M, START_RAD = 0.02, 0.005
#: m: who is off by more should not be called good
OFF_M = 0.05


class Way(NamedTuple):
    """How the two days are made one map.

    ``is_loose``: with the default sigmas of the starts; ``by_known_map``: the second day localised
    in the first one; ``turn_deg``: furniture is pushed in a direction turned by so much.
    """

    is_loose: bool = False
    by_known_map: bool = False
    turn_deg: float = 0.0


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


def drag(folder: Path, seed: int, push_m: float, way: Way) -> Drag:
    """Two days, made one map."""
    rng = np.random.default_rng(seed)
    turn = rng.uniform(-np.pi, np.pi) + np.radians(way.turn_deg)
    direction = np.array([np.cos(turn), np.sin(turn)])
    days = [day(folder, seed, k, k * push_m * direction) for k in range(2)]
    truth = read_truth(days, SAME_PLACE).trajectories
    sigmas = [START_M, START_M, START_RAD]
    told = {
        f"start.poses.{name}": (truth[name].poses[0] + rng.normal(0.0, sigmas)).tolist()
        for name in ("day0", "day1")
    }
    settings: dict[str, Any] = {
        "start.given_sigma_m": START_M,
        "start.given_sigma_rad": START_RAD,
    }
    if way.is_loose:
        settings = {}
    made = localised if way.by_known_map else joined
    found = made(days, told, settings)
    if found is None:
        return Drag(float("nan"), is_joined=False, is_good=False)
    first, second, is_good = found
    (one, true), (other, true_other) = (
        (pair.estimate[:, :2], pair.truth[:, :2])
        for pair in (pair_poses(first, truth["day0"]), pair_poses(second, truth["day1"]))
    )
    onto: Array = align(one, true)
    off = transform(onto, other) - true_other
    return Drag(float(off.mean(axis=0) @ direction), is_joined=True, is_good=is_good)


def joined(
    days: Sequence[Path], told: Mapping[str, Any], settings: Mapping[str, Any]
) -> tuple[Trajectory, Trajectory, bool] | None:
    """Paths of two sessions and whether the verdict is good; None if they are not one map."""
    result = graphslam.smooth(days, config=SAME_PLACE, **told, **settings)
    if len(set(result.summary["frames"].values())) > 1:
        return None
    first, second = (result.robots[name].final for name in ("day0", "day1"))
    return first, second, result.summary["verdict"]["verdict"] == "good"


def localised(
    days: Sequence[Path], told: Mapping[str, Any], settings: Mapping[str, Any]
) -> tuple[Trajectory, Trajectory, bool] | None:
    """The same of a day that is localised in the result of the first one; None if it is refused."""
    known = days[0].parent / "known"
    starts = [{"start.poses.robot": told[f"start.poses.{name}"]} for name in ("day0", "day1")]
    before = graphslam.smooth(days[0], output=known, force=True, **starts[0], **settings)
    settings = {"known_map.directory": str(known), **starts[1], **settings}
    try:
        after = graphslam.smooth(days[1], **settings)
    except EstimationError:
        return None
    first, second = (result.robots["robot"].final for result in (before, after))
    return first, second, after.summary["verdict"]["verdict"] == "good"


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
    options.add_argument("--turn", type=float, default=0.0, help="degrees, of the direction drawn")
    options.add_argument("--loose", action="store_true", help="default sigmas of the starts")
    options.add_argument("--known-map", action="store_true", help="localised in the first day")
    chosen = options.parse_args()
    way = Way(chosen.loose, chosen.known_map, chosen.turn)
    print("| pushed, mm | mean drag, mm | largest, mm | one map | silent | right, doubted |")
    print("|---|---|---|---|---|---|")
    for push_m in chosen.push:
        with tempfile.TemporaryDirectory() as name:
            seeds = range(chosen.first, chosen.first + chosen.seeds)
            found = [drag(Path(name), seed, push_m, way) for seed in seeds]
        sizes = 1e3 * np.abs([one.off_m for one in found if one.is_joined])
        joined = sum(one.is_joined for one in found)
        silent = sum(one.is_silent for one in found)
        doubted = sum(one.is_falsely_doubted for one in found)
        row = f"{1e3 * push_m:.0f} | {sizes.mean():.1f} | {sizes.max():.1f}"
        print(f"| {row} | {joined} of {len(found)} | {silent} | {doubted} |", flush=True)


if __name__ == "__main__":
    main()
