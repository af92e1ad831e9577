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

    def covariance(self, landmarks: Sequence[int]) -> Array:
        """Joint covariance (D, D) of some landmarks, m and rad, errors along their own axes.

        The time grows with the cube of the number of all landmarks.
        """
        dims = [len(self.means[n]) for n in self.numbers]
        first = dict(zip(self.numbers, np.cumsum([0, *dims])[:-1].tolist(), strict=True))

        def rows(numbers: Sequence[int]) -> list[int]:
            return [first[n] + k for n in numbers for k in range(len(self.means[n]))]

        information = np.zeros((sum(dims), sum(dims)))
        for numbers, row in self.rows():
            own = rows(numbers)
            information[np.ix_(own, own)] += row.T @ row
        wanted = rows(landmarks)
        return np.asarray(np.linalg.inv(information)[np.ix_(wanted, wanted)])

    def given_the_others(
        self, landmarks: Mapping[int, tuple[Array, Array]]
    ) -> dict[int, tuple[Array, Array]]:
        """Where each landmark is by what is known of it, if all others are as estimated.

        Args:
            landmarks: number -> mean and covariance, as estimated.

        Returns:
            Number -> how far (d,) from its own estimate, m and rad along its own axes, and the
            covariance (d, d) of that.
        """
        off = {n: _error(mean, landmarks[n][0]) for n, mean in self.means.items()}
        information = {n: np.zeros((len(e), len(e))) for n, e in off.items()}
        gradient = {n: np.zeros(len(e)) for n, e in off.items()}
        for numbers, row in self.rows():
            residual, first = row @ np.concatenate([off[n] for n in numbers]), 0
            for n in numbers:
                own = row[:, first : first + len(off[n])]
                first += len(off[n])
                information[n] += own.T @ own
                gradient[n] += own.T @ residual
        cov = {n: np.asarray(np.linalg.inv(one)) for n, one in information.items()}
        return {n: (-cov[n] @ gradient[n], cov[n]) for n in off}

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
