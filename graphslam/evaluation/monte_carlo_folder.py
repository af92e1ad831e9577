"""The folder of an experiment beside its rows: summary, report and figures."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from graphslam.core.errors import OutputError
from graphslam.evaluation.thesis_chapter import markdown_page, table_rows
from graphslam.results.file_formats import to_json
from graphslam.results.live_runs import RunsMap
from graphslam.results.report_experiment import experiment_figures, experiment_page


def save_summary(summary: Mapping[str, Any], directory: Path, maps: Sequence[RunsMap] = ()) -> None:
    """Write summary.json, report.html with its ``maps``, and figures/*.svg, each atomically.

    Of the thesis' chapter 6 also chapter.md: its tables.

    Raises:
        OutputError: nothing can be written there.
    """
    files = {"summary.json": to_json(summary, "summary"), "report.html": _page(summary, maps)}
    if summary["kind"] == "chapter":
        files["chapter.md"] = markdown_page(summary)
    figures = experiment_figures(summary)
    files |= {f"figures/{name}.svg": text for name, text in figures.items()}
    try:
        for name, text in files.items():
            path = directory / name
            path.parent.mkdir(exist_ok=True)
            part = path.with_name(f".{path.name}.part")
            part.write_text(text, encoding="utf-8")
            part.replace(path)
    except OSError as error:
        raise OutputError(f"{directory}: cannot be written: {error.strerror}") from error


def _page(summary: Mapping[str, Any], maps: Sequence[RunsMap]) -> str:
    tables = {
        experiment["title"]: table_rows(experiment)
        for experiment in summary.get("chapter", {}).values()
    }
    return experiment_page(summary, tables, maps)
