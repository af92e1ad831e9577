"""Landmarks and trajectories as CSV, one line each, for spreadsheets and data frames."""

import csv
import math
from collections.abc import Mapping, Sequence
from io import StringIO

import numpy as np

from graphslam.core.records import Landmark, Trajectory

LANDMARK_COLUMNS = (
    "id", "kind", "x_m", "y_m", "phi_rad", "x1_m", "y1_m", "x2_m", "y2_m",
    "xx_m2", "xy_m2", "yy_m2", "sightings", "first_ns", "last_ns", "identity", "frame",
)  # fmt: skip
TRAJECTORY_COLUMNS = (
    "robot", "stamp_ns", "x_m", "y_m", "phi_rad", "x_sigma_m", "y_sigma_m", "phi_sigma_rad",
    "frame",
)  # fmt: skip


def landmark_rows(landmarks: Sequence[Landmark]) -> list[tuple[object, ...]]:
    """A row of `LANDMARK_COLUMNS` for each; None where a landmark has no such value."""
    return [
        (
            m.id,
            m.kind,
            *m.position[:2].tolist(),
            None if m.kind == "point" else float(m.position[2]),
            *m.extent.ravel().tolist(),
            *(float(m.cov[i, j]) for i, j in ((0, 0), (0, 1), (1, 1))),
            m.sightings,
            m.first_ns,
            m.last_ns,
            m.identity,
            m.frame,
        )
        for m in landmarks
    ]


def trajectory_rows(
    paths: Mapping[str, Trajectory], frames: Mapping[str, str]
) -> list[tuple[object, ...]]:
    """A row of `TRAJECTORY_COLUMNS` for each pose; a sigma is None where it is not known.

    ``frames``: robot -> its frame, of those that are not in the world, where it is None.
    """
    rows: list[tuple[object, ...]] = []
    for robot, path in sorted(paths.items()):
        variances = np.diagonal(path.covs, axis1=1, axis2=2)
        with np.errstate(invalid="ignore"):
            sigmas = np.sqrt(variances).tolist()
        rows += [
            (robot, stamp, *pose, *(None if math.isnan(s) else s for s in sigma), frames.get(robot))
            for stamp, pose, sigma in zip(
                path.stamps_ns.tolist(), path.poses.tolist(), sigmas, strict=True
            )
        ]
    return rows


def csv_text(columns: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """CSV (RFC 4180 but for line ends) with a head; floats in full precision, None is empty."""
    made = StringIO()
    writer = csv.writer(made, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    return made.getvalue()
