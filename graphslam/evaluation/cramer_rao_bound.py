"""The Cramér-Rao bound of the bench: no unbiased estimator has a smaller covariance.

The information of the graph is evaluated at the truth with the Jacobians of `MODELS`, in numpy and
independently of the estimators. It is averaged over draws of the start, the only random part of
the truth: a hybrid bound, with a random start and the rest deterministic.

Source: H. L. Van Trees, Detection, Estimation, and Modulation Theory, Part I, 1968, section 2.4,
DOI 10.1002/0471221082; for filters P. Tichavský, C. H. Muravchik, A. Nehorai, Posterior
Cramér-Rao bounds for discrete-time nonlinear filtering, IEEE TSP 46(5), 1998,
DOI 10.1109/78.668800.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from graphslam.core.geometry import Array
from graphslam.core.observation_models import MODELS
from graphslam.core.records import Association
from graphslam.evaluation.monte_carlo_bench import BenchRun, Noise, draw_run
from graphslam.evaluation.monte_carlo_definition import Bench

#: starts over which the information is averaged; the result hardly depends on their number
_DRAWS = 200


@dataclass(frozen=True, slots=True, eq=False)
class PoseBounds:
    """Bounds on the mean squared error over time (K+1,): position m² and heading rad².

    Mean over the robots.
    """

    position_m2: Array
    heading_rad2: Array


@dataclass(frozen=True, slots=True, eq=False)
class Bound:
    """The bounds at one noise scale.

    ``causal``: of the latest poses by the data up to their time; ``final``: of all poses by all
    data. ``landmarks``: named as by `monte_carlo_consistency.landmark_squares`.
    """

    causal: PoseBounds
    final: PoseBounds
    landmarks: dict[str, float]


@dataclass(frozen=True, slots=True)
class _Layout:
    """Index of each state in the information matrix: poses by time and robot, then landmarks."""

    names: tuple[str, ...]
    steps: int
    points: int
    lines: int

    @property
    def size(self) -> int:
        return 3 * len(self.names) * (self.steps + 1) + 2 * (self.points + self.lines)

    def pose(self, robot: str, k: int) -> slice:
        start = 3 * (k * len(self.names) + self.names.index(robot))
        return slice(start, start + 3)

    def landmark(self, i: int) -> slice:
        start = 3 * len(self.names) * (self.steps + 1) + 2 * i
        return slice(start, start + 2)


def cramer_rao_bound(bench: Bench, scale: float, rng: np.random.Generator) -> Bound:
    """The bounds at a noise scale; ``rng`` draws the starts."""
    run, noise = draw_run(bench, scale, None), Noise.of(bench, scale)
    names = tuple(run.truth)
    steps = len(run.steps) - 1
    layout = _Layout(names, steps, len(bench.points_m), len(bench.walls_m))
    starts = {
        name: truth[0] + rng.standard_normal((_DRAWS, 3)) @ np.sqrt(noise.start)  # it is diagonal
        for name, truth in run.truth.items()
    }
    J = np.zeros((layout.size, layout.size))
    seen = np.zeros(layout.size, dtype=bool)
    causal = np.zeros((2, steps + 1))
    for k in range(steps + 1):
        for columns, H, V in _rows(run, noise, starts, layout, k):
            # H (draws, rows, columns) at each start, V (draws, rows, rows)
            J[np.ix_(columns, columns)] += (H.mT @ np.linalg.solve(V, H)).mean(axis=0)
            seen[columns] = True
        variance = _variances(J, seen)
        latest = np.array([variance[layout.pose(name, k)] for name in names])
        causal[:, k] = latest[:, :2].sum(axis=1).mean(), latest[:, 2].mean()
    variance = _variances(J, seen)
    poses = variance[: 3 * len(names) * (steps + 1)].reshape(steps + 1, len(names), 3)
    final = PoseBounds(poses[..., :2].sum(axis=2).mean(axis=1), poses[..., 2].mean(axis=1))
    return Bound(PoseBounds(*causal), final, _landmarks(variance, layout, run))


def _variances(J: Array, seen: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> Array:
    """Diagonal (n,) of the inverse information (n, n) of the observed states; else infinite."""
    out = np.full(len(J), np.inf)
    out[seen] = np.diag(np.linalg.inv(J[np.ix_(seen, seen)]))
    return out


def _rows(
    run: BenchRun, noise: Noise, starts: dict[str, Array], layout: _Layout, k: int
) -> Iterator[tuple[list[int], Array, Array]]:
    """Columns, Jacobian and covariance of every measurement of step k."""

    def columns(*blocks: slice) -> list[int]:
        return [i for block in blocks for i in range(block.start, block.stop)]

    def pose(name: str, at: int) -> Array:
        return starts[name] if at == 0 else run.truth[name][at][None]

    step = run.steps[k]
    for name in step.starts:
        yield columns(layout.pose(name, 0)), np.eye(3)[None], noise.start[None]
    for name in step.motions:
        # a motion is a measured relative pose of the state after it
        before, after = pose(name, k - 1), pose(name, k)
        model = MODELS["segment"]
        z = model.predict(before, after)
        H = np.concatenate(np.broadcast_arrays(*model.jacobians(z, before, after)), axis=-1)
        V = model.noise(z, noise.motion, before, after)
        yield columns(layout.pose(name, k - 1), layout.pose(name, k)), H, V
    for seen in step.associations:
        x, t, target = pose(seen.robot, k), *_target(run, layout, seen, k)
        model = MODELS[seen.model]
        H_x, H_t = model.jacobians(seen.z[None], x, t)
        if seen.model == "line":
            # normal offset and direction; the position along the line is a gauge
            c, s = np.cos(t[0, 2]), np.sin(t[0, 2])
            H_t = H_t @ np.array([[-s, 0.0], [c, 0.0], [0.0, 1.0]])
        V = model.noise(seen.z[None], seen.cov, x, t)
        yield (
            columns(layout.pose(seen.robot, k), target),
            np.concatenate([H_x, H_t], axis=-1),
            np.broadcast_to(V, (len(H_x), *V.shape[-2:])),
        )


def _target(run: BenchRun, layout: _Layout, seen: Association, k: int) -> tuple[Array, slice]:
    """True state (1, d) of what is observed at step k, and its block."""
    if isinstance(seen.target, int):
        return run.landmarks[seen.target][None], layout.landmark(seen.target)
    return run.truth[seen.target][k][None], layout.pose(seen.target, k)


def _landmarks(variance: Array, layout: _Layout, run: BenchRun) -> dict[str, float]:
    values: dict[str, list[float]] = {"points_m2": [], "lines_m2": [], "lines_rad2": []}
    for i in run.landmarks:
        block = variance[layout.landmark(i)]
        if not np.isfinite(block).all():
            continue  # never observed
        if i < layout.points:
            values["points_m2"].append(float(block.sum()))
        else:
            values["lines_m2"].append(float(block[0]))
            values["lines_rad2"].append(float(block[1]))
    return {name: float(np.mean(found)) for name, found in values.items() if found}
