"""Sightings of robots under false names, of nothing, and without names: what becomes of them.

Two robots that pass each other and a third one that watches them (`benchmarks/passing.toml`, logs
of sightings), and the scenario `fleet` (five robots with lasers and clocks of their own). Logs of
one seed differ in what the sightings of robots say, nothing else:

  named      every sighting under the right name
  exchanged  a tenth of the sightings of robots under the name of another one
  false      for each ten sightings of a robot one of nothing, under any name
  unnamed    robots without names
  both       robots without names, and false sightings
  untold     nothing says which of robots and landmarks was seen, nor whether robot or landmark

Errors are root mean squares over all robots, means over the seeds; of what is false (under a false
name, or of nothing) the share that is not used so, of what is true the share that is not used, and
of all used the share that is of another target.

Run: python benchmarks/robot_names.py [passing|fleet ...] [--seeds N] [--rows NAME ...]
"""

import tempfile
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
from common import parser

from graphslam.core.config import Config
from graphslam.core.config_io import load_config
from graphslam.evaluation.metrics import evaluate
from graphslam.logs import open_logs, read_true_associations, read_truth
from graphslam.pipeline.smoothing_job import SmoothingJob
from graphslam.results.folder import load, save
from graphslam.simulation import Scenario, load_scenario, simulate
from graphslam.slam.final_result import make_result
from graphslam.slam.initialisation import initialise
from graphslam.slam.passes import FinishedPass, run_passes
from graphslam.slam.sighting_passes import run_sighting_passes

SCENARIOS = {"passing": Path(__file__).with_name("passing.toml"), "fleet": "fleet"}
#: what changes in the sensors of robots; those of landmarks change in `untold` alone
ROWS = {
    "named": {},
    "exchanged": {"exchanged_share": 0.1},
    "false": {"false_share": 0.1},
    "unnamed": {"identified": False},
    "both": {"identified": False, "false_share": 0.1},
    "untold": {"identified": False, "told_apart": False},
}
BACKENDS = {"smoother": "batch", "EKF": "ekf"}


def changed(scenario: Scenario, row: str) -> Scenario:
    """The scenario with the sightings of a row."""
    robots = {
        name: replace(
            robot,
            sightings=tuple(
                replace(sensor, **ROWS[row]) if sensor.of == "robots" or row == "untold" else sensor
                for sensor in robot.sightings
            ),
        )
        for name, robot in scenario.robots.items()
    }
    return replace(scenario, robots=robots)


def solved(log: Path, config: Config) -> FinishedPass:
    """A log solved as `smooth` does it; the pass has the sightings behind the associations."""
    opened = open_logs([log], config)
    known = initialise(opened, config)
    job = SmoothingJob(opened, config)
    found = run_sighting_passes(job, known)
    return found or run_passes(job, known)


def fates(log: Path, finished: FinishedPass) -> Counter[str]:
    """How many sightings of robots were true and false, used and not."""
    one = finished.pipeline
    config = load_config()
    recorded = [m for m in open_logs([log], config).messages() if hasattr(m, "seen_robot")]
    truths = read_true_associations([log], config)
    said: dict[tuple[str, float], tuple[str, str]] = {}
    for robot in one.log.robots:
        images = truths.get(f"/{robot}/true_associations/sightings", ())
        true = [m.names[t] if t >= 0 else "" for m in images for t in m.targets]
        own = [m for m in recorded if m.robot == robot]
        for message, target in zip(own, true, strict=True):
            said[robot, float(message.z[1])] = message.seen_robot or "", target
    sightings = one.sources or one.robot_sightings
    used = {
        (a.robot, float(sightings[a.source].z[1])): a.target
        for step in one.steps
        for a in step.associations
        if a.source is not None
    }
    count: Counter[str] = Counter()
    for key, (name, target) in said.items():
        is_false = target == "" or (name != "" and name != target)
        if not is_false and target not in one.log.robots:
            continue  # a landmark
        count["false" if is_false else "true"] += 1
        if isinstance(used.get(key), str):
            count["used"] += 1
            count["wrong"] += used[key] != target
            count["false used" if is_false else "true used"] += 1
    return count


def run(log: Path, backend: str, folder: Path) -> tuple[dict[str, float], Counter[str]]:
    """Errors and fates of one run."""
    config = load_config(overrides=["start.from_truth=true", f"backend.name={backend}"])
    began = time.perf_counter()
    finished = solved(log, config)
    counts = fates(log, finished)
    save(make_result(finished, began), folder, force=True)
    truth = read_truth([log], config)
    found = evaluate(load(folder), truth.trajectories, truth.landmarks)
    final, causal = found["joint"]["final"], found["joint"]["causal"]
    errors = {
        "final": final["ate_rmse_m"],
        "nees": final["nees_per_dof"],
        "causal": causal["ate_rmse_m"],
        "extra": found["landmarks"]["extra"],
    }
    return errors, counts


def share(part: int, whole: int) -> str:
    """A share in percent; a dash without anything."""
    return f"{100 * part / whole:.1f}" if whole else "-"


def main() -> None:
    """Print the tables."""
    options = parser(__doc__)
    options.add_argument("scenarios", nargs="*", choices=[[], *SCENARIOS], default=[])
    options.add_argument("--seeds", type=int, default=20)
    options.add_argument("--rows", nargs="*", choices=list(ROWS), default=list(ROWS))
    given = options.parse_args()
    print(
        "| | | final, m | NEES/dof | causal, m | false rejected, % | true rejected, % |"
        " wrong robot, % |\n|---|---|---|---|---|---|---|---|",
        flush=True,
    )
    with tempfile.TemporaryDirectory() as scratch:
        for name in given.scenarios or SCENARIOS:
            scenario = load_scenario(SCENARIOS[name])
            for row in given.rows:
                errors: dict[str, list[dict[str, float]]] = {label: [] for label in BACKENDS}
                counts = {label: Counter[str]() for label in BACKENDS}
                for seed in range(given.seeds):
                    log = Path(scratch) / "log.mcap"
                    simulate(changed(scenario, row), log, seed)
                    for label, backend in BACKENDS.items():
                        found, fate = run(log, backend, Path(scratch) / "result")
                        errors[label].append(found)
                        counts[label] += fate
                for label, n in counts.items():
                    mean = {k: np.mean([e[k] for e in errors[label]]) for k in errors[label][0]}
                    false, true = (
                        share(n[kind] - n[f"{kind} used"], n[kind]) for kind in ("false", "true")
                    )
                    print(
                        f"| {name} {row} | {label} | {mean['final']:.4f} | {mean['nees']:.2f} "
                        f"| {mean['causal']:.4f} | {false} | {true} "
                        f"| {share(n['wrong'], n['used'])} |",
                        flush=True,
                    )


if __name__ == "__main__":
    main()
