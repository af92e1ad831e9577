"""Full smoothing with GTSAM: incrementally (iSAM2) and, at the end, to convergence.

`Isam2Backend` is incremental smoothing over the whole past (horizon = infinity), its tree updated
at every step (`compressed` does so seldom). `Reoptimiser` solves what was recorded once more.
"""

from collections.abc import Iterable, Sequence

import gtsam
import numpy as np

from graphslam.core.config import Config, RobustConfig
from graphslam.core.errors import EstimationError
from graphslam.core.geometry import Array
from graphslam.core.records import Association, Closure, Estimate, Step
from graphslam.core.worker import parallel_map
from graphslam.estimation import factors
from graphslam.estimation.factor_graph import (
    Estimates,
    GraphBackend,
    GraphBuilder,
    Part,
    read,
    write,
)

#: m or rad: the estimate has converged when all variables together move less than this
CONVERGED = 1e-6
#: the same for lines that are faced anew, and rounds of it: it converges in two without a kernel;
#: with one it need not, as weights change too, and more rounds change nothing that shows
FACED, MAX_FACINGS, MAX_FACINGS_ROBUST = 1e-6, 4, 2
#: relative decrease of the error at which optimising ends: without a kernel; with one (reweighting
#: converges linearly: beyond 1e-6 hundreds of iterations move nothing that shows); and where
#: another round follows anyway
CONVERGED_ERROR, CONVERGED_ERROR_ROBUST, CONVERGED_ERROR_ROUGH = 1e-10, 1e-6, 1e-3


#: linearising anew costs what there is by then: so many steps make the time between two looks for
#: what moved as long again
AS_LONG_AGAIN = 1000
#: marginals that are worth a second process
MANY = 500
#: updates between two looks, for GTSAM, that will not be
NEVER = 1 << 30


class WholeGraph(GraphBuilder):
    """Keeps every factor there ever was, in ``graph``.

    With ``faced_later`` those of lines are only there once `face_lines` made them, all at once.
    """

    def __init__(self, kernel: RobustConfig, *, faced_later: bool = False) -> None:
        super().__init__(kernel, lines=not faced_later)
        self.graph = gtsam.NonlinearFactorGraph()
        self._faced_later = faced_later
        self._observed: list[tuple[int, int, Association]] = []  # lines, and their places in graph
        self._places: list[int] = []
        self.meetings: list[tuple[int, tuple[int, int, Association]]] = []  # the same of robots

    def expand(self, step: Step, current: Estimates) -> list[Part]:
        """The parts of a step, taken in; ``current`` is asked for existing estimates."""
        fresh: dict[int, Array] = {}

        def estimate(key: int, dim: int) -> Array:
            return fresh[key] if key in fresh else current(key, dim)

        parts = []
        for part in self.parts(step, estimate):
            if part.new is not None:
                fresh.update([part.new])
            self._take(part)
            parts.append(part)
        return parts

    def insert(self, step: Step, start: Estimate, values: gtsam.Values) -> None:
        """Take in a recorded step, its variables at their values in ``start``."""
        for part in self.parts(step, lambda key, _dim: self.value_in(start, key)):
            if part.new is not None:
                write(values, part.new[0], self.value_in(start, part.new[0]))
            self._take(part)

    def _take(self, part: Part) -> None:
        for factor in part.factors:
            self.graph.add(factor)
        if self._note_line(part) and not self._faced_later:
            self._places.append(self.graph.size() - 1)
        elif part.observed is not None and isinstance(part.observed[2].target, str):
            self.meetings.append((self.graph.size() - 1, part.observed))

    def _note_line(self, part: Part) -> bool:
        """Whether a part observes a line: noted for `face_lines`."""
        if part.observed is None or part.observed[2].model != "line":
            return False
        self._observed.append(part.observed)
        return True

    def make_room(self) -> None:
        """Places in the graph for the factors of lines that were left to `face_lines`."""
        size, missing = self.graph.size(), len(self._observed) - len(self._places)
        self.graph.resize(size + missing)
        self._places += range(size, size + missing)

    def face_lines(self, values: gtsam.Values) -> None:
        """Make the factors of all lines anew at ``values``; see `GraphBuilder.faced`."""
        if not self._observed:
            return
        self.make_room()
        keys, targets, seen = zip(*self._observed, strict=True)
        known = np.unique([keys, targets])
        poses = np.array([read(values, int(key), 3) for key in known])
        made = factors.line_factors(
            keys,
            targets,
            np.array([a.z for a in seen]),
            np.array([a.cov for a in seen]),
            poses[np.searchsorted(known, keys)],
            poses[np.searchsorted(known, targets)],
            self.kernel,
        )
        for place, factor in zip(self._places, made, strict=True):
            self.graph.replace(place, factor)

    def close(self, closures: Iterable[Closure]) -> None:
        """Add closures between states that are there."""
        for closure in closures:
            part = self._closure(closure)
            if part is not None:
                for factor in part.factors:
                    self.graph.add(factor)

    def diagnose(self, values: gtsam.Values) -> EstimationError:
        """Which variable is indeterminate: QR answers NaN for all of them, Cholesky names one."""
        try:
            marginals = gtsam.Marginals(self.graph, values)
            for key in values.keys():  # noqa: SIM118 (GTSAM's values are no mapping)
                marginals.marginalCovariance(key)
        except RuntimeError as error:
            return self.explain(error)
        return self.explain(RuntimeError(""))


def isam2_parameters(config: Config, factorization: str) -> gtsam.ISAM2Params:
    """Settings of iSAM2; ``factorization`` CHOLESKY or QR."""
    parameters = gtsam.ISAM2Params()
    parameters.setRelinearizeThreshold(config.backend.relinearize_threshold)
    parameters.relinearizeSkip = NEVER  # `Isam2Backend` says when
    parameters.setFactorization(factorization)
    return parameters


class Isam2Backend(GraphBackend):
    """Incremental smoothing of all states; see the module's docstring."""

    smooths = True

    def __init__(self, config: Config, builder: WholeGraph | None = None) -> None:
        self._config = config
        self._builder = builder or WholeGraph(config.robust)
        super().__init__(self._builder)
        self._factorization = "CHOLESKY"
        self._isam = gtsam.ISAM2(isam2_parameters(config, self._factorization))
        self._finished: gtsam.Values | None = None  # `finish` ended here; not asked since
        self._steps = self._looked = 0  # steps taken; the one at which it was linearised anew

    def value(self, key: int, dim: int) -> Array:
        """Current estimate (dim,) of a variable."""
        self._settle()
        if dim == 3:
            return factors.array3(self._isam.calculateEstimatePose2(key))
        return np.asarray(self._isam.calculateEstimatePoint2(key))

    def add(self, step: Step) -> None:
        """See `Backend`."""
        self._settle()
        self._joints.clear()
        self._steps += 1
        self._update(self._builder.expand(step, self.value), self._due())

    def _due(self) -> bool:
        """Whether it is time to look for what is to be linearised anew."""
        every = self._config.backend.relinearize_every * (1 + self._steps // AS_LONG_AGAIN)
        return self._steps >= self._looked + every

    def _update(self, parts: Iterable[Part], anew: bool) -> None:
        """Let the tree take in parts; ``anew``: after linearising anew what has moved before."""
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for part in parts:
            if part.new is not None:
                write(values, *part.new)
            for factor in part.factors:
                graph.add(factor)
        if anew:
            self._looked = self._steps
        try:
            self._isam.update(graph, values, [], None, None, None, anew)
        except RuntimeError as error:
            self._use_qr(error)

    def _use_qr(self, error: RuntimeError) -> None:
        """Start the tree anew with QR, at what the failed one was linearised at.

        Cholesky is twice as fast but calls good graphs indeterminate where information spans many
        orders of magnitude (MIT at pose 165, M3500 at 695); QR does not.
        """
        if self._factorization == "QR":
            raise self._builder.explain(error) from error
        self._factorization = "QR"
        graph, values = self._isam.getFactorsUnsafe(), self._isam.getLinearizationPoint()
        self._isam = gtsam.ISAM2(isam2_parameters(self._config, "QR"))
        try:
            self._isam.update(graph, values)
        except RuntimeError as again:
            raise self._builder.explain(again) from again

    def _settle(self) -> None:
        """After `finish`: a tree built anew at the converged estimate, which answers from now on.

        Only made when something is asked, since most are done after `finish`.
        """
        if self._finished is None:
            return
        values, self._finished = self._finished, None
        self._isam = gtsam.ISAM2(isam2_parameters(self._config, self._factorization))
        try:
            self._isam.update(self._builder.graph, values)
        except RuntimeError as error:
            self._use_qr(error)

    def covariance(self, keys: list[int]) -> Array:
        """See `GraphBackend`."""
        return self._tree_covariance(keys)

    def _tree_covariance(self, keys: list[int]) -> Array:
        """The same according to the tree."""
        self._settle()
        try:
            if len(keys) == 1:
                cov = np.asarray(self._isam.marginalCovariance(keys[0]))
            else:
                cov = np.asarray(self._isam.jointMarginalCovariance(keys).fullMatrix())
        except RuntimeError as error:
            raise self._builder.explain(error) from error
        if not np.isfinite(cov).all():
            raise self._builder.diagnose(self._isam.calculateEstimate())
        return cov

    def finish(self) -> Estimate:
        """See `Backend`: optimised to convergence, or iSAM2 until it moves no more.

        What is asked afterwards, a joint marginal for example, is answered at that estimate.
        """
        if self._config.backend.optimise_at_end:
            return self._result(self._optimised(self._isam.calculateBestEstimate()))
        return self._result(self._converged())

    def state_covariance(self, states: Sequence[tuple[str, int]]) -> Array:
        """Joint covariance (3n, 3n) of states, by robot and time, errors along each one's axes."""
        builder = self._builder
        numbers = [(robot, builder.states.number(robot, t)) for robot, t in states]
        return self._tree_covariance([builder.state_key(*state) for state in numbers])

    def current_estimate(self) -> Estimate:
        """What the tree has now, where solving again begins: covariances are NaN."""
        return self._rough(self._isam.calculateBestEstimate())

    def _rough(self, values: gtsam.Values) -> Estimate:
        means = {key: read(values, key, dim) for key, dim in self._builder.dims().items()}
        covs = {key: np.full((len(mean), len(mean)), np.nan) for key, mean in means.items()}
        return self._estimate(means, covs, float(self._builder.graph.error(values)))

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
        """Optimised, the lines faced anew until that moves nothing any more."""
        plain = self._config.robust.kernel == "none"
        try:
            for _ in range(MAX_FACINGS if plain else MAX_FACINGS_ROBUST):
                before = values
                self._builder.face_lines(values)
                values = optimise(self._builder.graph, values, self._config.robust)
                if before.localCoordinates(values).norm() < FACED:
                    break
        except RuntimeError as error:
            raise self._builder.explain(error) from error
        return values

    def _marginals(self, values: gtsam.Values) -> dict[int, Array]:
        """Marginal covariance of every key: by Cholesky, or by QR where that gives up."""
        keys = values.keys()
        try:
            return marginals_of(gtsam.Marginals(self._builder.graph, values), keys)
        except RuntimeError as error:
            isam = gtsam.ISAM2(isam2_parameters(self._config, "QR"))
            isam.update(self._builder.graph, values)
            found = {key: isam.marginalCovariance(key) for key in keys}
            # QR does not complain about an indeterminate graph, it answers NaN
            if not all(np.isfinite(cov).all() for cov in found.values()):
                raise self._builder.explain(error) from error
            return found

    def _result(self, values: gtsam.Values) -> Estimate:
        self._finished = values
        self._joints.clear()
        covs = self._marginals(values)
        means = {key: read(values, key, len(cov)) for key, cov in covs.items()}
        return self._estimate(means, covs, float(self._builder.graph.error(values)))


class Reoptimiser(Isam2Backend):
    """Solves recorded steps again and again, with more closures or fewer."""

    def __init__(self, config: Config, steps: Iterable[Step], start: Estimate) -> None:
        """Take steps in.

        Args:
            config: settings.
            steps: all there are, as recorded.
            start: an estimate of every variable in them, where solving begins.

        Raises:
            EstimationError: a covariance is not positive definite and finite.
        """
        super().__init__(config, WholeGraph(config.robust, faced_later=True))
        values = gtsam.Values()
        for step in steps:
            self._builder.insert(step, start, values)
        self._builder.make_room()
        self._finished = values
        self._size, self._rows = self._builder.graph.size(), self._builder.rows

    def solve(self, closures: Iterable[Closure] = (), *, rough: bool = False) -> Estimate:
        """Solved from where the last solution ended.

        Args:
            closures: beside those in the steps; those of the last solution are gone.
            rough: to what a next round can go on from, in a fraction of the time: covariances are
                NaN (`joint` and `state_covariance` have them).

        Raises:
            EstimationError: the steps make the estimate indeterminate.
        """
        builder, values = self._builder, self._values()
        builder.graph.resize(self._size)
        builder.rows = self._rows
        builder.close(closures)
        if not rough:
            return self._result(self._optimised(values))
        try:
            builder.face_lines(values)
            values = optimise(builder.graph, values, self._config.robust, CONVERGED_ERROR_ROUGH)
        except RuntimeError as error:
            raise builder.explain(error) from error
        self._finished = values
        self._joints.clear()
        return self._rough(values)

    def _values(self) -> gtsam.Values:
        return self._isam.calculateBestEstimate() if self._finished is None else self._finished


def marginals_of(marginals: gtsam.Marginals, keys: Sequence[int]) -> dict[int, Array]:
    """Marginal covariance (d, d) of each key, m and rad.

    Raises:
        RuntimeError: one is indeterminate.
    """
    keys = list(keys)
    found = parallel_map(marginals.marginalCovariance, keys, fewest=MANY)
    return dict(zip(keys, found, strict=True))


def optimise(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    kernel: RobustConfig,
    converged: float | None = None,
) -> gtsam.Values:
    """Levenberg-Marquardt from ``values`` until the error decreases by less than ``converged``.

    Relative to the error; by default, without a kernel, to 1e-10, which comes for free where
    convergence is quadratic.
    """
    if converged is None:
        converged = CONVERGED_ERROR if kernel.kernel == "none" else CONVERGED_ERROR_ROBUST
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(converged)
    parameters.setAbsoluteErrorTol(1e-9)
    parameters.setMaxIterations(200)
    return gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
