"""Landmarks that are known before a log is read, as they enter an estimate."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from graphslam.core.geometry import Array, between, log
from graphslam.core.record import Record


@dataclass(frozen=True, slots=True, eq=False)
class SparseRoot:
    """Whitened rows of n variables, each with the ones that it depends on.

    ``parents``: of each variable the numbers of those before it that it depends on; ``rows``
    (d, d + the dimensions of the parents) take the errors of the variable and of its parents to
    white noise. ``widening``: factor on the variances, see `core.sparse_gaussian`.
    """

    parents: tuple[tuple[int, ...], ...]
    rows: tuple[Array, ...]
    widening: float


@dataclass(frozen=True, slots=True, eq=False)
class KnownLandmarks(Record):
    """A joint Gaussian of landmarks, that of an earlier estimate.

    ``means``: number -> (2,) of a point, (3,) of a wall, in the world. ``numbers`` (n,) are those
    of the variables of ``root``. Errors of walls are along each one's own axes, in the tangent
    space of its mean.
    """

    means: Mapping[int, Array]
    numbers: Sequence[int]
    root: SparseRoot

    def rows(self) -> list[tuple[tuple[int, ...], Array]]:
        """Numbers of the landmarks that each group of whitened rows is of, and the rows."""
        root, name = self.root, self.numbers
        return [
            ((own, *(name[parent] for parent in parents)), row)
            for own, parents, row in zip(name, root.parents, root.rows, strict=True)
        ]

    def squared_residual(self, landmarks: Mapping[int, tuple[Array, Array]]) -> float:
        """Of landmarks as estimated: number -> mean and covariance."""
        off = {n: _error(mean, landmarks[n][0]) for n, mean in self.means.items()}
        return float(
            sum(
                ((row @ np.concatenate([off[n] for n in numbers])) ** 2).sum()
                for numbers, row in self.rows()
            )
        )


def _error(mean: Array, value: Array) -> Array:
    return value - mean if len(mean) == 2 else log(between(mean, value))
