"""How uncertain an estimate is whose weights are not the inverse of its errors' covariance.

With weights W and errors of covariance R an estimate has the covariance P Hᵀ W R W H P, where
P = (Hᵀ W H)⁻¹ is what it would have if R were W⁻¹ (the sandwich of P. J. Huber, The behavior of
maximum likelihood estimates under nonstandard conditions, 5th Berkeley Symposium, 1967; H. White,
A heteroskedasticity-consistent covariance matrix estimator, Econometrica 48(4), 1980, DOI
10.2307/1912934). Errors that sightings of one target share make R a matrix of large blocks. The
sandwich is computed for some variables, and by how much it differs from P there holds for all: it
is much the same along a path.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.sparse import csr_matrix, diags, vstack
from scipy.sparse.linalg import SuperLU, splu

from graphslam.core.arrays import IntArray
from graphslam.core.geometry import Array
from graphslam.core.record import replace
from graphslam.core.records import Association, Estimate
from graphslam.estimation import factors
from graphslam.estimation.recorded_graph import (
    SHARED_NS,
    ObservationNoise,
    RecordedGraph,
    Source,
)

#: states of a robot, evenly spread, and landmarks, for which the sandwich is computed: the factors
#: of MRCLAM 6 are within 5 % of those by 40
SAMPLE = 5


def weighing_variance(noise: ObservationNoise, count: IntArray) -> Array:
    """Factors (n, 2) on stated variances, for sightings of which ``count`` (n,) share an error.

    An error that is the same for all of them asks for the white variance and n times the shared
    one, if it is not estimated: they tell no more of it than one sighting. But what they tell of
    the motion between them, in which it cancels, is then lost. Weighed as white each tells all of
    that, but if the error changes meanwhile, as the residuals do not show, it is not true. The root
    of n is between the two.
    """
    return np.asarray(noise.white + np.sqrt(count)[:, None] * noise.shared)


def shared_spans(targets: IntArray, times_ns: IntArray) -> tuple[IntArray, IntArray]:
    """The number (n,) of the span whose error each sighting shares, and with how many (n,).

    ``targets`` (n,) are numbers of what is seen, ``times_ns`` (n,) those of the states.
    """
    spans = np.column_stack([targets, times_ns // SHARED_NS])
    _, of, count = np.unique(spans, axis=0, return_inverse=True, return_counts=True)
    of = of.ravel()
    return of, count[of]


@dataclass(frozen=True, slots=True, eq=False)
class CovarianceFactors:
    """Robot -> factor on the covariances of its states; and that on those of landmarks."""

    states: Mapping[str, float]
    landmarks: float

    def applied_to(self, estimate: Estimate) -> Estimate:
        """The estimate with these covariances."""
        states = {
            robot: replace(own, covs=self.states[robot] * own.covs)
            for robot, own in estimate.states.items()
        }
        landmarks = {
            i: (mean, self.landmarks * cov) for i, (mean, cov) in estimate.landmarks.items()
        }
        return replace(estimate, states=states, landmarks=landmarks)


def covariance_factors(
    builder: RecordedGraph, values: gtsam.Values, noise: Mapping[Source, ObservationNoise]
) -> CovarianceFactors:
    """By how much the covariances of a solution have to be larger, for what its sightings share.

    Args:
        builder: the graph, whose bearings and ranges have `weighing_variance`.
        values: its solution.
        noise: of the sources of bearings and ranges.

    Raises:
        RuntimeError: the solution is indeterminate.
    """
    places, width = _places(builder, values)
    entries = np.asarray(builder.graph.linearize(values).sparseJacobian_())
    rows, columns = entries[:2].astype(np.int64) - 1
    left = columns < width  # the last column is the right side
    A = csr_matrix((entries[2, left], (rows[left], columns[left])), (int(rows.max()) + 1, width))
    solver = splu((A.T @ A).tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
    errors = _error_root(builder, noise, A.shape[0]) @ A
    states = {
        robot: _factor(solver, errors, _sample([places[k] for k in builder.state_keys(robot)]), 3)
        for robot in builder.robots
    }
    points = [places[factors.landmark_key(i)] for i, d in builder.landmark_dims.items() if d == 2]
    return CovarianceFactors(states, _factor(solver, errors, _sample(points), 2))


def _error_root(
    builder: RecordedGraph, noise: Mapping[Source, ObservationNoise], height: int
) -> csr_matrix:
    """B (m, ``height``) of which Bᵀ B is the covariance of the graph's whitened errors.

    That of motions, starts and calibrations is one, as weighed. Sightings are the last rows of the
    graph, in pairs.
    """
    sources = builder.bearings_and_ranges
    own = np.ones(height)
    first = height - 2 * sum(map(len, sources.values()))
    parts = []
    for source, seen in sources.items():
        rows = slice(first, first := first + 2 * len(seen))
        if source in noise:
            alone, shared, of = shared_parts([a for *_, a in seen], noise[source])
            own[rows] = alone.ravel()
            at = np.arange(rows.start, rows.stop)
            group = (2 * of[:, None] + np.arange(2)).ravel()
            parts.append(csr_matrix((shared.ravel(), (group, at)), (2 * int(of.max()) + 2, height)))
    return vstack([diags(own), *parts]).tocsr()


def shared_parts(
    seen: Sequence[Association], noise: ObservationNoise
) -> tuple[Array, Array, IntArray]:
    """Sigmas (n, 2) of the own and of the shared error, as whitened, and whose the latter is."""
    number = {target: k for k, target in enumerate(dict.fromkeys(a.target for a in seen))}
    targets = np.array([number[a.target] for a in seen], dtype=np.int64)
    of, count = shared_spans(targets, np.array([a.time_ns for a in seen], dtype=np.int64))
    weighed = weighing_variance(noise, count)
    return np.sqrt(noise.white / weighed), np.sqrt(noise.shared / weighed), of


def _places(builder: RecordedGraph, values: gtsam.Values) -> tuple[dict[int, int], int]:
    """First column of each variable, in the order of the keys, and how many columns there are."""
    dims, places, end = builder.dims(), dict[int, int](), 0
    for key in sorted(values.keys()):
        places[key] = end
        end += dims[key] if key in dims else len(values.atVector(key))  # calibrations are vectors
    return places, end


def _sample(places: Sequence[int]) -> IntArray:
    """Some of many places: the middle one of each of so many equal parts."""
    chosen = np.unique(((np.arange(SAMPLE) + 0.5) / SAMPLE * len(places)).astype(np.int64))
    return np.array(places, dtype=np.int64)[chosen] if places else np.zeros(0, dtype=np.int64)


def _factor(solver: SuperLU, errors: csr_matrix, places: IntArray, dim: int) -> float:
    """Mean factor on the covariances of some variables; 1 without any.

    ``solver``: of the information; ``errors`` (m, D): the root of the middle of the sandwich.
    """
    n = len(places)
    if not n:
        return 1.0
    rows = places[:, None] + np.arange(dim)
    unit = np.zeros((errors.shape[1], n * dim))
    unit[rows.ravel(), np.arange(n * dim)] = 1.0
    P = solver.solve(unit)
    moved = (errors @ P).reshape(-1, n, dim)
    sandwich = moved.transpose(1, 2, 0) @ moved.transpose(1, 0, 2)
    stated = P.reshape(-1, n, dim)[rows, np.arange(n)[:, None]]
    return float(np.trace(np.linalg.solve(stated, sandwich), axis1=1, axis2=2).mean() / dim)
