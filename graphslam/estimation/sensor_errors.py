"""By how much sensors of sightings are turned and their ranges scaled, as a solution shows it.

Each such error is one constant of the whole log, on which every sighting of its sensor depends.
As variables they would fill the graph; here they border it. Errors θ change residuals by G θ, and
the solution follows by D θ with D = -P Hᵀ W G. What is left, G + H D, is what the log can tell:
its information S = Gᵀ W (G + H D) and gradient Gᵀ W r are those of θ with all states, landmarks
and calibrations unknown too (Schur complement; e.g. B. Triggs et al., Bundle adjustment - a modern
synthesis, 2000, section 6.3, DOI 10.1007/3-540-44480-7_21).
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.geometry import Array, polar_points, rotation3
from graphslam.core.information_root import InformationRoot
from graphslam.core.observation_models import MODELS
from graphslam.core.record import replace
from graphslam.core.records import Association, Estimate, Step
from graphslam.estimation import factors
from graphslam.estimation.calibration_graph import CalibrationGraph
from graphslam.estimation.joint_covariances import solve_root
from graphslam.estimation.m_estimators import WEIGHTS
from graphslam.estimation.recorded_graph import ObservationNoise, Source
from graphslam.estimation.sandwich_covariance import shared_parts
from graphslam.estimation.solved_graph import SolvedGraph

#: errors of a sensor, in this order: turned to the left, rad; ranges too long, relative
ERRORS = ("sighting_yaw_rad", "sighting_range_scale")
#: rad and relative: of derivatives by differences
STEP = 1e-5


def without_errors(z: Array, mount: Array, errors: Array) -> Array:
    """Measurements (n, k) from a base as a sensor without errors would have made them.

    Args:
        z: (n, 2) bearings and ranges, or (n, 3) poses.
        mount: (n, 3) of the sensor that has the errors, in the base.
        errors: (n, 2) or (2,), see `ERRORS`.
    """
    is_pose = z.shape[1] == 3
    seen = z[:, :2] if is_pose else polar_points(z[:, 1], z[:, 0])
    yaw, scale = np.moveaxis(errors, -1, 0)
    c, s = np.cos(yaw), np.sin(yaw)
    x, y = ((seen - mount[:, :2]) / (1.0 + np.atleast_1d(scale)[:, None])).T
    x, y = c * x + s * y + mount[:, 0], c * y - s * x + mount[:, 1]
    if is_pose:
        return np.column_stack([x, y, z[:, 2] - yaw])
    return np.column_stack([np.arctan2(y, x), np.hypot(x, y)])


@dataclass(frozen=True, slots=True, eq=False)
class ShownErrors:
    """What a solution shows of k errors of sensors, to first order.

    ``gradient`` (k,) is minus that of half the squared error, ``information`` (k, k); ``spread``
    (k, k) the covariance of the gradient, which is larger if sightings share errors.
    ``taken`` (k,) is the part of the gradient that is of the priors of the odometry's calibration:
    the errors could be what that has taken up; ``taken_cov`` (k, k). ``moved`` (R, k): by how much
    each row of ``root`` is off for each error, in the axes of its variable.
    """

    gradient: Array
    information: Array
    spread: Array
    taken: Array
    taken_cov: Array
    moved: Array
    root: InformationRoot

    def with_errors(self, estimate: Estimate, errors: Array) -> Estimate:
        """The estimate whose covariances have what m independent errors (k, m) add."""
        off = self.moved @ errors

        def own(first: IntArray, turns: Array) -> Array:
            by = turns @ off[first[:, None] + np.arange(turns.shape[-1])]
            return np.asarray(by @ by.mT)

        states = {
            robot: replace(
                path, covs=path.covs + own(self.root.states[robot], rotation3(path.poses[:, 2]))
            )
            for robot, path in estimate.states.items()
        }
        landmarks = {}
        for number, (mean, cov) in estimate.landmarks.items():
            turn = rotation3(mean[2]) if len(mean) == 3 else np.eye(len(mean))
            first = np.array([self.root.landmarks[number]])
            landmarks[number] = mean, cov + own(first, turn[None])[0]
        return replace(estimate, states=states, landmarks=landmarks)


def shown_errors(
    graph: CalibrationGraph,
    steps: Sequence[Step],
    sensors: Mapping[int, int],
    mounts: Sequence[Array],
    noise: Mapping[Source, ObservationNoise] | None = None,
) -> ShownErrors:
    """What the last solution of a graph shows of the errors of sensors, two for each.

    Args:
        graph: of ``steps``.
        steps: whose associations are as in the graph.
        sensors: `Association.source` -> number of the sensor.
        mounts: (3,) of each sensor.
        noise: of sightings that share errors; None if none do.

    Raises:
        EstimationError: the solution is indeterminate.
    """
    solved, k = graph.solved(), 2 * len(mounts)
    seen: dict[Source, list[tuple[int, Association]]] = defaultdict(list)
    for step in steps:
        for a in step.associations:
            if a.source in sensors:
                seen[a.robot, a.model].append((step.time_ns, a))
    parts = [_Part.of(solved, own, sensors, mounts) for own in seen.values()]
    calibrated = [solved.root.mounts[robot] for robot in solved.calibrations]
    free = np.concatenate([np.zeros(0, dtype=np.int64), *calibrated])
    right = np.zeros((int(solved.root.own.sum()), k + len(free)))
    for part in parts:
        part.add_right(right[:, :k])
    right[free, k + np.arange(len(free))] = 1.0
    found = solve_root(solved.root, right)
    moved, calibration_cov = -found[:, :k], found[free, k:]
    gradient = -moved.T @ solved.gradient()  # solutions end before the very minimum
    information, shared = np.zeros((k, k)), np.zeros((k, k))
    for source, part in zip(seen, parts, strict=True):
        left = part.left(moved)
        gradient -= np.einsum("nik,ni->k", part.by_errors, part.residual)
        information += np.einsum("nik,nil->kl", part.by_errors, left)
        if noise and source in noise and part.residual.shape[1] == 2:
            own = [a for _, a in seen[source]]
            shared += _with_shared(left, own, noise[source]) - _sum_of_squares(left)
    information = 0.5 * (information + information.T)
    spread = information + shared
    taken, by_calibration = _taken(solved, moved)
    taken_cov = by_calibration @ calibration_cov @ by_calibration.T
    return ShownErrors(gradient, information, spread, taken, taken_cov, moved, solved.root)


def _taken(solved: SolvedGraph, moved: Array) -> tuple[Array, Array]:
    """`ShownErrors.taken` (k,), and its derivative (k, p) by all calibrations, sign apart."""
    k = moved.shape[1]
    taken, parts = np.zeros(k), []
    for robot, (key, prior) in solved.calibrations.items():
        by = np.linalg.solve(prior.cov, moved[solved.root.mounts[robot]]).T
        parts.append(by)
        taken -= by @ (solved.values.atVector(key) - prior.mean)
    return taken, np.hstack([np.zeros((k, 0)), *parts])


def _sum_of_squares(rows: Array) -> Array:
    """Of rows (..., k), over all others: (k, k)."""
    flat = rows.reshape(-1, rows.shape[-1])
    return np.asarray(flat.T @ flat)


def _with_shared(left: Array, seen: Sequence[Association], noise: ObservationNoise) -> Array:
    """`_sum_of_squares` of ``left`` (n, 2, k) by errors that sightings share, see `shared_parts`.

    Those of one target are taken as one error here, however long ago: how slowly they change is not
    measured, and against a constant of the sensor what matters is what does not average.
    """
    alone, shared, _ = shared_parts(seen, noise)
    number = {target: k for k, target in enumerate(dict.fromkeys(a.target for a in seen))}
    sums = np.zeros((len(number), *left.shape[1:]))
    np.add.at(sums, [number[a.target] for a in seen], shared[:, :, None] * left)
    return _sum_of_squares(alone[:, :, None] * left) + _sum_of_squares(sums)


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    """Sightings (n) of one kind by one robot, in sigmas and by the weights of the kernel.

    ``residual`` (n, i), ``by_errors`` (n, i, k), and ``ends``: first rows (n,) of the states and
    of the targets, and the derivatives (n, i, d) by them.
    """

    residual: Array
    by_errors: Array
    ends: tuple[tuple[IntArray, Array], tuple[IntArray, Array]]

    @classmethod
    def of(
        cls,
        solved: SolvedGraph,
        observed: Sequence[tuple[int, Association]],
        sensors: Mapping[int, int],
        mounts: Sequence[Array],
    ) -> "_Part":
        """From sightings with the times of their steps."""
        builder, root = solved.builder, solved.root
        first = observed[0][1]
        model, robot, n = MODELS[first.model], first.robot, len(observed)
        at = np.array([a.time_ns for _, a in observed], dtype=np.int64)
        number = builder.states.numbers(robot, at)
        x = solved.poses_at(builder.state_key(robot, 0) + number)
        t, rows = _targets(solved, observed, model.dim)
        z, cov = (np.array([getattr(a, name) for _, a in observed]) for name in ("z", "cov"))
        of = np.array([sensors[a.source] for _, a in observed if a.source is not None])
        mount = np.array(mounts)[of]
        L = np.linalg.cholesky(model.noise(z, cov, x, t))
        r = np.linalg.solve(L, model.residual(z, x, t)[:, :, None])[:, :, 0]
        weight, scale = WEIGHTS[builder.kernel.kernel], builder.kernel.scale
        sizes = np.linalg.norm(r, axis=1).tolist()
        root_weight = np.sqrt([weight(d, scale) for d in sizes])[:, None]
        whiten = root_weight[:, :, None] * np.linalg.inv(L)
        # at what is expected: with what is measured its noise would be in the residual as well
        h, G = model.predict(x, t), np.zeros((n, r.shape[1], 2 * len(mounts)))
        for k, off in enumerate(STEP * np.eye(2)):
            up, down = (model.residual(without_errors(h, mount, e), x, t) for e in (off, -off))
            by_error = whiten @ (up - down)[:, :, None] / (2 * STEP)
            G[np.arange(n), :, 2 * of + k] = by_error[:, :, 0]
        H_x, H_t = model.jacobians(z, x, t)
        H_x = whiten @ H_x @ rotation3(x[:, 2])
        H_t = whiten @ H_t @ (rotation3(t[:, 2]) if model.dim == 3 else np.eye(2))
        ends = (root.states[robot][number], H_x), (rows, H_t)
        return cls(root_weight * r, G, ends)

    def add_right(self, right: Array) -> None:
        """Add Hᵀ W G to ``right`` (R, k)."""
        for rows, H in self.ends:
            np.add.at(right, rows[:, None] + np.arange(H.shape[2]), H.mT @ self.by_errors)

    def left(self, moved: Array) -> Array:
        """G + H D (n, i, k) of ``moved`` D (R, k)."""
        left = self.by_errors.copy()
        for rows, H in self.ends:
            left += H @ moved[rows[:, None] + np.arange(H.shape[2])]
        return left


def _targets(
    solved: SolvedGraph, observed: Sequence[tuple[int, Association]], dim: int
) -> tuple[Array, IntArray]:
    """Values (n, dim) of what is seen in a solution, and their first rows (n,) of its root."""
    builder, root = solved.builder, solved.root
    names = [a.target for _, a in observed]
    if isinstance(names[0], int):
        numbers, of = np.unique(np.array(names, dtype=np.int64), return_inverse=True)
        found = [
            (factors.read(solved.values, factors.landmark_key(i), dim), root.landmarks[i])
            for i in numbers.tolist()
        ]
        t, rows = zip(*found, strict=True)
        return np.array(t)[of], np.array(rows, dtype=np.int64)[of]
    poses, first = np.zeros((len(observed), 3)), np.zeros(len(observed), dtype=np.int64)
    seen_ns = np.array([time_ns for time_ns, _ in observed], dtype=np.int64)
    for robot in set(names):
        own = np.array([name == robot for name in names])
        number = builder.states.numbers(str(robot), seen_ns[own])
        poses[own] = solved.poses_at(builder.state_key(str(robot), 0) + number)
        first[own] = root.states[str(robot)][number]
    return poses, first
