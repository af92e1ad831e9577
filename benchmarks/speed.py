"""What whole jobs cost, and how cost grows with the log: time, CPU, memory, beside a yardstick.

Every job is a command in a fresh process with default settings. Right before each repetition runs
the yardstick (`yardstick.py`), a fixed job; "/ Y" is a time over that of the yardstick just before,
the median of the repetitions, which depends little on the machine. Times are the least of the
repetitions, which are interleaved; the spread is largest over least, less one. Peak memory is that
of the largest process.

  jobs     whole commands: help, lab, office-loop, intel, aces, mrclam6, building (2 km), grid (a
           pose graph), ...
  laps     rounds of one ring of corridors: exponents of CPU time and memory at each doubling
  robots   five robots that see posts and each other: the same
  steps    milliseconds per keyframe of back ends that run while the log is read
  peers    bare loops of GTSAM and g2o on the same graphs (pip install g2opy)

Run: python benchmarks/speed.py [--only GROUP|JOB ...] [--json FILE] [--markdown PAGE] [--gate]
     python benchmarks/speed.py --saved FILE --markdown docs/performance.md   tables of a past run

--gate: exit code 1 if wall or CPU time over the yardstick, or memory, of a whole command is more
than a fifth above speed_baseline.json. Nothing else may run meanwhile.
"""

import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from common import ROOT, measured_process, parser
from speed_jobs import LOGS, AbsentError, Job, all_jobs
from speed_tables import baseline_of, failures, regressions, tables, with_tables

BASELINE = ROOT / "benchmarks/speed_baseline.json"
#: whose versions times depend on; the last is a peer
PACKAGES = ("gtsam", "numpy", "scipy", "opencv-python-headless", "mcap", "g2opy")


def measure(jobs: Sequence[Job], repeats: int, save: Callable[[Any], None]) -> dict[str, Any]:
    """Measure all jobs in turn, several times; ``save`` gets what there is after each run."""
    found: dict[str, Any] = {
        "made": time.strftime("%Y-%m-%d", time.gmtime()),
        "machine": machine(),
        "versions": versions(),
        "repeats": repeats,
        "yardstick": [],
        "groups": {},
    }
    for repeat in range(repeats):
        for job in jobs:
            group = found["groups"].setdefault(job.group, {})
            entry = group.setdefault(job.name, {"what": job.what, "runs": []})
            if "absent" in entry or "failed" in entry:
                continue
            print(f"{repeat + 1} of {repeats}: {job.group}, {job.name}", file=sys.stderr)
            try:
                entry["runs"].append(measure_job(job, found["yardstick"]))
            except AbsentError as reason:
                entry["absent"] = str(reason)
            except subprocess.CalledProcessError as error:
                entry["failed"] = f"exit code {error.returncode}"
            save(found)
    return found


def measure_job(job: Job, yardsticks: list[Any]) -> dict[str, Any]:
    """One run of the yardstick, which is added to the others, and one of the job."""
    arguments = job.arguments()
    printed, _ = measured_process([sys.executable, str(ROOT / "benchmarks/yardstick.py")])
    yardsticks.append(yardstick := json.loads(printed))
    printed, used = measured_process(arguments)
    return {
        "wall_s": used.wall_s,
        "cpu_s": used.cpu_s,
        "peak_mb": used.peak_mb,
        "yardstick_wall_s": yardstick["wall_s"]["all"],
        "yardstick_cpu_s": yardstick["cpu_s"]["all"],
        **job.values(printed),
    }


def machine() -> dict[str, Any]:
    """The machine as far as speed depends on it."""
    cpus = Path("/proc/cpuinfo")
    names = [
        line.split(":")[1].strip()
        for line in (cpus.read_text(encoding="utf-8").splitlines() if cpus.exists() else ())
        if line.startswith("model name")
    ]
    return {
        "CPU": names[0] if names else platform.processor(),
        "cores": os.cpu_count(),
        "GB": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9, 1),
        "system": platform.system(),
    }


def versions() -> dict[str, str]:
    """The last commit of the package, and the versions of what does the work."""
    git = ["git", "-C", str(ROOT)]
    commit, changed = (
        subprocess.run([*git, *arguments, "graphslam"], stdout=subprocess.PIPE, check=False).stdout
        for arguments in (("log", "-1", "--format=%h", "--"), ("status", "--porcelain"))
    )
    found = {
        "commit": commit.decode().strip() + ("+" if changed else ""),
        "Python": platform.python_version(),
    }
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except ModuleNotFoundError:
            continue
    return found


def main() -> int:
    """Measure, print the tables, and what else is asked for."""
    # commands find their bytecode compiled, as after any first run
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    options = parser(__doc__)
    add = options.add_argument
    add("--only", nargs="+", default=[], metavar="NAME", help="groups or jobs to measure")
    add("--repeats", type=int, default=3, help="runs of each job (default: 3)")
    add("--laps", type=int, nargs="*", default=[1, 2, 4, 8, 16, 32], help="lengths of laps")
    add("--rounds", type=int, nargs="*", default=[2, 4, 8, 16], help="lengths of robots")
    add("--stepped", choices=LOGS, default="intel", help="log of steps and peers (default: intel)")
    add("--cache", type=Path, help="folder that keeps logs for the next time, as they are")
    add("--json", type=Path, help="file to write what was measured to, after each run")
    add("--saved", type=Path, help="such a file, to be used instead of measuring")
    add("--markdown", type=Path, help="page whose tables to write anew")
    add("--gate", action="store_true", help="compare with the baseline")
    add("--write-baseline", action="store_true", help="make this the baseline")
    chosen = options.parse_args()

    def save(measured: Any) -> None:
        if chosen.json:
            chosen.json.write_text(json.dumps(measured, indent=1) + "\n", encoding="utf-8")

    if chosen.saved:
        measured = json.loads(chosen.saved.read_text(encoding="utf-8"))
    else:
        with tempfile.TemporaryDirectory() as scratch:
            folder = chosen.cache or Path(scratch)
            folder.mkdir(parents=True, exist_ok=True)
            jobs = list(all_jobs(folder, chosen.laps, chosen.rounds, chosen.stepped))
            names = {name for job in jobs for name in (job.group, job.name)}
            if unknown := set(chosen.only) - names:
                options.error(f"no group or job {', '.join(sorted(unknown))}")
            if chosen.only:
                jobs = [job for job in jobs if {job.group, job.name} & set(chosen.only)]
            measured = measure(jobs, chosen.repeats, save)
    print("\n".join(tables(measured)))
    if chosen.markdown:
        page = chosen.markdown.read_text(encoding="utf-8")
        chosen.markdown.write_text(with_tables(page, measured), encoding="utf-8")
    wrong = failures(measured)
    if chosen.gate:
        wrong += regressions(baseline_of(measured), json.loads(BASELINE.read_text("utf-8")))
        print("no job is more than a fifth above the baseline" if not wrong else "gate: failed")
    print("\n".join(wrong))
    if chosen.write_baseline:
        text = json.dumps(baseline_of(measured), indent=1) + "\n"
        BASELINE.write_text(text, encoding="utf-8")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
