"""Pictures of real logs: the map with the path, and the errors of all relations.

Drawn by benchmarks/real_logs.py --figures DIR, for docs/real-logs.md.
"""

from pathlib import Path

import numpy as np
from figure_style import BLUE, GREY, INK, RED, panels
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from graphslam.change_detection import load_visit
from graphslam.core.geometry import Array
from graphslam.evaluation.relation_metrics import read_relations, relation_errors
from graphslam.results.folder import load

#: every so many points of the map are drawn
THINNED = 7


def draw(name: str, result: Path, relations: Path, folder: Path) -> Path:
    """Write ``folder/real-NAME.png``.

    Args:
        name: of the log.
        result: its result folder.
        relations: file of hand-made relations between scans.
        folder: where the figure goes.
    """
    saved = load(result)
    visit = load_visit(saved, result)
    (robot,) = saved.robots.values()
    figure, (plan, errors) = panels(2, (9.0, 4.6))
    ends = visit.ends[visit.surface][::THINNED]
    plan.plot(*ends.T, ",", color=INK, alpha=0.35, rasterized=True)
    plan.plot(*robot.final.poses[:, :2].T, color=BLUE, lw=0.6)
    plan.set_title(f"{name}: scans where the final estimate has them, and the path, m", fontsize=9)
    errors.set_aspect("auto")
    known = read_relations(relations)
    for trajectory, label, color in (
        (robot.scan_causal, "causal", RED),
        (robot.scan_final, "final", BLUE),
    ):
        assert trajectory is not None
        found = relation_errors(known, trajectory)[:, 0]
        share(errors, found[known.local], f"{label}, near in time", color, "-")
        share(errors, found[~known.local], f"{label}, loops", color, "--")
    errors.set_xscale("log")
    errors.set_xlim(1e-3, 3.0)
    errors.set_title("share of relations with at most this error, m", fontsize=9)
    errors.grid(color=GREY, alpha=0.3)
    errors.legend(fontsize=8, frameon=False)
    target = folder / f"real-{name}.png"
    save(figure, target)
    return target


def share(axes: Axes, errors: Array, label: str, color: str, style: str) -> None:
    """A line of the right panel: the cumulative distribution of errors (n,), m."""
    found = np.sort(errors[np.isfinite(errors)])
    axes.plot(found, np.linspace(0, 1, len(found)), style, color=color, lw=1.2, label=label)


def save(figure: Figure, target: Path) -> None:
    """As a PNG that is not larger than it need be."""
    figure.savefig(target, dpi=130)
