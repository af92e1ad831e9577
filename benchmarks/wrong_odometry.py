"""Odometry that is wrong now and then, with scans to check it and without: one table.

The lab (25 m, forwards and backwards) with its odometry changed: `slip` 0.3 m in one second, every
ten seconds; `unsigned`, counters that do not tell backwards from forwards; `silent`, no reading for
5 s; `stopped`, no reading for 5 s and no count of what was driven then; `late`, its stamps 0.15 s
late. Mean and largest error of the final and the causal base, m, over seeds, and how many motions
the scans contradicted, by `odometry.scan_matching`.

Run: python benchmarks/wrong_odometry.py [--seeds 3]
"""

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from common import parser, simulated_log, smooth_log

from graphslam.core.config_io import load_config
from graphslam.core.geometry import Array, between, compose, exp, log
from graphslam.core.records import Message, OdometryPose, Scan, Truth
from graphslam.logs import LogWriter, open_logs

S = 1_000_000_000
#: seconds since the start, length of the increment (s), its twist -> the twist that is reported,
#: whether the reading is written
Change = Callable[[float, float, Array], tuple[Array, bool]]


def untouched(_seconds: float, _span_s: float, twist: Array) -> tuple[Array, bool]:
    return twist, True


def unsigned(_seconds: float, _span_s: float, twist: Array) -> tuple[Array, bool]:
    return np.array([abs(twist[0]), twist[1], twist[2]]), True


def slip(seconds: float, span_s: float, twist: Array) -> tuple[Array, bool]:
    return twist + np.array([0.3 * span_s * (seconds % 10 < 1), 0, 0]), True


def silent(seconds: float, _span_s: float, twist: Array) -> tuple[Array, bool]:
    return twist, not 30 <= seconds < 35


def stopped(seconds: float, _span_s: float, twist: Array) -> tuple[Array, bool]:
    lost = 30 <= seconds < 35
    return np.zeros(3) if lost else twist, not lost


#: name -> change of the readings, and by how much their stamps are late (s)
CHANGES: dict[str, tuple[Change, float]] = {
    "untouched": (untouched, 0.0),
    "slip": (slip, 0.0),
    "unsigned": (unsigned, 0.0),
    "silent": (silent, 0.0),
    "stopped": (stopped, 0.0),
    "late": (untouched, 0.15),
}


def recorded(seed: int, folder: Path) -> list[Message]:
    """What the lab's robot says, with good odometry."""
    messages = open_logs([simulated_log("lab", seed, folder)], load_config()).messages()
    return [m for m in messages if isinstance(m, OdometryPose | Scan | Truth)]


def run(
    messages: Sequence[Message], name: str, path: Path, *settings: str
) -> tuple[dict[str, Array], dict[str, Any]]:
    """Errors (n,) of final and causal positions, m, and the summary, of a log with a change."""
    how, late_s = CHANGES[name]
    t0 = min(m.time_ns for m in messages)
    last: Message | None = None
    pose, mounted, truth = np.zeros(3), False, []
    with LogWriter(path) as out:
        for m in messages:
            if isinstance(m, Truth):
                truth.append((m.time_ns, *m.pose))
            elif isinstance(m, Scan):
                if not mounted:
                    out.mount(m.robot, t0, m.mount)
                mounted = True
                beams = {"angle_min_rad": m.angle_min_rad, "angle_step_rad": m.angle_step_rad}
                out.scan(m.robot, m.stamp_ns, m.ranges, **beams, range_max_m=32.0)
            elif isinstance(m, OdometryPose):
                before = m if last is None else last
                span_s = (m.time_ns - before.time_ns) / S
                twist, reported = how(
                    (m.time_ns - t0) / S, span_s, log(between(before.pose, m.pose))
                )
                pose, last = compose(pose, exp(twist)), m
                if reported:
                    out.odometry(m.robot, m.stamp_ns + round(late_s * S), pose)
    config = load_config(overrides=["backend.causal=true", *settings])
    result = smooth_log(path, config)
    (robot,) = result.robots.values()
    t, *true = np.array(truth).T
    true[2] = np.unwrap(true[2])
    poses = np.column_stack([np.interp(robot.final.stamps_ns, t, c) for c in true])
    poses = between(poses[0], poses)
    errors = {
        kind: np.hypot(*(getattr(robot, kind).poses - poses)[:, :2].T)
        for kind in ("final", "causal")
    }
    return errors, dict(result.summary)


def main() -> None:
    """Print the table."""
    options = parser(__doc__)
    options.add_argument("--seeds", type=int, default=3)
    seeds = range(options.parse_args().seeds)
    print(f"{'':22}{'final mean':>11}{'max':>8}{'causal mean':>13}{'max':>8}{'contradicted':>14}")
    with tempfile.TemporaryDirectory() as folder:
        logs = [recorded(seed, Path(folder)) for seed in seeds]
        for name in CHANGES:
            for setting in ("off", "auto", "on"):
                runs = [
                    run(log, name, Path(folder) / "t.mcap", f"odometry.scan_matching={setting}")
                    for log in logs
                ]
                values = [
                    f(np.array([f(errors[kind]) for errors, _ in runs]))
                    for kind in ("final", "causal")
                    for f in (np.mean, np.max)
                ]
                odometry = [next(iter(summary["odometry"].values())) for _, summary in runs]
                contradicted, motions = (
                    sum(one[key] for one in odometry) for key in ("contradicted", "motions")
                )
                count = f"{contradicted}/{motions}"
                print(
                    f"{name + ', ' + setting:22}{values[0]:11.3f}{values[1]:8.3f}{values[2]:13.3f}"
                    f"{values[3]:8.3f}{count:>14}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
