"""Scan-to-map alignment: each scan's pose from the surfaces that it observes, with a prior.

The pose error is common to all beams of a scan. Its posterior given the scan's own beams
marginalises it: a beam is then judged by the uncertainty that the other beams leave. The prior
holds a scan where no surface constrains it; a redescending weight suppresses changes.
"""

from dataclasses import replace

import numpy as np

from graphslam.change_detection.surface_map import Surface
from graphslam.change_detection.visit import Bools, Ints, Visit
from graphslam.core.geometry import Array, wrap
from graphslam.perception.point_to_line import (
    line_metrics,
    normal_equations,
    point_terms,
    redescending,
    step_poses,
)

#: sigma of a beam against a surface beside the surface's own noise, m: neighbouring beams share the
#: surface's error, so their information must not grow without bound
_MIN_SIGMA_M = 0.008
#: number of beams per scan that suffices to estimate its pose
_BEAMS = 150


def align_scans(
    visit: Visit, surface: Surface, gates_m: tuple[float, ...], changed: Bools | None = None
) -> Visit:
    """The visit with poses and covariances updated by alignment with a surface map in its frame.

    ``gates_m``: largest distance of a return from its surface, one per iteration; ``changed`` (n,):
    beams to leave out, as they hit something that changed.
    """
    usable = visit.surface if changed is None else visit.surface & ~changed
    beams = np.nonzero(usable)[0]
    beams = beams[:: max(1, len(beams) // (_BEAMS * len(visit.poses)))]
    prior = np.linalg.inv(visit.covs + 1e-10 * np.eye(3))
    start, now, covs = visit.poses, visit, visit.covs
    for gate in gates_m:
        information, right = scan_normal_equations(now, surface, beams, gate)
        away = start - now.poses
        away[:, 2] = wrap(away[:, 2])
        covs = np.asarray(np.linalg.inv(prior + information))
        right = right + np.einsum("nij,nj->ni", prior, away)
        step = np.einsum("nij,nj->ni", covs, right)
        now = replace(now, poses=step_poses(now.poses, step))
    # the error is P prior⁻¹ (error of the prior) + (a part due to this scan's noise): the first may
    # be common to all scans; its covariance is P prior⁻¹ P
    return replace(now, covs=covs, shared=covs @ prior @ covs)


def scan_normal_equations(
    visit: Visit, surface: Surface, beams: Ints, gate_m: float
) -> tuple[Array, Array]:
    """Normal equations of point-to-line alignment with a surface map, per scan.

    Information (s, 3, 3) and right-hand side (s, 3) from ``beams`` (k,) that end within ``gate_m``
    of a surface.
    """
    ends, size = visit.ends_of(beams), len(visit.poses)
    row, e, found = surface_offsets(surface, ends, gate_m)
    scan = visit.scan[beams][found]
    n, arm = surface.normals[row], ends[found] - visit.poses[scan, :2]
    terms, squared = point_terms(e[:, None] * n, line_metrics(n), arm)
    weight = redescending(squared, gate_m) / (_MIN_SIGMA_M**2 + surface.noise[row])
    sums = np.array([np.bincount(scan, weight * t, size) for t in terms], dtype=float)
    information, gradient = normal_equations(sums)
    return information, -gradient


def surface_offsets(surface: Surface, ends: Array, gate_m: float) -> tuple[Ints, Array, Ints]:
    """Distances of points ``ends`` (k, 2) m from the surface next to them.

    Returns:
        For those points whose nearest piece is good, within the gate, and beside them: rows (f,) of
        the pieces, signed distances (f,) m along their normals, indices (f,) of the points.
    """
    grid = surface.nearest.grid
    cell = grid.cells(ends)
    near = cell >= 0
    row = np.where(near, surface.nearest.member[cell], 0)
    d = ends - surface.points[row]
    n = surface.normals[row]
    e = np.einsum("ni,ni->n", d, n)
    along = np.abs(d[:, 0] * n[:, 1] - d[:, 1] * n[:, 0])
    found = np.nonzero(
        near & surface.good[row] & (np.abs(e) < gate_m) & (along < 1.5 * grid.cell_m)
    )[0]
    return row[found].astype(np.int64), np.asarray(e[found]), np.asarray(found, dtype=np.int64)
