"""The tables and figures of docs/experiments.md: the thesis' chapter 6 in simulation.

Run: python benchmarks/thesis_experiments.py [--seeds 20] [--jobs 2] [--folder DIR] [--no-figures]
Does what `graphslam experiment thesis -o DIR` does (a DIR that holds it already is not run again),
writes its tables into the page, and draws the figures in docs/figures/. Exit code 1 if a bar is not
held.
"""

import sys
import tempfile
from dataclasses import replace
from pathlib import Path

from common import FIGURES, ROOT, parser
from thesis_figures import draw

from graphslam.campaigns.experiment import run_campaign
from graphslam.campaigns.tasks import Workers
from graphslam.evaluation.monte_carlo_definition import load_definition
from graphslam.evaluation.monte_carlo_folder import save_summary
from graphslam.evaluation.monte_carlo_summary import summarise
from graphslam.evaluation.thesis_chapter import markdown_table

PAGE = ROOT / "docs/experiments.md"


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
    options.add_argument("--seeds", type=int, default=20)
    options.add_argument("--jobs", type=int, default=2)
    options.add_argument("--folder", type=Path, help="of the experiment; kept")
    options.add_argument("--no-figures", action="store_true", help="only tables")
    arguments = options.parse_args()
    definition = replace(load_definition("thesis"), runs=arguments.seeds)
    with tempfile.TemporaryDirectory() as temporary:
        folder = arguments.folder or Path(temporary) / "thesis"
        summary = summarise(definition, run_campaign(definition, folder, Workers(arguments.jobs)))
        save_summary(summary, folder)
    failed = []
    for name, experiment in summary["chapter"].items():
        text = f"{arguments.seeds} seeds:\n\n{markdown_table(experiment)}\n"
        print(f"{name}\n{text}", flush=True)
        put(name, text)
        for quantity in experiment["quantities"]:
            missed = [label for label, r in quantity["results"].items() if not r["held"]]
            failed += [f"{name}: {quantity['what']}: {label}" for label in missed]
    if not arguments.no_figures:
        draw(list(summary["chapter"]), FIGURES)
    for line in failed:
        print(f"not held: {line}", file=sys.stderr)
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
