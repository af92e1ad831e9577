"""Whether a wrong map is called good: logs with one fault in their contents each.

Every fault is put into several short logs, simulated and real (GRAPHSLAM_DATA; those that are not
there are left out), at several sizes and times. A row says what the verdict was, with its reasons,
and how far the result is from the truth (where a log has none, from the result of the healthy log).
A row is *right* if its error is at most 5 times that of the healthy log, *named* if the verdict is
doubtful or bad and one of its reasons is of the right kind, and *wrong* else; *silent* is a
good verdict with an error over 5 times the healthy one.

Rows are kept in content_faults.jsonl as they are made, and an interrupted run goes on there.

Run: python benchmarks/content_faults.py [DIR] [--only TEXT] [--table]
exit code 1 if fewer than 90 % are right or named, or any is silent.
"""

import itertools
import json
import sys
import tempfile
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from common import DATA, import_freiburg, parser

from graphslam.core.config import Config
from graphslam.core.config_io import load_config
from graphslam.core.errors import GraphSlamError
from graphslam.core.geometry import Array, between, compose
from graphslam.core.records import (
    Message,
    OdometryIncrement,
    OdometryPose,
    RelativePose,
    Result,
    Scan,
    Sighting,
    Trajectory,
    Truth,
    WheelAngles,
)
from graphslam.logs import LogWriter, open_logs
from graphslam.pipeline.robot_settings import make_tracks
from graphslam.simulation import load_scenario, simulate
from graphslam.slam.smooth import smooth

S = 1_000_000_000
ALLOWED, WANTED = 5.0, 0.9
#: m: a healthy result is not better than this, so that few millimetres are no fault
FLOOR_M = 0.03
Messages = list[Message]
ODOMETRY = (OdometryPose, OdometryIncrement, WheelAngles)


# ---------------------------------------------------------------- logs


def marks(seed: int) -> Messages:
    """40 s of a robot among 24 named points: poses of odometry at 10 Hz, sightings at 2 Hz."""
    rng = np.random.default_rng(seed)
    points = rng.uniform((-7, -4), (7, 10), (24, 2))
    pose, odometry, made = np.zeros(3), np.zeros(3), []
    for k in range(400):
        time = (k + 10) * S // 10
        made.append(Truth("robot", time, time, pose))
        made.append(OdometryPose("robot", time, time, odometry))
        if k % 5 == 0:
            for n, point in enumerate(points):
                away = point - pose[:2]
                distance = float(np.hypot(*away))
                bearing = float(np.arctan2(away[1], away[0]) - pose[2])
                bearing = (bearing + np.pi) % (2 * np.pi) - np.pi
                if distance < 8 and abs(bearing) < 1.8:
                    z = np.array([bearing, distance]) + rng.normal(0, (0.01, 0.03))
                    cov = np.diag([1e-4, 9e-4])
                    made.append(Sighting("robot", time, time, z, cov, f"p{n}", None, np.zeros(3)))
        step = np.array([0.07, 0.0, 0.018 + 0.035 * np.sin(0.04 * k)])
        pose = compose(pose, step)
        odometry = compose(odometry, step + rng.normal(0, (0.002, 0.0005, 0.003)))
    return made


def simulated(scenario: str, seed: int, seconds: float = 1e9) -> Messages:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "log.mcap")
        simulate(load_scenario(scenario), path, seed)
        return recorded(path, 0.0, seconds)


def recorded(path: Path, begin_s: float = 0.0, end_s: float = 1e9) -> Messages:
    """Some seconds of a log; wheels' odometry as the poses that it amounts to."""
    log = open_logs([path], Config())
    messages = list(log.messages())
    first = messages[0].time_ns
    messages = [m for m in messages if begin_s <= (m.time_ns - first) * 1e-9 <= end_s]
    tracks = make_tracks(log, Config())
    for message in messages:
        if isinstance(message, ODOMETRY):
            tracks[message.robot].add(message)
    found: Messages = []
    for message in messages:
        if isinstance(message, WheelAngles):
            pose = tracks[message.robot].pose(np.array([message.time_ns]))[0]
            found.append(OdometryPose(message.robot, message.stamp_ns, message.time_ns, pose))
        else:
            found.append(message)
    return found


def logs(folder: Path) -> dict[str, Callable[[], Messages]]:
    made: dict[str, Callable[[], Messages]] = {
        "marks": lambda: marks(0),
        "marks-2": lambda: marks(1),
        "lab": lambda: simulated("lab", 0),
        "corridor": lambda: simulated("corridor", 0, 30.0),
    }
    if (DATA / "freiburg").is_dir():
        made["intel"] = lambda: recorded(import_freiburg("intel", folder), 60.0, 110.0)
        made["aces"] = lambda: recorded(import_freiburg("aces", folder), 60.0, 110.0)
    return made


def write(messages: Messages, path: Path) -> None:
    with LogWriter(path) as log:
        for mount in {m.robot: m for m in messages if isinstance(m, Scan)}.values():
            log.mount(mount.robot, messages[0].time_ns, mount.mount)
        for m in messages:
            where, logged = (m.robot, m.stamp_ns), {"log_time_ns": m.time_ns}
            if isinstance(m, OdometryPose):
                log.odometry(*where, m.pose, **logged)
            elif isinstance(m, Scan):
                ranges = np.where(np.isfinite(m.ranges), m.ranges, np.inf)
                log.scan(
                    *where, ranges, angle_min_rad=m.angle_min_rad, range_max_m=80.0,
                    angle_step_rad=m.angle_step_rad, **logged,
                )  # fmt: skip
            elif isinstance(m, Sighting):
                log.sighting(
                    *where, m.z, m.cov, identity=m.identity, seen_robot=m.seen_robot, **logged
                )
            elif isinstance(m, RelativePose):
                log.relative_pose(
                    m.robot, m.start_ns, m.stamp_ns, delta=m.delta, cov=m.cov, other=m.other
                )
            elif isinstance(m, Truth):
                log.truth(*where, m.pose, **logged)


# ---------------------------------------------------------------- faults


def each(
    messages: Messages, kind: type, change: Callable[[Any], Message | None], since: float = 0.0
) -> Messages:
    """The messages of a kind changed, from a share of the log on; None leaves one out."""
    begin, end = messages[0].time_ns, messages[-1].time_ns
    from_ns = begin + since * (end - begin)
    made = [change(m) if isinstance(m, kind) and m.time_ns >= from_ns else m for m in messages]
    return [m for m in made if m is not None]


def at(messages: Messages, share: float) -> int:
    return int(messages[0].time_ns + share * (messages[-1].time_ns - messages[0].time_ns))


def moved(
    messages: Messages, change: Callable[[Array, int], Array], since: float = 0.0
) -> Messages:
    """Odometry of changed motions: ``change`` of the motion (3,) since the last one, its number."""
    poses: dict[str, tuple[Array, Array]] = {}
    number = itertools.count()

    def one(m: OdometryPose) -> Message:
        last, made = poses.get(m.robot, (m.pose, m.pose))
        step = between(last, m.pose)
        if m.time_ns >= at(messages, since):
            step = change(step, next(number))
        poses[m.robot] = m.pose, compose(made, step)
        return replace(m, pose=poses[m.robot][1])

    return each(messages, OdometryPose, one)


def jumped(messages: Messages, jump: tuple[float, float, float], share: float) -> Messages:
    return moved(messages, lambda step, n: compose(step, np.array(jump)) if n == 0 else step, share)


def sighted(
    messages: Messages, change: Callable[[Sighting], Message | None], since: float = 0.0
) -> Messages:
    return each(messages, Sighting, change, since)


def repeated(messages: Messages, kind: type, since: float) -> Messages:
    """The last message of a kind again and again: what a driver does that lost its sensor."""
    last: dict[str, Any] = {}

    def one(m: Any) -> Message:
        first = last.setdefault(m.robot, m)
        if kind is Scan:
            return replace(m, ranges=first.ranges)
        return replace(m, pose=first.pose)

    return each(messages, kind, one, since)


def held_images(messages: Messages, since: float) -> Messages:
    """Sightings repeat those of one image."""
    begin = at(messages, since)
    stamps = sorted({m.stamp_ns for m in messages if isinstance(m, Sighting)})
    first = next(s for s in stamps if s >= begin)
    image = [m for m in messages if isinstance(m, Sighting) and m.stamp_ns == first]
    kept = [m for m in messages if not isinstance(m, Sighting) or m.time_ns < begin]
    late = [s for s in stamps if s >= begin]
    kept += [replace(m, stamp_ns=s, time_ns=s) for s in late for m in image]
    return sorted(kept, key=lambda m: m.time_ns)


def exchanged(messages: Messages, since: float, shift: int) -> Messages:
    names = sorted({m.identity for m in messages if isinstance(m, Sighting) and m.identity})
    other = {name: names[(k + shift) % len(names)] for k, name in enumerate(names)}
    return sighted(messages, lambda m: replace(m, identity=other[m.identity]), since)


def thinned(messages: Messages, kind: Any, period_s: float, since: float = 0.0) -> Messages:
    last: dict[str, int] = {}

    def one(m: Any) -> Message | None:
        if m.time_ns - last.get(m.robot, -1 << 60) < period_s * S:
            return None
        last[m.robot] = m.time_ns
        return m

    return each(messages, kind, one, since)


def shifted(messages: Messages, kind: type, offset_s: float, since: float = 0.0) -> Messages:
    """Stamps of a sensor that are wrong by an offset; recorded when they say."""
    offset = round(offset_s * S)
    made = each(
        messages,
        kind,
        lambda m: replace(m, stamp_ns=m.stamp_ns + offset, time_ns=m.time_ns + offset),
        since,
    )
    return sorted((m for m in made if m.time_ns > 0), key=lambda m: m.time_ns)


def lying(m: Scan, factor: float) -> Scan:
    return replace(m, ranges=m.ranges * factor)


def spaced(m: Scan, factor: float) -> Scan:
    return replace(
        m, angle_min_rad=factor * m.angle_min_rad, angle_step_rad=factor * m.angle_step_rad
    )


def mirrored_scan(m: Scan) -> Scan:
    return replace(m, ranges=m.ranges[::-1].copy())


class Fault(NamedTuple):
    """What is done, and words of reasons that name it."""

    change: Callable[[Messages], Messages]
    names: tuple[str, ...]
    needs: type = OdometryPose


def faults() -> dict[str, Fault]:
    made: dict[str, Fault] = {}
    odo = ("odometry",)
    see = ("sighting", "bearing", "range", "landmark")
    lid = ("scan", "laser")
    for since in (0.0, 0.3, 0.5, 0.7):
        w = f" from {since}"
        made["odometry frozen" + w] = Fault(lambda m, s=since: repeated(m, OdometryPose, s), odo)
        made["odometry heading negated" + w] = Fault(
            lambda m, s=since: moved(m, lambda d, _: d * (1, -1, -1), s), odo
        )
        made["odometry backwards" + w] = Fault(
            lambda m, s=since: moved(m, lambda d, _: d * (-1, 1, 1), s), odo
        )
        made["bearings negated" + w] = Fault(
            lambda m, s=since: sighted(m, lambda a: replace(a, z=a.z * (-1, 1)), s), see, Sighting
        )
        made["bearings 0.5 rad off" + w] = Fault(
            lambda m, s=since: sighted(m, lambda a: replace(a, z=a.z + np.array([0.5, 0.0])), s),
            see,
            Sighting,
        )
        made["ranges doubled" + w] = Fault(
            lambda m, s=since: sighted(m, lambda a: replace(a, z=a.z * (1, 2)), s), see, Sighting
        )
        made["identities exchanged" + w] = Fault(
            lambda m, s=since: exchanged(m, s, 5), see, Sighting
        )
        made["images repeated" + w] = Fault(lambda m, s=since: held_images(m, s), see, Sighting)
        made["laser repeats a scan" + w] = Fault(lambda m, s=since: repeated(m, Scan, s), lid, Scan)
        made["scans mirrored" + w] = Fault(
            lambda m, s=since: each(m, Scan, mirrored_scan, s), lid, Scan
        )
        made["ranges of scans doubled" + w] = Fault(
            lambda m, s=since: each(m, Scan, lambda a: lying(a, 2.0), s), lid, Scan
        )
    for name, scale in (
        ("mm", 1000.0),
        ("cm", 100.0),
        ("km", 0.001),
        ("twice", 2.0),
        ("half", 0.5),
    ):
        made[f"odometry in {name}"] = Fault(
            lambda m, k=scale: moved(m, lambda d, _: d * (k, k, 1)), odo
        )
        made[f"ranges of sightings in {name}"] = Fault(
            lambda m, k=scale: sighted(m, lambda a: replace(a, z=a.z * (1, k))), see, Sighting
        )
    for percent in (-2, 2):
        made[f"beams {percent:+d} % apart"] = Fault(
            lambda m, k=1 + 0.01 * percent: each(m, Scan, lambda a: spaced(a, k)), lid, Scan
        )
    made["odometry heading in degrees"] = Fault(
        lambda m: moved(m, lambda d, _: d * (1, 1, 57.3)), odo
    )
    made["bearings in degrees"] = Fault(
        lambda m: sighted(m, lambda a: replace(a, z=a.z * (180 / np.pi, 1))), see, Sighting
    )
    made["bearings 3 degrees off"] = Fault(
        lambda m: sighted(m, lambda a: replace(a, z=a.z + np.array([np.radians(3.0), 0.0]))),
        see,
        Sighting,
    )
    made["one name for all"] = Fault(
        lambda m: sighted(m, lambda a: replace(a, identity="x")), see, Sighting
    )
    for share in (0.25, 0.5, 0.75):
        for jump in ((0.3, 0, 0), (0, 0.5, 0), (2, 1, 0), (0, 0, 2.0), (0, 0, 0.7), (-1, 0, 3.0)):
            made[f"odometry jumps by {jump} at {share}"] = Fault(
                lambda m, j=jump, s=share: jumped(m, j, s), odo
            )
    for period in (2.0, 5.0, 10.0):
        made[f"scans every {period} s"] = Fault(lambda m, p=period: thinned(m, Scan, p), lid, Scan)
        made[f"odometry every {period} s"] = Fault(
            lambda m, p=period: thinned(m, OdometryPose, p), odo
        )
    for offset in (-1.5, -0.7, 0.7, 1.5):
        made[f"scans stamped {offset} s off"] = Fault(
            lambda m, o=offset: shifted(m, Scan, o), (*lid, "stamp", "clock", "odometry"), Scan
        )
        made[f"sightings stamped {offset} s off"] = Fault(
            lambda m, o=offset: shifted(m, Sighting, o),
            (*see, "stamp", "clock", "odometry"),
            Sighting,
        )
    for gap in (10.0, 28.0):
        made[f"odometry missing for {gap} s"] = Fault(
            lambda m, g=gap: [
                a for a in m
                if not (isinstance(a, OdometryPose) and 0 < a.time_ns - at(m, 0.4) < g * S)
            ],
            odo,
        )  # fmt: skip
    return made


# ---------------------------------------------------------------- runs


class Outcome(NamedTuple):
    """A run: its result or what refused it."""

    result: Result | None
    error: str


def run(messages: Messages, folder: Path) -> Outcome:
    path = folder / "log.mcap"
    try:
        write(messages, path)
        config = load_config()
        return Outcome(smooth(open_logs([path], config), config), "")
    except GraphSlamError as error:
        return Outcome(None, str(error))
    finally:
        path.unlink(missing_ok=True)


def truth_of(messages: Messages, healthy: Result) -> dict[str, Trajectory]:
    """True trajectories; where there are none those of the healthy result."""
    found: dict[str, Trajectory] = {}
    for name, robot in healthy.robots.items():
        own = [m for m in messages if isinstance(m, Truth) and m.robot == name]
        if own:
            stamps = np.array([m.stamp_ns for m in own], dtype=np.int64)
            poses = np.array([m.pose for m in own])
            found[name] = Trajectory(stamps, poses, np.zeros((len(own), 3, 3)))
        else:
            found[name] = robot.final
    return found


def error_m(result: Result, truth: dict[str, Trajectory]) -> float:
    """Root mean square distance of aligned positions, the worst of the robots, m."""
    worst = 0.0
    for name, known in truth.items():
        if name not in result.robots:
            return float("inf")
        final = result.robots[name].final
        inside = (final.stamps_ns >= known.stamps_ns[0]) & (final.stamps_ns <= known.stamps_ns[-1])
        stamps, poses = final.stamps_ns[inside], final.poses[inside]
        if len(stamps) < 3:
            return float("inf")
        nearest = np.clip(np.searchsorted(known.stamps_ns, stamps), 0, len(known) - 1)
        near = np.abs(known.stamps_ns[nearest] - stamps) < S // 5
        a, b = poses[near], known.poses[nearest][near]
        if len(a) < 3:
            return float("inf")
        worst = max(worst, aligned_error(a[:, :2], b[:, :2]))
    return worst


def aligned_error(a: Array, b: Array) -> float:
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    turn = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    c, s = np.cos(turn), np.sin(turn)
    return float(np.sqrt((((a @ np.array([[c, s], [-s, c]])) - b) ** 2).sum(axis=1).mean()))


def row_of(
    log: str, name: str, fault: Fault, outcome: Outcome, wrong: float, healthy: float
) -> dict[str, Any]:
    row = {
        "log": log,
        "fault": name,
        "error_m": wrong,
        "healthy_m": healthy,
        "refused": outcome.error,
    }
    if outcome.result is None:
        named = any(word in outcome.error.lower() for word in fault.names)
        return row | {"verdict": "refused", "reasons": [outcome.error], "named": named}
    verdict = outcome.result.summary["verdict"]
    reasons = [reason["text"] for reason in verdict["reasons"]]
    named = any(word in text.lower() for text in reasons for word in fault.names)
    return row | {"verdict": verdict["verdict"], "reasons": reasons, "named": named}


def kind_of(row: dict[str, Any]) -> str:
    allowed = ALLOWED * max(row["healthy_m"], FLOOR_M)
    if row["verdict"] != "good":
        return "named" if row["named"] else "misnamed"
    return "right" if row["error_m"] <= allowed else "silent"


def cases(folder: Path, only: str) -> Iterator[tuple[str, str, Callable[[], Messages], Fault]]:
    for log, load in logs(folder).items():
        for name, fault in faults().items():
            if only in f"{log} {name}":
                yield log, name, load, fault


def campaign(target: Path, only: str) -> list[dict[str, Any]]:
    rows = [json.loads(line) for line in target.read_text().splitlines()] if target.exists() else []
    done = {(row["log"], row["fault"]) for row in rows}
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as name, target.open("a") as out:
        folder = Path(name)
        for log, group in itertools.groupby(cases(folder, only), key=lambda case: case[0]):
            left = [case for case in group if (log, case[1]) not in done]
            if not left:
                continue
            messages = left[0][2]()
            healthy = run(messages, folder)
            assert healthy.result is not None, healthy.error
            truth = truth_of(messages, healthy.result)
            own = error_m(healthy.result, truth)
            for _, fault_name, _, fault in left:
                if not any(isinstance(m, fault.needs) for m in messages):
                    continue
                outcome = run(fault.change(messages), folder)
                wrong = float("inf") if outcome.result is None else error_m(outcome.result, truth)
                row = row_of(log, fault_name, fault, outcome, wrong, own)
                rows.append(row)
                out.write(json.dumps(row) + "\n")
                out.flush()
                print(f"{log:10}{fault_name:42}{wrong:9.3f} {row['verdict']:9}{kind_of(row)}")
    return rows


def table(rows: Sequence[dict[str, Any]]) -> None:
    by_log: dict[str, Counter[str]] = defaultdict(Counter)
    for row in rows:
        by_log[row["log"]][kind_of(row)] += 1
        by_log["all"][kind_of(row)] += 1
    kinds = ("right", "named", "misnamed", "silent")
    print("| log | faults | " + " | ".join(kinds) + " |\n|---|---|" + "---|" * len(kinds))
    for log, counts in by_log.items():
        cells = " | ".join(str(counts[kind]) for kind in kinds)
        print(f"| {log} | {sum(counts.values())} | {cells} |")


def main() -> int:
    options = parser(__doc__)
    options.add_argument("folder", nargs="?", default=".", type=Path)
    options.add_argument("--only", default="", help="cases whose log and fault have this text")
    options.add_argument("--table", action="store_true", help="show what is there")
    arguments = options.parse_args()
    target = arguments.folder / "content_faults.jsonl"
    if arguments.table:
        rows = [json.loads(line) for line in target.read_text().splitlines()]
    else:
        rows = campaign(target, arguments.only)
    table(rows)
    counts = Counter(map(kind_of, rows))
    good = counts["right"] + counts["named"]
    return int(good < WANTED * len(rows) or counts["silent"] > 0)


if __name__ == "__main__":
    sys.exit(main())
