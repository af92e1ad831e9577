"""Which of the things that vanished is which of those that appeared, and how it moved."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from graphslam.changes.regions import Region
from graphslam.changes.registration import Registration
from graphslam.changes.visit import Ints
from graphslam.geometry import (
    Array,
    compose,
    compose_cov,
    compose_jacobians,
    inverse,
    inverse_cov,
    rotation,
    transform,
    wrap,
)
from graphslam.records import Landmark

#: shapes are alike if what is left between them is less than this, m, for this share of both
_ALIKE_M, _ALIKE_SHARE = 0.05, 0.8
#: what the ends of a stretch are known to, m: beams and cells are coarse, edges are left out
_END_SIGMA_M = 0.04
#: what a piece is known to across, m, and how many pieces share one window
_ACROSS_SIGMA_M, _SHARED = 0.01, 5.0
_LENGTH_M = 0.12
_FARTHEST_M = 5.0


@dataclass(frozen=True, slots=True, eq=False)
class Displacement:
    """Rigid motion (3,) of the world that takes a thing from where it was, with cov (3, 3)."""

    motion: Array
    cov: Array


def segment_moves(
    reference: Sequence[Landmark], later: Sequence[Landmark], registration: Registration
) -> list[tuple[Landmark, Array, Displacement]]:
    """Segments of the map that are in both runs with the same length, but not in the same place.

    Returns:
        Per moved segment the reference's landmark, its ends (2, 2) m in the later run, in the
        reference's frame, and its displacement.
    """
    matched_ref, matched_later = set(registration.matched[:, 0]), set(registration.matched[:, 1])
    before = [m for i, m in enumerate(reference) if m.kind == "segment" and i not in matched_ref]
    after = [m for i, m in enumerate(later) if m.kind == "segment" and i not in matched_later]
    pairs = []
    for i, a in enumerate(before):
        for j, b in enumerate(after):
            longer = abs(_length(a) - _length(b))
            pose = compose(registration.pose, b.position)
            way = float(np.hypot(*(pose[:2] - a.position[:2])))
            if longer < _LENGTH_M and way < _FARTHEST_M and _length(a) > 4 * _LENGTH_M:
                pairs.append((longer + 0.1 * way, i, j))
    found, taken = [], (set[int](), set[int]())
    for _, i, j in sorted(pairs):
        if i in taken[0] or j in taken[1]:
            continue
        taken[0].add(i)
        taken[1].add(j)
        a, b = before[i], after[j]
        pose = compose(registration.pose, b.position)
        cov = compose_cov(registration.pose, registration.cov, b.position, b.cov)
        back = inverse(a.position)
        motion = compose(pose, back)
        total = compose_cov(pose, cov, back, inverse_cov(a.position, a.cov))
        ends = transform(registration.pose, b.extent)
        found.append((a, ends, Displacement(motion, total)))
    return found


def _length(landmark: Landmark) -> float:
    return float(np.hypot(*(landmark.extent[1] - landmark.extent[0])))


def paired(
    vanished: Sequence[Region], appeared: Sequence[Region]
) -> list[tuple[int, int, Displacement]]:
    """Pairs (vanished, appeared) of like shape, the most alike first, each region once."""
    fits = []
    for i, a in enumerate(vanished):
        for j, b in enumerate(appeared):
            fit = _fit(a, b)
            if fit is not None:
                fits.append((fit[0], i, j, fit[1]))
    found, taken = [], (set[int](), set[int]())
    for _, i, j, motion in sorted(fits, key=lambda fit: fit[0]):
        if i not in taken[0] and j not in taken[1]:
            taken[0].add(i)
            taken[1].add(j)
            found.append((i, j, motion))
    return found


def _fit(a: Region, b: Region) -> tuple[float, Displacement] | None:
    """The motion that brings a onto b, and what is left between them; None if not alike."""
    size_a, size_b = (float(np.sqrt(r.points.var(axis=0).sum())) for r in (a, b))
    away = b.points.mean(axis=0) - a.points.mean(axis=0)
    if np.hypot(*away) > _FARTHEST_M or not 0.7 < size_a / max(size_b, 1e-9) < 1.4:
        return None
    best: tuple[float, Displacement] | None = None
    for turn in np.linspace(-np.pi, np.pi, 24, endpoint=False):
        fit = _icp(a, b, float(turn))
        if fit is not None and (best is None or fit[0] < best[0]):
            best = fit
    return best


def _icp(a: Region, b: Region, turn: float) -> tuple[float, Displacement] | None:
    """Nearest points, again and again; the weight is across the surface, ends hold it along."""
    tree = cKDTree(b.points)
    center = a.points.mean(axis=0)
    local = a.points - center
    pose = np.array([*b.points.mean(axis=0), turn])  # of the frame at a's middle
    N, information, right = len(local), np.eye(3), np.zeros(3)
    for _ in range(12):
        moved = transform(pose, local)
        _, near = tree.query(moved)
        n = b.normals[near]
        weight = n[:, :, None] * n[:, None, :] / (_SHARED * _ACROSS_SIGMA_M**2)
        weight = weight + np.eye(2) / (N * _END_SIGMA_M**2)
        J = np.zeros((N, 2, 3))
        J[:, 0, 0] = J[:, 1, 1] = 1.0
        arm = moved - pose[:2]
        J[:, 0, 2], J[:, 1, 2] = -arm[:, 1], arm[:, 0]
        r = b.points[near] - moved
        information = np.einsum("nia,nij,njb->ab", J, weight, J)
        right = np.einsum("nia,nij,nj->a", J, weight, r)
        step = np.linalg.solve(information, right)
        pose = np.array([*(pose[:2] + step[:2]), wrap(pose[2] + step[2])])
    moved = transform(pose, local)
    there, back = tree.query(moved)[0], cKDTree(moved).query(b.points)[0]
    share = min((there < _ALIKE_M).mean(), (back < _ALIKE_M).mean())
    if share < _ALIKE_SHARE:
        return None
    cov = np.linalg.inv(information)
    # the frame at a's middle stood at (center, 0)
    start = np.array([-center[0], -center[1], 0.0])
    F, _ = compose_jacobians(pose, start)
    motion = compose(pose, start)
    return float(np.hypot(there.mean(), back.mean())), Displacement(motion, F @ cov @ F.T)


def moved_points(points: Array, by: Displacement) -> Array:
    """Points (n, 2) m after the motion."""
    return np.asarray(points @ rotation(by.motion[2]).T + by.motion[:2])


def close_to(points: Array, ends: Array, within_m: float) -> Ints:
    """Which points (n, 2) m lie within a distance of the stretch between ``ends`` (2, 2) m."""
    along = ends[1] - ends[0]
    t = np.clip((points - ends[0]) @ along / float(along @ along), 0.0, 1.0)
    away = np.hypot(*(points - ends[0] - t[:, None] * along).T)
    return np.asarray(np.nonzero(away < within_m)[0])
