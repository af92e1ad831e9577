"""Chapter 6 of the thesis as tables: what it reports beside what is measured, over many seeds.

`QUANTITIES` says what each of `thesis_experiments` shows, what the thesis says of it, and what has
to be reached here.
"""

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graphslam.evaluation.thesis_experiments import TRUE, WITH, WITHOUT

Array = NDArray[np.float64]
#: name of a value -> its values (n,) over seeds
Values = Mapping[str, Array]


@dataclass(frozen=True)
class Quantity:
    """A line of a table.

    ``of``: values over seeds -> (n,) or (1,), SI units; shown times ``scale`` in ``unit``. All of
    them must be at most ``bar``, or at least ``least``.
    """

    what: str
    thesis: str
    of: Callable[[Values], Array]
    scale: float = 100.0
    unit: str = "cm"
    bar: float | None = None
    least: float | None = None

    def held(self, values: Values) -> bool:
        """Whether every seed holds the bar."""
        v = self.of(values)
        return bool(
            (self.bar is None or (v <= self.bar).all())
            and (self.least is None or (v >= self.least).all())
        )

    def limit(self) -> str:
        """What has to be reached, as text; empty if nothing."""
        if self.least is not None:
            return f"≥ {self.scale * self.least:.3g} {self.unit}"
        return "" if self.bar is None else f"≤ {self.scale * self.bar:.3g} {self.unit}"

    def spread(self, values: Values) -> tuple[float, float]:
        """Median and worst, in SI units."""
        v = self.of(values)
        return float(np.median(v)), float(v.max() if self.least is None else v.min())


def _value(name: str) -> Callable[[Values], Array]:
    return lambda values: values[name]


def pooled(values: Values) -> Array:
    """RMS error over all seeds with cooperation over the one without, (1,)."""
    with_, without = values["error with"], values["error without"]
    return np.array([np.sqrt(np.mean(with_**2) / np.mean(without**2))])


def _sigma_share(values: Values) -> Array:
    return np.asarray(values["sigma with"] / values["sigma without"])


#: experiment -> section of the thesis and what it was
TITLES = {
    "lab": "6.1.1 Laboratory: 25 m forwards and backwards among furniture",
    "corridor": "6.1.2 Corridor, with the Hough front end: 160 m, a wheel 2 % too large",
    "two-robots": "6.1.3 Two robots: one drives with a single wall in view, one sights it",
    "change": "6.2 Changes: a table turned by up to 0.6 m between two visits",
}

QUANTITIES: dict[str, tuple[Quantity, ...]] = {
    "lab": (
        Quantity("scatter of the corner, with landmarks", "≈ 5 cm", _value(WITH), bar=0.025),
        Quantity("scatter of the corner, dead reckoning", "≈ 20 cm", _value(WITHOUT)),
        Quantity("scatter of the corner, true poses (the floor)", "", _value(TRUE)),
    ),
    "corridor": (
        Quantity(
            "end pose, with landmarks", "the loop closes", _value(f"end {WITH}"), 1.0, "m", 0.25
        ),
        Quantity(
            "end pose, dead reckoning", "> 90 m", _value(f"end {WITHOUT}"), 1.0, "m", least=80.0
        ),
        Quantity("the wheel's 2 %, error of", "", _value("wheel"), unit="%", bar=0.002),
        Quantity(
            "walls at the start, last visit from first",
            "they overlay",
            _value(f"overlay {WITH}"),
            bar=0.05,
        ),
        Quantity("the same, true poses (the floor)", "", _value(f"overlay {TRUE}")),
    ),
    "two-robots": (
        Quantity("error of the Pioneer, alone", "", _value("error without")),
        Quantity("error of the Pioneer, cooperating", "visibly sharper", _value("error with")),
        Quantity("standard deviation, alone", "", _value("sigma without")),
        Quantity("standard deviation, cooperating", "", _value("sigma with")),
        Quantity("error, cooperating of alone, pooled", "", pooled, unit="%", bar=2 / 3),
        Quantity("standard deviation, cooperating of alone", "", _sigma_share, unit="%", bar=2 / 3),
    ),
    "change": (
        Quantity("trajectory of the first visit, aligned", "", _value("reference")),
        Quantity("trajectory of the second visit, aligned", "", _value("later")),
        Quantity("changes found along the table from", "just over 5 cm", _value("found from")),
        Quantity("beams flagged beside it", "sporadic", _value("false alarms"), unit="%"),
    ),
}


def summarise_chapter(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Every experiment as ``{title, quantities}``; each quantity by front end and variant.

    ``rows`` are those of the campaign. Runs that failed are counted, and in no value.
    """
    groups: dict[str, dict[str, list[Mapping[str, Any]]]] = defaultdict(lambda: defaultdict(list))
    for row in rows:
        groups[row["scenario"]][f"{row['front_end']}, {row['variant']}"].append(row)
    return {name: _experiment(name, found) for name, found in groups.items()}


def _experiment(name: str, found: Mapping[str, Sequence[Mapping[str, Any]]]) -> dict[str, Any]:
    values: dict[str, Values] = {}
    counts = {}
    for label, rows in found.items():
        good = [row["values"] for row in rows if not row["error"]]
        counts[label] = {"runs": len(rows), "failed": len(rows) - len(good)}
        if good:
            values[label] = {key: np.array([run[key] for run in good]) for key in good[0]}
    quantities = []
    for quantity in QUANTITIES[name]:
        results = {}
        for label, own in values.items():
            median, worst = quantity.spread(own)
            results[label] = {"median": median, "worst": worst, "held": quantity.held(own)}
        quantities.append(
            {
                "what": quantity.what,
                "thesis": quantity.thesis,
                "bar": quantity.limit(),
                "scale": quantity.scale,
                "unit": quantity.unit,
                "results": results,
            }
        )
    return {"title": TITLES[name], "runs": counts, "quantities": quantities}


def table_rows(experiment: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Head and lines of an experiment's table: median and worst of every front end."""
    labels = list(experiment["runs"])
    head = ["", "thesis", "to reach", *(f"{label}: median (worst)" for label in labels)]
    lines = []
    for quantity in experiment["quantities"]:
        line = [quantity["what"], quantity["thesis"], quantity["bar"]]
        for label in labels:
            result = quantity["results"].get(label)
            if result is None:
                line.append("failed")
                continue
            median, worst = (quantity["scale"] * result[key] for key in ("median", "worst"))
            missed = "" if result["held"] else ", missed"
            line.append(f"{median:.3g} ({worst:.3g}{missed}) {quantity['unit']}")
        lines.append(line)
    return head, lines


def markdown_table(experiment: Mapping[str, Any]) -> str:
    """An experiment's table in Markdown."""
    head, lines = table_rows(experiment)
    rule = "|" + "---|" * len(head)
    return "\n".join([f"| {' | '.join(head)} |", rule, *(f"| {' | '.join(x)} |" for x in lines)])


def markdown_page(summary: Mapping[str, Any]) -> str:
    """All experiments of an experiment's summary as one page in Markdown."""
    parts = [f"# {summary['description']}\n\n{summary['runs']} seeds each.\n"]
    for experiment in summary["chapter"].values():
        parts.append(f"## {experiment['title']}\n\n{markdown_table(experiment)}\n")
    return "\n".join(parts)
