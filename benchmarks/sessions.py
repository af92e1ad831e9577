"""Sessions of one place: Intel cut into three, and five days of a simulated office that changes.

Intel: the log's thirds are joined without a word about where the second and the third begin; the
relations are those between all scans, also of different thirds. Office: every day the robot starts
elsewhere on its round, furniture in the corridors has moved, and on the third day a wall has been
built. Biases of surfaces are drawn once for all days of a seed, as they are the building's. The
start of the first day is told, with an error drawn from its prior, so that the world is that of the
truth; those of the others are found. Errors are of all days together, in the world, not aligned, of
the days that are in one frame with the first. NEES is of all their poses together, with its 99 %
bounds under the stated joint covariance, and its mean with those of all seeds together. Of the
changes from one day to the next those are false that are not near what changed. Timed is the CPU
time.

Run: python benchmarks/sessions.py [intel] [office] [--seeds N] [--first SEED]
"""

import os
import struct
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from common import FREIBURG, parser, pooled_bounds
from mcap.reader import make_reader
from scipy.spatial import cKDTree

import graphslam
from graphslam.core.geometry import Array, unit_vectors
from graphslam.evaluation.metrics import evaluate
from graphslam.evaluation.relation_metrics import read_relations
from graphslam.importers import IMPORTERS
from graphslam.logs import LogWriter, read_truth, schemas
from graphslam.simulation import load_scenario, simulate
from graphslam.simulation.scenario import Leg, Scenario, Wall
from graphslam.simulation.world import Outline, outlines_of

SAME_PLACE = graphslam.load_config(**{"logs.same_place": True})
DAYS, DAY_S = 5, 86_400
#: m: corners of the round through the corridors, and how far furniture moves from where it was
ROUND = ((6.9, 6.1), (20.0, 6.1), (33.1, 6.1), (33.1, 17.9), (20.0, 17.9), (6.9, 17.9))
MOVED_M = 0.6
#: corners of the round on a day
LEGS = 5
#: what stands in the corridors -> where it may be pushed
FURNITURE = {
    "copier": (0.0, -1.0),
    "cabinet": (0.0, 1.0),
    "plant 1": (1.0, 0.0),
    "plant 2": (-1.0, 0.0),
}
#: messages that begin with a header
STAMPED = (
    schemas.LASER_SCAN, schemas.ODOMETRY, schemas.JOINT_STATE, schemas.SIGHTING, schemas.TRUE_POSE,
    schemas.TRUE_LANDMARK,
)  # fmt: skip
#: m, m, rad: what the first day's start is known to. With 10 mrad all days would be 0.3 m off
#: together at the other end of the building, and NEES would be that of a single draw
START_SIGMA = (0.002, 0.002, 0.0002)
#: m: a day whose mean error is larger is joined at a wrong place
WRONG_M = 0.5
#: m: half of what a change shows lies nearer to something that changed, or it is a false one
NEAR_M = 0.2
#: built on the third day, in front of the doors of a room
BUILT = Wall("built", ((14.0, 18.85), (17.5, 18.85)))


def main() -> None:
    """Print what was asked for."""
    options = parser(__doc__)
    options.add_argument("which", nargs="*", default=("intel", "office"))
    options.add_argument("--seeds", type=int, default=20)
    options.add_argument("--first", type=int, default=0)
    chosen = options.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if "intel" in chosen.which:
            print(intel(folder))
        if "office" in chosen.which:
            for line in office(folder, range(chosen.first, chosen.first + chosen.seeds)):
                print(line, flush=True)


def intel(folder: Path) -> str:
    """The relations of Intel's thirds as sessions."""
    log = folder / "intel.mcap"
    IMPORTERS["carmen"](FREIBURG / "intel.clf.bz2", log)
    thirds = list(cut(log, folder, 3))
    result = graphslam.smooth(thirds, config=SAME_PLACE)
    found = evaluate(result, relations=read_relations(FREIBURG / "intel.relations"))["relations"]
    numbers = ", ".join(
        f"{kind} {found[kind]['trans_mean_m']:.4f} m of {found[kind]['n']}"
        for kind in ("all", "local", "loops")
    )
    return f"intel in thirds: frames {result.summary['frames']}; relations: {numbers}"


def cut(log: Path, folder: Path, parts: int) -> Iterator[Path]:
    """A log of one robot in pieces of equal length in time, as they would have been recorded."""
    with log.open("rb") as stream:
        found = [
            (channel.topic, schema.name, message.data, message.log_time)
            for schema, channel, message in make_reader(stream).iter_messages(log_time_order=False)
        ]
    times = [log_time for *_, log_time in found]
    ends = np.linspace(min(times), max(times) + 1, parts + 1).astype(np.int64)
    for part, (begin, end) in enumerate(pairwise(ends.tolist())):
        path = folder / f"part{part}.mcap"
        with LogWriter(path) as made:
            for topic, schema, data, log_time in found:
                if begin <= log_time < end:
                    made.encoded(topic, schema, data, log_time)
        yield path


def office(folder: Path, seeds: Iterable[int]) -> Iterator[str]:
    """A line for each seed, and one for all."""
    errors, nees, poses, found, refused, wrong, seconds = [], [], [], 0, 0, 0, []
    changes, doubtful = np.zeros(2, dtype=np.int64), 0
    bounds: list[Any] = []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        days = [day(folder, seed, number) for number in range(DAYS)]
        truth = read_truth(days, SAME_PLACE)
        told = truth.trajectories["day0"].poses[0] + rng.normal(0.0, START_SIGMA, 3)
        start = {
            "start.poses.day0": [float(x) for x in told],
            "start.given_sigma_m": START_SIGMA[0],
            "start.given_sigma_rad": START_SIGMA[2],
        }
        began = sum(os.times()[:4])
        result = graphslam.smooth(days, config=SAME_PLACE, **start)
        seconds.append(sum(os.times()[:4]) - began)
        frames = result.summary["frames"]
        others = [name for name in frames if name != "day0"]
        together = [name for name in others if frames[name] == "day0"]
        measured = evaluate(result, truth.trajectories)
        own = {name: one["final"]["ate_rmse_m"] for name, one in measured["robots"].items()}
        off = [name for name in together if own[name] is None or own[name] > WRONG_M]
        found, refused = found + len(together) - len(off), refused + len(others) - len(together)
        wrong += len(off)
        joint = measured["joint"]["final"]
        errors.append(joint["ate_rmse_m"])
        nees.append(joint["nees_per_dof"])
        bounds.append(joint["nees_bounds_99"])
        poses.append(joint["effective_poses"])
        now = np.array(told_changes(result.summary["sessions"]["changes"], seed))
        changes += now
        said = [reason["text"] for reason in result.summary["verdict"]["reasons"]]
        doubtful += result.summary["verdict"]["verdict"] != "good"
        yield (
            f"office, seed {seed}: of {len(others)} days {len(together)} joined, {len(off)} wrong; "
            f"ATE {errors[-1]:.4f} m, aligned {joint['ate_aligned_rmse_m']:.4f} m, NEES/dof "
            f"{nees[-1]:.2f} in {bounds[-1][0]:.2f} to {bounds[-1][1]:.2f}; {now.sum()} changes, "
            f"{now[1]} false; {seconds[-1]:.0f} CPU s; {'; '.join(said) or 'good'}"
        )
    low, high = np.array(bounds).T
    least, most = pooled_bounds(poses)
    yield (
        f"office, {len(errors)} seeds: {found} days found, {refused} refused, {wrong} wrong; ATE "
        f"mean {np.mean(errors):.4f} m, worst {np.max(errors):.4f}; NEES/dof mean "
        f"{np.mean(nees):.2f} in {least:.2f} to {most:.2f}, single ones {np.min(nees):.2f} "
        f"to {np.max(nees):.2f}, "
        f"{np.sum(np.array(nees) > high)} above and {np.sum(np.array(nees) < low)} below their "
        f"99 % bounds; {changes.sum()} changes, {changes[1]} false; {doubtful} doubtful; "
        f"{np.mean(seconds):.0f} CPU s"
    )


def told_changes(since: Sequence[Mapping[str, Any]], seed: int) -> tuple[int, int]:
    """How many entries of ``sessions.changes`` are of what changed, and how many are false."""
    counts = [0, 0]
    for entry in since:
        days = [int(entry[key].removeprefix("day")) for key in ("since", "session")]
        there = cKDTree(np.concatenate(list(changed_surfaces(seed, *days))))
        for change in entry["changes"]:
            off_m, _ = there.query(np.array(change["polygon"]))
            counts[bool(np.median(off_m) > NEAR_M)] += 1
    return counts[0], counts[1]


def changed_surfaces(seed: int, before: int, later: int) -> Iterator[Array]:
    """Points (n, 2) on what stands there on one of two days only, m."""
    scenario = load_scenario("office-loop")
    worlds = [
        {one.name: one for one in outlines_of(changed(scenario, seed, number).world)}
        for number in (before, later)
    ]
    for these, others in (worlds, worlds[::-1]):
        for name, one in these.items():
            if name not in others or not np.array_equal(one.points, others[name].points):
                yield surface(one)


def surface(one: Outline) -> Array:
    """Points (n, 2) on an outline, m, near each other."""
    if one.radius_m:
        return one.points + one.radius_m * unit_vectors(np.linspace(0.0, 2 * np.pi, 60))
    return np.concatenate([np.linspace(*face, 200) for face in one.faces])


def day(folder: Path, seed: int, number: int) -> Path:
    """The log of a day: the office as it is then, and the robot that starts anywhere on its round.

    It drives half of the round, in either direction.
    """
    rng = np.random.default_rng([seed, number])
    scenario = load_scenario("office-loop")
    (robot,) = scenario.robots.values()
    begin, back = int(rng.integers(len(ROUND))), bool(rng.integers(2))
    corners = np.roll(np.array(ROUND), -begin, axis=0)[:: -1 if back else 1]
    first, second = corners[:2]
    robot = replace(
        robot,
        start_m=tuple(first.tolist()),
        start_deg=float(np.degrees(np.arctan2(*(second - first)[::-1]))),
        drive=(Leg(through_m=tuple(map(tuple, corners[1:LEGS].tolist()))),),
    )
    made = replace(changed(scenario, seed, number), robots={"robot": robot})
    path = folder / f"day{number}.mcap"
    path.unlink(missing_ok=True)
    simulate(made, folder / "now.mcap", 100 * seed + number, materials_seed=seed)
    later(folder / "now.mcap", path, DAY_S * number)
    (folder / "now.mcap").unlink()
    return path


def changed(scenario: Scenario, seed: int, number: int) -> Scenario:
    """The office on a day: furniture stands elsewhere along its wall, but for the first day."""
    world = scenario.world
    rng = np.random.default_rng([seed, 1000 + number])
    if number:
        boxes, cylinders = (
            tuple(moved(thing, rng.uniform(0.0, MOVED_M)) for thing in things)
            for things in (world.boxes, world.cylinders)
        )
        world = replace(world, boxes=boxes, cylinders=cylinders)
    if number >= 2:
        world = replace(world, walls=(*world.walls, BUILT))
    return replace(scenario, world=world)


def moved(thing: Any, by_m: float) -> Any:
    """A thing, pushed away from the corner if it is in a corridor."""
    along = np.array(FURNITURE.get(thing.name, (0.0, 0.0)))
    x, y = (np.array(thing.center_m) + by_m * along).tolist()
    return replace(thing, center_m=(x, y))


def later(log: Path, target: Path, seconds: int) -> None:
    """The recording as if it had been made so much later."""
    with log.open("rb") as stream, LogWriter(target) as made:
        for schema, channel, message in make_reader(stream).iter_messages(log_time_order=False):
            data = message.data
            if schema.name in STAMPED:
                (stamp,) = struct.unpack_from("<i", data, 4)
                data = data[:4] + struct.pack("<i", stamp + seconds) + data[8:]
            made.encoded(channel.topic, schema.name, data, message.log_time + seconds * 10**9)


if __name__ == "__main__":
    main()
