"""Full smoothing that updates its tree seldom: in between, a Kalman filter of what is in use.

Between two updates of iSAM2 a robot deals with a few variables: its latest pose and the landmarks
around it. The joint marginal of those at the last update, moved on by each step's factors, is all
that the rest of the graph can say of them: `Active` is that filter. iSAM2 gets the steps of a
stretch at once, when something is asked that is not in use, or when it is due to linearise anew.
So a tree that holds thousands of poses is updated, solved and asked for marginals once in several
steps, and nothing is lost: in between, the filter's answers are iSAM2's.

Source: J. Guivant, E. Nebot, Optimization of the simultaneous localization and map-building
algorithm for real-time implementation, IEEE T-RA 17(3), 2001, https://doi.org/10.1109/70.938382
(the compressed filter; there a filter is behind it as well).
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import groupby

import gtsam
import numpy as np

from graphslam.core.config import Config
from graphslam.core.gaussian import JointGaussian, whiten
from graphslam.core.geometry import Array
from graphslam.core.records import Estimate, Step
from graphslam.estimation import factors
from graphslam.estimation.factor_graph import Part, read, write
from graphslam.estimation.isam2 import Isam2Backend

#: landmarks in use: those last seen or asked for. A stretch ends where another one is asked for,
#: and a larger filter costs less than an update of the tree
REMEMBERED = 32


class LocalFilter:
    """Joint estimate of a few variables, by GTSAM's factors and in errors of body frames.

    Every variable keeps the place at which the tree linearises, and z is how far, in the tangent
    space there, it has moved from it: with Jacobians of now the filter would claim to know along a
    line what nobody measured (see `fixed_lag`).
    """

    def __init__(self, places: Mapping[int, Array], z: Array, cov: Array) -> None:
        """Begin.

        Args:
            places: where variables (2,) or (3,) are linearised, by key.
            z: (D,) how far they are from there, in that order.
            cov: (D, D) of that.
        """
        self._places = gtsam.Values()
        for key, place in places.items():
            write(self._places, key, place)
        self._dims = {key: len(place) for key, place in places.items()}
        self._moved: JointGaussian[int] = JointGaussian.of(self._dims, z, cov)

    def __contains__(self, key: object) -> bool:
        """Whether a variable is in use."""
        return key in self._moved

    def value(self, key: int) -> Array:
        """Estimate (2,) or (3,) of a variable in use."""
        z = self._moved.x[self._moved.slot(key)]
        if len(z) == 3:
            return factors.array3(self._places.atPose2(key).retract(z))
        return np.asarray(self._places.atPoint2(key) + z)

    def covariance(self, keys: Sequence[int]) -> Array:
        """Joint covariance (D, D) of variables in use, in this order."""
        return self._moved.marginal(keys)

    def takes(self, parts: Iterable[Part]) -> bool:
        """Whether ``parts`` are about nothing but variables in use and those that they bring."""
        known = set(self._moved)
        for part in parts:
            if part.new is not None:
                known.add(part.new[0])
            if not all(known.issuperset(factor.keys()) for factor in part.factors):
                return False
        return True

    def take(self, parts: Iterable[Part]) -> None:
        """One step of the filter.

        Raises:
            numpy.linalg.LinAlgError: rounding, or a part that does not determine what it brings,
                made an end of it; this filter is of no use any more.
        """
        measured: list[gtsam.NonlinearFactor] = []
        for moves, some in groupby(parts, key=lambda part: part.replaces is not None):
            if moves:
                self._move(list(some))
                continue
            for part in some:
                if part.new is not None:
                    self._enter(*part.new, part.factors)
                else:
                    measured += part.factors
        if measured:
            self._update(measured)

    def _move(self, parts: Sequence[Part]) -> None:
        """New states of several robots at once: `_enter` where each has one factor, of its motion.

        That factor is between the state before and the new one, in this order.
        """
        news = [part.new for part in parts if part.new is not None]
        for key, place in news:
            write(self._places, key, place)
            self._dims[key] = len(place)
        befores = [part.replaces for part in parts if part.replaces is not None]
        linear = [part.factors[0].linearize(self._places).jacobian() for part in parts]
        A, b = np.array([A for A, _ in linear]), np.array([b for _, b in linear])
        noise = np.linalg.inv(A[:, :, 3:])
        G = -noise @ A[:, :, :3]
        last = np.array([self._moved.x[self._moved.slot(before)] for before in befores])
        means = (noise @ b[:, :, None] + G @ last[:, :, None])[:, :, 0]
        self._moved.add_each([key for key, _ in news], befores, means, noise @ noise.mT, G)

    def _enter(self, key: int, place: Array, made_by: Iterable[gtsam.NonlinearFactor]) -> None:
        """A new variable, as the factors that bring it have it: thesis 4.24-4.28."""
        write(self._places, key, place)
        self._dims[key] = len(place)
        H, b = self._linear(made_by)
        J = H.pop(key)  # square, but for a line's empty row
        noise = np.linalg.solve(J.T @ J, J.T)
        given = {other: -noise @ block for other, block in H.items()}
        self._moved.add(key, noise @ (b - self._expected(H)), noise @ noise.T, given)

    def _update(self, measured: Iterable[gtsam.NonlinearFactor]) -> None:
        """Measurement update with all of a step's factors at once, thesis 3.5-3.8."""
        H, b = self._linear(measured)
        PHt, HPHt = self._moved.project(H, len(b))
        B, whitened, _ = whiten(PHt, HPHt + np.eye(len(b)), b - self._expected(H))
        self._moved.x[:] += B.T @ whitened
        self._moved.condition(B)

    def _linear(self, measured: Iterable[gtsam.NonlinearFactor]) -> tuple[dict[int, Array], Array]:
        """Whitened Jacobians (k, d) of factors by variable, and b (k,): they say that H z = b."""
        linear = [(f.keys(), *f.linearize(self._places).jacobian()) for f in measured]
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
        parts = [block @ self._moved.x[self._moved.slot(key)] for key, block in H.items()]
        return np.asarray(sum(parts, start=np.zeros(())))

    def forget(self, keys: Sequence[int]) -> None:
        """Marginalise variables out."""
        self._moved.remove(*keys)
        for key in keys:
            self._places.erase(key)
            del self._dims[key]


class CompressedBackend(Isam2Backend):
    """Incremental smoothing with a filter in front of it; see the module's docstring."""

    def __init__(self, config: Config) -> None:
        super().__init__(config)
        self._active: LocalFilter | None = None
        self._waiting: list[Part] = []  # what the filter has and the tree has not
        self._used: dict[int, None] = {}  # keys of landmarks, the last used one last
        # states per robot: those that the sightings of a landmark's promotion belong to, as a rule
        self._kept = config.association.sightings_to_promote

    def value(self, key: int, dim: int) -> Array:
        """See `GraphBackend`."""
        if self._active is not None and key in self._active:
            return self._active.value(key)
        self._flush()
        return super().value(key, dim)

    def add(self, step: Step) -> None:
        """See `Backend`."""
        self._joints.clear()
        self._settle()
        parts = self._builder.expand(step, self._nearly)
        self._steps += 1
        self._waiting += parts
        self._use(part.observed[1] for part in parts if part.observed is not None)
        if self._active is None or self._due() or not self._active.takes(parts):
            self._flush()
            return
        try:
            self._active.take(parts)
        except np.linalg.LinAlgError:
            self._flush()  # what is wrong the tree says by name
            return
        builder = self._builder
        states = ((robot, builder.states.latest(robot) - self._kept) for robot in step.motions)
        before = [builder.state_key(robot, number) for robot, number in states if number >= 0]
        self._active.forget([key for key in before if key in self._active])

    def landmark_means(self, landmarks: Sequence[int]) -> list[Array]:
        """See `Backend`; of what is not in use, as the tree has it without what waits."""
        dims = self._builder.landmark_dims
        return [self._nearly(factors.landmark_key(i), dims[i]) for i in landmarks]

    def _nearly(self, key: int, dim: int) -> Array:
        """`value`, but of what is not in use the tree's last one: near enough to begin with."""
        known = self._active is not None and key not in self._active and self._isam.valueExists(key)
        return super().value(key, dim) if known else self.value(key, dim)

    def _use(self, keys: Iterable[int]) -> None:
        for key in keys:
            if not factors.is_state(key):
                self._used.pop(key, None)
                self._used[key] = None

    def _flush(self) -> None:
        """The tree takes in what waits; it answers until a covariance is asked for."""
        self._active = None
        if self._waiting:
            waiting, self._waiting = self._waiting, []
            self._update(waiting, False)
            if self._due():
                self._update((), True)  # a second time: by what has moved with what waited

    def covariance(self, keys: list[int]) -> Array:
        """See `GraphBackend`; what is asked for is in use from now on."""
        self._use(keys)
        if self._active is None or not all(key in self._active for key in keys):
            self._flush()
            self._used = dict.fromkeys(list(self._used)[-max(REMEMBERED, len(keys)) :])
            self._active = self._marginal([*self._latest(), *self._used])
        return self._active.covariance(keys)

    def _latest(self) -> Iterator[int]:
        """Keys of each robot's latest states."""
        builder = self._builder
        for robot in builder.robots:
            latest = builder.states.latest(robot)
            for number in range(max(0, latest + 1 - self._kept), latest + 1):
                yield builder.state_key(robot, number)

    def _marginal(self, keys: list[int]) -> LocalFilter:
        """What the tree says of variables."""
        self._settle()
        everywhere = self._isam.getLinearizationPoint()
        places = {key: read(everywhere, key, self._builder.dim(key)) for key in keys}
        z = self._isam.getDelta().vector(keys)
        return LocalFilter(places, z, self._tree_covariance(keys))

    def state_covariance(self, states: Sequence[tuple[str, int]]) -> Array:
        """See `Isam2Backend`."""
        self._flush()
        return super().state_covariance(states)

    def finish(self) -> Estimate:
        """See `Backend`."""
        self._flush()
        return super().finish()

    def current_estimate(self) -> Estimate:
        """See `Isam2Backend`."""
        self._flush()
        return super().current_estimate()


class BatchBackend(CompressedBackend):
    """The converged limit, whatever `backend.optimise_at_end` says; associations as with iSAM2."""

    def finish(self) -> Estimate:
        """See `Backend`."""
        self._flush()
        return self._result(self._optimised(self._isam.calculateBestEstimate()))
