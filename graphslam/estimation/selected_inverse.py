"""Marginal covariances of all variables at once, by selected inversion of the square root.

Of the inverse of the information matrix only the blocks in the sparsity pattern of its triangular
factor are computed, from the last eliminated variable to the first: K. Takahashi, J. Fagan and
M. Chin, Formation of a sparse bus impedance matrix, PICA 1973; for SLAM M. Kaess and F. Dellaert,
Covariance recovery from a square root information matrix, RAS 57, 2009, DOI
10.1016/j.robot.2009.06.008. That costs about as much as the elimination, while `gtsam.Marginals`
climbs its tree for each variable that it is asked for.
"""

from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.linalg.lapack import dtrtri

from graphslam.core.arrays import BoolArray, IntArray
from graphslam.core.geometry import Array

#: numbers in covariances of cliques that are kept until those of variables are read from them
NOTED = 1_000_000
#: the clique above one without separator
NONE = -1


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
    tree = _Tree.of(graph, use_qr)
    blocks = _Blocks(tree, wanted)
    held, first = tree.rows_above()
    kept: dict[int, Array] = {}  # covariances that cliques below need
    below = tree.below.tolist()
    for number, above in enumerate(tree.above.tolist()):
        rows = held[first[number] : first[number + 1]]
        cov = _inverted(tree.conditionals[number], kept.get(above), rows)
        if below[number]:
            kept[number] = cov
        if above != NONE:
            below[above] -= 1
            if not below[above]:
                del kept[above]
        blocks.add(cov)
    blocks.read()
    return CovarianceBlocks(blocks.marginals, blocks.joint, tree.rows() if keep_rows else None)


def root_rows(graph: gtsam.GaussianFactorGraph, *, use_qr: bool = False) -> tuple[CliqueRows, ...]:
    """The root of the information of a linear graph, from the last eliminated clique on.

    Raises:
        RuntimeError: the graph is indeterminate (by QR: the root is not finite instead).
    """
    return _Tree.of(graph, use_qr).rows()


def _inverted(conditional: gtsam.GaussianConditional, above: Array | None, rows: IntArray) -> Array:
    """Covariance of a clique's own variables and then its separator.

    Args:
        conditional: its rows of the root.
        above: covariance of the clique above it; None without separator.
        rows: (m,) of the separator in ``above``.
    """
    inverse, singular = dtrtri(conditional.R())
    inverse, own = np.asarray(inverse), len(inverse)
    if singular:
        inverse = np.full((own, own), np.nan)
    if above is None:
        return np.asarray(inverse @ inverse.T)
    joint = above.take(rows, axis=0).take(rows, axis=1)
    gain = inverse @ conditional.S()
    cross = gain @ joint
    end = own + len(joint)
    cov = np.empty((end, end))
    cov[:own, :own] = inverse @ inverse.T + cross @ gain.T
    np.negative(cross, out=cov[:own, own:])
    np.negative(cross.T, out=cov[own:, :own])
    cov[own:, own:] = joint
    return cov


def _empty_factor(a: int, b: int) -> gtsam.JacobianFactor:
    """A row without information that makes the block of two poses part of the pattern."""
    unit, nothing = gtsam.noiseModel.Unit.Create(1), np.zeros((1, 3))
    return gtsam.JacobianFactor(a, nothing, b, nothing, np.zeros(1), unit)


@dataclass(frozen=True, slots=True, eq=False)
class _Tree:
    """The c cliques of an eliminated graph, each after the one above it, and its v variables.

    A clique has own variables, whose rows of the square root end in the same later variables, the
    separator, all of which are in the clique ``above``.

    ``conditionals``: these rows. ``above`` (c,): its number, `NONE` without separator; ``below``
    (c,): how many are below. ``keys`` (v,) are sorted, ``sizes`` (v,) their dimensions,
    ``clique_of`` (v,) the cliques that own them. The e members of all cliques one after another:
    ``member`` (e,) is a number of a variable, ``start`` (e,) its first row in the covariance of
    the ``clique`` (e,), ``is_own`` (e,) whether that owns it. ``width`` (c,): of that covariance.
    ``place`` (e,): clique times v + variable, sorted; ``by_place`` (e,): whose they are.
    """

    conditionals: list[gtsam.GaussianConditional]
    above: IntArray
    below: IntArray
    keys: IntArray
    sizes: IntArray
    clique_of: IntArray
    member: IntArray
    start: IntArray
    clique: IntArray
    is_own: BoolArray
    width: IntArray
    place: IntArray
    by_place: IntArray

    @classmethod
    def of(cls, graph: gtsam.GaussianFactorGraph, use_qr: bool) -> "_Tree":
        """Eliminate a graph."""
        ordering = gtsam.Ordering.ColamdGaussianFactorGraph(graph)
        tree = graph.eliminateMultifrontal(ordering, *((gtsam.EliminateQR,) if use_qr else ()))
        conditionals: list[gtsam.GaussianConditional] = []
        numbers_above: list[int] = []
        below: list[int] = []
        owned: list[int] = []
        counts: list[int] = []
        members: list[int] = []
        waiting: list[tuple[gtsam.GaussianBayesTreeClique, int]] = []
        waiting += [(root, NONE) for root in tree.roots()]
        while waiting:
            node, above = waiting.pop()
            number, children, conditional = len(below), node.nrChildren(), node.conditional()
            own = conditional.keys()
            members += own
            conditionals.append(conditional)
            counts.append(len(own))
            owned.append(conditional.rows())
            numbers_above.append(above)
            below.append(children)
            waiting += [(node[k], number) for k in range(children)]
        keys, member = np.unique(np.array(members, dtype=np.int64), return_inverse=True)
        gradient = graph.gradientAtZero()
        sizes = np.array([len(gradient.at(key)) for key in keys.tolist()], dtype=np.int64)
        clique = np.repeat(np.arange(len(counts)), counts)
        ends = np.cumsum(sizes[member])
        lasts = np.append(0, ends)[np.append(0, np.cumsum(counts))]
        start = ends - sizes[member] - lasts[clique]
        is_own = start < np.array(owned, dtype=np.int64)[clique]
        clique_of = np.empty(len(keys), dtype=np.int64)
        clique_of[member[is_own]] = clique[is_own]
        place = clique * len(keys) + member
        by_place = np.argsort(place)
        above_of, below_of = (np.array(x, dtype=np.int64) for x in (numbers_above, below))
        return cls(
            conditionals, above_of, below_of, keys, sizes, clique_of,
            member, start, clique, is_own, np.diff(lasts), place[by_place], by_place,
        )  # fmt: skip

    def starts(self, cliques: IntArray, variables: IntArray) -> IntArray:
        """First rows (n,) of variables in the covariances of cliques that have them."""
        wanted = cliques * len(self.keys) + variables
        return self.start[self.by_place[np.searchsorted(self.place, wanted)]]

    def rows_above(self) -> tuple[IntArray, IntArray]:
        """Rows (r,) of all separators in the covariances above them, and where each's begin.

        The latter (c + 1,) with the end of the last.
        """
        separators = np.flatnonzero(~self.is_own)
        below, member = self.clique[separators], self.member[separators]
        sizes = self.sizes[member]
        rows = _ranges(self.starts(self.above[below], member), sizes)
        counts = np.bincount(below, sizes, len(self.above)).astype(np.int64)
        return rows, np.append(0, np.cumsum(counts))

    def rows(self) -> tuple[CliqueRows, ...]:
        """What others see of the root."""
        found = []
        keys, sizes = self.keys[self.member], self.sizes[self.member]
        ends = np.append(0, np.cumsum(np.bincount(self.clique, minlength=len(self.above))))
        owned = np.bincount(self.clique, self.is_own, len(self.above)).astype(np.int64)
        for number, conditional in enumerate(self.conditionals):
            begin, end = ends[number : number + 2]
            middle, above = begin + owned[number], int(self.above[number])
            own = dict(zip(keys[begin:middle].tolist(), sizes[begin:middle].tolist(), strict=True))
            block = np.hstack((conditional.R(), conditional.S()))
            separator = keys[middle:end].tolist()
            found.append(CliqueRows(own, separator, None if above == NONE else above, block))
        return tuple(found)


def _ranges(first: IntArray, sizes: IntArray) -> IntArray:
    """The numbers from each ``first`` (n,) on, ``sizes`` (n,) of them, one after another."""
    offsets = np.arange(int(sizes.sum())) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    return np.repeat(first, sizes) + offsets


class _Blocks:
    """Covariances of single variables and of a few together, read from those of many cliques."""

    def __init__(self, tree: _Tree, wanted: Collection[tuple[int, ...]]) -> None:
        """``wanted``: keys of variables that are in one clique."""
        self.marginals: dict[int, Array] = {}
        self.joint: dict[tuple[int, ...], Array] = {}
        self._tree = tree
        self._covs: list[Array] = []
        self._size, self._first = 0, 0  # numbers in them; the first of their cliques
        # each by what it is called, its clique, and where its rows begin there: in their order
        own = np.flatnonzero(tree.is_own)
        self._singles = own, tree.sizes[tree.member[own]]
        by_count: dict[int, list[tuple[int, ...]]] = defaultdict(list)
        for names in wanted:
            by_count[len(names)].append(names)
        self._several = [self._sorted(some) for some in by_count.values()]

    def _sorted(
        self, wanted: list[tuple[int, ...]]
    ) -> tuple[list[tuple[int, ...]], IntArray, IntArray, IntArray]:
        """Keys (n, k) in the order of their cliques, these (n,), their starts and sizes (n, k)."""
        tree = self._tree
        variables = np.searchsorted(tree.keys, np.array(wanted, dtype=np.int64))
        # of the variables in one factor the first eliminated has the others in its row
        cliques = tree.clique_of[variables].max(axis=1)
        order = np.argsort(cliques, kind="stable")
        cliques, variables = cliques[order], variables[order]
        starts = tree.starts(np.repeat(cliques, variables.shape[1]), variables.ravel())
        names = [wanted[k] for k in order.tolist()]
        return names, cliques, starts.reshape(variables.shape), tree.sizes[variables]

    def add(self, cov: Array) -> None:
        """Take the covariance (n, n) of the next clique."""
        self._covs.append(cov.ravel())
        self._size += cov.size
        if self._size > NOTED:
            self.read()

    def read(self) -> None:
        """Read what there is in the covariances that were taken."""
        tree, first, last = self._tree, self._first, self._first + len(self._covs)
        flat = np.concatenate([*self._covs, np.zeros(0)])
        widths = tree.width[first:last]
        begins = np.cumsum(widths**2) - widths**2

        def gather(cliques: IntArray, starts: IntArray, dims: tuple[int, ...]) -> Array:
            rows = np.repeat(starts, dims, axis=1) + _ranges(
                np.zeros(len(dims), dtype=np.int64), np.array(dims)
            )
            begin = begins[cliques - first][:, None] + rows * widths[cliques - first][:, None]
            return np.asarray(flat[begin[:, :, None] + rows[:, None]])

        own, sizes = self._singles
        part = slice(*np.searchsorted(tree.clique[own], [first, last]).tolist())
        own, sizes = own[part], sizes[part]
        for dim in np.unique(sizes).tolist():
            some = own[sizes == dim]
            covs = gather(tree.clique[some], tree.start[some][:, None], (dim,))
            self.marginals.update(zip(tree.keys[tree.member[some]].tolist(), covs, strict=True))
        for names, cliques, starts, several in self._several:
            begin, end = np.searchsorted(cliques, [first, last]).tolist()
            shapes, of = np.unique(several[begin:end], axis=0, return_inverse=True)
            for number, dims in enumerate(shapes.tolist()):
                which = begin + np.flatnonzero(of.ravel() == number)
                covs = gather(cliques[which], starts[which], tuple(dims))
                self.joint.update(zip((names[k] for k in which.tolist()), covs, strict=True))
        self._covs, self._size, self._first = [], 0, last
