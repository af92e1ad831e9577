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
from dataclasses import dataclass, field
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
    rows: list[CliqueRows] = []
    for number, clique in enumerate(cliques):
        above = None if clique.above is None else cliques[clique.above]
        block = clique.square_root(above)
        cov = clique.invert(above, block)
        if keep_rows:
            rows.append(clique.with_block(block))
        for key in clique.own:
            rows_of = slice(clique.starts[key], clique.starts[key] + clique.sizes[key])
            marginals[key] = cov[rows_of, rows_of]
        if number in pairs_in:
            joint.note(cov, clique, pairs_in[number])
        if above is not None:
            above.release()
    return CovarianceBlocks(marginals, joint.read(), tuple(rows) if keep_rows else None)


def root_rows(graph: gtsam.GaussianFactorGraph, *, use_qr: bool = False) -> tuple[CliqueRows, ...]:
    """The root of the information of a linear graph, from the last eliminated clique on.

    Raises:
        RuntimeError: the graph is indeterminate (by QR: the root is not finite instead).
    """
    cliques, _ = _eliminated(graph, use_qr)
    rows = []
    for clique in cliques:
        block = clique.square_root(None if clique.above is None else cliques[clique.above])
        rows.append(clique.with_block(block))
    return tuple(rows)


def _eliminated(
    graph: gtsam.GaussianFactorGraph, use_qr: bool
) -> tuple[list["_Clique"], dict[int, int]]:
    ordering = gtsam.Ordering.ColamdGaussianFactorGraph(graph)
    by_qr = (gtsam.EliminateQR,) if use_qr else ()
    return _cliques(graph.eliminateSequential(ordering, *by_qr))


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

    ``conditionals``: their rows, the last eliminated first. ``above``: the clique that has the
    whole separator; None without separator. ``sizes``: key -> dimension, of all cliques.
    ``starts``: key -> its first row in the covariance. ``joint_rows``: those of the separator in
    the covariance above. ``below``: how many cliques still need the covariance.
    """

    conditionals: list[gtsam.GaussianConditional]
    own: list[int]
    separator: Sequence[int]
    above: int | None
    sizes: dict[int, int]
    starts: dict[int, int] = field(default_factory=dict)
    joint_rows: list[int] = field(default_factory=list)
    below: int = 0
    _cov: Array | None = None

    def square_root(self, above: "_Clique | None") -> Array:
        """Rows (n, n + m) of the root of the own variables, and then of the separator."""
        roots = [conditional.R() for conditional in self.conditionals]
        starts, sizes, end = self.starts, self.sizes, 0
        for key, root in zip(self.own, roots, strict=True):
            starts[key], sizes[key] = end, len(root)
            end += len(root)
        own = end
        if above is not None:
            for key in self.separator:
                starts[key], first, size = end, above.starts[key], sizes[key]
                self.joint_rows += range(first, first + size)
                end += size
        return self._square_root(roots, own, end)

    def with_block(self, block: Array) -> CliqueRows:
        """What others see of it, with its rows of the root."""
        own = {key: self.sizes[key] for key in self.own}
        return CliqueRows(own, self.separator, self.above, block)

    def invert(self, above: "_Clique | None", block: Array) -> Array:
        """Covariance of the own variables and then the separator; kept while it is needed.

        ``block``: its `square_root`.
        """
        own, end = block.shape
        if above is None:
            joint = np.zeros((0, 0))
        else:
            assert above._cov is not None
            which = np.array(self.joint_rows)
            joint = above._cov.take(which, axis=0).take(which, axis=1)
        inverse, singular = dtrtri(block[:, :own])
        if singular:
            inverse = np.full((own, own), np.nan)
        gain = inverse @ block[:, own:]
        cov = np.empty((end, end))
        cross = gain @ joint
        cov[:own, :own] = inverse @ inverse.T + cross @ gain.T
        np.negative(cross, out=cov[:own, own:])
        np.negative(cross.T, out=cov[own:, :own])
        cov[own:, own:] = joint
        if self.below:
            self._cov = cov
        return cov

    def _square_root(self, roots: Sequence[Array], own: int, end: int) -> Array:
        """Rows of the own variables: upper triangular (n, n), and (n, m) of the separator.

        ``roots``: of each own variable the triangle of its own.
        """
        R = np.zeros((own, end))
        if len(self.own) == 1:
            R[:, :own] = roots[0]
            R[:, own:] = self.conditionals[0].S()
            return R
        starts, sizes = self.starts, self.sizes
        for key, root, conditional in zip(self.own, roots, self.conditionals, strict=True):
            rows, (_, *others) = slice(starts[key], starts[key] + sizes[key]), conditional.keys()
            R[rows, rows] = root
            R[rows, [row for k in others for row in range(starts[k], starts[k] + sizes[k])]] = (
                conditional.S()
            )
        return R

    def release(self) -> None:
        """One clique less needs the covariance."""
        self.below -= 1
        if not self.below:
            self._cov = None


def _cliques(net: gtsam.GaussianBayesNet) -> tuple[list[_Clique], dict[int, int]]:
    """Cliques of a net, each after the one above it, and the clique of each variable."""
    conditionals = [net.at(n) for n in range(net.size())]
    keys = [conditional.keys() for conditional in conditionals]
    number = {own[0]: n for n, own in enumerate(keys)}
    cliques: list[_Clique] = []
    clique_of: dict[int, int] = {}
    sizes: dict[int, int] = {}
    for n in reversed(range(len(keys))):
        key, *others = keys[n]
        following = min(map(number.__getitem__, others), default=None)
        if following is None:
            above = None
        else:
            above = clique_of[keys[following][0]]
            one = cliques[above]
            if one.own[-1] == keys[following][0] and len(others) == len(one.own) + len(
                one.separator
            ):
                one.own.append(key)
                one.conditionals.append(conditionals[n])
                clique_of[key] = above
                continue
            one.below += 1
        clique_of[key] = len(cliques)
        cliques.append(_Clique([conditionals[n]], [key], others, above, sizes))
    for one in cliques:  # in the order of elimination the square root is upper triangular
        one.own.reverse()
        one.conditionals.reverse()
    return cliques, clique_of
