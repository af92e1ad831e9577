"""Variables out of use, kept exactly: each block of them as a Gaussian given those in use.

The joint Gaussian of all variables is p(dormant | in use) p(in use). Measurements of variables in
use change the second part only, so a step costs what the variables in use cost, however many are
dormant. Nothing is approximated: means, covariances and correlations of dormant variables follow
from those in use whenever they are asked for, and a dormant variable that is measured again is
*woken*: its rows come back, and the blocks that were made later are given it, too.

This is the elimination order of a compressed filter (J. Guivant, E. Nebot, Optimization of the
simultaneous localization and map-building algorithm for real-time implementation, IEEE T-RA 17(3),
2001, https://doi.org/10.1109/70.938382) with square roots instead of covariances: storage is
linear in the number of dormant variables, as long as few are in use at a time.
"""

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.linalg.blas import dtrsm

from graphslam.core.geometry import Array
from graphslam.estimation import factors
from graphslam.estimation.square_root import (
    Conditional,
    IntArray,
    Rows,
    column_slices,
    columns_of,
    eliminate,
    pruned,
    stacked,
)

#: so many landmarks become dormant together: fewer would make as many blocks to go through
AT_ONCE = 16


@dataclass(frozen=True, slots=True, eq=False)
class _Block:
    """A conditional solved for its variables: z = c + G y + R⁻¹ noise.

    ``own``, ``given``: where z and y are in a vector of all variables that the chain knows.
    """

    conditional: Conditional
    c: Array
    G: Array
    own: IntArray
    given: IntArray


class DormantVariables:
    """Blocks of dormant variables, each given variables in use or in later blocks.

    ``anchors`` are the states among the variables in use that a block is given. They must stay in
    use until they become dormant themselves, with the next block.
    """

    def __init__(self) -> None:
        self.anchors: set[int] = set()
        self.dims: dict[int, int] = {}
        self._blocks: list[_Block] = []
        self._slices: dict[int, slice] = {}  # places of all variables ever in a block
        self._size = 0

    def __contains__(self, key: object) -> bool:
        """Whether a variable is dormant."""
        return key in self.dims

    def due(self, landmarks: Collection[int], states: Iterable[int]) -> list[int]:
        """What is to become dormant.

        ``landmarks`` are those out of use, ``states`` those that are not estimated any more.
        """
        if len(landmarks) < AT_ONCE:
            return []
        return [*landmarks, *(key for key in states if key in self.anchors)]

    def add(self, rows: Rows, keys: Collection[int]) -> Rows:
        """Make ``keys`` dormant, all information on which is in ``rows``; the remaining rows."""
        first = {key: rows.dims[key] for key in keys}
        order = {**first, **{key: d for key, d in rows.dims.items() if key not in first}}
        conditional, rest = eliminate(stacked([rows], order), len(first))
        self.dims.update(first)
        block = self._block(conditional)
        self._blocks.append(block)
        self.anchors -= first.keys()
        self.anchors |= {key for key in block.conditional.given if factors.is_state(key)}
        return rest

    def wake(self, keys: Iterable[int]) -> list[Rows]:
        """The rows of dormant variables that are measured again: they are in use from now on."""
        wanted = {key for key in keys if key in self.dims}
        if not wanted:
            return []
        kept: list[_Block] = []
        carried: list[Rows] = []
        for block in self._blocks:
            old = block.conditional
            if wanted.isdisjoint(old.dims) and all(
                old.dims.keys().isdisjoint(rows.dims) for rows in carried
            ):
                kept.append(block)
                continue
            stay = {key: d for key, d in old.dims.items() if key not in wanted}
            parts = [old.rows(), *carried]
            others = {k: d for part in parts for k, d in part.dims.items() if k not in stay}
            rows = stacked(parts, {**stay, **others})
            carried = [rows]
            if stay:
                conditional, rest = eliminate(rows, len(stay))
                kept.append(self._block(conditional))
                carried = [rest]
        self._blocks = kept
        for key in wanted:
            del self.dims[key]
        return carried

    def _block(self, conditional: Conditional) -> _Block:
        made = pruned(conditional)
        for key, dim in {**made.dims, **made.given}.items():
            if key not in self._slices:
                self._slices[key] = slice(self._size, self._size + dim)
                self._size += dim
        solved = dtrsm(1.0, made.R, np.hstack([made.d[:, None], -made.S]))
        own, given = (columns_of(keys, self._slices) for keys in (made.dims, made.given))
        return _Block(made, solved[:, 0], solved[:, 1:], own, given)

    def solve(self, in_use: Callable[[int], Array], *, changes: int = 0) -> dict[int, Array]:
        """Dormant variables (d,) that follow from those in use, or so many changes (d, n) of them.

        ``in_use`` gives a variable in use, (d,) or its changes (d, n).
        """
        z = np.zeros((self._size, max(changes, 1)))
        own = {key for block in self._blocks for key in block.conditional.dims}
        for block in self._blocks:
            for key in block.conditional.given:
                if key not in own:
                    z[self._slices[key]] = in_use(key).reshape(-1, z.shape[1])
                    own.add(key)
        for block in reversed(self._blocks):
            z[block.own] = block.G @ z[block.given]
            if not changes:
                z[block.own] += block.c[:, None]
        found = z if changes else z[:, 0]
        return {key: found[self._slices[key]] for key in self.dims}

    def expand(self, keys: Collection[int]) -> tuple[dict[int, Array], Array]:
        """Dormant variables in terms of those in use, up to their means.

        Returns:
            W: for variables y in use, the stacked ``keys`` are Σ W[y]ᵀ y + noise; W[y] (d, D).
            The covariance (D, D) of that noise.
        """
        own = column_slices({key: self.dims[key] for key in keys})
        total = sum(self.dims[key] for key in keys)
        W, noise = np.zeros((self._size, total)), np.zeros((total, total))
        for key, at in own.items():
            W[self._slices[key], at] = np.eye(at.stop - at.start)
        pending = set(keys)
        for block in self._blocks:
            if pending.isdisjoint(block.conditional.dims):
                continue
            E = W[block.own]
            half = dtrsm(1.0, block.conditional.R, E, trans_a=1)
            noise += half.T @ half
            W[block.given] += block.G.T @ E
            pending.update(block.conditional.given)
        return {k: W[self._slices[k]] for k in pending if k not in self.dims}, noise


def covariance(
    R: Array, slices: Mapping[int, slice], dormant: DormantVariables, keys: Collection[int]
) -> Array:
    """Joint covariance (D, D) of variables, in use or dormant, in this order.

    ``R`` (n, n) is the upper triangular square root information of those in use, with the columns
    ``slices``.
    """
    dims = {k: dormant.dims[k] if k in dormant else slices[k].stop - slices[k].start for k in keys}
    places = column_slices(dims)
    asleep = [key for key in keys if key in dormant]
    E = np.zeros((len(R), sum(dims.values())))
    for key, at in places.items():
        if key not in dormant:
            E[slices[key], at] = np.eye(at.stop - at.start)
    cov = np.zeros((E.shape[1], E.shape[1]))
    if asleep:
        W, noise = dormant.expand(asleep)
        into = columns_of(asleep, places)
        for key, weights in W.items():
            E[slices[key], into] = weights
        cov[np.ix_(into, into)] = noise
    half = dtrsm(1.0, R, E, trans_a=1)
    return np.asarray(cov + half.T @ half)
