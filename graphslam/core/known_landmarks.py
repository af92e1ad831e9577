"""Landmarks that are known before a log is read, as they enter an estimate."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from graphslam.core.geometry import Array, adjoint, between, inverse, log, moved_by_world
from graphslam.core.record import Record

#: m and rad: sigma of what nothing is known of
UNKNOWN = 1e3
#: landmarks that hold a map, at most: it takes time by the cube of their number
MOST_HOLDING = 30


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

    def rows_at(self, values: Mapping[int, Array]) -> list[tuple[tuple[int, ...], Array]]:
        """`rows` in the tangent spaces of other values of the landmarks than their means.

        The rows say nothing more of the pose of the whole map there than at the means. The errors
        of the values themselves are the same: Ad(exp(v)) v = v.
        """
        carried = {
            n: np.eye(2) if len(mean) == 2 else adjoint(between(mean, values[n]))
            for n, mean in self.means.items()
        }
        made = []
        for numbers, row in self.rows():
            ends = np.cumsum([len(carried[n]) for n in numbers])
            blocks = np.split(row, ends[:-1], axis=1)
            parts = [block @ carried[n] for n, block in zip(numbers, blocks, strict=True)]
            made.append((numbers, np.concatenate(parts, axis=1)))
        return made

    def pose_covariance(self) -> Array:
        """Covariance (3, 3), m and rad, of the twist by which all landmarks are moved alike.

        That is how well it is known where in the world the map lies. What is not known at all, such
        as the place along a single wall, has sigmas of `UNKNOWN`.
        """
        moved = self._moved_by_world()
        information = np.eye(3) / UNKNOWN**2
        for numbers, row in self.rows():
            J = row @ np.concatenate([moved[n] for n in numbers])
            information += J.T @ J
        return np.asarray(np.linalg.inv(information))

    def pose_rows(self) -> tuple[tuple[int, ...], Array]:
        """Numbers of up to `MOST_HOLDING` landmarks, and rows (3, D) that their errors have.

        These are those of the twist by which they are moved alike, by least squares with the
        information on each by itself, in sigmas of `pose_covariance`.
        """
        moved, own = self._moved_by_world(), {n: np.zeros((0, 0)) for n in self.numbers}
        for (number, *_), row in self.rows():
            own[number] = row[:, : len(row)].T @ row[:, : len(row)]
        some = tuple(self.numbers[:: 1 + (len(self.numbers) - 1) // MOST_HOLDING])
        weighed = np.concatenate([moved[n].T @ own[n] for n in some], axis=1)
        information = weighed @ np.concatenate([moved[n] for n in some])
        twist = np.linalg.solve(information + np.eye(3) / UNKNOWN**2, weighed)
        white = np.linalg.inv(np.linalg.cholesky(self.pose_covariance()))
        return some, np.asarray(white @ twist)

    def _moved_by_world(self) -> dict[int, Array]:
        """Derivative (d, 3) of each landmark's error by the twist of the world."""
        return {
            n: moved_by_world(np.append(mean, 0.0))[:2]
            if len(mean) == 2
            else adjoint(inverse(mean))
            for n, mean in self.means.items()
        }

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
