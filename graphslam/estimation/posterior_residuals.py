"""Residuals of a batch solution, and how much of their noise the solution has absorbed.

For white noise of covariance R that a linear least-squares estimate is made from, residuals have
the covariance R - H P Hᵀ: the estimate, of covariance P, follows each measurement a little. Only
with both parts do residuals tell how large the noise is (C. R. Rao, Estimation of variance and
covariance components in linear models, JASA 67, 1972, DOI 10.1080/01621459.1972.10481212).
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.geometry import Array, adjoint, between, inverse, log, rotation3
from graphslam.core.motion_models import Increments
from graphslam.core.observation_models import MODELS
from graphslam.core.records import Step
from graphslam.estimation import factors
from graphslam.estimation.recorded_graph import RecordedGraph, Source
from graphslam.estimation.selected_inverse import CovarianceBlocks
from graphslam.odometry.noise_estimation import clipped

#: share of its variance that a residual needs at least to tell about its noise
MIN_REDUNDANCY = 1e-3
#: ns: errors of motions may be the same over as long as this
SPAN_NS = 3_000_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Residuals:
    """Residuals of n measurements of one kind.

    ``residual`` (n, k); ``variance`` (n, k) of the noise as assumed; ``absorbed`` (n, k): the
    diagonal of H P Hᵀ.
    """

    residual: Array
    variance: Array
    absorbed: Array

    @property
    def redundancy(self) -> Array:
        """(n, k): the share of the noise that is left in each residual."""
        return np.asarray(np.maximum(1.0 - self.absorbed / self.variance, MIN_REDUNDANCY))

    def variance_factor(self) -> Array:
        """Factors (k,) on the variances: residuals squared, each cut, over what is left of them."""
        left = self.redundancy
        return np.asarray((clipped(self.normalised) ** 2 * left).sum(axis=0) / left.sum(axis=0))

    @property
    def normalised(self) -> Array:
        """(n, k): residuals divided by the sigmas that they should have."""
        return np.asarray(self.residual / np.sqrt(self.variance * self.redundancy))


@dataclass(frozen=True, slots=True, eq=False)
class Posterior:
    """A solution: its graph, values and covariances, those of `posterior_pairs` among them.

    ``steps``: what was solved. ``made``: robot -> the motions of it, as they were solved, by the
    calibration that was found.
    ``calibrations``: robot -> key of its calibration, and which of its parameters (p,) that has.
    ``blocks`` are of errors along the axes of each pose; ``poses_at``: `RecordedGraph.pose_reader`.
    """

    steps: Sequence[Step]
    made: Mapping[str, Increments]
    builder: RecordedGraph
    values: gtsam.Values
    blocks: CovarianceBlocks
    calibrations: Mapping[str, tuple[int, IntArray]]
    poses_at: Callable[[IntArray], Array]

    def motions(self, robot: str, made: Increments, *, over_spans: bool = False) -> Residuals:
        """Residuals of all motions of a robot, along the axes of their starts.

        Args:
            robot: its name.
            made: the n motions as they were solved, by the calibration that was found.
            over_spans: the motions are those over `spans` of its states, which were asked for.
        """
        if over_spans:
            pairs = span_keys(self.builder, robot)
        else:
            pairs = [(last, key) for _, name, last, key in self.builder.motions if name == robot]
        moved = between(*(self._values([pair[end] for pair in pairs], 3) for end in (0, 1)))
        turn = rotation3(made.delta[:, 2])
        r = (turn @ log(between(made.delta, moved))[:, :, None])[:, :, 0]
        H = np.concatenate([turn @ -adjoint(inverse(moved)), turn], axis=2)
        variances = np.diagonal(made.cov, axis1=1, axis2=2)
        known = self.calibrations.get(robot)
        if known is None:
            return Residuals(r, variances, self._absorbed(H, pairs))
        # the calibration follows the motions too
        key, use = known
        H = np.concatenate([H, -made.d_cal[:, :, use]], axis=2)
        return Residuals(r, variances, self._absorbed(H, [(*pair, key) for pair in pairs]))

    def sightings(self, source: Source) -> Residuals:
        """Residuals of all bearings and ranges of a source, by its noise in the graph."""
        seen = self.builder.bearings_and_ranges[source]
        model = MODELS[source[1]]
        pairs = [(key, target) for key, target, _ in seen]
        x, t = (
            self._values([pair[end] for pair in pairs], dim)
            for end, dim in enumerate((3, model.dim))
        )
        z, cov = self.builder.polar[source]
        variance = np.diagonal(cov, axis1=1, axis2=2)
        if source in self.builder.noise:
            variance = variance * self.builder.noise[source].white
        H_x, H_t = model.jacobians(z, x, t)
        H_x = H_x @ rotation3(x[:, 2])
        if model.dim == 3:
            H_t = H_t @ rotation3(t[:, 2])
        H = np.concatenate([H_x, H_t], axis=2)
        return Residuals(model.residual(z, x, t), variance, self._absorbed(H, pairs))

    def shared(self, source: Source) -> Residuals | None:
        """Shared errors (n, 2) of a source, as residuals of their priors; None without any."""
        found = self.builder.shared_errors.get(source)
        if found is None:
            return None
        pairs = [(a, b) for a, b in found.keys.tolist()]
        offset = np.subtract(*(self._values([pair[end] for pair in pairs], 2) for end in (1, 0)))
        r = (found.axes @ offset[:, :, None])[:, :, 0]
        H = np.concatenate([-found.axes, found.axes], axis=2)
        return Residuals(r, found.variance, self._absorbed(H, pairs))

    def _absorbed(self, H: Array, pairs: Sequence[tuple[int, ...]]) -> Array:
        P = np.array([self.blocks.joint[pair] for pair in pairs])
        return np.asarray(np.einsum("nij,njk,nik->ni", H, P, H))

    def _values(self, keys: Sequence[int], dim: int) -> Array:
        """Values (n, dim) of states or of points."""
        if dim == 3:
            return self.poses_at(np.array(keys, dtype=np.int64))
        unique, where = np.unique(np.array(keys, dtype=np.int64), return_inverse=True)
        return np.array([factors.read(self.values, key, dim) for key in unique.tolist()])[where]


def spans(times_ns: IntArray) -> IntArray:
    """Indices (n, 2) of states (m,) that begin and end spans of `SPAN_NS`, or a longer motion."""
    ends = np.append(np.flatnonzero(np.diff(times_ns // SPAN_NS)), len(times_ns) - 1)
    ends = np.unique(np.append(0, ends))
    return np.column_stack([ends[:-1], ends[1:]])


def span_keys(builder: RecordedGraph, robot: str) -> list[tuple[int, int]]:
    """Keys of a robot's states that begin and end `spans`."""
    first = builder.state_key(robot, 0)
    return [(first + i, first + j) for i, j in spans(builder.states.stamps(robot)).tolist()]


def posterior_pairs(
    builder: RecordedGraph,
    calibrations: Mapping[str, tuple[int, IntArray]],
    over_spans: Collection[str],
) -> tuple[list[tuple[int, ...]], list[tuple[int, ...]]]:
    """Keys of the variables whose joint covariances `Posterior` needs: in a factor, and over spans.

    Args:
        builder: of the graph.
        calibrations: robot -> key of its calibration, and which of its parameters (p,) that has.
        over_spans: robots whose motions over spans are wanted; these fill the information up.
    """
    own = {robot: (key,) for robot, (key, _) in calibrations.items()}
    over = [
        (*pair, *own.get(robot, ()))
        for robot in builder.robots
        if robot in over_spans
        for pair in span_keys(builder, robot)
    ]
    moved = [(last, key, *own.get(robot, ())) for _, robot, last, key in builder.motions]
    seen = [(key, target) for own in builder.bearings_and_ranges.values() for key, target, _ in own]
    shared = [(a, b) for found in builder.shared_errors.values() for a, b in found.keys.tolist()]
    return moved + seen + shared, over
