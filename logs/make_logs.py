"""Writes the sample logs and the table of README.md.

Run: python logs/make_logs.py

The same version gives the same bytes; a change of the simulator shows as different digests.
"""

import hashlib
import shutil
from pathlib import Path

from graphslam.simulation import SCENARIOS, load_scenario, simulate

HERE = Path(__file__).parent
SEED = 0
BEGIN, END = "<!-- table -->\n", "<!-- end -->"


def simulate_to_folder(name: str) -> list[Path]:
    """Simulate a scenario into this folder; the paths of its files."""
    scenario = load_scenario(name)
    target = HERE / (name if scenario.later else f"{name}.mcap")
    if target.is_dir():
        shutil.rmtree(target)
    target.unlink(missing_ok=True)
    simulate(scenario, target, seed=SEED)
    return sorted(target.iterdir()) if target.is_dir() else [target]


def row(path: Path) -> str:
    """A line of the table."""
    name = path.relative_to(HERE).as_posix()
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    return f"| `{name}` | {path.stat().st_size / 1e3:.0f} | `{digest}` |\n"


def main() -> None:
    """Write all recordings, then the table."""
    table = "| file | kB | SHA-256 |\n|---|---|---|\n"
    table += "".join(row(path) for name in sorted(SCENARIOS) for path in simulate_to_folder(name))
    page = HERE / "README.md"
    before, _, rest = page.read_text(encoding="utf-8").partition(BEGIN)
    page.write_text(before + BEGIN + table + END + rest.partition(END)[2], encoding="utf-8")


if __name__ == "__main__":
    main()
