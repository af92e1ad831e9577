"""Residuals of lines in a batch solution, added up, and how much of them the solution absorbs."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.geometry import Array, path_length, rotate_cov, rotation3
from graphslam.core.observation_models import LineModel
from graphslam.estimation import factors
from graphslam.estimation.isam2 import observed_ends
from graphslam.estimation.joint_covariances import variances_of
from graphslam.estimation.posterior_residuals import Residuals
from graphslam.estimation.solved_graph import SolvedGraph
from graphslam.estimation.weighed_walls import WeighedWalls, weighed_walls


@dataclass(frozen=True, slots=True, eq=False)
class LineResiduals(SolvedGraph):
    """Residuals of the lines in a solution."""

    @property
    def robots(self) -> Sequence[str]:
        """Whose lines there are."""
        return [robot for robot in self.builder.robots if self.builder.lines_of(robot)]

    def seen_along(self, robot: str) -> tuple[IntArray, Array]:
        """Of each of a robot's n observations of lines the landmark, and after which path, m."""
        seen, own = self.builder.lines_of(robot), self.builder.state_keys(robot)
        path = path_length(np.array([factors.read(self.values, key, 3) for key in own]))
        numbers = np.array([key - own[0] for key, *_ in seen], dtype=np.int64)
        return np.array([a.target for *_, a in seen], dtype=np.int64), path[numbers]

    def sums(self, robot: str, of: IntArray, shown: IntArray) -> Residuals:
        """Residuals in sigmas as stated, added up: normal offsets and directions, (m, 2).

        Each is where the line was observed, not where it faces its landmark's origin, and by the
        weight that it has. The time is that of `covariance_of` for two columns of each sum.

        Args:
            robot: who observed the lines.
            of: (n,) the number of the sum that each of its observations is part of.
            shown: (m,) the sums that are wanted, in increasing order.
        """
        builder = self.builder
        observed = builder.lines_of(robot)
        ends = observed_ends(observed, self.values)
        lines = weighed_walls("line", builder.robots, observed, ends, {}, builder.kernel)
        model, back = LineModel(), _back(lines)
        residuals = (back @ model.residual(lines.z, lines.x, lines.t)[:, :, None])[:, :, 0]
        sums = np.zeros((int(of.max()) + 1, 2))
        np.add.at(sums, of, residuals)
        used = np.flatnonzero(np.isin(of, shown))
        column = 2 * np.searchsorted(shown, of[used])[:, None] + np.arange(2)  # (u, 2)
        H_x, H_t = model.jacobians(lines.z, lines.x, lines.t)
        entries = []
        for rows, poses, H in (
            (lines.state_rows(self.root), lines.x, H_x),
            (lines.landmark_rows(self.root), lines.t, H_t),
        ):
            by = (back @ H @ rotation3(poses[:, 2]))[used]  # (u, 2, 3)
            at = rows[used, None, None] + np.arange(3)
            entries.append([a.ravel() for a in np.broadcast_arrays(at, column[:, :, None], by)])
        at, columns, by = (np.concatenate(part) for part in zip(*entries, strict=True))
        absorbed = variances_of(self.root, at, columns, by, 2 * len(shown))
        variance = np.repeat(np.bincount(of)[shown].astype(float), 2)
        return Residuals(sums[shown], variance.reshape(-1, 2), absorbed.reshape(-1, 2))


def _back(lines: WeighedWalls) -> Array:
    """From residuals where lines face their landmarks to those where they are, in sigmas."""
    z = lines.z
    back = np.zeros((len(z), 2, 2))
    back[:, 0, 0] = back[:, 1, 1] = 1.0
    back[:, 0, 1] = -LineModel().along(z, lines.x, lines.t)
    sigma = np.sqrt(np.diagonal(rotate_cov(lines.cov, -z[:, 2]), axis1=1, axis2=2)[:, 1:])
    return np.asarray(back / sigma[:, :, None])
