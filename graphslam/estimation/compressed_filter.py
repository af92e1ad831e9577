"""Full smoothing that updates its tree seldom; in between, a Kalman filter of the local variables.

Between two updates of iSAM2 a robot involves a few variables: its latest poses and the landmarks
around it. Their joint marginal at the last update, updated by each step's factors, contains all
that the rest of the graph says about them: that is `LocalFilter`. iSAM2 gets the pending steps at
once, when a variable that is not local is queried or when relinearisation is due. So a tree of
thousands of poses is updated, solved and queried for marginals once in several steps, and nothing
is lost: in between, the filter's marginals are iSAM2's.

Source: J. Guivant, E. Nebot, Optimization of the simultaneous localization and map-building
algorithm for real-time implementation, IEEE T-RA 17(3), 2001, https://doi.org/10.1109/70.938382
(the compressed filter; theirs has a filter behind it, not a smoother).
"""

from collections.abc import Iterable, Mapping, Sequence
from itertools import chain, groupby

import gtsam
import numpy as np

from graphslam.core.config import Config
from graphslam.core.gaussian import JointGaussian, whiten
from graphslam.core.geometry import Array
from graphslam.core.records import Estimate, Step
from graphslam.estimation import factors
from graphslam.estimation.factor_graph import FactorGroup
from graphslam.estimation.isam2 import BatchGraph, Isam2Backend


class LocalFilter:
    """Joint Gaussian of a few variables, from GTSAM's factors, with errors in body frames.

    Every variable keeps the linearisation point of the tree, and z is its correction in the tangent
    space there. With Jacobians at the current estimate the filter would gain false information
    along lines (see `fixed_lag`).
    """

    def __init__(self, points: Mapping[int, Array], z: Array, cov: Array) -> None:
        """Begin with linearisation points (2,) or (3,), corrections z (D,), covariance (D, D)."""
        self._points = gtsam.Values()
        for key, point in points.items():
            factors.write(self._points, key, point)
        self._dims = {key: len(point) for key, point in points.items()}
        self._gaussian: JointGaussian[int] = JointGaussian.of(self._dims, z, cov)

    def __contains__(self, key: object) -> bool:
        """Whether a variable is in the filter."""
        return key in self._gaussian

    def value(self, key: int) -> Array:
        """Estimate (2,) or (3,) of a variable."""
        z = self._gaussian.x[self._gaussian.slot(key)]
        if len(z) == 3:
            return factors.array3(self._points.atPose2(key).retract(z))
        return np.asarray(self._points.atPoint2(key) + z)

    def covariance(self, keys: Sequence[int]) -> Array:
        """Joint covariance (D, D) of variables, in this order."""
        return self._gaussian.marginal(keys)

    def has_variables_of(self, groups: Iterable[FactorGroup]) -> bool:
        """Whether ``groups`` involve only variables of the filter and those that they introduce."""
        known = set(self._gaussian)
        for group in groups:
            if group.new is not None:
                known.add(group.new[0])
            if not all(known.issuperset(factor.keys()) for factor in group.factors):
                return False
        return True

    def add(self, groups: Iterable[FactorGroup]) -> None:
        """Add the factors of one step.

        Raises:
            numpy.linalg.LinAlgError: rounding, or a group that does not determine its new variable;
                this filter cannot be used any more.
        """
        measured: list[gtsam.NonlinearFactor] = []
        for moves, some in groupby(groups, key=lambda group: group.replaces is not None):
            if moves:
                self._move(list(some))
                continue
            for group in some:
                if group.new is not None:
                    self._augment(*group.new, group.factors)
                else:
                    measured += group.factors
        if measured:
            self._update(measured)

    def _move(self, groups: Sequence[FactorGroup]) -> None:
        """New states of several robots at once: `_augment` where each has only its motion's factor.

        That factor is between the state before and the new one, in this order.
        """
        news = [group.new for group in groups if group.new is not None]
        for key, point in news:
            factors.write(self._points, key, point)
            self._dims[key] = len(point)
        befores = [group.replaces for group in groups if group.replaces is not None]
        linear = [group.factors[0].linearize(self._points).jacobian() for group in groups]
        A, b = np.array([A for A, _ in linear]), np.array([b for _, b in linear])
        noise = np.linalg.inv(A[:, :, 3:])
        G = -noise @ A[:, :, :3]
        last = np.array([self._gaussian.x[self._gaussian.slot(before)] for before in befores])
        means = (noise @ b[:, :, None] + G @ last[:, :, None])[:, :, 0]
        self._gaussian.add_each([key for key, _ in news], befores, means, noise @ noise.mT, G)

    def _augment(self, key: int, point: Array, group: Iterable[gtsam.NonlinearFactor]) -> None:
        """A new variable from the factors that introduce it: thesis 4.24-4.28."""
        factors.write(self._points, key, point)
        self._dims[key] = len(point)
        H, b = self._linear(group)
        J = H.pop(key)  # square, but for a line's empty row
        noise = np.linalg.solve(J.T @ J, J.T)
        given = {other: -noise @ block for other, block in H.items()}
        self._gaussian.add(key, noise @ (b - self._expected(H)), noise @ noise.T, given)

    def _update(self, measured: Iterable[gtsam.NonlinearFactor]) -> None:
        """Measurement update with all of a step's factors at once, thesis 3.5-3.8."""
        H, b = self._linear(measured)
        PHt, HPHt = self._gaussian.project(H, len(b))
        B, whitened, _ = whiten(PHt, HPHt + np.eye(len(b)), b - self._expected(H))
        self._gaussian.x[:] += B.T @ whitened
        self._gaussian.condition(B)

    def _linear(self, measured: Iterable[gtsam.NonlinearFactor]) -> tuple[dict[int, Array], Array]:
        """Whitened Jacobians (k, d) of factors by variable, and b (k,), with H z = b."""
        linear = [(f.keys(), *f.linearize(self._points).jacobian()) for f in measured]
        b = np.concatenate([own for _, _, own in linear])
        H: dict[int, Array] = {}
        row = 0
        for keys, A, own in linear:
            rows, begin = slice(row, row + len(own)), 0
            for key in keys:
                end = begin + self._dims[key]
                H.setdefault(key, np.zeros((len(b), end - begin)))[rows] = A[:, begin:end]
                begin = end
            row = rows.stop
        return H, b

    def _expected(self, H: Mapping[int, Array]) -> Array:
        """H z (k,), for H by its blocks."""
        terms = [block @ self._gaussian.x[self._gaussian.slot(key)] for key, block in H.items()]
        return np.asarray(sum(terms, start=np.zeros(())))

    def marginalise(self, keys: Sequence[int]) -> None:
        """Marginalise variables out."""
        self._gaussian.remove(*keys)
        for key in keys:
            self._points.erase(key)
            del self._dims[key]


class CompressedBackend(Isam2Backend):
    """Incremental smoothing with a filter in front of it; see the module's docstring."""

    def __init__(self, config: Config) -> None:
        super().__init__(config)
        self._local: LocalFilter | None = None
        self._pending: list[FactorGroup] = []  # in the filter but not yet in the tree
        self._recent: dict[int, None] = {}  # landmarks by last observation or query, latest last
        # states per robot in the filter: mostly those of the observations that promote a landmark
        self._past_states = config.association.sightings_to_promote

    @classmethod
    def at_estimate(
        cls, config: Config, steps: Sequence[Step], start: Estimate
    ) -> "CompressedBackend":
        """The back end after ``steps``, linearised where ``start`` has their variables.

        Raises:
            EstimationError: a covariance is not positive definite and finite.
        """
        made = cls(config)
        made.restart(steps, start)
        return made

    def restart(self, steps: Sequence[Step], start: Estimate) -> None:
        """Forget all; go on after ``steps``, linearised where ``start`` has their variables.

        Raises:
            EstimationError: a covariance is not positive definite and finite.
        """
        self.builder = self._builder = BatchGraph(self._config.robust)
        self._joints.clear()
        self._local, self._pending, self._recent = None, [], {}
        values = gtsam.Values()
        for step in steps:
            self._builder.insert(step, start, values)
            targets = (a.target for a in step.associations)
            self._mark_recent(factors.landmark_key(i) for i in targets if isinstance(i, int))
        self._steps = self._relinearised = len(steps)
        self._finished = values  # a tree is built of them at the first query

    def value(self, key: int, dim: int) -> Array:
        """See `GraphBackend`."""
        if self._local is not None and key in self._local:
            return self._local.value(key)
        self._flush()
        return super().value(key, dim)

    def add(self, step: Step) -> None:
        """See `Backend`."""
        self._joints.clear()
        self._rebuild_if_finished()
        groups = self._builder.expand(step, self._approximate_value)
        self._steps += 1
        self._pending += groups
        self._mark_recent(group.observed[1] for group in groups if group.observed is not None)
        if self._local is None or self._due() or not self._local.has_variables_of(groups):
            self._flush()
            return
        try:
            self._local.add(groups)
        except np.linalg.LinAlgError:
            self._flush()  # the tree names the variable that is indeterminate
            return
        builder = self._builder
        states = ((r, builder.states.latest(r) - self._past_states) for r in step.motions)
        leaving = [builder.state_key(robot, number) for robot, number in states if number >= 0]
        self._local.marginalise([key for key in leaving if key in self._local])

    def landmark_means(self, landmarks: Sequence[int]) -> list[Array]:
        """See `Backend`; landmarks that are not local are without the pending steps."""
        dims = self._builder.landmark_dims
        return [self._approximate_value(factors.landmark_key(i), dims[i]) for i in landmarks]

    def _approximate_value(self, key: int, dim: int) -> Array:
        """`value`, but without the pending steps if not local: good enough as an initial value."""
        in_tree = self._local is not None and key not in self._local and self._isam.valueExists(key)
        return super().value(key, dim) if in_tree else self.value(key, dim)

    def _mark_recent(self, keys: Iterable[int]) -> None:
        for key in keys:
            if not factors.is_state(key):
                self._recent.pop(key, None)
                self._recent[key] = None

    def _flush(self) -> None:
        """Add the pending steps to the tree, and use it until a covariance is queried."""
        self._local = None
        if self._pending:
            pending, self._pending = self._pending, []
            self._update(pending, False)
            if self._due():
                self._update((), True)  # separately: what the pending steps have moved, too

    def covariance(self, keys: list[int]) -> Array:
        """See `GraphBackend`; these variables are local from now on."""
        self._mark_recent(keys)
        if self._local is None or not all(key in self._local for key in keys):
            self._flush()
            most = max(self._config.backend.local_landmarks, len(keys))
            self._recent = dict.fromkeys(list(self._recent)[-most:])
            robots = self._builder.robots
            states = [self._builder.state_keys(r, -self._past_states) for r in robots]
            self._local = self._make_local([*chain.from_iterable(states), *self._recent])
        return self._local.covariance(keys)

    def _make_local(self, keys: list[int]) -> LocalFilter:
        """The filter of variables, from the tree."""
        self._rebuild_if_finished()
        linearised_at = self._isam.getLinearizationPoint()
        points = {key: factors.read(linearised_at, key, self._builder.dim(key)) for key in keys}
        z = self._isam.getDelta().vector(keys)
        return LocalFilter(points, z, self._tree_covariance(keys))


class BatchBackend(CompressedBackend):
    """Optimises to convergence at the end, whatever `backend.optimise_at_end`; else as `isam2`."""

    def finish(self) -> Estimate:
        """See `Backend`."""
        self._flush()
        return self._result(self._optimised(self._isam.calculateBestEstimate()))
