"""Each scan's pose by the surfaces it sees, within what its covariance allows.

The pose error is shared by all beams of a scan. Its posterior given the scan's own beams is what
is left of it, which marginalises the shared error: a beam is then judged by what the others leave
open. The prior keeps a scan where nothing holds it, and a redescending weight keeps changes out.
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

#: noise of a beam against a surface beside its own, m: neighbouring beams share the surface's
#: error, so they must not count as independent without end
_LEAST_SIGMA_M = 0.008
#: beams per scan that are enough to place it
_BEAMS = 150


def align_scans(
    visit: Visit, surface: Surface, gates_m: tuple[float, ...], changed: Bools | None = None
) -> Visit:
    """The visit with poses and covariances that agree with a surface map.

    Args:
        visit: scans in the frame of the surfaces, covariances as known so far.
        surface: what to agree with.
        gates_m: farthest a return may lie from its surface to count, one per iteration.
        changed: (n,) beams that have no say, as they are known to have met what changed.
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
    # the error is P prior⁻¹ (error of the prior) + (a part of this scan's noise): the first may be
    # common to all scans, and has the covariance P prior⁻¹ P
    return replace(now, covs=covs, shared=covs @ prior @ covs)


def scan_normal_equations(
    visit: Visit, surface: Surface, beams: Ints, gate_m: float
) -> tuple[Array, Array]:
    """How beams pull their scans' poses onto a surface map: normal equations per scan.

    Args:
        visit: scans in the frame of the surfaces.
        surface: what to agree with.
        beams: (k,) which have a say.
        gate_m: farthest a return may lie from its surface to count.

    Returns:
        Information (s, 3, 3) and right-hand side (s, 3); the step is the solution of both.
    """
    ends, size = visit.ends[beams], len(visit.poses)
    row, e, found = surface_offsets(surface, ends, gate_m)
    scan = visit.scan[beams][found]
    n, arm = surface.normals[row], ends[found] - visit.poses[scan, :2]
    terms, squared = point_terms(e[:, None] * n, line_metrics(n), arm)
    weight = redescending(squared, gate_m) / (_LEAST_SIGMA_M**2 + surface.noise[row])
    sums = np.array([np.bincount(scan, weight * t, size) for t in terms], dtype=float)
    information, gradient = normal_equations(sums)
    return information, -gradient


def surface_offsets(surface: Surface, ends: Array, gate_m: float) -> tuple[Ints, Array, Ints]:
    """Where points lie against the surface next to them.

    Args:
        surface: pieces.
        ends: (k, 2) m.
        gate_m: farthest from the piece.

    Returns:
        Rows (f,) of pieces and signed distances (f,) m along their normals, for those points
        (f,) whose nearest piece is good, near enough, and not ending before them.
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
