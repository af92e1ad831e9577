"""Where the beams of one visit reach past the surfaces of the other.

One question, asked twice. Later beams past a reference surface: something vanished, or moved back.
Reference beams past a later surface: something appeared, or moved forward. A beam that ends before
a surface was stopped by something else and says nothing about it, so what is not seen is never
taken to have vanished.

The innovation of a beam is its range minus the expected one, one degree of freedom; times the
cosine of incidence it is the offset along the surface's normal, whose variance has no pole at
grazing angles. Offsets are averaged over a window of the surface and all scans.
"""

from dataclasses import dataclass

import numpy as np
from scipy.stats import norm

from graphslam.change_detection.grid import row_sums, sorted_unique, window_sums
from graphslam.change_detection.scan_to_map import surface_offsets
from graphslam.change_detection.surface_map import (
    WINDOW,
    Surface,
    pose_variance,
    scans_per_cell,
    window_max,
)
from graphslam.change_detection.visit import Bools, Ints, Visit
from graphslam.core.config import ChangesConfig
from graphslam.core.geometry import Array, unit_vectors

#: a beam along a surface says nothing about whether it passed it
_LEAST_COSINE = 0.2
#: a beam must cross a surface this many sigmas of its own sideways error inside of its edge
_INSIDE_SIGMAS = 3.0
#: share of the scores, the smallest, that is taken to be of what did not change
_BULK = 0.8
#: what the bulk promises, the tails (corners, curves, edges) do not keep: they are so much wider
#: (1.05 +- 0.02 at 1 % and 0.1 %, over seeds of visits between which nothing changed)
_TAILS = 1.05
#: sigmas are believed to be overstated by no more than this, and not at all by few scores
_LEAST_SPREAD, _LEAST_SCORES = 0.86, 100
#: beams traced at a time, which bounds the memory
_CHUNK = 400_000


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """What the beams of one visit say about each piece of the other's surfaces.

    Attributes:
        beams: (p,) beam numbers of pairs (beam, piece), ``rows`` (p,) their pieces.
        offset: (n,) m, weighted mean of how far behind the piece the beams ended.
        variance: (n,) m² of it if nothing changed.
        count: (n,) beams in the window.
        passed: (n,) beams among them that went through.
        tested: (n,) whether enough beams tell.
        first_ns: (n,) stamp of the first scan with a beam that went clearly past, or else of the
            first that met its window; int64 max only where nothing was tested.
    """

    beams: Ints
    rows: Ints
    offset: Array
    variance: Array
    count: Array
    passed: Array
    tested: Bools
    first_ns: Ints

    def scores(self, spread: float) -> Array:
        """Offsets (n,) in sigmas, the stated ones times ``spread``; 0 where nothing was tested."""
        score = self.offset / (spread * np.sqrt(self.variance))
        return np.asarray(np.where(self.tested, score, 0.0))


def beams_past_surfaces(
    surface: Surface, visit: Visit, incidence_of: Array, sigma_m: float, config: ChangesConfig
) -> Evidence:
    """Beams of ``visit`` against surfaces of the other visit.

    Args:
        surface: pieces of the other visit.
        visit: beams, in the same frame.
        incidence_of: (n,) mean cosine at which the other visit saw its pieces.
        sigma_m: range noise.
        config: settings.
    """
    used = np.nonzero(visit.surface & (visit.range_m <= config.max_range_m))[0]
    ends, directions = visit.ends[used], visit.directions[used]
    row, e, found = surface_offsets(surface, ends, config.gate_m)
    cosine = np.einsum("ni,ni->n", surface.normals[row], directions[found])
    near = (row, used[found], np.sign(cosine) * e, np.abs(cosine))
    far = crossings(surface, visit, used, config.gate_m)
    row, beam = np.concatenate([near[0], far[0]]), np.concatenate([near[1], far[1]])
    e, cosine = np.concatenate([near[2], far[2]]), np.concatenate([near[3], far[3]])
    passed = np.concatenate([np.zeros(len(near[0])), np.ones(len(far[0]))])
    n = len(surface.cells)
    weight = 1 / ((sigma_m * cosine) ** 2 + config.flatness_m**2)
    own, common = pose_variance(visit, beam, visit.ends[beam], surface.normals[row])
    # a bound on the pose's part where a beam went far behind: it is judged at the surface
    own, common = np.minimum(own, config.gate_m**2), np.minimum(common, config.gate_m**2)
    terms = (
        weight,
        weight * e,
        weight * own,
        weight * common,
        weight * cosine,
        np.ones(len(row)),
        passed,
        weight**2,
        weight**2 * e,
        weight**2 * e**2,
    )
    sums = np.column_stack([row_sums(row, t, n) for t in terms])
    inner = inner_windows(surface)
    total, sum_e, sum_own, sum_common, sum_cos, count, through, *squares = window_sums(
        sums, inner
    ).T
    safe = np.where(total > 0, total, 1.0)
    mean = sum_e / safe
    # Beams that contradict each other (most stop at a surface, a few graze past its edge) tell
    # less than as many that agree: the variance is no smaller than their scatter makes it.
    scatter = (squares[2] - 2 * mean * squares[1] + mean**2 * squares[0]) / safe**2
    white = np.maximum(1 / safe, scatter)
    scans = scans_per_cell(row, visit.scan[beam], len(visit.poses), n)
    pose = (sum_common + sum_own / np.maximum(window_max(scans, inner), 1)) / safe
    bias = config.bias_sigma_m * (sum_cos / safe - incidence_of)
    variance = white + surface.offset_cov + pose + surface.pose_var + bias**2
    tested = surface.good & (count >= config.min_beams)
    never = np.iinfo(np.int64).max
    first, met, stamps = np.full(n, never), np.full(n, never), visit.stamps_ns[visit.scan[beam]]
    beyond = e > 0.5 * config.gate_m
    np.minimum.at(first, row[beyond], stamps[beyond])
    np.minimum.at(met, row, stamps)
    # what lies less far off than one beam can tell was first seen when its window was first met
    padded = np.concatenate([met, [never]])
    met = np.min([padded[place] for place in inner], axis=0)
    first = np.where(first == never, met, first)
    return Evidence(beam, row, mean, variance, count, through, tested, first)


def inner_windows(surface: Surface) -> list[Ints]:
    """The 3 x 3 neighbourhood out of a surface's windows."""
    side = 2 * WINDOW + 1
    return [
        surface.windows[i * side + j]
        for i in range(WINDOW - 1, WINDOW + 2)
        for j in range(WINDOW - 1, WINDOW + 2)
    ]


def crossings(
    surface: Surface, visit: Visit, used: Ints, gate_m: float
) -> tuple[Ints, Ints, Array, Array]:
    """Beams that cross a piece and end more than ``gate_m`` behind it.

    Args:
        surface: pieces.
        visit: beams.
        used: (k,) which of them.
        gate_m: as above.

    Returns:
        Rows (p,) of pieces, beams (p,), offsets (p,) m cut off at the gate, cosines (p,).
    """
    parts = [
        _crossings(surface, visit, used[i : i + _CHUNK], gate_m)
        for i in range(0, len(used), _CHUNK)
    ]
    row, beam, cosine = (np.concatenate(p) for p in zip(*parts, strict=True))
    return row, beam, np.full(len(row), gate_m), cosine


def _crossings(
    surface: Surface, visit: Visit, used: Ints, gate_m: float
) -> tuple[Ints, Ints, Array]:
    beam, row = _candidates(surface, visit, used)
    scan = visit.scan[beam]
    heading = visit.poses[scan, 2] + visit.angle[beam]
    d = unit_vectors(heading)
    o, n = visit.poses[scan, :2], surface.normals[row]
    cosine = np.einsum("ni,ni->n", d, n)
    steep = (np.abs(cosine) > _LEAST_COSINE) & surface.good[row]
    distance = np.einsum("ni,ni->n", n, surface.points[row] - o)
    reach = distance / np.where(steep, cosine, 1.0)
    at = o + reach[:, None] * d
    tangent = np.column_stack([-n[:, 1], n[:, 0]])
    aside = np.abs(np.einsum("ni,ni->n", tangent, at - surface.points[row]))
    grid = surface.nearest.grid
    behind = (visit.range_m[beam] - reach) * np.abs(cosine)
    hit = np.nonzero(steep & (reach > 0) & (aside < 0.75 * grid.cell_m) & (behind > gate_m))[0]
    # inside of its edges, on both sides
    P = visit.covs[scan[hit]]
    sideways = P[:, 0, 0] + P[:, 1, 1] + P[:, 2, 2] * reach[hit] ** 2
    margin = _INSIDE_SIGMAS * np.sqrt(sideways) + half_beam_spacing(visit) * reach[hit]
    margin = np.maximum(margin / np.abs(cosine[hit]), 2 * grid.cell_m)[:, None]
    inside = np.ones(len(hit), dtype=bool)
    for way in (-1.0, 1.0):
        cell = grid.cells(at[hit] + way * margin * tangent[hit])
        inside &= (cell >= 0) & (surface.nearest.distance_m[cell] < 1.6 * grid.cell_m)
    hit = hit[inside]
    return row[hit], beam[hit], np.abs(cosine[hit])


def half_beam_spacing(visit: Visit) -> float:
    """Half the angle between neighbouring beams, rad: how far a beam's ray is known."""
    step = np.diff(visit.angle[: int(np.searchsorted(visit.scan, visit.scan[0] + 1))])
    return float(np.median(step)) / 2 if len(step) else 0.0


def _candidates(surface: Surface, visit: Visit, used: Ints) -> tuple[Ints, Ints]:
    """Pairs (beam, piece) where a beam comes close to a piece before its end, each once.

    A beam jumps as far as the nearest piece is away: tens of steps instead of hundreds of cells.
    """
    near, grid = surface.nearest, surface.nearest.grid
    cell = np.float32(grid.cell_m)
    scan = visit.scan[used]
    heading = visit.poses[scan, 2] + visit.angle[used]
    # in cells, single precision: a thousandth of a cell at this size of a map
    origin = ((visit.poses[scan, :2] - np.array(grid.origin_m)) / grid.cell_m).astype(np.float32)
    ox, oy = origin.T.copy()
    dx, dy = np.cos(heading).astype(np.float32), np.sin(heading).astype(np.float32)
    end = (visit.range_m[used] / grid.cell_m).astype(np.float32)
    s = np.zeros(len(used), dtype=np.float32)
    active = np.arange(len(used), dtype=np.int64)
    pairs: list[Ints] = []
    width = len(surface.cells)
    while len(active):
        i = np.floor(ox + s * dx).astype(np.int32)
        j = np.floor(oy + s * dy).astype(np.int32)
        inside = (i >= 0) & (i < grid.shape[0]) & (j >= 0) & (j < grid.shape[1])
        flat = np.where(inside, i * np.int32(grid.shape[1]) + j, 0)
        distance = np.where(inside, near.distance_m[flat] / cell, np.float32(4))
        close = np.nonzero(inside & (distance < 1.5))[0]
        pairs.append(active[close] * width + near.member[flat[close]])
        s = s + np.maximum(distance - np.float32(1.5), np.float32(1.0))
        going = s < end
        active, s, end = active[going], s[going], end[going]
        ox, oy, dx, dy = ox[going], oy[going], dx[going], dy[going]
    found = sorted_unique(np.concatenate(pairs)) if pairs else np.zeros(0, dtype=np.int64)
    return used[found // width], found % width


def range_noise(surface: Surface, visit: Visit, gate_m: float) -> float:
    """Sigma of ranges, m, from how returns scatter about the surfaces they are on; robust."""
    beams = np.nonzero(visit.surface)[0]
    row, e, found = surface_offsets(surface, visit.ends[beams], gate_m)
    cosine = np.abs(np.einsum("ni,ni->n", surface.normals[row], visit.directions[beams[found]]))
    face_on = cosine > 0.5
    if not face_on.any():
        return 0.02
    return float(np.median(np.abs(e[face_on] / cosine[face_on])) / norm.ppf(0.75))


def null_sigma(evidence: tuple[Evidence, ...]) -> float:
    """Sigma of the scores of what did not change: of the bulk, widened for the tails.

    Most of what is seen has not changed, so the middle of the distribution is that of no change
    (an empirical null, doi:10.1198/016214504000000089). Its tails are not used, where changes are.
    Pieces weigh as many beams as they have, since the rate that is asked for is per beam.
    """
    scores = np.abs(np.concatenate([e.scores(1.0)[e.tested] for e in evidence]))
    weight = np.concatenate([e.count[e.tested] for e in evidence])
    if len(scores) < _LEAST_SCORES:
        return 1.0
    order = np.argsort(scores)
    share = np.cumsum(weight[order]) / weight.sum()
    found = float(scores[order][np.searchsorted(share, _BULK)] / norm.ppf((1 + _BULK) / 2))
    return max(_TAILS * found, _LEAST_SPREAD)


def repeatability(evidence: tuple[Evidence, ...]) -> float:
    """Sigma, m, with which two visits place what did not change; robust.

    Whatever the covariances leave out is in it: other things' bias that pulled at the scans, and
    walls that are not flat.
    """
    offsets = np.abs(np.concatenate([e.offset[e.tested] for e in evidence]))
    weight = np.concatenate([e.count[e.tested] for e in evidence])
    if not len(offsets):
        return 0.0
    order = np.argsort(offsets)
    half = int(np.searchsorted(np.cumsum(weight[order]), 0.5 * weight.sum()))
    return float(offsets[order][half] / norm.ppf(0.75))
