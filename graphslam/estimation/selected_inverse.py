"""Marginal covariances of all variables at once, by selected inversion of the square root.

Of the inverse of the information matrix only the blocks in the sparsity pattern of its triangular
factor are computed, from the last eliminated variable to the first: K. Takahashi, J. Fagan and
M. Chin, Formation of a sparse bus impedance matrix, PICA 1973; for SLAM M. Kaess and F. Dellaert,
Covariance recovery from a square root information matrix, RAS 57, 2009, DOI
10.1016/j.robot.2009.06.008. That costs about as much as the elimination, while `gtsam.Marginals`
climbs its tree for each variable that it is asked for.
"""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from scipy.linalg.lapack import dtrtri

from graphslam.core.geometry import Array

#: numbers in covariances of cliques that are kept until joint ones are read from them
NOTED = 1_000_000


@dataclass(frozen=True, slots=True, eq=False)
class CliqueRows:
    """Rows of the root of some variables: block (n, n + m), m of the ``separator``'s dimensions.

    ``own``: key -> dimension. ``above`` is the number of the clique that has the whole separator;
    None without one.
    """

    own: Mapping[int, int]
    separator: Sequence[int]
    above: int | None
    block: Array


@dataclass(frozen=True, slots=True, eq=False)
class CovarianceBlocks:
    """``marginals``: key -> (d, d) of every variable; ``joint``: keys of variables -> (D, D).

    ``rows``: the root of the information that they are of, from the last eliminated clique on; None
    if it was not asked for.
    """

    marginals: Mapping[int, Array]
    joint: Mapping[tuple[int, ...], Array]
    rows: tuple[CliqueRows, ...] | None = None


def covariance_blocks(
    graph: gtsam.GaussianFactorGraph,
    pairs: Iterable[tuple[int, ...]] = (),
    apart: Iterable[tuple[int, ...]] = (),
    *,
    use_qr: bool = False,
    keep_rows: bool = False,
) -> CovarianceBlocks:
    """Covariances of all variables of a linear graph, joint ones of ``pairs`` and of ``apart``.

    Args:
        graph: factors; it gains empty ones for ``apart``.
        pairs: keys of variables that are in one factor.
        apart: keys of two different poses each, whether a factor connects them or not, and of
            others to which factors connect both.
        use_qr: eliminate by QR, slower than Cholesky, but precise where information spans many
            orders of magnitude.
        keep_rows: whether to return the root too.

    Raises:
        RuntimeError: the graph is indeterminate (by QR: covariances are not finite instead).
    """
    wanted, others = set(pairs), sorted(set(apart))
    for pair in others:
        graph.add(_empty_factor(*pair[:2]))
    wanted.update(others)
    cliques, clique_of = _eliminated(graph, use_qr)
    pairs_in: dict[int, list[tuple[int, ...]]] = defaultdict(list)
    for pair in wanted:
        # of the variables in one factor the first eliminated has the others in its row
        pairs_in[max(map(clique_of.__getitem__, pair))].append(pair)
    marginals: dict[int, Array] = {}
    joint = _Blocks()
    for number, clique in enumerate(cliques):
        above = None if clique.above is None else cliques[clique.above]
        cov = clique.invert(above)
        for key in clique.own:
            rows = slice(clique.starts[key], clique.starts[key] + clique.sizes[key])
            marginals[key] = cov[rows, rows]
        if number in pairs_in:
            joint.note(cov, clique, pairs_in[number])
        if above is not None:
            above.release()
    rows_of = tuple(clique.rows() for clique in cliques) if keep_rows else None
    return CovarianceBlocks(marginals, joint.read(), rows_of)


def root_rows(graph: gtsam.GaussianFactorGraph, *, use_qr: bool = False) -> tuple[CliqueRows, ...]:
    """The root of the information of a linear graph, from the last eliminated clique on.

    Raises:
        RuntimeError: the graph is indeterminate (by QR: the root is not finite instead).
    """
    cliques, _ = _eliminated(graph, use_qr)
    return tuple(clique.rows() for clique in cliques)


class _Blocks:
    """Joint covariances of a few variables each, read from those of cliques many at once."""

    def __init__(self) -> None:
        self._found: dict[tuple[int, ...], Array] = {}
        self._forget()

    def _forget(self) -> None:
        # by dimensions: keys, where the covariance begins, its width, where their rows begin
        self._noted: dict[tuple[int, ...], list[tuple[Any, ...]]] = defaultdict(list)
        self._covs: list[Array] = []
        self._size = 0

    def note(self, cov: Array, clique: "_Clique", wanted: Iterable[tuple[int, ...]]) -> None:
        """Note which keys are wanted of the covariance (n, n) of a clique."""
        start, size = clique.starts.__getitem__, clique.sizes.__getitem__
        width, first = len(cov), self._size
        for keys in wanted:
            self._noted[tuple(map(size, keys))].append(
                (keys, first, width, tuple(map(start, keys)))
            )
        self._covs.append(cov.ravel())
        self._size += cov.size
        if self._size > NOTED:
            self.read()

    def read(self) -> dict[tuple[int, ...], Array]:
        """Keys -> covariance (k, k), of all that was noted."""
        flat = np.concatenate([*self._covs, np.zeros(0)])
        for dims, noted in self._noted.items():
            keys, first, width, starts = zip(*noted, strict=True)
            rows = np.repeat(starts, dims, axis=1)
            rows += np.concatenate([np.arange(dim) for dim in dims])
            begin = np.array(first)[:, None] + rows * np.array(width)[:, None]
            self._found.update(zip(keys, flat[begin[:, :, None] + rows[:, None]], strict=True))
        self._forget()
        return self._found


def _empty_factor(a: int, b: int) -> gtsam.JacobianFactor:
    """A row without information that makes the block of two poses part of the pattern."""
    unit, nothing = gtsam.noiseModel.Unit.Create(1), np.zeros((1, 3))
    return gtsam.JacobianFactor(a, nothing, b, nothing, np.zeros(1), unit)


@dataclass(slots=True, eq=False)
class _Clique:
    """Variables whose rows of the square root end in the same later variables, the separator.

    ``conditional``: these rows. ``above``: number of the clique that has the whole separator; None
    without separator. ``sizes``: key -> dimension, of all variables. ``starts``: key -> its first
    row in the covariance. ``below``: how many cliques still need the covariance.
    """

    conditional: gtsam.GaussianConditional
    own: list[int]
    separator: list[int]
    above: int | None
    below: int
    sizes: Mapping[int, int]
    starts: Mapping[int, int]
    _cov: Array | None = None

    def rows(self) -> CliqueRows:
        """What others see of it."""
        own = {key: self.sizes[key] for key in self.own}
        block = np.hstack((self.conditional.R(), self.conditional.S()))
        return CliqueRows(own, self.separator, self.above, block)

    def invert(self, above: "_Clique | None") -> Array:
        """Covariance of the own variables and then the separator; kept while it is needed."""
        inverse, singular = dtrtri(self.conditional.R())
        inverse, own = np.asarray(inverse), len(inverse)
        if singular:
            inverse = np.full((own, own), np.nan)
        if above is None:
            cov = np.asarray(inverse @ inverse.T)
        else:
            assert above._cov is not None
            starts, sizes = above.starts, self.sizes
            held: list[int] = []
            for key in self.separator:
                held += range(starts[key], starts[key] + sizes[key])
            which = np.array(held)
            joint = above._cov.take(which, axis=0).take(which, axis=1)
            gain = inverse @ self.conditional.S()
            cross = gain @ joint
            end = own + len(joint)
            cov = np.empty((end, end))
            cov[:own, :own] = inverse @ inverse.T + cross @ gain.T
            np.negative(cross, out=cov[:own, own:])
            np.negative(cross.T, out=cov[own:, :own])
            cov[own:, own:] = joint
        if self.below:
            self._cov = cov
        return cov

    def release(self) -> None:
        """One clique less needs the covariance."""
        self.below -= 1
        if not self.below:
            self._cov = None


def _eliminated(
    graph: gtsam.GaussianFactorGraph, use_qr: bool
) -> tuple[list[_Clique], dict[int, int]]:
    """Cliques of a graph, each after the one above it, and the clique of each variable."""
    ordering = gtsam.Ordering.ColamdGaussianFactorGraph(graph)
    by_qr = (gtsam.EliminateQR,) if use_qr else ()
    tree = graph.eliminateMultifrontal(ordering, *by_qr)
    gradient = graph.gradientAtZero()
    sizes = {key: len(gradient.at(key)) for key in map(ordering.at, range(ordering.size()))}
    cliques: list[_Clique] = []
    clique_of: dict[int, int] = {}
    waiting: list[tuple[gtsam.GaussianBayesTreeClique, int | None]] = []
    waiting += [(root, None) for root in tree.roots()]
    while waiting:
        node, above = waiting.pop()
        number, below, conditional = len(cliques), node.nrChildren(), node.conditional()
        keys, dim = conditional.keys(), len(conditional.R())
        starts, count, end = {}, 0, 0
        for key in keys:
            count += end < dim
            starts[key] = end
            end += sizes[key]
        own = keys[:count]
        clique_of.update(dict.fromkeys(own, number))
        cliques.append(_Clique(conditional, own, keys[count:], above, below, sizes, starts))
        waiting += [(node[k], number) for k in range(below)]
    return cliques, clique_of
