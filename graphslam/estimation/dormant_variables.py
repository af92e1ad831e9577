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

from graphslam.core.arrays import IntArray
from graphslam.core.geometry import Array
from graphslam.estimation import factors
from graphslam.estimation.square_root import (
    Rows,
    column_slices,
    columns_of,
    eliminate_below,
    eliminate_columns,
    stacked,
)

#: so many landmarks become dormant together: fewer would make as many blocks to go through
AT_ONCE = 16
#: blocks are joined up to so many coordinates, since waking leaves small ones
SMALL = 64
#: a coefficient below this part of the largest one of its block is rounding
NEGLIGIBLE = 1e-13


@dataclass(frozen=True, slots=True, eq=False)
class _Block:
    """R z = d - S y + noise of unit covariance: coordinates z given others y.

    R (n, n) is upper triangular, in LAPACK's order of memory. ``own`` (n,) and
    ``given`` (p,) are the numbers of z and y.
    """

    own: IntArray
    given: IntArray
    R: Array
    S: Array
    d: Array


class DormantVariables:
    """Blocks of dormant variables, each given variables in use or in later blocks.

    ``anchors`` are the states among the variables in use that a block is given. They must stay in
    use until they become dormant themselves, with the next block.
    """

    def __init__(self) -> None:
        self.anchors: set[int] = set()
        self.dims: dict[int, int] = {}
        self._blocks: list[_Block] = []
        self._given_keys: list[int] | None = []  # see `_given`; None: not computed
        self._slices: dict[int, slice] = {}  # coordinates of all variables ever in a block
        self._keys: list[int] = []  # coordinate -> its variable

    def __contains__(self, key: object) -> bool:
        """Whether a variable is dormant."""
        return key in self.dims

    def due(self, landmarks: Collection[int], past_states: Iterable[int]) -> list[int]:
        """What is to become dormant, if anything.

        ``landmarks`` are those out of use, ``past_states`` the states in use that are not estimated
        any more.
        """
        if len(landmarks) < AT_ONCE:
            return []
        return [*landmarks, *(key for key in past_states if key in self.anchors)]

    def add(self, rows: Rows, keys: Collection[int]) -> Rows:
        """Make ``keys`` dormant, all information on which is in ``rows``; the remaining rows."""
        first = {key: rows.dims[key] for key in keys}
        others = {key: dim for key, dim in rows.dims.items() if key not in first}
        whole = stacked([rows], {**first, **others})
        own = self._coordinates(first)
        n = len(own)
        R, S, d, A, b = eliminate_columns(whole.A, whole.b, n)
        self._blocks.append(_block(own, self._coordinates(others), R, S, d))
        self._given_keys = None
        self.dims |= first
        given = {self._keys[n] for n in self._blocks[-1].given}
        self.anchors = (self.anchors - first.keys()) | set(filter(factors.is_state, given))
        return Rows(others, A, b)

    def wake(self, keys: Iterable[int]) -> list[Rows]:
        """The rows of dormant variables that are measured again: they are in use from now on."""
        woken = {key: self.dims.pop(key) for key in keys}
        if not woken:
            return []
        carried, A, b = np.zeros(0, dtype=np.int64), np.zeros((0, 0)), np.zeros(0)
        position = np.zeros(len(self._keys), dtype=np.int64)
        wanted, involved = (np.zeros(len(self._keys), dtype=bool) for _ in range(2))
        wanted[columns_of(woken, self._slices)] = True
        blocks: list[_Block] = []
        for block in self._blocks:
            leaves = wanted[block.own]
            if not (leaves.any() or involved[block.own].any()):
                _append(blocks, block)
                continue
            own = block.own[~leaves]
            involved[block.own] = involved[block.given] = True
            involved[own] = False
            others = np.flatnonzero(involved)
            n, m = len(own), len(block.d)
            position[own], position[others] = np.arange(n), n + np.arange(len(others))
            whole = np.zeros((m + len(b), n + len(others)))
            whole[:m, position[block.own]] = block.R
            whole[:m, position[block.given]] = block.S
            whole[m:, position[carried]] = A
            right, count = np.append(block.d, b), m + len(b) - n
            if n < m:
                R, S, d, A, b = eliminate_columns(whole, right, n)
                # there are as many rows as variables, so no z leaves any error
                A, b = A[:count], b[:count]
            else:
                R, S, d, A, b = eliminate_below(whole, right, n)
            carried = others
            if n:
                _append(blocks, _block(own, others, R, S, d))
        self._blocks, self._given_keys = blocks, None
        dims = {key: self._slices[key] for key in dict.fromkeys(self._keys[n] for n in carried)}
        sizes = {key: at.stop - at.start for key, at in dims.items()}
        out = np.zeros((len(b), sum(sizes.values())))
        position[columns_of(sizes, self._slices)] = np.arange(out.shape[1])
        out[:, position[carried]] = A
        return [Rows(sizes, out, b)]

    def _coordinates(self, dims: Mapping[int, int]) -> IntArray:
        """Numbers of the coordinates of variables; new ones are numbered."""
        for key, dim in dims.items():
            if key not in self._slices:
                self._slices[key] = slice(len(self._keys), len(self._keys) + dim)
                self._keys += [key] * dim
        return columns_of(dims, self._slices)

    def is_given(self, key: int) -> bool:
        """Whether a block is given a variable in use."""
        return key in self._given()

    def _given(self) -> list[int]:
        """The variables in use that the blocks are given."""
        if self._given_keys is None:
            known = np.zeros(len(self._keys), dtype=bool)
            for block in self._blocks:
                known[block.given] = True
            for block in self._blocks:
                known[block.own] = False
            self._given_keys = list(dict.fromkeys(self._keys[n] for n in np.flatnonzero(known)))
        return self._given_keys

    def solve(self, in_use: Callable[[int], Array], *, changes: int = 0) -> dict[int, Array]:
        """Dormant variables (d,) that follow from those in use, or so many changes (d, n) of them.

        ``in_use`` gives a variable in use, (d,) or its changes (d, n).
        """
        z = np.zeros((len(self._keys), max(changes, 1)))
        for key in self._given():
            z[self._slices[key]] = in_use(key).reshape(-1, z.shape[1])
        for block in reversed(self._blocks):
            right = -block.S @ z[block.given]
            if not changes:
                right += block.d[:, None]
            z[block.own] = dtrsm(1.0, block.R, right)
        found = z if changes else z[:, 0]
        return {key: found[self._slices[key]] for key in self.dims}

    def expand(self, keys: Collection[int]) -> tuple[dict[int, Array], Array]:
        """Dormant variables in terms of those in use, up to their means.

        Returns:
            W: for variables y in use, the stacked ``keys`` are Σ W[y]ᵀ y + noise; W[y] (d, D).
            The covariance (D, D) of that noise.
        """
        wanted = columns_of(keys, self._slices)
        W, noise = np.zeros((len(self._keys), len(wanted))), np.zeros((len(wanted),) * 2)
        W[wanted, np.arange(len(wanted))] = 1.0
        involved = np.zeros(len(self._keys), dtype=bool)
        involved[wanted] = True
        for block in self._blocks:
            if involved[block.own].any():
                half = dtrsm(1.0, block.R, W[block.own], trans_a=1)
                noise += half.T @ half
                W[block.given] -= block.S.T @ half
                involved[block.given] = True
                involved[block.own] = False
        given = dict.fromkeys(self._keys[n] for n in np.flatnonzero(involved))
        return {key: W[self._slices[key]] for key in given}, noise


def _block(own: IntArray, given: IntArray, R: Array, S: Array, d: Array) -> _Block:
    """A block, without the coordinates that it depends on by rounding only."""
    kept = np.abs(S).max(axis=0, initial=0.0) > NEGLIGIBLE * np.abs(R).max()
    return _Block(own, given[kept], np.asfortranarray(R), S[:, kept], d)


def _append(blocks: list[_Block], block: _Block) -> None:
    """Append a block, as part of the one before if they are small."""
    if not blocks or len(blocks[-1].own) + len(block.own) > SMALL:
        blocks.append(block)
        return
    first = blocks.pop()
    own = np.concatenate([first.own, block.own])
    given = np.setdiff1d(np.concatenate([first.given, block.given]), own)
    n = len(first.own)
    columns = np.concatenate([own, given])
    order = np.argsort(columns)

    def place(of: IntArray) -> IntArray:
        return order[np.searchsorted(columns, of, sorter=order)]

    whole = np.zeros((len(own), len(columns)))
    whole[:n, :n], whole[:n, place(first.given)] = first.R, first.S
    whole[n:, n : len(own)], whole[n:, place(block.given)] = block.R, block.S
    R, S = np.asfortranarray(whole[:, : len(own)]), whole[:, len(own) :].copy()
    blocks.append(_Block(own, given, R, S, np.concatenate([first.d, block.d])))


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
