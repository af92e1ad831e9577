"""Chapter 5 of the thesis as a whole, over two visits: `thesis_method` has its equations.

1. Both visits in one frame, by their landmarks. 2. The reference map: every return of a reference
scan leaves a dent. 3. The occlusion map: what that scan saw, free or hit. 4. A later scan is
compared with what is expected from its pose; what differs and was not hidden is a change.

As in 6.2 a scan is compared with one scan, here the reference's nearest one: in a map of many scans
the first dent on a beam is that of the most outlying return, and nearly all beams are marked. For
comparison only: beams are marked one by one, with a gate that takes their errors for independent.
Applications use `detect_changes`.
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from scipy.ndimage import binary_dilation, label

from graphslam.change_detection.detect import identity_registration
from graphslam.change_detection.grid import Grid, grid_over
from graphslam.change_detection.rigid_registration import Registration, landmarks_of_map, register
from graphslam.change_detection.thesis_method import (
    BeamComparison,
    DentMap,
    LaserNoise,
    compare_scan,
    consecutive_runs,
    make_dents,
    occlusion_map,
    point_covariances,
    scan_points,
)
from graphslam.change_detection.visit import Bools, Ints, Visit, pose_to_dict
from graphslam.core.config import ChangesConfig
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array, wrap

#: m: marked points nearer than this are one region
REGION_M = 0.15
#: scans of a visit that are used: the thesis uses one
MOST_SCANS = 300
#: m: depth of a surface behind a return, in the occlusion map
MARGIN_M = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class MarkedRegion:
    """Marked points near each other.

    ``kind``: `appeared` if most are nearer than expected, else `vanished`; ``polygon`` (c, 2) m
    counter-clockwise; ``beams`` are the marked ones; ``first_seen_ns`` the first of their scans.
    """

    kind: str
    polygon: Array
    beams: int
    first_seen_ns: int


@dataclass(frozen=True, slots=True, eq=False)
class ThesisChanges:
    """What the thesis' method says of two visits, in the reference's frame.

    Attributes:
        reference, later: the visits.
        registration: of the later world frame in the reference's.
        nearest: (s,) the reference scan that each later scan was compared with.
        grid: cells of all maps.
        expected: of all later beams (n): ranges, distances and what was dismissed.
        marked: (n,) beams that show a change.
        regions: of marked points, largest first.
        gate: on the squared distance of 5.14.
        rate: the false-alarm rate that the gate is for, if errors were independent.
        warnings: what was left out, one line each.
    """

    reference: Visit
    later: Visit
    registration: Registration
    nearest: Ints
    grid: Grid
    expected: BeamComparison
    marked: Bools
    regions: tuple[MarkedRegion, ...]
    gate: float
    rate: float
    warnings: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """The contents of changes.json."""
        return {
            "method": "thesis",
            "changes": [
                {
                    "kind": region.kind,
                    "polygon": region.polygon.tolist(),
                    "before": None,
                    "probability": None,
                    "displacement": None,
                    "beams": region.beams,
                    "first_seen_ns": region.first_seen_ns,
                    "lines_before": [],
                    "lines_now": [],
                }
                for region in self.regions
            ],
            "beams_compared": int(self.expected.compared.sum()),
            "beams_flagged": int(self.marked.sum()),
            "beams_dismissed": int(self.expected.dismissed.sum()),
            "false_alarm_rate_requested": self.rate,
            "gate": self.gate,
            "registration": pose_to_dict(self.registration.pose, self.registration.cov)
            | {"landmarks": len(self.registration.matched)},
            "warnings": list(self.warnings),
        }


def thesis_changes(
    reference: Visit, later: Visit, config: ChangesConfig, *, same_frame: bool = False
) -> ThesisChanges:
    """Compare two visits by the thesis' method; ``same_frame``: they are spans of one run.

    Raises:
        OutputError: the two cannot be registered.
    """
    found = (
        identity_registration(reference)
        if same_frame
        else register(landmarks_of_map(reference), landmarks_of_map(later))
    )
    reference, later = _thinned(reference), _thinned(later.transformed(found.pose, found.cov))
    every = np.concatenate([visit.ends[np.isfinite(visit.range_m)] for visit in (reference, later)])
    grid = grid_over(every, config.resolution_m, config.max_side_cells**2)
    noise = laser_noise(config)
    nearest = nearest_scans(reference, later)
    gate = float(chi2_quantile(1.0 - config.false_alarm_rate, 2))
    parts, marked = [], []
    for scan, near in enumerate(nearest.tolist()):
        dents, visible = reference_maps(reference, near, grid, config)
        beams = later.scan == scan
        ranges = _usable(later.range_m[beams], config)
        one = compare_scan(
            dents, visible, later.poses[scan], later.covs[scan], later.angle[beams], ranges, noise
        )
        parts.append(one)
        marked.append(consecutive_runs(one.differs(gate), config.consecutive_beams))
    expected = BeamComparison.joined(parts)
    every_marked = np.concatenate(marked)
    regions = marked_regions(later, expected, every_marked, grid)
    return ThesisChanges(
        reference, later, found, nearest, grid, expected, every_marked, regions, gate,
        config.false_alarm_rate,
    )  # fmt: skip


def nearest_scans(reference: Visit, later: Visit) -> Ints:
    """The reference scan (s,) that each later one is nearest to: metres and radians added."""
    away = np.hypot(*(later.poses[:, None, :2] - reference.poses[:, :2]).transpose(2, 0, 1))
    turned = np.abs(wrap(later.poses[:, None, 2] - reference.poses[:, 2]))
    return np.asarray((away + turned).argmin(axis=1))


def laser_noise(config: ChangesConfig) -> LaserNoise:
    """Of a beam, with the range noise of the settings."""
    return LaserNoise(range_m=config.range_sigma_m)


def reference_maps(
    reference: Visit, scan: int, grid: Grid, config: ChangesConfig
) -> tuple[DentMap, Bools]:
    """The map of dents of one scan (5.7-5.12), and which cells (cells,) it saw (5.4)."""
    beams = reference.scan == scan
    pose, cov = reference.poses[scan], reference.covs[scan]
    angles, ranges = reference.angle[beams], _usable(reference.range_m[beams], config)
    covs = point_covariances(pose, cov, angles, np.nan_to_num(ranges, nan=1.0), laser_noise(config))
    dents = make_dents(grid, scan_points(pose, angles, ranges), covs)
    return dents, occlusion_map(grid, pose, angles, ranges, MARGIN_M)


def _thinned(visit: Visit) -> Visit:
    """At most `MOST_SCANS` scans, evenly spaced."""
    every = np.zeros(len(visit.poses), dtype=bool)
    every[:: -(-len(every) // MOST_SCANS)] = True
    return visit if every.all() else visit.select(every)


def _usable(ranges: Array, config: ChangesConfig) -> Array:
    """Ranges (n,), NaN where they are too short or too long to be used."""
    with np.errstate(invalid="ignore"):
        good = (ranges > config.min_range_m) & (ranges < config.max_range_m)
    return np.where(good, ranges, np.nan)


def marked_regions(
    later: Visit, expected: BeamComparison, marked: Bools, grid: Grid
) -> tuple[MarkedRegion, ...]:
    """Marked points in groups: of cells that are nearer to each other than `REGION_M`."""
    beams = np.flatnonzero(marked)
    cell = grid.cells(later.ends[beams])
    beams, cell = beams[cell >= 0], cell[cell >= 0]
    taken = np.zeros(grid.shape, dtype=bool)
    taken.reshape(-1)[cell] = True
    reach = max(1, round(REGION_M / grid.cell_m / 2))
    joined, count = label(binary_dilation(taken, iterations=reach), np.ones((3, 3)))
    group = joined.reshape(-1)[cell]
    found = [_region(later, expected, beams[group == k]) for k in range(1, count + 1)]
    return tuple(sorted(found, key=lambda region: -region.beams))


def _region(later: Visit, expected: BeamComparison, beams: Ints) -> MarkedRegion:
    points = later.ends[beams]
    nearer = later.range_m[beams] < expected.ranges[beams]
    hull = cv2.convexHull(points.astype(np.float32))[:, 0].astype(float)
    x, y = hull.T
    if np.dot(x, np.roll(y, -1)) < np.dot(y, np.roll(x, -1)):
        hull = hull[::-1]
    return MarkedRegion(
        "appeared" if nearer.mean() >= 0.5 else "vanished",
        hull,
        len(beams),
        int(later.stamps_ns[later.scan[beams]].min()),
    )
