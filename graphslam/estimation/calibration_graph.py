"""Batch smoothing with the robots' calibration as variables of the same graph.

A scale or a latency of odometry is one constant of the whole run. Estimated separately, given the
trajectory, it is biased towards the calibration that the trajectory was made with. As a variable it
is estimated jointly, and its uncertainty is in every covariance.
"""

from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from graphslam.core.config import RobustConfig
from graphslam.core.geometry import Array, rotation3
from graphslam.core.motion_models import HELD_SIGMA, MOUNT_NAMES, Calibration, Increments
from graphslam.core.mount_covariances import MountCovariances
from graphslam.core.record import replace
from graphslam.core.records import Estimate, Step
from graphslam.estimation import factors
from graphslam.estimation.backend import JointMarginal
from graphslam.estimation.isam2 import NO_COVARIANCES, with_means
from graphslam.estimation.joint_covariances import solve_root
from graphslam.estimation.line_noise import fit_line_noise
from graphslam.estimation.line_residuals import LineResiduals
from graphslam.estimation.motion_arrays import increments_of, linear_motions, moved_by
from graphslam.estimation.optimisation import (
    CONVERGED_ERROR_ROUGH,
    JointMarginals,
    marginals_of,
    reweighted,
    root_of,
)
from graphslam.estimation.posterior_residuals import Posterior, posterior_pairs
from graphslam.estimation.recorded_graph import ObservationNoise, RecordedGraph, Source
from graphslam.estimation.sandwich_covariance import CovarianceFactors, covariance_factors
from graphslam.estimation.selected_inverse import CliqueRows
from graphslam.estimation.solved_graph import SolvedGraph
from graphslam.estimation.surface_bias import with_surface_bias
from graphslam.estimation.weighed_walls import WeighedWalls

#: relative decrease of the error at which optimisation ends
CONVERGED_ERROR = 1e-5


def solve_calibrated(
    steps: Sequence[Step],
    start: Estimate,
    priors: Mapping[str, Calibration],
    now: Mapping[str, Calibration],
    kernel: RobustConfig,
    *,
    rough: bool = False,
    joint: bool = False,
    mounts: bool = False,
    bias_m: float | None = None,
) -> "CalibratedSolution":
    """Optimise all states, landmarks and calibrations together.

    Motions are linear in the calibration, around the one that they were computed with, and
    linearised in their states at ``start``: recompute them and solve again from the result. Their
    covariances must not include the calibration's.

    Args:
        steps: all steps.
        start: an estimate of every variable.
        priors: robot -> its calibration before any data.
        now: robot -> the calibration that the motions were computed with.
        kernel: of observations.
        rough: stop early, see `Reoptimiser.solve`; covariances are NaN.
        joint: whether the estimate is to have the root of the information.
        mounts: whether it is then to have covariances with the mounts.
        bias_m: see `CalibrationGraph.solution`.

    Raises:
        EstimationError: a covariance is not positive definite, or a state is unknown.
    """
    problem = CalibrationGraph(steps, start, priors, now, kernel, calibrated=True)
    converged = CONVERGED_ERROR_ROUGH if rough else CONVERGED_ERROR
    problem.optimise(converged)
    found = problem.solution(marginals=not rough, joint=joint, mounts=mounts, bias_m=bias_m)
    return CalibratedSolution(*found, problem)


class CalibrationGraph:
    """The graph of steps with calibrations as variables, whose motions can be exchanged.

    The motions are those of the steps, at first with nothing about calibrations unless the graph is
    made ``calibrated``. ``line_noise``: robot -> factors (2,), see `fit_line_noise`, once
    covariances are by them.
    """

    def __init__(
        self,
        steps: Sequence[Step],
        start: Estimate,
        priors: Mapping[str, Calibration],
        now: Mapping[str, Calibration],
        kernel: RobustConfig,
        noise: Mapping[Source, ObservationNoise] | None = None,
        *,
        calibrated: bool = False,
    ) -> None:
        """Build the graph; for the arguments see `solve_calibrated` and `RecordedGraph`.

        ``calibrated``: the motions depend on the calibrations, as by `calibrate_motions`.

        Raises:
            EstimationError: a covariance is not positive definite, or a state is unknown.
        """
        self._builder = builder = RecordedGraph(kernel, noise)
        self._values, self._priors = gtsam.Values(), priors
        # at the last solution, as is the error of the graph that was solved
        self._marginals: JointMarginals | None = None
        self._rows: tuple[CliqueRows, ...] | None = None  # of the root, if it is known
        self._error = 0.0
        self.line_noise: Mapping[str, Array] = {}
        self._steps = steps
        self._made: Mapping[str, Increments] = increments_of(steps)  # the motions in the graph
        self._now = now  # by what they were computed
        self._linear_at: gtsam.Values | None = None  # the solution around which they are linear
        self._keys = {r: int(gtsam.symbol("c", k)) for k, r in enumerate(sorted(priors))}
        unknown = {r: np.flatnonzero(np.diag(c.cov) > HELD_SIGMA**2) for r, c in priors.items()}
        self._free = {robot: use for robot, use in unknown.items() if len(use)}
        self._motions: dict[str, list[tuple[int, int, int]]] = defaultdict(list)  # index, two keys
        for robot, use in self._free.items():
            key, prior = self._keys[robot], priors[robot].part(use)
            self._values.insert(key, now[robot].mean[use])
            model = factors.gaussian(prior.cov)
            builder.graph.add(gtsam.PriorFactorVector(key, prior.mean, model))
        builder.insert_all(steps, start, self._values, list(self._free) if calibrated else [])
        builder.rebuild_lines(self._values)
        for index, robot, last, key in builder.motions:
            self._motions[robot].append((index, last, key))
        if calibrated:
            self._linearise(self._made, now)

    def calibrate_motions(self, steps: Sequence[Step], now: Mapping[str, Calibration]) -> None:
        """Put motions in the graph that depend on the calibration.

        Args:
            steps: with motions between the same states, computed with ``now``.
            now: robot -> calibration, around which motions are linear.
        """
        self._steps = steps
        self._linearise(increments_of(steps), now)

    def _linearise(self, made: Mapping[str, Increments], now: Mapping[str, Calibration]) -> None:
        """Put motions in the graph that are ``made`` with calibrations ``now``, see above."""
        graph, values = self._builder.graph, self._values
        unit, poses_at = gtsam.noiseModel.Unit.Create(3), self._builder.pose_reader(values)
        self._made, self._now, self._linear_at, self._rows = made, now, values, None
        for robot, use in self._free.items():
            values.update(self._keys[robot], now[robot].mean[use])
            if robot not in made:
                continue
            keys = np.array(self._builder.state_keys(robot), dtype=np.int64)
            linear = linear_motions(made[robot], poses_at(keys), use)
            for (index, last, key), (A_x, R, A_c, b) in zip(
                self._motions[robot], linear, strict=True
            ):
                row = gtsam.JacobianFactor(last, A_x, key, R, self._keys[robot], A_c, b, unit)
                graph.replace(index, gtsam.LinearContainerFactor(row, values))

    def solve(
        self,
        converged: float,
        *,
        marginals: bool = False,
        joint: bool = False,
        mounts: bool = False,
    ) -> tuple[Estimate, dict[str, Calibration]]:
        """Optimise from the last solution, see `optimise`; what was found, see `solution`.

        Raises:
            EstimationError: the estimate is indeterminate.
        """
        self.optimise(converged)
        return self.solution(marginals=marginals, joint=joint, mounts=mounts)

    def optimise(self, converged: float) -> None:
        """Optimise from the last solution until the relative decrease of the error is so small.

        Raises:
            EstimationError: the estimate is indeterminate.
        """
        builder, graph = self._builder, self._builder.graph
        parameters = gtsam.LevenbergMarquardtParams()
        parameters.setRelativeErrorTol(converged)
        parameters.setMaxIterations(50)
        values, error, is_done = self._values, 0.0, False
        try:
            # rough solutions begin far off
            if builder.kernel.kernel != "none" and converged < CONVERGED_ERROR_ROUGH:
                values, error, is_done = reweighted(graph, values, converged)
            if not is_done:
                optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)
                values, error = optimizer.optimize(), optimizer.error()
        except RuntimeError as failed:
            raise builder.explain(failed) from failed
        self._values, self._error, self._marginals, self._rows = values, error, None, None

    def solution(
        self,
        *,
        marginals: bool = False,
        joint: bool = False,
        mounts: bool = False,
        bias_m: float | None = None,
    ) -> tuple[Estimate, dict[str, Calibration]]:
        """The estimate and the calibrations where it was optimised last.

        Args:
            marginals: whether covariances are wanted; else they are NaN.
            joint: whether the root of the information is wanted beside them.
            mounts: whether covariances with the mounts are then wanted too.
            bias_m: sigma of the biases of surfaces. Covariances are then by these, and by the noise
                of lines that their residuals show, which the graph keeps (`line_noise`); else by
                what is stated.

        Raises:
            EstimationError: the estimate is indeterminate.
        """
        builder, values, found = self._builder, self._values, NO_COVARIANCES
        weighed: list[WeighedWalls] = []
        half_error = self._error
        if marginals:
            self._relinearise()
            builder.place(in_world=True)
            half_error = float(builder.graph.error(values))
            if bias_m is not None and builder.observes_walls:
                self.line_noise = fit_line_noise(self.line_residuals())
                weighed = builder.weigh_walls(values, self.line_noise)
            try:
                found = marginals_of(builder.graph, values, keep_rows=joint)
            except RuntimeError as error:
                raise builder.explain(error) from error
            builder.place(in_world=False)
        self._rows, covs = found.rows, found.marginals
        means = with_means(values, builder.dims(), covs)
        mounted = self._mount_places() if mounts else {}
        estimate = builder.estimate(means, half_error, found.rows, mounted)
        if found.rows is not None and mounted:
            estimate = replace(estimate, mounts=self._mounts(estimate))
        if found.rows is not None and bias_m is not None and weighed:
            estimate = with_surface_bias(estimate, weighed, bias_m)
        return estimate, self._calibrations(covs)

    def _calibrations(self, covs: Mapping[int, Array]) -> dict[str, Calibration]:
        """The calibrations where it was optimised last, with those covariances that are known."""
        calibrations = {}
        for robot, prior in self._priors.items():
            mean, cov = prior.mean.copy(), prior.cov.copy()
            if robot in self._free:
                key, use = self._keys[robot], self._free[robot]
                mean[use] = self._values.atVector(key)
                cov[np.ix_(use, use)] = covs.get(key, np.nan)
            calibrations[robot] = Calibration(prior.names, mean, cov)
        return calibrations

    def _relinearise(self) -> None:
        """Put factors in the graph as they are linear around the last solution, for covariances.

        These are what is known of landmarks, and the motions. They were around that from which it
        was sought, in the axes of its poses. Where these have turned since, they change if all is
        turned alike, which would be information about the direction of the whole map that no
        measurement has.
        """
        self._builder.carry_known(self._values)
        if self._linear_at is self._values:
            return
        found = self._calibrations({})
        made = {
            robot: moved_by(motions, found[robot].mean - self._now[robot].mean)
            if robot in found
            else motions
            for robot, motions in self._made.items()
        }
        self._linearise(made, found)

    def _mount_places(self) -> dict[str, tuple[int, list[int]]]:
        """Robots whose mounts are estimated, see `information_root`."""
        found = {}
        for robot, use in self._free.items():
            names = [self._priors[robot].names[k] for k in use]
            at = [names.index(name) if name in names else -1 for name in MOUNT_NAMES]
            if max(at) >= 0:
                found[robot] = (self._keys[robot], at)
        return found

    def _mounts(self, estimate: Estimate) -> MountCovariances:
        """Covariances of the mounts, and of states and landmarks with them, by the root."""
        root = estimate.root
        assert root is not None
        robots = tuple(sorted(root.mounts))
        rows = np.concatenate([root.mounts[robot] for robot in robots])
        free = np.flatnonzero(rows >= 0)
        unit = np.zeros((int(root.own.sum()), len(rows)))
        unit[rows[free], free] = 1.0
        columns, cov = solve_root(root, unit), np.zeros((len(rows), len(rows)))
        cov[free] = columns[rows[free]]
        states = {
            robot: rotation3(path.poses[:, 2]) @ columns[root.states[robot][:, None] + np.arange(3)]
            for robot, path in estimate.states.items()
        }
        landmarks = {}
        for number, (mean, _) in estimate.landmarks.items():
            first, dim = root.landmarks[number], len(mean)
            turn = rotation3(mean[2]) if dim == 3 else np.eye(dim)
            landmarks[number] = turn @ columns[first : first + dim]
        return MountCovariances(robots, cov, states, landmarks)

    def posterior(self, over_spans: Collection[str] = ()) -> Posterior:
        """The last solution with the covariances that its residuals need.

        ``over_spans``: robots of which also motions over spans are wanted, see `stated_robots`.

        Raises:
            EstimationError: it is indeterminate.
        """
        builder = self._builder
        self._relinearise()
        free = {robot: (self._keys[robot], use) for robot, use in self._free.items()}
        pairs = posterior_pairs(builder, free, over_spans)
        try:
            blocks = marginals_of(builder.graph, self._values, *pairs)
        except RuntimeError as error:
            raise builder.explain(error) from error
        solved = self._values, blocks, free, builder.pose_reader(self._values)
        return Posterior(self._steps, self._made, builder, *solved)

    def weigh_lines(self) -> None:
        """Give lines the noise that their residuals in the last solution show, from now on.

        Raises:
            EstimationError: it is indeterminate.
        """
        if self._builder.observes_walls:
            self.line_noise = fit_line_noise(self.line_residuals())
            self._builder.weigh_walls(self._values, self.line_noise)
            self._rows = None

    def line_residuals(self) -> LineResiduals:
        """Residuals of lines in the last solution; for errors see `solved`."""
        s = self.solved()
        return LineResiduals(s.builder, s.values, s.root, s.calibrations, s.poses_at)

    def solved(self) -> SolvedGraph:
        """The last solution.

        Raises:
            EstimationError: it is indeterminate.
        """
        builder = self._builder
        self._relinearise()
        try:
            rows = self._rows or root_of(builder.graph, self._values)
        except RuntimeError as error:
            raise builder.explain(error) from error
        self._rows = None  # they are as large as the graph, and not asked for twice
        priors = {r: (self._keys[r], self._priors[r].part(use)) for r, use in self._free.items()}
        return SolvedGraph.of(builder, self._values, rows, priors)

    def covariance_factors(self, noise: Mapping[Source, ObservationNoise]) -> CovarianceFactors:
        """See `sandwich_covariance`; of the last solution.

        Raises:
            EstimationError: it is indeterminate.
        """
        try:
            return covariance_factors(self._builder, self._values, noise)
        except RuntimeError as error:
            raise self._builder.explain(error) from error

    def calibration_covariances(self, posterior: Posterior | None = None) -> dict[str, Array]:
        """Robot -> covariance (p, p) of its calibration at the last solution, or a ``posterior``.

        Raises:
            EstimationError: it is indeterminate.
        """
        covs = {robot: prior.cov.copy() for robot, prior in self._priors.items()}
        for robot, use in self._free.items():
            key = self._keys[robot]
            if posterior is None:
                own = self._joint_covariance([key])
            else:
                own = posterior.blocks.marginals[key]
            covs[robot][np.ix_(use, use)] = own
        return covs

    def landmark_covariance(self, landmarks: Sequence[int], *, in_world: bool = False) -> Array:
        """Joint covariance (D, D) of landmarks at the last solution, along world axes.

        ``in_world``: with what is not known of where in the world a known map lies.

        Raises:
            EstimationError: it is indeterminate.
        """
        keys = [factors.landmark_key(i) for i in landmarks]
        dims = [self._builder.landmark_dims[i] for i in landmarks]
        own = self._joint_covariance(keys, in_world=in_world)
        turn, ends = np.eye(len(own)), np.cumsum(dims)
        for key, dim, end in zip(keys, dims, ends, strict=True):
            if dim == 3:
                block = slice(end - 3, end)
                turn[block, block] = rotation3(factors.read(self._values, key, 3)[2])
        return np.asarray(turn @ own @ turn.T)

    def _joint_covariance(self, keys: Sequence[int], *, in_world: bool = False) -> Array:
        """Joint covariance (D, D) of variables at the last solution, in their own axes."""
        try:
            if in_world:
                self._relinearise()
                self._builder.place(in_world=True)
                found = JointMarginals(self._builder.graph, self._values).of(keys)
                self._builder.place(in_world=False)
                return found
            if self._marginals is None:
                self._relinearise()
                self._marginals = JointMarginals(self._builder.graph, self._values)
            return self._marginals.of(keys)
        except RuntimeError as error:
            raise self._builder.explain(error) from error


@dataclass(frozen=True, slots=True, eq=False)
class CalibratedSolution:
    """The estimate and each robot's calibration; the ``graph`` that was solved."""

    estimate: Estimate
    calibrations: Mapping[str, Calibration]
    graph: CalibrationGraph

    def joint(self, landmarks: Sequence[int], *, in_world: bool = False) -> JointMarginal:
        """Joint marginal of landmarks; the pose in front of them is left out (zeros).

        ``in_world``: see `CalibrationGraph.landmark_covariance`.
        """
        own = self.graph.landmark_covariance(landmarks, in_world=in_world)
        means = [np.zeros(3), *(self.estimate.landmarks[i][0] for i in landmarks)]
        cov = np.zeros((3 + len(own), 3 + len(own)))
        cov[3:, 3:] = own
        return JointMarginal.of(means, len(landmarks), cov)
