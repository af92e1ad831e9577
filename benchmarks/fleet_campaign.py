"""A day of a fleet: the logs of 50 simulated robots as one batch, its overview, and what it costs.

    python benchmarks/fleet_campaign.py [DIR] [--robots 50] [--jobs 2] [--pictures FOLDER]

Most robots patrol the corridors of an office, each its own way with its own wheels; the others are
in a cluttered room and among trees. Of every ten logs one has a fault: no recording at all, cut off
in the middle, odometry that turns the wrong way or freezes, a laser that repeats a scan. Prints
the table of the batch, and per recorded hour the core seconds and the storage, with the largest
memory: what docs/clusters.md computes with. Logs that are in DIR are used again. With --pictures
the overview is drawn in a browser, 1280 and 390 pixels wide (needs Chromium and `.[browser]`).
"""

import json
import shutil
import sys
import tempfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from common import measured_process, parser
from content_faults import faults, recorded, write

from graphslam.campaigns.engine import run_tasks
from graphslam.campaigns.tasks import Task, Workers
from graphslam.simulation import load_scenario, simulate
from graphslam.simulation.scenario import Leg, Scenario, ScenarioError

#: crossings of the corridors of the office, m, and which of them a corridor joins
CROSSINGS = ((6.9, 6.1), (20.0, 6.1), (33.1, 6.1), (33.1, 17.9), (20.0, 17.9), (6.9, 17.9))
CORRIDORS = ((0, 1), (1, 2), (2, 3), (3, 4), (4, 5), (5, 0), (1, 4))
#: faults of contents (see content_faults.py), and of files
FAULTS: tuple[str | Callable[[bytes], bytes], ...] = (
    lambda _data: b"not a recording at all",
    "odometry heading negated from 0.5",
    lambda data: data[: len(data) // 2],
    "laser repeats a scan from 0.5",
    "odometry frozen from 0.3",
)
WIDTHS, HEIGHT = (1280, 390), 900


def patrol(rng: np.random.Generator) -> Scenario:
    """A walk of four to nine corridors of the office, and a robot with wheels of its own."""
    office = load_scenario("office-loop")
    (robot,) = office.robots.values()
    at = int(rng.integers(len(CROSSINGS)))
    start, before, way = at, -1, []
    for _ in range(int(rng.integers(4, 10))):
        ends = [b if a == at else a for a, b in CORRIDORS if at in (a, b)]
        before, at = at, int(rng.choice([end for end in ends if end != before]))
        way.append(CROSSINGS[at])
    errors = rng.normal(0.0, 0.004, 2)
    wheels = replace(
        robot.encoders,
        radius_error_left=float(errors[0]),
        radius_error_right=float(errors[1]),
        axle_error=float(rng.normal(0.0, 0.01)),
    )
    first = np.subtract(way[0], CROSSINGS[start])
    heading = float(np.degrees(np.arctan2(first[1], first[0])))
    legs = (Leg(through_m=tuple(way)),)
    moved = replace(robot, start_m=CROSSINGS[start], start_deg=heading, drive=legs, encoders=wheels)
    return replace(office, robots={"robot": moved})


def make_log(path: Path, number: int) -> None:
    """The log of one robot; equal numbers give equal logs."""
    rng = np.random.default_rng(number)
    kind = {3: "lab", 7: "forest"}.get(number % 10)
    clean = path.with_suffix(".clean")
    while not clean.exists():
        with suppress(ScenarioError):  # a way that runs into the furniture: another one
            simulate(load_scenario(kind) if kind else patrol(rng), clean, number)
    if number % 10 == 5:
        fault = FAULTS[number // 10 % len(FAULTS)]
        if isinstance(fault, str):
            write(faults()[fault].change(recorded(clean)), path)
        else:
            path.write_bytes(fault(clean.read_bytes()))
        clean.unlink()
    else:
        clean.rename(path)


def make_logs(folder: Path, robots: int, jobs: int) -> None:
    """All logs that are not there yet."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"robot-{number:02d}.mcap" for number in range(robots)]
    tasks = [
        Task(path.stem, make_log, (path, number))
        for number, path in enumerate(paths)
        if not path.exists()
    ]
    for outcome in run_tasks(tasks, Workers(jobs)):
        if outcome.error is not None:
            raise outcome.error


def storage(folder: Path) -> int:
    """Bytes of all files of a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def draw(page: Path, target: Path) -> None:
    """The overview wide and narrow, side by side."""
    from playwright.sync_api import sync_playwright  # noqa: PLC0415 -- of an extra

    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    if chromium is None:
        sys.exit("needs Chromium from the system's packages: apt-get install chromium")
    shots = []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        for width in WIDTHS:
            for theme in ("light", "dark"):
                context = browser.new_context(
                    viewport={"width": width, "height": HEIGHT}, color_scheme=theme
                )
                tab = context.new_page()
                tab.goto(page.resolve().as_uri())
                shot = cv2.imdecode(np.frombuffer(tab.screenshot(), np.uint8), cv2.IMREAD_COLOR)
                border = cv2.BORDER_CONSTANT
                shots.append(cv2.copyMakeBorder(shot, 0, 0, 0, 12, border, value=[128] * 3))
                context.close()
        browser.close()
    picture = cv2.resize(np.hstack(shots), None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(target / "report-batch.webp"), picture, [cv2.IMWRITE_WEBP_QUALITY, 70])
    print(f"{target / 'report-batch.webp'}")


def main() -> None:
    options = parser(__doc__)
    options.add_argument("folder", nargs="?", type=Path)
    options.add_argument("--robots", type=int, default=50)
    options.add_argument("--jobs", type=int, default=2)
    options.add_argument("--pictures", type=Path)
    arguments = options.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = arguments.folder or Path(scratch)
        make_logs(folder / "logs", arguments.robots, arguments.jobs)
        command = [sys.executable, "-m", "graphslam", "batch", str(folder / "logs")]
        command += ["-o", str(folder / "batch"), "--jobs", str(arguments.jobs), "--force"]
        # exit code 1: a log is broken, as it is meant to be
        wrapped = ["sh", "-c", '"$@" || test $? = 1', "sh", *command]
        printed, used = measured_process(wrapped)
        print(printed.decode())
        found = json.loads((folder / "batch/overview.json").read_text())
        done = [row for row in found["logs"] if row["status"] == "done"]
        hours = found["totals"]["duration_s"] / 3600
        results = sum(storage(folder / "batch/results" / row["name"]) for row in done)
        logs = sum(file["bytes"] for row in done for file in row["files"])
        print(f"{len(done)} logs of {hours:.2f} h, {1e-6 * logs:.0f} MB:")
        print(f"  {used.wall_s:.0f} s, {used.cpu_s / hours:.0f} core seconds per recorded hour")
        print(f"  results {1e-6 * results / hours:.0f} MB per hour; logs {1e-6 * logs / hours:.0f}")
        print(f"  largest memory {max(row['memory_mb'] for row in done):.0f} MB of a worker")
        page = folder / "batch/report.html"
        print(f"  overview {1e-6 * page.stat().st_size:.2f} MB")
        if arguments.pictures:
            draw(page, arguments.pictures)


if __name__ == "__main__":
    main()
