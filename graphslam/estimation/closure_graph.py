"""Motions of robots with any choice of candidate closures, solved again and again.

Factors are built once; each solution begins at the one before.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import gtsam
import numpy as np

from graphslam.core.config import RobustConfig
from graphslam.core.geometry import Array
from graphslam.core.records import Closure, Estimate, Step
from graphslam.estimation import factors
from graphslam.estimation.isam2 import BatchGraph, with_means
from graphslam.estimation.joint_covariances import information_root, pair_covariances
from graphslam.estimation.optimisation import (
    CONVERGED_ERROR_ROUGH,
    is_wide,
    marginals_of,
    optimise,
)
from graphslam.estimation.selected_inverse import CovarianceBlocks

NO_KERNEL = RobustConfig("none")


class ClosureGraph:
    """A pose graph whose closures are chosen in every solution."""

    def __init__(
        self,
        steps: Iterable[Step],
        start: Estimate,
        closures: Sequence[Closure],
        kernel: RobustConfig,
    ) -> None:
        """Build all factors.

        Args:
            steps: starts and motions of all states.
            start: their poses, where the first solution begins.
            closures: the candidates.
            kernel: of the candidates, where it is asked for.

        Raises:
            EstimationError: a covariance is not positive definite and finite.
        """
        steps = list(steps)
        self._builder, self._values = BatchGraph.at_estimate(steps, start, kernel)
        motions = [motion for step in steps for motion in step.motions.values()]
        self._use_qr = is_wide(motions, closures)
        self._graph, self._size = self._builder.graph, self._builder.graph.size()
        self._kernel, self._rows = kernel, self._builder.rows
        groups = self._builder.closure_groups(replace(c, verified=True) for c in closures)
        self._plain = [factor for group in groups for factor in group.factors]
        self._used: tuple[int, ...] = ()
        self._ends: list[tuple[int, int]] = []
        self._robust: list[gtsam.NonlinearFactor] = []
        for factor in self._plain:
            assert isinstance(factor, gtsam.BetweenFactorPose2)
            other, key = factor.keys()
            noise = factors.robust(factor.noiseModel(), kernel)
            self._ends.append((other, key))
            self._robust.append(gtsam.BetweenFactorPose2(other, key, factor.measured(), noise))

    def begin_at(self, start: Estimate) -> None:
        """The next solution begins at these poses of all states."""
        values = gtsam.Values()
        for key in self._builder.dims():
            factors.write(values, key, self._builder.value_in(start, key))
        self._values = values

    def solve(self, used: Iterable[int], *, robust: bool, rough: bool = True) -> None:
        """Optimise with the candidates of these numbers, from the solution before.

        Args:
            used: indices into the closures.
            robust: under the kernel.
            rough: stop where the error decreases by less than a thousandth; ignored where the
                information is so wide that this may be anywhere on the way.

        Raises:
            EstimationError: the graph is indeterminate.
        """
        self._graph.resize(self._size)
        self._used = tuple(used)
        made = self._robust if robust else self._plain
        chosen = [made[k] for k in self._used]
        for factor in chosen:
            self._graph.add(factor)
        self._builder.rows = self._rows + 3 * len(chosen)
        kernel = self._kernel if robust else NO_KERNEL
        until = CONVERGED_ERROR_ROUGH if rough and not self._use_qr else None
        try:
            self._values = optimise(self._graph, self._values, kernel, until, use_qr=self._use_qr)
        except RuntimeError as error:
            raise self._builder.explain(error) from error

    def ends(self) -> tuple[Array, Array, Array]:
        """Both ends of every candidate in the solution.

        Returns:
            Poses (n, 3) of the states in whose frames the candidates are, poses (n, 3) of the
            others, and their joint covariances (n, 6, 6), errors along each one's axes.

        Raises:
            EstimationError: the graph is indeterminate.
        """
        x, y = (
            np.array([factors.read(self._values, pair[end], 3) for pair in self._ends])
            for end in (0, 1)
        )
        return x, y, self._joint()

    def estimate(self) -> Estimate:
        """The solution with its covariances.

        Raises:
            EstimationError: the graph is indeterminate.
        """
        builder = self._builder
        means = with_means(self._values, builder.dims(), self._covariances().marginals)
        return builder.estimate(means, float(self._graph.error(self._values)))

    def _joint(self) -> Array:
        """Joint covariances (n, 6, 6) of the ends of every candidate.

        Those in the solution are in its root. False ones tie poses far from each other, so if they
        were made part of it they would fill it: the time would grow with the cube of their number.
        """
        inside = {self._ends[k] for k in self._used}
        apart = sorted(set(self._ends) - inside)
        blocks = self._covariances(sorted(inside), keep_rows=bool(apart))
        joint = dict(blocks.joint)
        if apart:
            assert blocks.rows is not None
            keys, numbers = np.unique(apart, return_inverse=True)
            root = information_root(blocks.rows, {"": keys.tolist()}, {})
            rows, maps = root.states[""][:, None], np.broadcast_to(np.eye(3), (len(keys), 1, 3, 3))
            pairs = numbers.reshape(-1, 2)
            own, cross = pair_covariances(root, rows, maps, pairs)
            for pair, (a, b), between in zip(apart, pairs, cross, strict=True):
                joint[pair] = np.block([[own[a], between], [between.T, own[b]]])
        return np.array([joint[pair] for pair in self._ends])

    def _covariances(
        self, pairs: Sequence[tuple[int, int]] = (), *, keep_rows: bool = False
    ) -> CovarianceBlocks:
        try:
            return marginals_of(
                self._graph, self._values, pairs, keep_rows=keep_rows, use_qr=self._use_qr
            )
        except RuntimeError as error:
            raise self._builder.explain(error) from error
