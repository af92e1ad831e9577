"""Full smoothing with GTSAM: incremental (iSAM2), and batch optimisation to convergence.

`Isam2Backend` smooths all states incrementally (horizon = infinity) and updates its tree at every
step (`compressed_filter` does so seldom). `Reoptimiser` solves recorded steps again.
"""

from collections.abc import Iterable, Mapping, Sequence

import gtsam
import numpy as np

from graphslam.core.config import Config, RobustConfig
from graphslam.core.geometry import Array
from graphslam.core.records import Association, Closure, Estimate, Step
from graphslam.estimation import factors
from graphslam.estimation.factor_graph import Estimates, FactorGroup, GraphBackend, GraphBuilder
from graphslam.estimation.optimisation import (
    CONVERGED_ERROR_ROUGH,
    is_wide,
    marginals_of,
    optimise,
)
from graphslam.estimation.selected_inverse import CovarianceBlocks

#: m or rad: the estimate has converged when all variables together move less than this
CONVERGED = 1e-6
#: the same for lines whose factors are built again, and the largest number of rounds: it converges
#: in two without a kernel; with one it need not, as weights change too, and more rounds change
#: nothing that shows
LINES_CONVERGED, MAX_LINE_ROUNDS, MAX_LINE_ROUNDS_ROBUST = 1e-6, 4, 2
#: of an estimate that is only a start for another round
NO_COVARIANCES = CovarianceBlocks({}, {})
#: steps after which the interval between relinearisations has doubled, since each costs as much as
#: there are steps
INTERVAL_DOUBLES = 1000
#: `relinearizeSkip` that leaves the decision to `Isam2Backend`
NEVER = 1 << 30


class BatchGraph(GraphBuilder):
    """Keeps every factor, in ``graph``.

    With ``defer_lines`` the factors of lines are missing until `rebuild_lines` makes them, all at
    once. ``robot_observations`` are those of robots: index in the graph, and both keys.
    ``is_wide``: whether the information of motions and closures asks for QR, see `optimisation`.
    """

    #: see `factors.line_rows`
    sliding_lines = False

    def __init__(self, kernel: RobustConfig, *, defer_lines: bool = False) -> None:
        super().__init__(kernel, lines=not defer_lines)
        self.graph = gtsam.NonlinearFactorGraph()
        self.robot_observations: list[tuple[int, tuple[int, int, Association]]] = []
        self.is_wide = False
        self._defer_lines = defer_lines
        self._lines: list[tuple[int, int, Association]] = []
        self._line_indices: list[int] = []  # of the factors of `_lines` in the graph

    @classmethod
    def at_estimate(
        cls, steps: Iterable[Step], start: Estimate, kernel: RobustConfig
    ) -> tuple["BatchGraph", gtsam.Values]:
        """The graph of recorded steps, lines deferred, and its variables' values in ``start``."""
        builder, values, steps = cls(kernel, defer_lines=True), gtsam.Values(), list(steps)
        for step in steps:
            builder.insert(step, start, values)
        motions = [motion for step in steps for motion in step.motions.values()]
        closures = [closure for step in steps for closure in step.closures]
        builder.is_wide = is_wide(motions, closures)
        return builder, values

    def expand(self, step: Step, current: Estimates) -> list[FactorGroup]:
        """Add a step; ``current`` is called for estimates of variables that were there before."""
        new: dict[int, Array] = {}

        def estimate(key: int, dim: int) -> Array:
            return new[key] if key in new else current(key, dim)

        groups = []
        for group in self.factor_groups(step, estimate):
            if group.new is not None:
                new.update([group.new])
            self._add(group)
            groups.append(group)
        return groups

    def insert(self, step: Step, start: Estimate, values: gtsam.Values) -> None:
        """Add a recorded step, its variables with their values in ``start``."""
        for group in self.expand(step, lambda key, _dim: self.value_in(start, key)):
            if group.new is not None:
                factors.write(values, group.new[0], self.value_in(start, group.new[0]))

    def _add(self, group: FactorGroup) -> None:
        for factor in group.factors:
            self.graph.add(factor)
        if group.observed is None:
            return
        *_, seen = group.observed
        if seen.model == "line":
            self._lines.append(group.observed)
            if not self._defer_lines:
                self._line_indices.append(self.graph.size() - 1)
        elif isinstance(seen.target, str):
            self.robot_observations.append((self.graph.size() - 1, group.observed))

    @property
    def has_lines(self) -> bool:
        """Whether lines were observed."""
        return bool(self._lines)

    def reserve_lines(self) -> None:
        """Reserve indices in the graph for the factors of deferred lines."""
        size, missing = self.graph.size(), len(self._lines) - len(self._line_indices)
        self.graph.resize(size + missing)
        self._line_indices += range(size, size + missing)

    def rebuild_lines(self, values: gtsam.Values) -> None:
        """Make the factors of all lines again at ``values``; see `line_factors_at_estimate`."""
        if not self._lines:
            return
        self.reserve_lines()
        keys, targets, seen = zip(*self._lines, strict=True)
        made = factors.line_factors(
            keys,
            targets,
            np.array([a.z for a in seen]),
            np.array([a.cov for a in seen]),
            *observed_ends(self._lines, values),
            self.kernel,
            sliding=self.sliding_lines,
        )
        for index, factor in zip(self._line_indices, made, strict=True):
            self.graph.replace(index, factor)

    def lines_of(self, robot: str) -> list[tuple[int, int, Association]]:
        """Keys of the state and of the landmark of a robot's observations of lines, and these."""
        first, last = self.state_key(robot, 0), self.latest_key(robot)
        return [one for one in self._lines if first <= one[0] <= last]

    def add_closures(self, closures: Iterable[Closure]) -> None:
        """Add closures between existing states."""
        for group in self.closure_groups(closures):
            self._add(group)


def observed_ends(
    observed: Sequence[tuple[int, int, Association]], values: gtsam.Values
) -> tuple[Array, Array]:
    """The states (n, 3) and landmarks (n, 3) of observations of walls, given with their keys."""
    keys, targets, _ = zip(*observed, strict=True)
    unique = np.unique([keys, targets])
    poses = np.array([factors.read(values, int(key), 3) for key in unique])
    return poses[np.searchsorted(unique, keys)], poses[np.searchsorted(unique, targets)]


def isam2_parameters(config: Config, factorization: str) -> gtsam.ISAM2Params:
    """Settings of iSAM2; ``factorization`` CHOLESKY or QR."""
    parameters = gtsam.ISAM2Params()
    parameters.setRelinearizeThreshold(config.backend.relinearize_threshold)
    parameters.relinearizeSkip = NEVER
    parameters.setFactorization(factorization)
    return parameters


def isam2_tree(
    config: Config, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values
) -> gtsam.ISAM2:
    """A tree of the whole graph by QR, linearised at ``values``.

    Raises:
        RuntimeError: it is indeterminate.
    """
    tree = gtsam.ISAM2(isam2_parameters(config, "QR"))
    tree.update(graph, values)
    return tree


class Isam2Backend(GraphBackend):
    """Incremental smoothing of all states; see the module's docstring."""

    def __init__(self, config: Config, builder: BatchGraph | None = None) -> None:
        self._config = config
        self._builder = builder or BatchGraph(config.robust)
        super().__init__(self._builder)
        self._factorization = "CHOLESKY"
        self._isam = gtsam.ISAM2(isam2_parameters(config, self._factorization))
        self._finished: gtsam.Values | None = None  # result of `finish`, until the next query
        self._steps = self._relinearised = 0  # number of steps; the one of the last relinearisation

    def value(self, key: int, dim: int) -> Array:
        """See `GraphBackend`."""
        self._rebuild_if_finished()
        if dim == 3:
            return factors.array3(self._isam.calculateEstimatePose2(key))
        return np.asarray(self._isam.calculateEstimatePoint2(key))

    def add(self, step: Step) -> None:
        """See `Backend`."""
        self._rebuild_if_finished()
        self._joints.clear()
        self._steps += 1
        self._update(self._builder.expand(step, self.value), self._due())

    def _due(self) -> bool:
        """Whether variables that have moved are to be relinearised now."""
        interval = self._config.backend.relinearize_every * (1 + self._steps // INTERVAL_DOUBLES)
        return self._steps >= self._relinearised + interval

    def _update(self, groups: Iterable[FactorGroup], relinearise: bool) -> None:
        """Add factors to the tree; with ``relinearise`` variables that have moved first."""
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for group in groups:
            if group.new is not None:
                factors.write(values, *group.new)
            for factor in group.factors:
                graph.add(factor)
        if relinearise:
            self._relinearised = self._steps
        try:
            self._isam.update(graph, values, [], None, None, None, relinearise)
        except RuntimeError as error:
            self._use_qr(error)

    def _use_qr(self, error: RuntimeError) -> None:
        """Build the tree again with QR, at the linearisation point of the one that failed.

        Cholesky is twice as fast but calls good graphs indeterminate where information spans many
        orders of magnitude (MIT at pose 165, M3500 at 695); QR does not.
        """
        if self._factorization == "QR":
            raise self._builder.explain(error) from error
        self._factorization = "QR"
        graph, values = self._isam.getFactorsUnsafe(), self._isam.getLinearizationPoint()
        try:
            self._isam = isam2_tree(self._config, graph, values)
        except RuntimeError as again:
            raise self._builder.explain(again) from again

    def _rebuild_if_finished(self) -> None:
        """After `finish`: build a tree at the converged estimate for queries from now on.

        Not done by `finish` itself, since most runs end there.
        """
        if self._finished is None:
            return
        values, self._finished = self._finished, None
        self._isam = gtsam.ISAM2(isam2_parameters(self._config, self._factorization))
        try:
            self._isam.update(self._builder.graph, values)
        except RuntimeError as error:
            self._use_qr(error)

    def _flush(self) -> None:
        """Bring the tree up to date; a subclass may have steps pending."""

    def covariance(self, keys: list[int]) -> Array:
        """See `GraphBackend`."""
        return self._tree_covariance(keys)

    def _tree_covariance(self, keys: list[int]) -> Array:
        """The same by the tree, whatever a subclass has in front of it."""
        self._rebuild_if_finished()
        return self._builder.covariance(self._isam, self._builder.graph, keys)

    def finish(self) -> Estimate:
        """See `Backend`: optimised to convergence, or iSAM2 updated until it has converged.

        Queries afterwards, of a joint marginal for example, are answered at that estimate.
        """
        self._flush()
        if self._config.backend.optimise_at_end:
            values = self._optimised(self._isam.calculateBestEstimate())
            return self._result(values)
        return self._result(self._converged())

    def state_covariance(self, states: Sequence[tuple[str, int]]) -> Array:
        """Joint covariance (3n, 3n) of states, by robot and time, errors along each one's axes."""
        self._flush()
        builder = self._builder
        numbers = [(robot, builder.states.number(robot, t)) for robot, t in states]
        return self._tree_covariance([builder.state_key(*state) for state in numbers])

    def current_estimate(self) -> Estimate:
        """The tree's estimate, from which to optimise again: covariances are NaN."""
        self._flush()
        return self._estimate(self._isam.calculateBestEstimate(), NO_COVARIANCES)

    def _estimate(self, values: gtsam.Values, found: CovarianceBlocks) -> Estimate:
        """The estimate with these covariances; those that are missing are NaN."""
        marginals = with_means(values, self._builder.dims(), found.marginals)
        error = float(self._builder.graph.error(values))
        return self._builder.estimate(marginals, error, found.rows)

    def _converged(self) -> gtsam.Values:
        nothing, no_values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        try:
            for _ in range(20):
                self._isam.update(nothing, no_values, [], None, None, None, True)
                if self._isam.getDelta().norm() < CONVERGED:
                    break
        except RuntimeError as error:
            self._use_qr(error)
        return self._isam.calculateBestEstimate()

    def _optimised(self, values: gtsam.Values) -> gtsam.Values:
        """Optimise, and build the lines' factors again, until nothing moves."""
        plain = self._config.robust.kernel == "none"
        rounds = MAX_LINE_ROUNDS if plain else MAX_LINE_ROUNDS_ROBUST
        try:
            for _ in range(rounds if self._builder.has_lines else 1):
                before = values
                self._builder.rebuild_lines(values)
                values = optimise(
                    self._builder.graph,
                    values,
                    self._config.robust,
                    use_qr=self._builder.is_wide,
                )
                if before.localCoordinates(values).norm() < LINES_CONVERGED:
                    break
        except RuntimeError as error:
            raise self._builder.explain(error) from error
        return values

    def _covariances(self, values: gtsam.Values, *, joint: bool) -> CovarianceBlocks:
        """Marginal covariance of every key, and with ``joint`` the root of the information."""
        try:
            builder = self._builder
            return marginals_of(builder.graph, values, keep_rows=joint, use_qr=builder.is_wide)
        except RuntimeError as error:
            raise self._builder.explain(error) from error

    def _result(self, values: gtsam.Values, *, rough: bool = False, joint: bool = True) -> Estimate:
        self._finished = values
        self._joints.clear()
        return self._estimate(
            values, NO_COVARIANCES if rough else self._covariances(values, joint=joint)
        )


class Reoptimiser(Isam2Backend):
    """Solves recorded steps repeatedly, with varying closures."""

    def __init__(self, config: Config, steps: Iterable[Step], start: Estimate) -> None:
        """Build the graph of all steps; optimisation begins at ``start``.

        Raises:
            EstimationError: a covariance is not positive definite and finite.
        """
        builder, values = BatchGraph.at_estimate(steps, start, config.robust)
        super().__init__(config, builder)
        self._builder.reserve_lines()
        self._finished = values
        self._size, self._rows = self._builder.graph.size(), self._builder.rows

    def solve(
        self, closures: Iterable[Closure] = (), *, rough: bool = False, joint: bool = False
    ) -> Estimate:
        """Optimise from the last solution.

        ``closures`` are in addition to those in the steps; those of the last call are removed.
        ``rough``: stop early, in a fraction of the time, as a start for another round; covariances
        are NaN (`joint` and `state_covariance` have them). ``joint``: whether the root of the
        information is wanted too.

        Raises:
            EstimationError: the steps make the estimate indeterminate.
        """
        builder, values = self._builder, self._finished
        if values is None:
            values = self._isam.calculateBestEstimate()
        builder.graph.resize(self._size)
        builder.rows = self._rows
        builder.add_closures(closures)
        if not rough:
            return self._result(self._optimised(values), joint=joint)
        try:
            builder.rebuild_lines(values)
            values = optimise(
                builder.graph,
                values,
                self._config.robust,
                CONVERGED_ERROR_ROUGH,
                use_qr=builder.is_wide,
            )
        except RuntimeError as error:
            raise builder.explain(error) from error
        return self._result(values, rough=True)


def with_means(
    values: gtsam.Values, dims: Mapping[int, int], covs: Mapping[int, Array]
) -> dict[int, tuple[Array, Array]]:
    """Mean (d,) and covariance (d, d), NaN if missing in ``covs``, of every variable."""
    unknown = {dim: np.full((dim, dim), np.nan) for dim in (2, 3)}
    poses = sorted(key for key, dim in dims.items() if dim == 3)
    means = dict(zip(poses, factors.read_poses(values), strict=True))
    return {
        key: (
            means[key] if dim == 3 else factors.read(values, key, dim),
            covs.get(key, unknown[dim]),
        )
        for key, dim in dims.items()
    }
