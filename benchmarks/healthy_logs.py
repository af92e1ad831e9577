"""Whether a good result is called good: simulated logs of fresh seeds, and real ones, all healthy.

Simulated: every scenario of the package, patrols of an office (fleet_campaign.py) and named points
(content_faults.py), each with several seeds. Real (--real; GRAPHSLAM_DATA): Intel, ACES, MRCLAM 6,
tinySLAM, Victoria Park and logs/; of all but the last also the halves, and without the first 20 s.
The verdict is that without any truth (the estimate does not know it either), then with that of the
log. A row says both, with their reasons, and the largest error of a robot, aligned, m.

Rows are kept in healthy_logs.jsonl as they are made; an interrupted run goes on there.

Run: python benchmarks/healthy_logs.py [DIR] [--seeds 10] [--first 100] [--only TEXT] [--real]
     python benchmarks/healthy_logs.py DIR --table
exit code 1 if more than 1 in 100 is doubtful, or any is bad.
"""

import json
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from common import DATA, ROOT, command, import_freiburg, parser
from content_faults import marks, write
from fleet_campaign import patrol
from mcap.reader import make_reader

from graphslam.core.config_io import load_config
from graphslam.evaluation.ground_truth import errors_of_run
from graphslam.logs import LogWriter, open_logs, read_truth
from graphslam.logs.containers import open_recording
from graphslam.simulation import load_scenario, simulate
from graphslam.simulation.scenario import ScenarioError
from graphslam.slam.smooth import smooth

SCENARIOS = (
    "lab", "corridor", "two-robots", "robots-in-scans", "office-loop", "two-lasers",
    "long-corridor", "forest", "fleet",
)  # fmt: skip
#: settings without which a scenario shows nothing of a robot, see docs/several-robots.md
SETTINGS = {
    "robots-in-scans": (
        "robots.pioneer.outline=[[-0.22, -0.19], [0.23, -0.19], [0.23, 0.19], [-0.22, 0.19]]",
        "start.poses.pioneer=[1.5, 0, 0]",
        "start.poses.vehicle=[0, 0, 0]",
    )
}
MOST_DOUBTFUL = 0.01
Make = Callable[[Path], None]
#: part of a log -> first and last time, ns, by those of the whole
PARTS: dict[str, Callable[[int, int], tuple[int, int]]] = {
    "first half": lambda begin, end: (begin, (begin + end) // 2),
    "second half": lambda begin, end: ((begin + end) // 2, end),
    "late": lambda begin, end: (begin + 20_000_000_000, end),
}


def made_patrol(path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    while not path.exists():
        with suppress(ScenarioError):  # a way that runs into the furniture: another one
            simulate(patrol(rng), path, seed)


def simulated(seeds: Sequence[int]) -> dict[tuple[str, str], Make]:
    """(kind, name) -> what makes the log."""
    made: dict[tuple[str, str], Make] = {}
    for seed in seeds:
        for kind in SCENARIOS:
            scenario = load_scenario(kind)
            made[kind, f"{kind}-{seed}"] = lambda p, c=scenario, s=seed: simulate(c, p, s)
        made["patrol", f"patrol-{seed}"] = lambda p, s=seed: made_patrol(p, s)
        made["named points", f"points-{seed}"] = lambda p, s=seed: write(marks(s), p)
    return made


def real(folder: Path) -> dict[tuple[str, str], Make]:
    """The same of real logs, and of those that the package comes with."""
    made: dict[tuple[str, str], Make] = {}

    def imported(kind: str, source: Path) -> Make:
        return lambda path: command("import", kind, str(source), "-o", str(path)) and None

    victoria = Path(gtsam.findExampleDataFile("victoria_park.txt"))
    whole = {"victoria-park": imported("isam", victoria)}
    for name in ("intel", "aces"):
        if (DATA / "freiburg").is_dir():
            whole[name] = lambda path, n=name: import_freiburg(n, path.parent) and None
    for source in sorted((DATA / "tinyslam").glob("*.dat.xz")):
        whole[f"tinyslam-{source.name.split('.')[0]}"] = imported("tinyslam", source)
    for source in sorted((DATA / "mrclam").glob("*.tar.xz")):
        whole["mrclam-6"] = imported("mrclam", source)
    for name, make in whole.items():
        made["real", name] = make
        for part in PARTS:
            made["real", f"{name}, {part}"] = lambda p, n=name, m=make, w=part: write_part(
                folder / f"{n}.mcap", m, w, p
            )
    for source in sorted((ROOT / "logs").glob("*.mcap")):
        made["logs/", source.stem] = lambda path, s=source: path.symlink_to(s)
    return made


def write_part(source: Path, make: Make, part: str, path: Path) -> None:
    """Write the messages of a part, as they are, by the time of their recording."""
    if not source.exists():
        make(source)
    with source.open("rb") as stream:
        found = list(make_reader(stream).iter_messages(log_time_order=False))
    times = [message.log_time for _, _, message in found]
    begin, end = PARTS[part](min(times), max(times) + 1)
    with LogWriter(path, open_recording(source).notes) as log:
        for schema, channel, message in found:
            # mounts and true landmarks are told once, at the start
            always = channel.topic in ("/tf_static", "/true_landmarks")
            if always or begin <= message.log_time < end:
                log.encoded(channel.topic, schema.name, message.data, max(message.log_time, begin))


def row_of(kind: str, name: str, path: Path) -> dict[str, Any]:
    """The verdicts on a log."""
    began, settings = time.process_time(), SETTINGS.get(kind, SETTINGS.get(name, ()))
    config = load_config(overrides=settings)
    result = smooth(open_logs([path], config), config)
    alone = result.summary["verdict"]
    row = {"kind": kind, "log": name, "verdict": alone["verdict"], "reasons": alone["reasons"]}
    result.summary["verdict"] = dict(alone)
    errors = errors_of_run(result, read_truth([path], config))
    told = result.summary["verdict"]
    finals = [one.get("final") or {} for one in (errors or {}).get("robots", {}).values()]
    return row | {
        "with_truth": told["verdict"],
        "reasons_with_truth": told["reasons"],
        "error_m": max((one["ate_aligned_rmse_m"] for one in finals), default=None),
        "nees": max((one.get("nees_per_dof") or 0.0 for one in finals), default=None),
        "cpu_s": time.process_time() - began,
    }


def campaign(target: Path, logs: dict[tuple[str, str], Make], only: str) -> list[dict[str, Any]]:
    rows = [json.loads(line) for line in target.read_text().splitlines()] if target.exists() else []
    done = {row["log"] for row in rows}
    with target.open("a") as out:
        for (kind, name), make in logs.items():
            if name in done or only not in f"{kind} {name}":
                continue
            path = target.parent / f"{name}.mcap"
            if not path.exists():
                make(path)
            row = row_of(kind, name, path)
            if kind not in ("real", "logs/"):
                path.unlink()
            rows.append(row)
            out.write(json.dumps(row) + "\n")
            out.flush()
            reasons = "; ".join(reason["text"] for reason in row["reasons_with_truth"])
            print(f"{name:28}{row['verdict']:10}{row['with_truth']:10}{row['error_m']} {reasons}")
    return rows


def table(rows: Sequence[dict[str, Any]]) -> None:
    verdicts: dict[str, Counter[str]] = defaultdict(Counter)
    for row in rows:
        for kind in ("all", row["kind"]):
            verdicts[kind][row["verdict"]] += 1
            verdicts[kind]["with truth"] += row["with_truth"] != "good"
    columns = ("good", "doubtful", "bad")
    print("| logs | number | " + " | ".join(columns) + " | not good with truth |")
    print("|---" * 6 + "|")
    for kind, counts in verdicts.items():
        cells = [sum(counts[c] for c in columns), *(counts[c] for c in (*columns, "with truth"))]
        print(f"| {kind} | " + " | ".join(map(str, cells)) + " |")


def main() -> int:
    options = parser(__doc__)
    options.add_argument("folder", nargs="?", type=Path, help="where rows and logs are kept")
    options.add_argument("--seeds", type=int, default=10)
    options.add_argument("--first", type=int, default=100, help="the first seed")
    options.add_argument("--only", default="", help="logs whose kind and name have this text")
    options.add_argument("--real", action="store_true", help="real logs instead")
    options.add_argument("--table", action="store_true", help="show what is there")
    arguments = options.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = arguments.folder or Path(name)
        folder.mkdir(parents=True, exist_ok=True)
        target = folder / "healthy_logs.jsonl"
        seeds = range(arguments.first, arguments.first + arguments.seeds)
        if arguments.table:
            rows = [json.loads(line) for line in target.read_text().splitlines()]
        else:
            logs = real(folder.resolve()) if arguments.real else simulated(seeds)
            rows = campaign(target, logs, arguments.only)
    table(rows)
    verdicts = Counter(row["verdict"] for row in rows)
    return int(verdicts["bad"] > 0 or verdicts["doubtful"] > MOST_DOUBTFUL * len(rows))


if __name__ == "__main__":
    sys.exit(main())
