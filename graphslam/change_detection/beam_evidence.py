"""Evidence of change: beams of one visit that end behind surfaces of the other.

The test is applied in both directions. Later beams behind a reference surface: something vanished,
or moved back. Reference beams behind a later surface: something appeared, or moved forward. A beam
that ends in front of a surface was occluded and carries no information about it, so what is
occluded is never taken to have vanished.

The innovation of a beam is its range minus the expected one, one degree of freedom; times the
cosine of incidence it is the offset along the surface's normal, whose variance has no pole at
grazing angles. Offsets are averaged over a window of the surface and over all scans.
"""

from dataclasses import dataclass

import numpy as np
from scipy.stats import norm

from graphslam.change_detection.grid import row_sums, sorted_unique, window_sums
from graphslam.change_detection.surface_alignment import surface_offsets
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

#: smallest cosine of incidence of a beam that is taken to cross a surface
MIN_COSINE = 0.2
#: a beam must cross a surface this many sigmas of its lateral error away from the surface's edge
_INSIDE_SIGMAS = 3.0
#: the null distribution is estimated from scores up to _CUT of its own sigmas, by the quantile
#: _BULK of these; rounds until that is consistent (it converges within a few)
_CUT, _BULK, _ROUNDS = 4.0, 0.8, 20
#: the tails (corners, curves, edges) are wider than those of a normal distribution fitted to the
#: bulk by this factor (1.05 +- 0.02 at 1 % and 0.1 %, over seeds of visits without changes)
_TAILS = 1.05
#: lower bound on the estimated sigma of the null distribution, and least number of scores for it
_MIN_SIGMA, _MIN_SCORES = 0.86, 100
#: null sigma from which on the two visits disagree for reasons that nobody stated
DOUBTFUL_SIGMA = 1.5
#: beams traced at a time, which bounds the memory
_CHUNK = 400_000


@dataclass(frozen=True, slots=True, eq=False)
class BeamEvidence:
    """Test statistics of the beams of one visit on each piece of the other's surfaces.

    Attributes:
        beams: (p,) beams of pairs (beam, piece), ``rows`` (p,) their pieces.
        offset: (n,) m, weighted mean distance of the beams' ends behind the piece.
        variance: (n,) m² of ``offset`` under the null hypothesis of no change.
        count: (n,) number of beams in the window.
        passed: (n,) number of those that ended more than the gate behind it.
        tested: (n,) whether there are enough beams for a test.
        first_ns: (n,) stamp of the first scan with a beam that ended clearly behind, or else of the
            first that hit the piece's window; int64 max only where nothing was tested.
    """

    beams: Ints
    rows: Ints
    offset: Array
    variance: Array
    count: Array
    passed: Array
    tested: Bools
    first_ns: Ints

    def scores(self, sigma: float) -> Array:
        """Offsets (n,) over ``sigma`` times their stated sigmas; 0 where nothing was tested."""
        score = self.offset / (sigma * np.sqrt(self.variance))
        return np.asarray(np.where(self.tested, score, 0.0))


def beams_past_surfaces(
    surface: Surface, visit: Visit, sigma_m: float, config: ChangesConfig
) -> BeamEvidence:
    """Evidence of the beams of ``visit``, of range noise ``sigma_m``, on the other's surfaces."""
    used = np.nonzero(visit.surface & (visit.range_m <= config.max_range_m))[0]
    ends, directions = visit.ends_of(used), visit.directions[used]
    row, e, found = surface_offsets(surface, ends, config.gate_m)
    cosine = np.einsum("ni,ni->n", surface.normals[row], directions[found])
    near = (row, used[found], np.sign(cosine) * e, np.abs(cosine))
    row, beam, cosine = crossings(surface, visit, used, config.gate_m)
    far = (row, beam, np.full(len(row), config.gate_m), cosine)
    row, beam, e, cosine = map(np.concatenate, zip(near, far, strict=True))
    passed = np.repeat([0.0, 1.0], [len(near[0]), len(far[0])])
    n = len(surface.cells)
    weight = 1 / ((sigma_m * cosine) ** 2 + config.flatness_m**2)
    own, common = pose_variance(visit, beam, visit.ends[beam], surface.normals[row])
    # bounds the part of the pose where a beam ended far behind: it is tested at the surface
    own, common = np.minimum(own, config.gate_m**2), np.minimum(common, config.gate_m**2)
    terms = (
        weight, weight * e, weight * own, weight * common, weight * cosine, np.ones(len(row)),
        passed, weight**2, weight**2 * e, weight**2 * e**2,
    )  # fmt: skip
    inner = inner_windows(surface)
    sums = window_sums(np.column_stack([row_sums(row, t, n) for t in terms]), inner)
    total, sum_e, sum_own, sum_common, sum_cos, count, through, *squares = sums.T
    safe = np.where(total > 0, total, 1.0)
    mean = sum_e / safe
    # Beams that contradict each other (most end on the surface, a few graze past its edge) carry
    # less information than as many that agree: the variance is at least that of their scatter.
    scatter = (squares[2] - 2 * mean * squares[1] + mean**2 * squares[0]) / safe**2
    white = np.maximum(1 / safe, scatter)
    scans = scans_per_cell(row, visit.scan[beam], len(visit.poses), n)
    pose = (sum_common + sum_own / np.maximum(window_max(scans, inner), 1)) / safe
    bias = config.bias_sigma_m * (sum_cos / safe - surface.incidence)
    variance = white + surface.offset_cov + pose + surface.pose_var + bias**2
    tested = surface.good & (count >= config.min_beams)
    never = np.iinfo(np.int64).max
    first, hit, stamps = np.full(n, never), np.full(n, never), visit.stamps_ns[visit.scan[beam]]
    behind = e > 0.5 * config.gate_m
    np.minimum.at(first, row[behind], stamps[behind])
    np.minimum.at(hit, row, stamps)
    # an offset too small for a single beam was first observed when its window was first hit
    padded = np.concatenate([hit, [never]])
    hit = np.min([padded[rows] for rows in inner], axis=0)
    first = np.where(first == never, hit, first)
    return BeamEvidence(beam, row, mean, variance, count, through, tested, first)


def inner_windows(surface: Surface) -> list[Ints]:
    """The inner 3 x 3 neighbourhood of a surface's windows."""
    side, inner = 2 * WINDOW + 1, range(WINDOW - 1, WINDOW + 2)
    return [surface.windows[i * side + j] for i in inner for j in inner]


def crossings(
    surface: Surface, visit: Visit, used: Ints, gate_m: float
) -> tuple[Ints, Ints, Array]:
    """Beams, of those in ``used`` (k,), that cross a piece and end over ``gate_m`` behind it.

    Returns:
        Rows (p,) of pieces, beams (p,), and cosines of incidence (p,).
    """
    chunks = (used[i : i + _CHUNK] for i in range(0, len(used), _CHUNK))
    parts = [_crossings(surface, visit, chunk, gate_m) for chunk in chunks]
    row, beam, cosine = (np.concatenate(part) for part in zip(*parts, strict=True))
    return row, beam, cosine


def _crossings(
    surface: Surface, visit: Visit, used: Ints, gate_m: float
) -> tuple[Ints, Ints, Array]:
    beam, row = _candidates(surface, visit, used)
    scan = visit.scan[beam]
    d = unit_vectors(visit.headings(beam))
    o, n = visit.poses[scan, :2], surface.normals[row]
    cosine = np.einsum("ni,ni->n", d, n)
    steep = (np.abs(cosine) > MIN_COSINE) & surface.good[row]
    distance = np.einsum("ni,ni->n", n, surface.points[row] - o)
    reach = distance / np.where(steep, cosine, 1.0)
    at = o + reach[:, None] * d
    tangent = np.column_stack([-n[:, 1], n[:, 0]])
    aside = np.abs(np.einsum("ni,ni->n", tangent, at - surface.points[row]))
    grid = surface.nearest.grid
    behind = (visit.range_m[beam] - reach) * np.abs(cosine)
    hit = np.nonzero(steep & (reach > 0) & (aside < 0.75 * grid.cell_m) & (behind > gate_m))[0]
    # the surface continues on both sides
    P = visit.covs[scan[hit]]
    sideways = P[:, 0, 0] + P[:, 1, 1] + P[:, 2, 2] * reach[hit] ** 2
    margin = _INSIDE_SIGMAS * np.sqrt(sideways) + half_beam_spacing(visit) * reach[hit]
    margin = np.maximum(margin / np.abs(cosine[hit]), 2 * grid.cell_m)[:, None]
    inside = np.ones(len(hit), dtype=bool)
    for sign in (-1.0, 1.0):
        cell = grid.cells(at[hit] + sign * margin * tangent[hit])
        inside &= (cell >= 0) & (surface.nearest.distance_m[cell] < 1.6 * grid.cell_m)
    hit = hit[inside]
    return row[hit], beam[hit], np.abs(cosine[hit])


def half_beam_spacing(visit: Visit) -> float:
    """Half the angle between neighbouring beams, rad: the uncertainty of a ray's direction."""
    step = np.diff(visit.angle[: int(np.searchsorted(visit.scan, visit.scan[0] + 1))])
    return float(np.median(step)) / 2 if len(step) else 0.0


def _candidates(surface: Surface, visit: Visit, used: Ints) -> tuple[Ints, Ints]:
    """Distinct pairs (beam, piece) of which the beam passes close to the piece.

    Sphere tracing: each step is as long as the distance to the nearest piece, which takes tens of
    steps instead of hundreds of cells.
    """
    near, grid = surface.nearest, surface.nearest.grid
    cell = np.float32(grid.cell_m)
    scan = visit.scan[used]
    heading = visit.headings(used)
    # in cells; single precision resolves a thousandth of a cell at this size of a map
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


def range_noise(surface: Surface, visit: Visit, config: ChangesConfig) -> float:
    """Range noise sigma, m, from the median absolute offset of returns from their surfaces."""
    beams = np.nonzero(visit.surface)[0]
    row, e, found = surface_offsets(surface, visit.ends_of(beams), config.gate_m)
    cosine = np.abs(np.einsum("ni,ni->n", surface.normals[row], visit.directions[beams[found]]))
    face_on = cosine > 0.5
    if not face_on.any():
        return config.range_sigma_m
    return float(np.median(np.abs(e[face_on] / cosine[face_on])) / norm.ppf(0.75))


def null_sigma(evidence: tuple[BeamEvidence, ...]) -> float:
    """Sigma of the scores without a change: 1 if all covariances are as stated.

    Most of what is observed has not changed, so the bulk of the scores has the null distribution
    (an empirical null, doi:10.1198/016214504000000089); the tails, where changes are, are not used.
    Where the tails begin is told by the sigma itself, first by that of the median: any share of
    changed surface below a half is left out. Pieces are weighted by their number of beams, as the
    requested false-alarm rate is per beam.
    """
    scores, weight = _tested_scores(evidence)
    if len(scores) < _MIN_SCORES:
        return 1.0
    sigma = _robust_sigma(scores, weight, 0.5)
    # of a normal distribution that ends at _CUT
    inner = _BULK * (2 * float(norm.cdf(_CUT)) - 1)
    for _ in range(_ROUNDS):
        before, bulk = sigma, np.abs(scores) <= _CUT * sigma
        if weight[bulk].sum() == 0:
            break
        sigma = _robust_sigma(scores[bulk], weight[bulk], _BULK, inner)
        if abs(sigma - before) <= 1e-3 * before:
            break
    return max(_TAILS * sigma, _MIN_SIGMA)


def agreeing_share(evidence: tuple[BeamEvidence, ...], sigmas: float, per_beam: bool) -> float:
    """Share of the tested pieces whose offset is within ``sigmas`` of the stated one; or of beams.

    1 if nothing was tested.
    """
    scores, weight = _tested_scores(evidence)
    if not len(scores):
        return 1.0
    return float(np.average(np.abs(scores) <= sigmas, weights=weight if per_beam else None))


def repeatability(evidence: tuple[BeamEvidence, ...]) -> float:
    """Sigma, m, of the offsets between two visits of what did not change, from the median.

    It includes what the covariances leave out: bias of other materials that affected the alignment
    of the scans, and walls that are not flat.
    """
    offsets = np.concatenate([e.offset[e.tested] for e in evidence])
    return _robust_sigma(offsets, _tested_scores(evidence)[1], 0.5) if len(offsets) else 0.0


def _tested_scores(evidence: tuple[BeamEvidence, ...]) -> tuple[Array, Array]:
    """Scores (k,), for a sigma of 1, of all tested pieces, and their numbers of beams (k,)."""
    scores = np.concatenate([e.scores(1.0)[e.tested] for e in evidence])
    return scores, np.concatenate([e.count[e.tested] for e in evidence])


def _robust_sigma(
    values: Array, weight: Array, share: float, normal_share: float | None = None
) -> float:
    """Sigma of a normal distribution of which a share is as near to 0 as that of the values (k,).

    Of the values, with ``weight`` (k,), that is ``share``; of the distribution the same, or
    ``normal_share`` where the values are only a part of it.
    """
    order = np.argsort(np.abs(values))
    at = int(np.searchsorted(np.cumsum(weight[order]) / weight.sum(), share))
    quantile = norm.ppf((1 + (share if normal_share is None else normal_share)) / 2)
    return float(np.abs(values[order[min(at, len(order) - 1)]]) / quantile)
