"""Figures like the thesis' own, of seed 0: superposed scans, enlargements, landmarks, trajectories.

Drawn by benchmarks/thesis_experiments.py into docs/figures/.
"""

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from figure_style import BLUE, GREY, MARK, RED, WALL, legend, panels, path, scatter, window
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from graphslam.core.geometry import transform
from graphslam.evaluation.thesis_experiments import (
    CORNER_M,
    DEFAULTS,
    TRUE,
    WITH,
    WITHOUT,
    Array,
    Run,
    alone,
    in_start_frame,
    run,
    simulated,
    visits_of_the_start,
    with_known_starts,
)
from graphslam.simulation import load_scenario, simulate

SEED = 0


def walls(ax: Axes, done: Run, label: str = "true walls") -> None:
    """True faces, thin."""
    for face in done.faces.values():
        if face.kind == "segment" and face.extent is not None:
            ax.plot(*face.extent.T, color=WALL, lw=0.8, alpha=0.8, label=label)
            label = "_"


def landmarks(ax: Axes, done: Run, frame: Array) -> None:
    """Estimated landmarks, moved by ``frame``."""
    label = "estimated landmarks"
    for mark in done.result.landmarks:
        ends = transform(frame, mark.extent)
        ax.plot(*ends.T, ".-", color=MARK, lw=1.6, ms=3, label=label)
        label = "_"


def lab(folder: Path) -> dict[str, Figure]:
    """Thesis figures 6-1 to 6-4."""
    done = simulated(load_scenario("lab"), SEED, folder)
    room, axes = panels(2, (10, 4.6))
    corner, close = panels(3, (10, 3.6))
    for ax, source in zip(axes, (WITHOUT, WITH), strict=True):
        scatter(ax, done.points("vehicle", source, done.aligned("vehicle", source)), source)
        ax.set_xlim(-1, 11)
        ax.set_ylim(-2.6, 9)
    for ax, source in zip(close, (WITHOUT, WITH, TRUE), strict=True):
        points = done.points("vehicle", source, done.aligned("vehicle", source))
        scatter(ax, points, f"corner, {source}", size=1)
        walls(ax, done)
        window(ax, CORNER_M + np.array([0.35, -0.35]), 0.6)
    legend(close[0])
    marks, (ax,) = panels(1, (6.4, 5))
    walls(ax, done)
    frame = done.aligned("vehicle", WITH)
    landmarks(ax, done, frame)
    path(ax, done.laser("vehicle", WITH), BLUE, "laser, with landmarks", frame)
    path(
        ax, done.laser("vehicle", WITHOUT), RED, "laser, dead reckoning",
        done.aligned("vehicle", WITHOUT),
    )  # fmt: skip
    path(ax, done.laser("vehicle", TRUE), GREY, "laser, true")
    legend(ax)
    return {"lab-scans": room, "lab-corner": corner, "lab-landmarks": marks}


def corridor(folder: Path) -> dict[str, Figure]:
    """Thesis figures 6-5 to 6-9."""
    done = simulated(load_scenario("corridor"), SEED, folder)
    frames = {source: in_start_frame(done, source) for source in (WITH, WITHOUT)}
    scans, axes = panels(2, (10, 4.2))
    for ax, source in zip(axes, (WITHOUT, WITH), strict=True):
        scatter(ax, done.points("vehicle", source, frames[source]), source)
        path(ax, done.base("vehicle", source), BLUE, "trajectory", frames[source])
        legend(ax)
    close, axes = panels(2, (10, 2.9))
    first, last = visits_of_the_start(done)
    for ax, source in zip(axes, (WITH, TRUE), strict=True):
        points = done.points("vehicle", source, frames.get(source))
        scatter(ax, points[first], f"walls at the start, {source}", BLUE, 1)
        scatter(ax, points[last], f"walls at the start, {source}", RED, 1)
        ax.set_xlim(-4, 9)
        ax.set_ylim(-2.2, 2.2)
        ax.plot([], [], ".", color=BLUE, label="first 10 m")
        ax.plot([], [], ".", color=RED, label="last 10 m")
        legend(ax)
    marks, (ax,) = panels(1, (8, 4.6))
    walls(ax, done)
    landmarks(ax, done, frames[WITH])
    path(ax, done.base("vehicle", WITH), BLUE, "with landmarks", frames[WITH])
    path(ax, done.base("vehicle", TRUE), GREY, "true")
    legend(ax)
    return {"corridor-scans": scans, "corridor-start": close, "corridor-landmarks": marks}


def two_robots(folder: Path) -> dict[str, Figure]:
    """Thesis figures 6-10 to 6-13."""
    scenario = load_scenario("two-robots")
    both = simulated(scenario, SEED, folder, with_known_starts(DEFAULTS))
    (folder / f"{SEED}.mcap").unlink()
    single = simulated(alone(scenario), SEED, folder, with_known_starts(DEFAULTS))
    scans, axes = panels(2, (10, 4.6))
    close, details = panels(2, (10, 4.4))
    pole = both.faces["pole 6"].pose[:2]
    for ax, detail, done, title in zip(
        axes, details, (single, both), ("alone", "cooperating"), strict=True
    ):
        scatter(ax, done.points("pioneer", WITH), f"the Pioneer {title}", size=1)
        walls(ax, done)
        path(ax, done.base("pioneer", WITH), BLUE, "estimate")
        path(ax, done.base("pioneer", TRUE), GREY, "truth")
        ax.set_xlim(-1, 14)
        ax.set_ylim(-3.5, 6)
        legend(ax)
        scatter(detail, done.points("pioneer", WITH), f"pole 6, the Pioneer {title}", size=4)
        window(detail, pole, 0.25)
    course = Figure(figsize=(10, 3.2), layout="constrained")
    left, right = course.subplots(1, 2)
    for done, title, color in ((single, "alone", RED), (both, "cooperating", BLUE)):
        found = done.result.robots["pioneer"].final
        stamps = found.stamps_ns[done.kept["pioneer"]]
        seconds = 1e-9 * (stamps - stamps[0])
        off = done.base("pioneer", WITH)[:, :2] - done.base("pioneer", TRUE)[:, :2]
        covs = found.covs[done.kept["pioneer"]]
        left.plot(seconds, 100 * np.hypot(*off.T), color=color, label=title)
        sigma = np.sqrt(covs[:, 0, 0] + covs[:, 1, 1])
        right.plot(seconds, 100 * sigma, color=color, label=title)
    for ax, title in ((left, "position error, cm"), (right, "its standard deviation, cm")):
        ax.set_title(title, fontsize=9)
        ax.set_xlabel("s", fontsize=8)
        ax.tick_params(labelsize=7)
        ax.set_ylim(bottom=0)
        ax.legend(fontsize=7, frameon=False)
    return {"two-robots-scans": scans, "two-robots-pole": close, "two-robots-course": course}


def change(folder: Path) -> dict[str, Figure]:
    """Thesis figure 6-14: the two visits on each other."""
    simulate(load_scenario("change"), folder / "change", seed=SEED)
    figure, axes = panels(2, (10, 4.8))
    colors = {"reference": BLUE, "later": RED}
    for name, color in colors.items():
        done = run(folder / "change" / f"{name}.mcap")
        frame = done.aligned("vehicle", WITH)
        for ax, title in zip(axes, ("both visits", "the tipped table"), strict=True):
            scatter(ax, done.points("vehicle", WITH, frame), title, color, 1)
            path(ax, done.base("vehicle", WITH), color, name, frame)
    axes[0].set_xlim(-1, 11)
    axes[0].set_ylim(-2.6, 9)
    legend(axes[0])
    window(axes[1], np.array([8.5, 2.8]), 1.2)
    return {"change-scans": figure}


FIGURES: dict[str, Callable[[Path], dict[str, Figure]]] = {
    "lab": lab,
    "corridor": corridor,
    "two-robots": two_robots,
    "change": change,
}


def draw(names: Sequence[str], target: Path) -> None:
    """Draw the figures of some experiments into a folder, as PNG files."""
    mpl.rcParams["font.family"] = "DejaVu Sans"
    target.mkdir(parents=True, exist_ok=True)
    for name in names:
        with tempfile.TemporaryDirectory() as folder:
            for title, figure in FIGURES[name](Path(folder)).items():
                figure.savefig(target / f"{title}.png", dpi=130)
