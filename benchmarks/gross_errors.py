"""What do gross errors among sightings cost, and does the verdict tell harmless ones from others?

Simulated logs of sightings (`full_information.py`: bearing 1.5 deg, range 3 cm, 17 points) of one
robot with named points, without names, and of three robots with named points; part of the sightings
are changed afterwards. World frame, not aligned, final poses; means over seeds.

outliers     bearing and range of a sighting are drawn evenly from all that the sensor can see
names        the name of a sighting is that of another point
flipping     a pair of points bears each other's names in half of the images, by chance
exchanged    a pair of points bears each other's names from the middle on
moved        a point is 1 m elsewhere from the middle on
bursts       for 5 s of every minute all sightings are outliers
shifted      for 5 s of every minute all ranges are 1 m too long

Errors and NEES per degree of freedom (with its largest) are to be compared with the row "none".
"wrong landmarks": over 0.3 m from the point of their name, or without a name from all points. An
*alarm* is a verdict that is not good; it is *false* if the error is at most 1.5 times that without
the fault, the NEES at most 2, and no landmark wrong. *Silent* is a good verdict with 3 times that
error and a NEES over 4, or with a named landmark that is wrong. "told" is the share of sightings
that the verdict calls gross errors, "true" that which is changed.

Run: python benchmarks/gross_errors.py [KIND ...] [--seeds 10] [--first 0] [--seconds 150]
     [--only TEXT]
exit code 1 if any is silent, or over 1 in 20 with up to 5 % of outliers or names is a false alarm.
"""

import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from common import parser
from full_information import PERIOD_S, START, T0, Log, S, judged, simulated, write

from graphslam.core.config_io import load_config
from graphslam.core.geometry import Array, wrap
from graphslam.core.records import Landmark
from graphslam.logs import open_logs
from graphslam.slam.smooth import smooth

#: kind -> those of `full_information.py`: as it is simulated, and as it is written
KINDS = {"named": ("given", "given"), "unnamed": ("given", "unnamed"), "three": ("three", "three")}
SHARES = (0.01, 0.02, 0.05, 0.1, 0.2, 0.4)
#: of what is seen: rad to either side, m from and to
SIGHT_RAD, NEAR_M, FAR_M = 2.0, 0.3, 8.0
MOVED_M, BURST_S, EVERY_S = 1.0, 5.0, 60.0
#: m: a landmark that is further from its point is wrong
WRONG_M = 0.3
#: error over that without a fault, and NEES: of a false alarm at most, of a silent one at least
HARMLESS, HARMFUL = (1.5, 2.0), (3.0, 4.0)
MOST_FALSE = 0.05

Change = Callable[[Log, np.random.Generator], Log]


# ---------------------------------------------------------------- faults


def changed(log: Log, which: Array, names: Sequence[str], z: Array) -> Log:
    """The log with other names and measurements (n, 2) where ``which`` (n,) says so."""
    seen = [
        (robot, k, names[i], z[i]) if which[i] else (robot, k, name, own)
        for i, (robot, k, name, own) in enumerate(log.seen)
    ]
    return replace(log, seen=seen)


def as_arrays(log: Log) -> tuple[Array, list[str], Array]:
    """When sightings were made, s (n,), their names and their measurements (n, 2)."""
    times = np.array([k * PERIOD_S for _, k, _, _ in log.seen])
    return times, [name for _, _, name, _ in log.seen], np.array([z for *_, z in log.seen])


def drawn(n: int, rng: np.random.Generator) -> Array:
    """Bearings and ranges (n, 2), evenly from all that can be seen."""
    return rng.uniform((-SIGHT_RAD, NEAR_M), (SIGHT_RAD, FAR_M), (n, 2))


def outliers(share: float) -> Change:
    def change(log: Log, rng: np.random.Generator) -> Log:
        _, names, z = as_arrays(log)
        return changed(log, rng.random(len(z)) < share, names, drawn(len(z), rng))

    return change


def wrong_names(share: float) -> Change:
    """Never of one that is in the same image, which an image of named sightings has once."""

    def change(log: Log, rng: np.random.Generator) -> Log:
        _, names, z = as_arrays(log)
        points = [f"p{i}" for i in range(len(log.points))]
        others = [
            rng.choice([p for p in points if p != name]) if name in points else name
            for name in names
        ]
        return changed(log, rng.random(len(z)) < share, others, z)

    return change


def exchanged(since: float, share: float) -> Change:
    """Two neighbours' names, in a share of the images after a share of the log."""

    def change(log: Log, rng: np.random.Generator) -> Log:
        times, names, z = as_arrays(log)
        one, other = pair(log)
        to = {one: other, other: one}
        image = rng.random(len(next(iter(log.drives.values())).poses)) < share
        numbers = np.array([k for _, k, _, _ in log.seen])
        which = image[numbers] & (times >= since * times[-1])
        which &= np.array([name in to for name in names])
        return changed(log, which, [to.get(name, name) for name in names], z)

    return change


def pair(log: Log) -> tuple[str, str]:
    """The two points that are seen most often."""
    _, names, _ = as_arrays(log)
    points, counts = np.unique([name for name in names if name[0] == "p"], return_counts=True)
    one, other = points[np.argsort(-counts, kind="stable")[:2]].tolist()
    return one, other


def moved(log: Log, rng: np.random.Generator) -> Log:
    """The point that is seen most often."""
    times, names, z = as_arrays(log)
    name = pair(log)[0]
    angle = rng.uniform(-np.pi, np.pi)
    place = log.points[int(name[1:])][:2] + MOVED_M * np.array([np.cos(angle), np.sin(angle)])
    which = np.array([own == name for own in names]) & (times >= 0.5 * times[-1])
    for i in np.flatnonzero(which).tolist():
        robot, k, _, own = log.seen[i]
        pose = log.drives[robot].poses[k]
        before, after = (seen_from(pose, p) for p in (log.points[int(name[1:])][:2], place))
        z[i] = own + after - before
    z[:, 0] = wrap(z[:, 0])
    return changed(log, which, names, z)


def seen_from(pose: Array, place: Array) -> Array:
    """Bearing, rad, and range, m."""
    away = place - pose[:2]
    return np.array([wrap(np.arctan2(away[1], away[0]) - pose[2]), np.hypot(*away)])


def bursts(log: Log, rng: np.random.Generator) -> Log:
    times, names, z = as_arrays(log)
    return changed(log, in_burst(times), names, drawn(len(z), rng))


def shifted(log: Log, rng: np.random.Generator) -> Log:
    times, names, z = as_arrays(log)
    return changed(log, in_burst(times), names, z + np.array([0.0, MOVED_M]))


def in_burst(times: Array) -> Array:
    return (times - EVERY_S / 4) % EVERY_S < BURST_S


def faults() -> dict[str, Change]:
    made: dict[str, Change] = {"none": lambda log, _: log}
    made |= {f"outliers {100 * share:.0f} %": outliers(share) for share in SHARES}
    made |= {f"names {100 * share:.0f} %": wrong_names(share) for share in SHARES}
    made |= {"flipping": exchanged(0.0, 0.5), "exchanged": exchanged(0.5, 1.0), "moved": moved}
    return made | {"bursts": bursts, "shifted": shifted}


def is_few(fault: str) -> bool:
    """Whether it is about a few sightings, each by itself, which a kernel is there for."""
    return any(f"{100 * share:.0f} %" == fault.partition(" ")[2] for share in SHARES[:3])


# ---------------------------------------------------------------- runs


class Row(NamedTuple):
    """A run: error m, NEES, shares of gross errors, and what the verdict says."""

    error_m: float
    nees: float
    wrong: int
    wrong_names: int
    true: float
    told: float
    verdict: str
    checks: tuple[str, ...]


def run(log: Log, written: str, true: float, folder: Path) -> Row:
    path = folder / "log.mcap"
    write(path, log, written)
    poses = {name: tuple(own.poses[0] + own.start) for name, own in log.drives.items()}
    config = load_config()
    start = replace(
        config.start, poses=poses, given_sigma_m=float(START[0]), given_sigma_rad=float(START[2])
    )
    config = replace(config, start=start)
    result = smooth(open_logs([path], config), config)
    finals = {name: result.robots[name].final for name in log.drives}
    drives = {
        # a robot's first state is where it is first seen, or sees
        name: replace(own, poses=own.poses[np.rint((at_ns - T0) / (PERIOD_S * S)).astype(int)])
        for name, own in log.drives.items()
        for at_ns in (finals[name].stamps_ns,)
    }
    found = {name: (final.poses, final.covs) for name, final in finals.items()}
    error, nees = judged(replace(log, drives=drives), found)
    wrong = [is_wrong(mark, log) for mark in result.landmarks]
    named = [one for one, mark in zip(wrong, result.landmarks, strict=True) if mark.identity]
    verdict = result.summary["verdict"]
    share = sum(fact["share"] for fact in verdict.get("facts", ())) / len(log.drives)
    reasons = tuple(f"{one['check']}: {one['text']}" for one in verdict["reasons"])
    return Row(error, nees, sum(wrong), sum(named), true, share, verdict["verdict"], reasons)


def is_wrong(mark: Landmark, log: Log) -> bool:
    """Whether a landmark is not where the point of its name is, or without a name where none is."""
    points = log.points[int(mark.identity[1:])][None] if mark.identity else log.points
    return bool(np.hypot(*(points[:, :2] - mark.position[:2]).T).min() > WRONG_M)


def changed_share(log: Log, other: Log) -> float:
    same = [
        one[2] == two[2] and np.array_equal(one[3], two[3])
        for one, two in zip(log.seen, other.seen, strict=True)
    ]
    return 1.0 - float(np.mean(same))


def is_false(row: Row, healthy: Row) -> bool:
    right = row.error_m <= HARMLESS[0] * healthy.error_m and row.nees <= HARMLESS[1]
    return row.verdict != "good" and right and not row.wrong


def is_silent(row: Row, healthy: Row) -> bool:
    wrong = row.error_m > HARMFUL[0] * healthy.error_m and row.nees > HARMFUL[1]
    return row.verdict == "good" and (wrong or row.wrong_names > 0)


def campaign(
    kind: str, seeds: range, seconds: float, only: str, each: bool
) -> dict[str, list[Row]]:
    """Fault -> a row of every seed; that without a fault is first."""
    simulation, written = KINDS[kind]
    rows: dict[str, list[Row]] = {}
    with tempfile.TemporaryDirectory() as name:
        for seed in seeds:
            log = simulated(simulation, seconds, seed)
            for fault, change in faults().items():
                if fault != "none" and only not in fault:
                    continue
                if kind == "unnamed" and not fault.startswith(("none", "outliers", "burst", "shi")):
                    continue
                bad = change(log, np.random.default_rng(seed))
                row = run(bad, written, changed_share(log, bad), Path(name))
                rows.setdefault(fault, []).append(row)
                if each:
                    print(kind, seed, fault, *row, flush=True)
    return rows


def table(kind: str, rows: dict[str, list[Row]]) -> None:
    for fault, found in rows.items():
        healthy = rows["none"]
        error, nees, wrong, _, true, told = np.array([row[:6] for row in found]).mean(axis=0)
        pairs = list(zip(found, healthy, strict=True))
        verdicts = [sum(row.verdict == v for row in found) for v in ("good", "doubtful", "bad")]
        counts = [sum(of(*one) for one in pairs) for of in (is_false, is_silent)]
        cells = [
            kind, fault, f"{100 * true:.1f}", f"{100 * told:.1f}", f"{error:.4f}",
            f"{nees:.2f} ({max(row.nees for row in found):.1f})", f"{wrong:.1f}",
            *map(str, [*verdicts, *counts]),
        ]  # fmt: skip
        print("| " + " | ".join(cells) + " |", flush=True)


def main() -> int:
    options = parser(__doc__)
    options.add_argument("kinds", nargs="*", default=list(KINDS), metavar="KIND")
    options.add_argument("--seeds", type=int, default=10)
    options.add_argument("--first", type=int, default=0, help="the first of the seeds")
    options.add_argument("--seconds", type=float, default=150.0)
    options.add_argument("--only", default="", help="faults that have this text")
    options.add_argument("--each", action="store_true", help="print every run")
    given = options.parse_args()
    columns = (
        "robots", "fault", "true, %", "told, %", "error, m", "NEES (largest)", "wrong landmarks",
        "good", "doubtful", "bad", "false alarms", "silent",
    )  # fmt: skip
    print("| " + " | ".join(columns) + " |\n" + "|---" * len(columns) + "|")
    silent, false, few = 0, 0, 0
    for kind in given.kinds:
        seeds = range(given.first, given.first + given.seeds)
        rows = campaign(kind, seeds, given.seconds, given.only, given.each)
        table(kind, rows)
        for fault, found in rows.items():
            pairs = list(zip(found, rows["none"], strict=True))
            silent += sum(is_silent(*one) for one in pairs)
            if is_few(fault):
                few += len(pairs)
                false += sum(is_false(*one) for one in pairs)
    return int(silent > 0 or false > MOST_FALSE * few)


if __name__ == "__main__":
    sys.exit(main())
