"""Observations of walls as they are weighed where a graph is linear."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.config import RobustConfig
from graphslam.core.geometry import Array, rotate_cov
from graphslam.core.information_root import InformationRoot
from graphslam.core.observation_models import MODELS
from graphslam.core.records import Association
from graphslam.estimation import factors
from graphslam.estimation.m_estimators import WEIGHTS


@dataclass(frozen=True, slots=True, eq=False)
class WeighedWalls:
    """n observations of walls, with the states and landmarks that they are between.

    ``model``: the row of `MODELS` of all of them, "line" or "segment". ``robots``: whose states;
    ``keys`` (n,) of these; ``targets`` (n,) numbers of landmarks. ``z`` (n, 3) and ``cov``
    (n, 3, 3) as observed, the noise over the weights of a kernel; ``x`` and ``t`` (n, 3) states
    and landmarks in the world; ``extent`` (n, 2) from where to where the wall was seen, m along
    the x axis of ``z``.
    """

    model: str
    robots: Sequence[str]
    keys: IntArray
    targets: IntArray
    z: Array
    cov: Array
    x: Array
    t: Array
    extent: Array

    def state_rows(self, root: InformationRoot) -> IntArray:
        """First row (n,) of the root of each observation's state."""
        of, number = np.divmod(self.keys - factors.FIRST_STATE, factors.STATES)
        rows = np.zeros(len(self.keys), dtype=np.int64)
        for k, robot in enumerate(self.robots):
            own = of == k
            if own.any():
                rows[own] = root.states[robot][number[own]]
        return rows

    def landmark_rows(self, root: InformationRoot) -> IntArray:
        """First row (n,) of the root of each observation's landmark."""
        marks, of = np.unique(self.targets, return_inverse=True)
        return np.array([root.landmarks[number] for number in marks.tolist()], dtype=np.int64)[of]


def weighed_walls(
    model: str,
    robots: Sequence[str],
    observed: Sequence[tuple[int, int, Association]],
    ends: tuple[Array, Array],
    variances: Mapping[str, Array],
    kernel: RobustConfig,
) -> WeighedWalls:
    """Observations with their noise as a log shows it, and the weights that a kernel gives them.

    The weights are those by the noise as stated: by these the estimate was made.

    Args:
        model: row of `MODELS` of all of them.
        robots: in the order of the keys of their states.
        observed: keys of the state and of the landmark of each of n, and its association.
        ends: the states and landmarks there, (n, 3) each.
        variances: robot -> factors (2,) on the variances of its walls' normal offsets and
            directions; as stated where it is missing.
        kernel: of the estimate.
    """
    keys, _, seen = zip(*observed, strict=True)
    z, cov = np.array([a.z for a in seen]), np.array([a.cov for a in seen])
    compared, (x, t) = MODELS[model], ends
    r, noise = compared.residual(z, x, t), compared.noise(z, cov, x, t)
    whitened = np.linalg.solve(np.linalg.cholesky(noise), r[:, :, None])
    distances = np.linalg.norm(whitened[:, :, 0], axis=1)
    weight = WEIGHTS[kernel.kernel]
    weights = np.array([weight(d, kernel.scale) for d in distances.tolist()])
    as_stated = np.ones(2)
    factor = np.array([variances.get(a.robot, as_stated) for a in seen])
    sigma = np.sqrt(np.column_stack([np.ones(len(seen)), factor]))
    own = sigma[:, :, None] * rotate_cov(cov, -z[:, 2]) * sigma[:, None, :]
    extent = np.array([np.zeros(2) if a.extent is None else a.extent for a in seen])
    return WeighedWalls(
        model,
        robots,
        np.array(keys, dtype=np.int64),
        np.array([a.target for a in seen], dtype=np.int64),
        z,
        rotate_cov(own, z[:, 2]) / weights[:, None, None],
        x,
        t,
        extent,
    )
