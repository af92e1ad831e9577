"""Figures of docs/change-detection.md: the thesis' 6-14 to 6-18, the detection rate, a real room.

Drawn by `benchmarks/changes.py figures` into docs/figures/.
"""

import os
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from changes import case, detection, table_beams, true_frame
from figure_style import BLUE, GREY, INK, MARK, RED, WALL, legend, panels, path, scatter
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from graphslam.change_detection import Visit, detect_changes, load_visit
from graphslam.change_detection.detect import ChangeResult
from graphslam.change_detection.grid import grid_over
from graphslam.change_detection.rigid_registration import register
from graphslam.change_detection.thesis_method import (
    LaserNoise,
    changed_beams,
    expected_measurements,
    make_dents,
    occlusion_map,
    point_covariances,
    scan_points,
)
from graphslam.core.config import ChangesConfig, Config
from graphslam.core.geometry import Array, transform
from graphslam.importers.formats import IMPORTERS
from graphslam.logs import open_logs
from graphslam.results.folder import load, save
from graphslam.slam.smooth import smooth

TARGET = Path(__file__).parents[1] / "docs/figures"
KINDS = {"appeared": MARK, "vanished": WALL, "moved": "#aa3377"}
GATE = 9.21  # 1 % of two degrees of freedom, as printed


def draw(seeds: Sequence[int], folder: Path) -> None:
    """All of them."""
    figures = {**table(folder), "changes-rate": rate(detection(seeds, folder))}
    data = Path(os.environ.get("GRAPHSLAM_DATA", "")) / "tinyslam"
    if (data / "exp1.dat.xz").exists():
        figures["changes-real"] = real(data, folder)
    else:
        sys.stderr.write("GRAPHSLAM_DATA has no tinyslam: the real room is not drawn\n")
    for name, figure in figures.items():
        figure.savefig(TARGET / f"{name}.png", dpi=110)
        sys.stdout.write(f"{TARGET / name}.png\n")


def one_scan(visit: Visit, scan: int) -> tuple[Array, Array]:
    """Bearings and ranges (k,)."""
    beams = visit.scan == scan
    return visit.angle[beams], visit.range_m[beams]


def table(folder: Path) -> dict[str, Figure]:
    """Thesis figures 6-14 to 6-18, seed 0, in the lab's frame, and the same by all scans."""
    a, b, truth, sweeps = case("table", 0, folder)
    found = detect_changes(a, b, ChangesConfig())
    frame, move = true_frame(truth), truth["changes"][0]
    registration = register(a.landmarks, b.landmarks)
    b = b.transformed(registration.pose, registration.cov)
    scans = table_beams(truth, sweeps[1])[1] // len(one_scan(b, 0)[0])
    later = int(np.bincount(scans).argmax())
    apart = np.abs(np.angle(np.exp(1j * (a.poses[:, 2] - b.poses[later, 2]))))
    first = int(np.argmin(np.hypot(*(a.poses[:, :2] - b.poses[later, :2]).T) + apart))

    visits, axes = panels(2, (10, 4.6))
    before, after = np.array(move["before"]), np.array(move["after"])
    axes[0].plot(*before.T, color=GREY, lw=2, label="table before")
    axes[0].plot(*after.T, color=RED, lw=2, label="table after, 0 to 0.6 m away")
    for visit, color, name in ((a, GREY, "reference"), (b, BLUE, "later")):
        ends = transform(frame, visit.ends[visit.surface])
        scatter(axes[0], ends[::3], "6-14: the table", color)
        scatter(axes[1], ends[::3], "6-15: trajectories and the two scans", color)
        axes[1].plot(*transform(frame, visit.poses[:, :2]).T, color=color, lw=1.2, label=name)
    for visit, scan, star in ((a, first, "*"), (b, later, "**")):
        at = transform(frame, visit.poses[scan, :2][None])[0]
        axes[1].plot(*at, "o", color=INK, ms=4)
        axes[1].annotate(star, at, (4, 2), textcoords="offset points")
    axes[0].set_xlim(7.2, 10.2)
    axes[0].set_ylim(1.6, 4.2)
    axes[1].set_xlim(-0.5, 10.5)
    axes[1].set_ylim(-0.5, 8.5)
    for ax in axes:
        legend(ax)

    noise = LaserNoise()
    angles, ranges = one_scan(a, first)
    points = scan_points(a.poses[first], angles, ranges)
    covs = point_covariances(a.poses[first], a.covs[first], angles, np.nan_to_num(ranges), noise)
    grid = grid_over(np.concatenate([a.ends[a.surface], b.ends[b.surface]]), 0.025, 1_000_000)
    dents = make_dents(grid, points, covs)
    pose = b.poses[later]
    bearings, measured = one_scan(b, later)
    expected, _ = expected_measurements(dents, pose, bearings, float(np.nanmax(measured)) + 1)
    visible = occlusion_map(grid, a.poses[first], angles, ranges, 0.1)
    compared, marked = changed_beams(
        dents, visible, pose, b.covs[later], bearings, measured, noise, GATE
    )
    there = transform(frame, scan_points(pose, bearings, expected))
    now = transform(frame, scan_points(pose, bearings, measured))
    scan, axes = panels(3, (13, 4.4))
    for ax, rings, title in (
        (axes[0], transform(frame, points), "6-16: reference scan (rings), expected (dots)"),
        (axes[1], now, "6-17: comparing scan (rings), expected (dots)"),
    ):
        ax.plot(*there.T, ".", color=GREY, ms=3)
        ax.plot(*rings.T, "o", mfc="none", mec=BLUE, ms=3, mew=0.5)
        ax.set_title(title, fontsize=9)
    axes[2].plot(*there[compared & ~marked].T, ".", color=GREY, ms=3, label="as before")
    axes[2].plot(*there[marked].T, "o", mfc="none", mec=RED, ms=4, label="changed")
    axes[2].set_title("6-18: the thesis' method, gate for 1 %", fontsize=9)
    legend(axes[2])

    every, (ax,) = panels(1, (6.4, 5))
    overlay(ax, found, "the same by all scans of both visits, 1 %", frame)
    for figure_axes in (*axes, ax):
        figure_axes.set_xlim(-0.5, 10.5)
        figure_axes.set_ylim(-0.5, 8.5)
    return {"changes-visits": visits, "changes-scan": scan, "changes-all": every}


def overlay(ax: Axes, found: ChangeResult, title: str, frame: Array) -> None:
    """Reference grey, later blue, changes outlined."""
    for visit, color in ((found.reference, GREY), (found.later, BLUE)):
        scatter(ax, transform(frame, visit.ends[visit.surface])[::3], title, color)
    labels = set()
    for change in found.changes:
        label = "_" if change.kind in labels else change.kind
        labels.add(change.kind)
        color = KINDS[change.kind]
        outline = transform(frame, change.polygon)
        ax.add_patch(Polygon(outline, fill=False, ec=color, lw=1.6, label=label))
        if change.before is not None:
            old = transform(frame, change.before)
            ax.add_patch(Polygon(old, fill=False, ec=color, lw=1.2, ls="--"))
    legend(ax)


def rate(rows: Array) -> Figure:
    """Detection rate against true displacement."""
    figure = Figure(figsize=(6.4, 4), layout="constrained")
    ax = figure.subplots()
    cm = 100 * rows[:, 0]
    for column, style, label in (
        (1, "o-", "all scans, measured"),
        (2, "-", "all scans, limit by the stated sigmas"),
        (3, "s-", "thesis, one scan each, gate for 1 %"),
        (4, "--", "limit of one pair of beams, poses known"),
    ):
        color = {1: BLUE, 2: INK, 3: RED, 4: GREY}[column]
        ax.plot(cm, 100 * rows[:, column], style, color=color, ms=4, lw=1.2, label=label)
    ax.axvline(4, color=MARK, lw=0.8, ls=":")
    ax.set_xscale("log")
    ax.set_xticks([1, 2, 4, 10, 20, 50], ["1", "2", "4", "10", "20", "50"])
    ax.set_xlabel("displacement across the surface, cm")
    ax.set_ylabel("beams on the table that are flagged, %")
    ax.legend(fontsize=8, frameon=False)
    return figure


def real(data: Path, folder: Path) -> Figure:
    """The room of the tinySLAM logs, driven twice."""
    visits = []
    for name in ("exp1", "exp2"):
        log = folder / f"{name}.mcap"
        if not (folder / name).exists():
            IMPORTERS["tinyslam"](data / f"{name}.dat.xz", log)
            save(smooth(open_logs([log], Config()), Config()), folder / name, force=True)
        visits.append(load_visit(load(folder / name), folder / name))
    found = detect_changes(*visits, ChangesConfig())
    figure, axes = panels(2, (12, 6))
    for visit, color, name in zip(visits, (GREY, BLUE), ("first", "second"), strict=True):
        scatter(
            axes[0], visit.ends[visit.surface][::2], "as smoothed, each in its own frame", color
        )
        path(axes[0], visit.poses, color, name)
    legend(axes[0])
    overlay(axes[1], found, "straightened, placed, compared", np.zeros(3))
    return figure
