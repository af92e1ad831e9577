"""The thesis' experiments (chapter 6) in simulation: every claim as a number, over many seeds.

Run: python benchmarks/thesis_experiments.py [--seeds 20] [lab corridor two-robots change]
Writes the tables of docs/experiments.md and its figures in docs/figures/. Exit code 1 if a bar is
not held.
"""

import sys
import tempfile
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from common import FIGURES, ROOT, parser
from thesis_figures import draw
from thesis_runs import EXPERIMENTS, TRUE, WITH, WITHOUT, Array

PAGE = ROOT / "docs/experiments.md"


def one(job: tuple[str, int]) -> dict[str, float]:
    """One seed of one experiment, in a folder of its own."""
    name, seed = job
    with tempfile.TemporaryDirectory() as folder:
        return EXPERIMENTS[name](seed, Path(folder))


@dataclass(frozen=True)
class Row:
    """A line of the table: values over seeds, and what the thesis says."""

    what: str
    thesis: str
    values: Array
    scale: float = 100.0
    unit: str = "cm"
    bar: float | None = None  # median and worst must stay at or below it, in SI units
    least: float | None = None  # or all at or above it

    def held(self) -> bool:
        """Whether every seed holds the bar."""
        low, high = self.least, self.bar
        return (high is None or bool((self.values <= high).all())) and (
            low is None or bool((self.values >= low).all())
        )

    def text(self) -> str:
        """The line in Markdown."""
        shown = [self.scale * float(f(self.values)) for f in (np.median, np.min, np.max)]
        median, low, high = (f"{value:.3g}" for value in shown)
        worst = low if self.least is not None else high
        bar = "" if self.bar is None else f"≤ {self.scale * self.bar:.3g} {self.unit}"
        bar = bar if self.least is None else f"≥ {self.scale * self.least:.3g} {self.unit}"
        return (
            f"| {self.what} | {self.thesis} | {bar} | {median} {self.unit} | {worst} {self.unit} |"
        )


def rows(name: str, runs: list[dict[str, float]]) -> list[Row]:
    """The table of an experiment."""
    v = {key: np.array([found[key] for found in runs]) for key in runs[0]}
    if name == "lab":
        return [
            Row("scatter of the corner, with landmarks", "≈ 5 cm", v[WITH], bar=0.025),
            Row("scatter of the corner, dead reckoning", "≈ 20 cm", v[WITHOUT]),
            Row("scatter of the corner, true poses (the floor)", "", v[TRUE]),
        ]
    if name == "corridor":
        metre = {"scale": 1.0, "unit": "m"}
        return [
            Row("end pose, with landmarks", "", v[f"end {WITH}"], bar=0.25, **metre),
            Row("end pose, dead reckoning", "> 90 m", v[f"end {WITHOUT}"], least=80.0, **metre),
            Row("the wheel's 2 %, found", "", v["wheel"], unit="%", bar=0.002),
            Row("walls at the start, last visit from first", "", v[f"overlay {WITH}"], bar=0.05),
            Row("the same, true poses (the floor)", "", v[f"overlay {TRUE}"]),
        ]
    if name == "two-robots":
        share = {"scale": 100.0, "unit": "%", "bar": 2 / 3}
        return [
            Row("error of the Pioneer, alone", "", v["error without"]),
            Row("error of the Pioneer, cooperating", "", v["error with"]),
            Row("standard deviation, alone", "", v["sigma without"]),
            Row("standard deviation, cooperating", "", v["sigma with"]),
            Row("error, cooperating of alone, pooled", "", pooled(v), **share),
            Row(
                "standard deviation, cooperating of alone",
                "",
                v["sigma with"] / v["sigma without"],
                **share,
            ),
        ]
    return [
        Row("trajectory of the first visit, aligned", "", v["reference"]),
        Row("trajectory of the second visit, aligned", "", v["later"]),
    ]


def pooled(v: Mapping[str, Array]) -> Array:
    """RMS error over all seeds with cooperation over the one without, (1,)."""
    return np.sqrt(np.mean(v["error with"] ** 2) / np.mean(v["error without"] ** 2))[None]


def table(name: str, runs: list[dict[str, float]]) -> str:
    """Markdown table of an experiment."""
    head = f"| {len(runs)} seeds | thesis | bar | median | worst |\n|---|---|---|---|---|\n"
    return head + "\n".join(row.text() for row in rows(name, runs)) + "\n"


def put(name: str, text: str) -> None:
    """Replace what lies between an experiment's marks in the page."""
    begin, end = f"<!-- table {name} -->\n", f"<!-- end {name} -->"
    page = PAGE.read_text(encoding="utf-8")
    before, _, rest = page.partition(begin)
    _, _, after = rest.partition(end)
    PAGE.write_text(before + begin + text + end + after, encoding="utf-8")


def main() -> int:
    """Run, print, write the page; 1 if a bar is not held."""
    options = parser(__doc__)
    options.add_argument("names", nargs="*", metavar="NAME", help=", ".join(EXPERIMENTS))
    options.add_argument("--seeds", type=int, default=20)
    options.add_argument("--jobs", type=int, default=2)
    options.add_argument("--no-page", action="store_true", help="print only")
    arguments = options.parse_args()
    names = arguments.names or list(EXPERIMENTS)
    if unknown := set(names) - set(EXPERIMENTS):
        options.error(f"no experiment {', '.join(sorted(unknown))}")
    failed = []
    with ProcessPoolExecutor(arguments.jobs, mp_context=get_context("spawn")) as pool:
        for name in names:
            found = list(pool.map(one, [(name, seed) for seed in range(arguments.seeds)]))
            text = table(name, found)
            print(f"{name}\n{text}", flush=True)
            failed += [f"{name}: {row.what}" for row in rows(name, found) if not row.held()]
            if not arguments.no_page:
                put(name, text)
    if not arguments.no_page:
        draw(names, FIGURES)
    for line in failed:
        print(f"not held: {line}", file=sys.stderr)
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
