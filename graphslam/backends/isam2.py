"""Full smoothing with GTSAM: incrementally (iSAM2) and, at the end, to convergence.

`Isam2Backend` is incremental smoothing over the whole past (horizon = infinity); `BatchBackend`
is its converged limit: the same graph, optimised by Levenberg-Marquardt from iSAM2's estimate.
"""

import re
from collections.abc import Sequence

import gtsam
import numpy as np

from graphslam import factors
from graphslam.backends.base import Joint, StateTable, block_slices
from graphslam.config import Config
from graphslam.errors import EstimationError
from graphslam.geometry import Array, compose
from graphslam.models import MODELS
from graphslam.records import Association, Estimate, Step, Trajectory

#: m or rad: the estimate has converged when all variables together move less than this
CONVERGED = 1e-6


class GraphBuilder:
    """Turns steps into factors and first values; remembers which key is what.

    ``rows`` counts the residual rows that carry information: GTSAM counts a line's empty row too.
    """

    def __init__(self, config: Config) -> None:
        self._config = config
        self.states = StateTable()
        self.robots: list[str] = []
        self.landmark_dims: dict[int, int] = {}
        self.rows = 0
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


def qr_parameters(config: Config) -> gtsam.ISAM2Params:
    """Settings of iSAM2."""
    parameters = gtsam.ISAM2Params()
    parameters.setRelinearizeThreshold(config.backend.relinearize_threshold)
    parameters.relinearizeSkip = config.backend.relinearize_every
    # Cholesky calls good graphs indeterminate: information spans ten orders of magnitude here
    parameters.setFactorization("QR")
    return parameters


class Isam2Backend:
    """Incremental smoothing of all states; see the module's docstring."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._builder = GraphBuilder(config)
        self._isam = gtsam.ISAM2(qr_parameters(config))

    def value(self, key: int, dim: int) -> Array:
        """Current estimate of a variable."""
        if dim == 3:
            return factors.array3(self._isam.calculateEstimatePose2(key))
        return np.asarray(self._isam.calculateEstimatePoint2(key))

    def add(self, step: Step) -> None:
        """See `Backend`."""
        graph, values = self._builder.expand(step, self)
        try:
            self._isam.update(graph, values)
        except RuntimeError as error:
            raise self._builder.explain(error) from error

    def joint(self, robot: str, landmarks: Sequence[int]) -> Joint:
        """See `Backend`."""
        key = self._builder.state_key(robot, self._builder.states.latest(robot))
        dims = [self._builder.landmark_dims[i] for i in landmarks]
        keys = [factors.landmark_key(i) for i in landmarks]
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
        return Joint(pose, means, turn @ cov @ turn.T, slices)

    def landmark_means(self, landmarks: Sequence[int]) -> list[Array]:
        """See `Backend`."""
        return [
            self.value(factors.landmark_key(i), self._builder.landmark_dims[i]) for i in landmarks
        ]

    def finish(self) -> Estimate:
        """See `Backend`: iSAM2 until it moves no more, then optimised to convergence."""
        values = self._converged()
        if self._config.backend.polish:
            values = self._optimised(values)
        return self._estimate(values)

    def _converged(self) -> gtsam.Values:
        nothing, no_values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        try:
            for _ in range(20):
                self._isam.update(nothing, no_values, [], None, None, None, True)
                if self._isam.getDelta().norm() < CONVERGED:
                    break
        except RuntimeError as error:
            raise self._builder.explain(error) from error
        return self._isam.calculateBestEstimate()

    def _optimised(self, values: gtsam.Values) -> gtsam.Values:
        try:
            return optimise(self._builder.graph, values)
        except RuntimeError as error:
            raise self._builder.explain(error) from error

    def _marginals(self, values: gtsam.Values) -> dict[int, Array]:
        """Marginal covariance of every key: by Cholesky, or by QR where that gives up."""
        keys = values.keys()
        try:
            marginals = gtsam.Marginals(self._builder.graph, values)
            return {key: marginals.marginalCovariance(key) for key in keys}
        except RuntimeError as error:
            isam = gtsam.ISAM2(qr_parameters(self._config))
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
                builder.states.stamps(robot), poses, _to_world(covs, poses[:, 2])
            )
        landmarks = {}
        for landmark, dim in builder.landmark_dims.items():
            key = factors.landmark_key(landmark)
            cov = marginals[key]
            if dim == 3:
                mean = factors.array3(values.atPose2(key))
                cov = _to_world(cov[None], mean[None, 2])[0]
            else:
                mean = np.asarray(values.atPoint2(key))
            landmarks[landmark] = (mean, cov)
        error = float(builder.graph.error(values))
        return Estimate(states, landmarks, error, builder.rows - values.dim())


class BatchBackend(Isam2Backend):
    """The converged limit: associations from iSAM2's estimate, the result from one optimisation."""

    def finish(self) -> Estimate:
        """See `Backend`."""
        return self._estimate(self._optimised(self._isam.calculateBestEstimate()))


def optimise(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Values:
    """Levenberg-Marquardt from ``values`` until the error changes by less than 1e-7 of itself."""
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-7)
    parameters.setAbsoluteErrorTol(1e-9)
    parameters.setMaxIterations(200)
    return gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()


def _to_world(covs: Array, headings: Array) -> Array:
    """Body-frame covariances (n, 3, 3) to additive world-axis errors."""
    c, s = np.cos(headings), np.sin(headings)
    turn = np.zeros((len(headings), 3, 3))
    turn[:, 0, 0] = turn[:, 1, 1] = c
    turn[:, 0, 1], turn[:, 1, 0] = -s, s
    turn[:, 2, 2] = 1.0
    return np.asarray(turn @ covs @ turn.mT)
