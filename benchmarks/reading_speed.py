"""How fast recordings are read: 10 000 scans of 360 beams and 20 000 odometry messages.

Seconds to open each container and to take all its messages, best of three, and as multiples of the
yardstick (`yardstick.py`): of wall time, and of CPU, of all threads together. The most memory that
it took.

Run: python benchmarks/reading_speed.py [--folder out/reading]
"""

import argparse
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from graphslam.core.config import Config
from graphslam.logs import LogWriter, open_logs

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from recordings import CONTAINERS

S = 1_000_000_000
ODOMETRY = 20_000
CASES = (
    "MCAP", "bare .db3", "rosbag2 folder, sqlite3, zstd by file",
    "rosbag2 folder, sqlite3, zstd by message", "ROS 1 bag", "ROS 1 bag, lz4", "ROS 1 bag, bz2",
)  # fmt: skip


def written(folder: Path, name: str) -> Path:
    """The log in a container, made if it is not there."""
    folder.mkdir(parents=True, exist_ok=True)
    log = folder / "log.mcap"
    if not log.exists():
        rng = np.random.default_rng(0)
        shape = {"angle_min_rad": -np.pi, "angle_step_rad": np.radians(1), "range_max_m": 20.0}
        with LogWriter(log) as out:
            out.mount("robot", S, (0, 0, 0))
            for k in range(ODOMETRY):
                stamp = S + k * S // 20
                out.odometry("robot", stamp, (0.01 * k, 0, 0))
                if k % 2 == 0:
                    out.scan("robot", stamp + 7, 1 + 10 * rng.random(360), **shape)
    if name == "MCAP":
        return log
    file, make = CONTAINERS[name]
    return folder / file if (folder / file).exists() else make(log, folder / file)


def measure(path: Path) -> None:
    """Print the seconds of one reading, wall and CPU, and the most memory, MB."""
    wall_s = cpu_s = np.inf
    for _ in range(3):
        wall, cpu = time.perf_counter(), time.process_time()
        count = sum(1 for _ in open_logs([path], Config()).messages())
        wall_s = min(wall_s, time.perf_counter() - wall)
        cpu_s = min(cpu_s, time.process_time() - cpu)
        if count != ODOMETRY * 3 // 2:
            sys.exit(f"{path}: {count} messages")
    # not getrusage, which has that of the process that began this one
    status = Path("/proc/self/status").read_text(encoding="ascii")
    print(wall_s, cpu_s, int(status.split("VmHWM:")[1].split()[0]) / 1024)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, default=Path("out/reading"))
    parser.add_argument("--measure", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.measure:
        measure(arguments.measure)
        return
    from yardstick import measure as run_yardstick  # noqa: PLC0415

    unit = run_yardstick()
    print("| container | wall, s | yardsticks | CPU, s | yardsticks | peak, MB |")
    print("|---|---|---|---|---|---|")
    for name in CASES:
        path = written(arguments.folder, name)
        command = [sys.executable, __file__, "--measure", str(path)]
        output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        wall_s, cpu_s, memory = map(float, output.split())
        wall, cpu = wall_s / unit["wall_s"]["all"], cpu_s / unit["cpu_s"]["all"]
        print(
            f"| {name} | {wall_s:.2f} | {wall:.3f} | {cpu_s:.2f} | {cpu:.3f} | {memory:.0f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
