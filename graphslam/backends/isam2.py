"""Full smoothing with GTSAM: incrementally (iSAM2) and, at the end, to convergence.

`Isam2Backend` is incremental smoothing over the whole past (horizon = infinity); `BatchBackend`
is its converged limit: the same graph, optimised by Levenberg-Marquardt from iSAM2's estimate.
"""

import re
from collections.abc import Sequence
from typing import Literal

import gtsam
import numpy as np

from graphslam import factors
from graphslam.backends.base import Joint, StateTable, block_slices
from graphslam.config import Config, RobustConfig
from graphslam.errors import EstimationError
from graphslam.geometry import Array, compose, rotate_cov
from graphslam.models import MODELS
from graphslam.records import Association, Estimate, Step, Trajectory

#: m or rad: the estimate has converged when all variables together move less than this
CONVERGED = 1e-6
#: the same for lines that are faced anew (it converges in two rounds), without and with a kernel
FACED, FACED_ROBUST, MAX_FACINGS = 1e-6, 1e-2, 4


class GraphBuilder:
    """Turns steps into factors and first values; remembers which key is what.

    ``rows`` counts the residual rows that carry information: GTSAM counts a line's empty row too.
    ``graph`` holds every factor so far.
    """

    def __init__(self, config: Config) -> None:
        self._config = config
        self.states = StateTable()
        self.robots: list[str] = []
        self.landmark_dims: dict[int, int] = {}
        self.rows = 0
        self._lines: list[tuple[int, int, int, Association]] = []  # place in graph, keys, what
        self.graph = gtsam.NonlinearFactorGraph()

    def state_key(self, robot: str, number: int) -> int:
        """Key of a robot's state."""
        return factors.state_key(self.robots.index(robot), number)

    def expand(
        self, step: Step, current: "Isam2Backend"
    ) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        """Factors and new variables of a step; ``current`` is asked for existing estimates."""
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        fresh: dict[int, Array] = {}

        def insert(key: int, value: Array) -> None:
            fresh[key] = value
            values.insert(key, factors.pose2(value) if len(value) == 3 else value)

        def estimate(key: int, dim: int) -> Array:
            return fresh[key] if key in fresh else current.value(key, dim)

        for robot, start in step.starts.items():
            self.robots.append(robot)
            key = self.state_key(robot, self.states.append(robot, step.time_ns))
            insert(key, start.pose)
            graph.add(factors.start_factor(key, start))
            self.rows += 3
        for robot, motion in step.motions.items():
            last = self.state_key(robot, self.states.latest(robot))
            key = self.state_key(robot, self.states.append(robot, step.time_ns))
            insert(key, compose(estimate(last, 3), motion.delta))
            graph.add(factors.motion_factor(last, key, motion))
            self.rows += 3
        for seen in step.associations:
            key = self.state_key(seen.robot, self.states.number(seen.robot, seen.time_ns))
            x = estimate(key, 3)
            target = self._target_key(seen, step.time_ns)
            dim = MODELS[seen.model].dim
            if isinstance(seen.target, int) and seen.target not in self.landmark_dims:
                self.landmark_dims[seen.target] = dim
                insert(target, MODELS[seen.model].invert(seen.z, x))
                if seen.model == "line":
                    graph.add(factors.line_gauge_factor(key, target, seen))
                    self.rows += 1
            if seen.model == "line":
                self._lines.append((self.graph.size() + graph.size(), key, target, seen))
            t = estimate(target, dim)
            graph.add(factors.observation_factor(key, target, seen, self._config.robust, x, t))
            self.rows += MODELS[seen.model].rows
        for closure in step.closures:
            key = self.state_key(closure.robot, self.states.number(closure.robot, closure.time_ns))
            other = self.state_key(
                closure.other, self.states.number(closure.other, closure.other_time_ns)
            )
            graph.add(factors.closure_factor(key, other, closure, self._config.robust))
            self.rows += 3
        self.graph.push_back(graph)
        return graph, values

    def face_lines(self, values: gtsam.Values) -> None:
        """Rebuild the factors of lines at ``values``.

        A line's measurement was moved along the line to face the landmark's origin as estimated at
        its time (see `LineModel`); where the estimate has moved since, so must the measurement, or
        it claims some knowledge along the line.
        """
        for place, key, target, seen in self._lines:
            x = factors.array3(values.atPose2(key))
            t = factors.array3(values.atPose2(target))
            factor = factors.observation_factor(key, target, seen, self._config.robust, x, t)
            self.graph.replace(place, factor)

    def _target_key(self, seen: Association, time_ns: int) -> int:
        if isinstance(seen.target, int):
            return factors.landmark_key(seen.target)
        return self.state_key(seen.target, self.states.number(seen.target, time_ns))

    def diagnose(self, values: gtsam.Values) -> EstimationError:
        """Which variable is indeterminate: QR answers NaN for all of them, Cholesky names one."""
        try:
            marginals = gtsam.Marginals(self.graph, values)
            for key in values.keys():  # noqa: SIM118 (GTSAM's values are no mapping)
                marginals.marginalCovariance(key)
        except RuntimeError as error:
            return self.explain(error)
        return self.explain(RuntimeError(""))

    def explain(self, error: RuntimeError) -> EstimationError:
        """GTSAM's complaint about a variable, said in terms of the log."""
        found = re.search(r"Symbol: ([xl])(\d+)", str(error))
        where = "some variable"
        if found and found[1] == "l":
            where = f"landmark {found[2]}"
        elif found:
            robot, number = divmod(int(found[2]), 1 << 40)
            name = self.robots[robot]
            where = f"robot {name} at {self.states.times[name][number]} ns"
        return EstimationError(
            f"the estimate is indeterminate at {where}: it has too few or too weak observations"
        )


def isam2_parameters(config: Config, factorization: str) -> gtsam.ISAM2Params:
    """Settings of iSAM2; ``factorization`` CHOLESKY or QR."""
    parameters = gtsam.ISAM2Params()
    parameters.setRelinearizeThreshold(config.backend.relinearize_threshold)
    parameters.relinearizeSkip = config.backend.relinearize_every
    parameters.setFactorization(factorization)
    return parameters


class Isam2Backend:
    """Incremental smoothing of all states; see the module's docstring."""

    error_frame: Literal["body", "world"] = "body"

    def __init__(self, config: Config) -> None:
        self._config = config
        self._builder = GraphBuilder(config)
        self._factorization = "CHOLESKY"
        self._isam = gtsam.ISAM2(isam2_parameters(config, self._factorization))
        self._joints: dict[str, Joint] = {}  # since the last step

    def value(self, key: int, dim: int) -> Array:
        """Current estimate of a variable."""
        if dim == 3:
            return factors.array3(self._isam.calculateEstimatePose2(key))
        return np.asarray(self._isam.calculateEstimatePoint2(key))

    def add(self, step: Step) -> None:
        """See `Backend`."""
        graph, values = self._builder.expand(step, self)
        self._joints.clear()
        try:
            self._isam.update(graph, values)
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
        values = self._isam.getLinearizationPoint()
        self._isam = gtsam.ISAM2(isam2_parameters(self._config, "QR"))
        try:
            self._isam.update(self._builder.graph, values)
        except RuntimeError as again:
            raise self._builder.explain(again) from again

    def joint(self, robot: str, landmarks: Sequence[int], others: Sequence[str] = ()) -> Joint:
        """See `Backend`; asked for the pose alone after more, it answers from what it has."""
        if not landmarks and not others and robot in self._joints:
            known = self._joints[robot]
            return Joint(known.pose, (), known.cov[:3, :3], ())
        key = self._latest_key(robot)
        dims = [self._builder.landmark_dims[i] for i in landmarks] + [3] * len(others)
        keys = [factors.landmark_key(i) for i in landmarks] + [self._latest_key(r) for r in others]
        pose = self.value(key, 3)
        means = tuple(self.value(k, d) for k, d in zip(keys, dims, strict=True))
        try:
            if keys:
                cov = self._isam.jointMarginalCovariance([key, *keys]).fullMatrix()
            else:
                cov = self._isam.marginalCovariance(key)
        except RuntimeError as error:
            raise self._builder.explain(error) from error
        if not np.isfinite(cov).all():
            raise self._builder.diagnose(self._isam.calculateEstimate())
        slices = block_slices(dims)
        turn = np.eye(len(cov))
        for block, mean in zip((slice(0, 3), *slices), (pose, *means), strict=True):
            if len(mean) == 3:
                turn[block, block] = factors.world_from_body(float(mean[2]))
        n = len(landmarks)
        self._joints[robot] = Joint(pose, means[:n], turn @ cov @ turn.T, slices, means[n:])
        return self._joints[robot]

    def _latest_key(self, robot: str) -> int:
        return self._builder.state_key(robot, self._builder.states.latest(robot))

    def state_mean(self, robot: str) -> Array:
        """See `Backend`."""
        return self.value(self._latest_key(robot), 3)

    def landmark_means(self, landmarks: Sequence[int]) -> list[Array]:
        """See `Backend`."""
        return [
            self.value(factors.landmark_key(i), self._builder.landmark_dims[i]) for i in landmarks
        ]

    def finish(self) -> Estimate:
        """See `Backend`: optimised to convergence, or iSAM2 until it moves no more."""
        if self._config.backend.polish:
            return self._estimate(self._optimised(self._isam.calculateBestEstimate()))
        return self._estimate(self._converged())

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
        enough = FACED if self._config.robust.kernel == "none" else FACED_ROBUST
        try:
            for _ in range(MAX_FACINGS):
                before = values
                self._builder.face_lines(values)
                values = optimise(self._builder.graph, values, self._config.robust)
                if before.localCoordinates(values).norm() < enough:
                    break
        except RuntimeError as error:
            raise self._builder.explain(error) from error
        return values

    def _marginals(self, values: gtsam.Values) -> dict[int, Array]:
        """Marginal covariance of every key: by Cholesky, or by QR where that gives up."""
        keys = values.keys()
        try:
            marginals = gtsam.Marginals(self._builder.graph, values)
            return {key: marginals.marginalCovariance(key) for key in keys}
        except RuntimeError as error:
            isam = gtsam.ISAM2(isam2_parameters(self._config, "QR"))
            isam.update(self._builder.graph, values)
            found = {key: isam.marginalCovariance(key) for key in keys}
            # QR does not complain about an indeterminate graph, it answers NaN
            if not all(np.isfinite(cov).all() for cov in found.values()):
                raise self._builder.explain(error) from error
            return found

    def _estimate(self, values: gtsam.Values) -> Estimate:
        builder, marginals = self._builder, self._marginals(values)
        states = {}
        for robot in sorted(builder.robots):
            keys = [builder.state_key(robot, n) for n in range(len(builder.states.times[robot]))]
            poses = np.array([factors.array3(values.atPose2(k)) for k in keys])
            covs = np.array([marginals[k] for k in keys])
            states[robot] = Trajectory(
                builder.states.stamps(robot), poses, rotate_cov(covs, poses[:, 2])
            )
        landmarks = {}
        for landmark, dim in builder.landmark_dims.items():
            key = factors.landmark_key(landmark)
            cov = marginals[key]
            if dim == 3:
                mean = factors.array3(values.atPose2(key))
                cov = rotate_cov(cov, mean[2])
            else:
                mean = np.asarray(values.atPoint2(key))
            landmarks[landmark] = (mean, cov)
        error = float(builder.graph.error(values))
        return Estimate(states, landmarks, error, builder.rows - values.dim())


class BatchBackend(Isam2Backend):
    """The converged limit, whatever `backend.polish` says; associations as with iSAM2."""

    def finish(self) -> Estimate:
        """See `Backend`."""
        return self._estimate(self._optimised(self._isam.calculateBestEstimate()))


def optimise(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, kernel: RobustConfig
) -> gtsam.Values:
    """Levenberg-Marquardt from ``values`` until the error hardly changes.

    Without a kernel convergence is quadratic and 1e-10 of the error comes for free. Under a kernel
    GTSAM reweights, which converges linearly: beyond 1e-6 hundreds of iterations move nothing that
    shows.
    """
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-10 if kernel.kernel == "none" else 1e-6)
    parameters.setAbsoluteErrorTol(1e-9)
    parameters.setMaxIterations(200)
    return gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
