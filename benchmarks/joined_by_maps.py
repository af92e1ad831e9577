"""A real log cut into two robots whose relative start is unknown: are they joined correctly?

The first half of the log is one robot, the second half another, whose odometry begins at an origin
of its own. They drive in the same building but never see each other, and no landmark has an
identity. Printed are the pose of the second robot's first scan in the frame of the first robot's
first scan, by the run of two robots and by that of the whole log; the estimated start with its
sigmas; and the errors of Kümmerle et al. 2009 over the hand-made relations, separately within the
halves and across them.

`parts` cuts the submaps of each half into five stretches and relates any two of the same half as if
they were of two robots. Both are in one frame, so the correct start is the origin. Two stretches
overlap if at least four submaps of one are within 2 m of a submap of the other.

Run: python benchmarks/joined_by_maps.py [parts] [intel] [aces]
Exit code 1 if a log is not joined, or a part wrongly.
"""

import json
import sys
import tempfile
from collections import Counter
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
from common import FREIBURG, FREIBURG_LOGS, import_freiburg, measured_command, parser
from perturbed_logs import write

from graphslam.core.config import Config, MultiRobotConfig
from graphslam.core.geometry import between
from graphslam.core.records import Message, OdometryPose, Trajectory
from graphslam.evaluation.relation_metrics import Relations, read_relations, relation_errors
from graphslam.logs import open_logs
from graphslam.multi_robot.anonymous_map import AnonymousMap
from graphslam.multi_robot.frame_tree import FrameAssignment
from graphslam.multi_robot.place_recognition import PlaceMap, relate_places
from graphslam.multi_robot.relative_frames import RelativeFrame
from graphslam.pipeline.log_pass import PriorKnowledge
from graphslam.pipeline.pipeline import Pipeline
from graphslam.pipeline.recorded_closures import judge_recorded_closures
from graphslam.pipeline.start_priors import origin, start_poses
from graphslam.results.folder import load
from graphslam.slam.initialisation import anonymous_maps, separate_estimates

NAMES = ("first", "second")
#: stretches of each half; two overlap if so many submaps are so near (m); limits of a correct start
PARTS, OVERLAPPING, OVERLAP_M = 5, 4, 2.0
RIGHT_M, RIGHT_RAD = 0.5, 0.05
#: of the table: headings and their widths
HEADS = (
    ("wall s", 8), ("within: n", 11), ("m", 6), ("°", 8), ("across: n", 10), ("m", 5), ("°", 8)
)  # fmt: skip


def halves(messages: list[Message]) -> tuple[list[Message], int]:
    """The messages as those of two robots, and when the second one begins, ns."""
    middle = (messages[0].time_ns + messages[-1].time_ns) // 2
    renamed = [replace(m, robot=NAMES[m.time_ns >= middle]) for m in messages]
    origin = next(m.pose for m in renamed if isinstance(m, OdometryPose) and m.robot == NAMES[1])
    return [
        replace(m, pose=between(origin, m.pose))
        if isinstance(m, OdometryPose) and m.robot == NAMES[1]
        else m
        for m in renamed
    ], middle


def scans_of(folder: Path) -> Trajectory:
    """The laser's final poses, of all robots together, by their stamps."""
    found = [r.scan_final for r in load(folder).robots.values() if r.scan_final is not None]
    stamps, poses, covs = (
        np.concatenate([getattr(t, name) for t in found]) for name in ("stamps_ns", "poses", "covs")
    )
    order = np.argsort(stamps, kind="stable")
    return Trajectory(stamps[order], poses[order], covs[order])


def errors(relations: Relations, scans: Trajectory, middle: int) -> str:
    """Mean errors within the halves and across."""
    off = relation_errors(relations, scans)
    across = (relations.from_ns >= middle) != (relations.to_ns >= middle)
    cells = []
    for group in (~across, across):
        mean_m, mean_deg = np.nanmean(off[group], axis=0)
        cells.append(f"{np.isfinite(off[group, 0]).sum():6}{mean_m:9.4f}{mean_deg:8.3f}")
    return "".join(cells)


def joined(name: str, folder: Path) -> bool:
    """Print what becomes of one log; whether it is one frame."""
    whole, cut = import_freiburg(name, folder), folder / f"{name}-cut.mcap"
    messages, middle = halves(list(open_logs([whole], Config()).messages()))
    write(messages, cut)
    relations = read_relations(FREIBURG / f"{name}.relations")
    heads = "".join(f"{head:>{width}}" for head, width in HEADS)
    print(f"\n{name:24}{heads}")
    seen = {}
    for label, log in (("one robot", whole), ("two robots", cut)):
        target = folder / f"{log.stem}-result"
        _, used = measured_command("smooth", str(log), "-o", str(target))
        scans = scans_of(target)
        k = int(np.searchsorted(scans.stamps_ns, middle))
        seen[label] = between(scans.poses[0], scans.poses[k])
        print(f"{label:24}{used.wall_s:8.1f}  {errors(relations, scans, middle)}")
    summary = json.loads((folder / f"{cut.stem}-result" / "summary.json").read_text("utf-8"))
    for label, pose in seen.items():
        print(f"first scan of the second, {label:12}" + "".join(f"{v:10.4f}" for v in pose))
    print("start found:", summary.get("starts_found"))
    print("frames:", summary.get("frames"))
    return len(set(summary["frames"].values())) == 1


def seen_alone(log: Path) -> dict[str, AnonymousMap]:
    """What each robot of a log saw by itself."""
    config = Config()
    opened = open_logs([log], config)
    recorded = judge_recorded_closures(opened, config, start_poses(opened, config))
    known = PriorKnowledge(FrameAssignment.separate_frames(opened.robots, origin(config)), recorded)
    pipeline = Pipeline(opened, config, known)
    pipeline.run(lambda _count: None)
    return anonymous_maps(pipeline, separate_estimates(pipeline, pipeline.backend.finish()))


def parts(name: str, folder: Path) -> bool:
    """Print what becomes of pairs of parts; whether none was joined wrongly."""
    whole, cut = import_freiburg(name, folder), folder / f"{name}-cut.mcap"
    write(halves(list(open_logs([whole], Config()).messages()))[0], cut)
    counts: Counter[str] = Counter()
    for seen in (alone.places for alone in seen_alone(cut).values()):
        stretches = np.array_split(np.arange(len(seen.places)), PARTS)
        for pair in combinations(stretches, 2):
            rows = [(3 * part[:, None] + np.arange(3)).ravel() for part in pair]
            maps = [
                PlaceMap([seen.places[n] for n in part], seen.cov[np.ix_(k, k)])
                for part, k in zip(pair, rows, strict=True)
            ]
            found = relate_places("a", "b", *maps, MultiRobotConfig())
            p, q = (np.array([place.pose[:2] for place in one.places]) for one in maps)
            near = np.linalg.norm(p[:, None] - q, axis=-1).min(axis=0) < OVERLAP_M
            kind = "overlapping" if near.sum() >= OVERLAPPING else "others"
            counts[kind] += 1
            if isinstance(found, RelativeFrame):
                right = np.hypot(*found.pose[:2]) < RIGHT_M and abs(found.pose[2]) < RIGHT_RAD
                counts[f"{kind}, joined {'rightly' if right else 'WRONGLY'}"] += 1
    print(f"\n{name}, pairs of parts:", dict(sorted(counts.items())), flush=True)
    return not any("WRONGLY" in kind for kind in counts)


def main() -> int:
    """Print all; 0 if every log was joined, or no part wrongly."""
    options = parser(__doc__)
    options.add_argument("arguments", nargs="*", metavar="parts | LOG")
    arguments = options.parse_args().arguments
    names = [name for name in arguments if name in FREIBURG_LOGS] or list(FREIBURG_LOGS)
    judge = parts if "parts" in arguments else joined
    with tempfile.TemporaryDirectory() as folder:
        good = [judge(name, Path(folder)) for name in names]
    return 0 if all(good) else 1


if __name__ == "__main__":
    sys.exit(main())
