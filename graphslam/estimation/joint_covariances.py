"""The joint covariance of any variables, from the square root of the information of a whole graph.

The root of a graph of n states is sparse, their joint covariance of n² blocks is not. So the root
is kept, and the blocks that are asked for are computed from it: with R'R the information, the
covariance of two linear combinations E'x and F'x is (R'⁻¹E)'(R'⁻¹F), and a column of R'⁻¹E has
entries only in the cliques from that of its variable up to the last one. To that comes what errors
have in common that R takes for independent (`InformationRoot.shared`). M. Kaess and F. Dellaert,
Covariance recovery from a square root information matrix, RAS 57, 2009, DOI
10.1016/j.robot.2009.06.008.
"""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg.lapack import dtrtrs

from graphslam.core.arrays import IntArray
from graphslam.core.geometry import Array
from graphslam.core.information_root import InformationRoot
from graphslam.core.mount_covariances import MountCovariances
from graphslam.core.record import replace

if TYPE_CHECKING:  # what reads the root of a folder needs no GTSAM
    from graphslam.estimation.selected_inverse import CliqueRows

#: numbers (float64) that are gathered at a time
_CHUNK = 4_000_000


def information_root(
    cliques: "Sequence[CliqueRows]",
    states: Mapping[str, Sequence[int]],
    landmarks: Mapping[int, int],
    mounts: Mapping[str, tuple[int, Sequence[int]]] = MappingProxyType({}),
) -> InformationRoot:
    """The root as arrays, without cliques on which nothing of these depends.

    Args:
        cliques: from the last one on, each after the one above it.
        states: robot -> keys of its states.
        landmarks: number -> key.
        mounts: robot -> key of its calibration, and which of its dimensions x, y and yaw of the
            mount are, -1 of what is held.
    """
    wanted = {key for keys in states.values() for key in keys} | set(landmarks.values())
    wanted |= {key for key, _ in mounts.values()}
    needed = [not wanted.isdisjoint(clique.own) for clique in cliques]
    for n in reversed(range(len(cliques))):
        above = cliques[n].above
        if needed[n] and above is not None:
            needed[above] = True
    kept = [clique for clique, is_needed in zip(cliques, needed, strict=True) if is_needed]
    number = np.cumsum(needed) - 1
    rows: dict[int, range] = {}
    end = 0
    aboves, owns, widths = [], [], []
    separators: list[int] = []
    for clique in kept:
        begin = end
        for key, dim in clique.own.items():
            rows[key] = range(end, end := end + dim)
        aboves.append(-1 if clique.above is None else int(number[clique.above]))
        owns.append(end - begin)
        widths.append(clique.block.shape[1] - owns[-1])
        for key in clique.separator:
            separators.extend(rows[key])
    blocks = [clique.block.ravel() for clique in kept]
    return InformationRoot(
        np.array(aboves, dtype=np.int64),
        np.array(owns, dtype=np.int64),
        np.array(widths, dtype=np.int64),
        np.array(separators, dtype=np.int64),
        np.concatenate(blocks) if blocks else np.zeros(0),
        {
            robot: np.array([rows[key].start for key in keys], dtype=np.int64)
            for robot, keys in states.items()
        },
        {number: rows[key].start for number, key in landmarks.items()},
        {
            robot: np.array([n if n < 0 else rows[key].start + n for n in at], dtype=np.int64)
            for robot, (key, at) in mounts.items()
        },
    )


def joint_covariance(root: InformationRoot, rows: IntArray) -> Array:
    """Joint covariance (k, k) of k dimensions of variables, given by their rows of the root."""
    k = len(rows)
    return covariance_of(root, rows, np.arange(k), np.ones(k), k)


def covariance_of(
    root: InformationRoot, rows: IntArray, columns: IntArray, derivatives: Array, k: int
) -> Array:
    """Joint covariance (k, k) of linear combinations of all variables.

    The time is that of k forward substitutions through all of the root, in one go.

    Args:
        root: of the graph.
        rows: (n,) rows of the root on which combinations depend.
        columns: (n,) the number of the combination; those of one row and number add up.
        derivatives: (n,) of the combination by the error of the row.
        k: how many combinations there are.
    """
    P = np.zeros((k, k))
    # solved rows are multiplied many at a time
    solved, end = np.zeros((max(int(root.own.max(initial=0)), _CHUNK // max(16 * k, 1)), k)), 0
    for use, y in _substituted(root, rows, columns, derivatives, k):
        n = len(y)
        if end + n > len(solved):
            P += solved[:end].T @ solved[:end]
            solved[:end], end = 0.0, 0
        solved[end : end + n, use] = y
        end += n
    P += solved[:end].T @ solved[:end]
    by_shared = _by_shared(root, rows, columns, derivatives, k)
    return P + by_shared @ by_shared.T


def variances_of(
    root: InformationRoot, rows: IntArray, columns: IntArray, derivatives: Array, k: int
) -> Array:
    """Variances (k,) of linear combinations, the diagonal of `covariance_of`."""
    found = np.zeros(k)
    for use, y in _substituted(root, rows, columns, derivatives, k):
        found[use] += np.einsum("nu,nu->u", y, y)
    found += (_by_shared(root, rows, columns, derivatives, k) ** 2).sum(axis=1)
    return found


def _by_shared(
    root: InformationRoot, rows: IntArray, columns: IntArray, derivatives: Array, k: int
) -> Array:
    """Linear combinations (k, errors) by what errors share."""
    found = np.zeros((k, root.shared.shape[1]))
    if root.shared.size:
        np.add.at(found, columns, derivatives[:, None] * root.shared[rows])
    return found


def _substituted(
    root: InformationRoot, rows: IntArray, columns: IntArray, derivatives: Array, k: int
) -> Iterator[tuple[IntArray, Array]]:
    """Clique by clique which of k combinations depend on it (u,), and R'⁻¹E there (n, u).

    What is left of the right sides is held only where cliques above need it.
    """
    starts = np.concatenate([[0], np.cumsum(root.own)])
    widths = np.concatenate([[0], np.cumsum(root.width)])
    values = np.concatenate([[0], np.cumsum(root.own * (root.own + root.width))])
    order = np.argsort(rows, kind="stable")
    rows, columns, derivatives = rows[order], columns[order], derivatives[order]
    entering = np.searchsorted(rows, starts)
    below: dict[int, list[tuple[IntArray, IntArray, Array]]] = defaultdict(list)
    place, is_used = np.empty(k, dtype=np.int64), np.zeros(k, dtype=np.bool_)
    for c in reversed(range(len(root.own))):  # the last clique depends on no other
        n, m = int(root.own[c]), int(root.width[c])
        parts, new = below.pop(c, []), slice(entering[c], entering[c + 1])
        is_used[columns[new]] = True
        for _, part_columns, _ in parts:
            is_used[part_columns] = True
        use = np.flatnonzero(is_used)
        if not len(use):
            continue
        is_used[use] = False
        place[use] = np.arange(len(use))
        separator = root.separators[widths[c] : widths[c + 1]]
        held = np.concatenate([np.arange(starts[c], starts[c + 1]), separator])
        b = np.zeros((n + m, len(use)))
        for part_rows, part_columns, rest in parts:
            b[np.ix_(_places(held, part_rows), place[part_columns])] += rest
        np.add.at(b, (rows[new] - starts[c], place[columns[new]]), derivatives[new])
        block = root.values[values[c] : values[c + 1]].reshape(n, n + m)
        y, _ = dtrtrs(block[:, :n], b[:n], trans=1)
        if root.above[c] >= 0:
            below[int(root.above[c])].append((separator, use, b[n:] - block[:, n:].T @ y))
        yield use, y


def in_other_axes(root: InformationRoot, axes: Mapping[int, Array]) -> InformationRoot:
    """The root of the same information about errors of some variables along other axes.

    ``axes``: first row of a variable -> (3, 3), which takes its errors along the new axes to those
    along the old ones.
    """
    starts = np.concatenate([[0], np.cumsum(root.own)])
    widths = np.concatenate([[0], np.cumsum(root.width)])
    ends = np.concatenate([[0], np.cumsum(root.own * (root.own + root.width))])
    turned, values = np.zeros(int(starts[-1]), dtype=np.bool_), root.values.copy()
    turned[list(axes)] = True
    for c, (n, m) in enumerate(zip(root.own.tolist(), root.width.tolist(), strict=True)):
        separator = root.separators[widths[c] : widths[c + 1]]
        held = np.concatenate([np.arange(starts[c], starts[c + 1]), separator])
        at = np.flatnonzero(turned[held]).tolist()
        if not at:
            continue
        block = values[ends[c] : ends[c + 1]].reshape(n, n + m)
        for k in at:  # the rows of a variable follow each other
            block[:, k : k + 3] = block[:, k : k + 3] @ axes[int(held[k])]
        if at[0] < n:  # it is to be triangular again
            block[:] = np.linalg.qr(block[:, :n])[0].T @ block
    shared = root.shared.copy()
    for first, turn in axes.items() if shared.size else ():
        shared[first : first + 3] = np.linalg.solve(turn, shared[first : first + 3])
    return replace(root, values=values, shared=shared)


def solve_root(root: InformationRoot, right: Array) -> Array:
    """(R'R)⁻¹ ``right``, (n, k) both: a forward substitution through all of R, and one back.

    The time is that of k products with R. What errors share (`InformationRoot.shared`) has no part
    in it.
    """
    starts = np.concatenate([[0], np.cumsum(root.own)])
    widths = np.concatenate([[0], np.cumsum(root.width)])
    values = np.concatenate([[0], np.cumsum(root.own * (root.own + root.width))])
    x = np.array(right, dtype=float)

    def clique(c: int) -> tuple[slice, IntArray, Array]:
        n, m = int(root.own[c]), int(root.width[c])
        block = root.values[values[c] : values[c + 1]].reshape(n, n + m)
        return slice(starts[c], starts[c + 1]), root.separators[widths[c] : widths[c + 1]], block

    for c in reversed(range(len(root.own))):  # the last clique depends on no other
        own, separator, block = clique(c)
        n = own.stop - own.start
        x[own], _ = dtrtrs(block[:, :n], x[own], trans=1)
        x[separator] -= block[:, n:].T @ x[own]
    for c in range(len(root.own)):
        own, separator, block = clique(c)
        n = own.stop - own.start
        x[own], _ = dtrtrs(block[:, :n], x[own] - block[:, n:] @ x[separator])
    return x


def mount_errors(root: InformationRoot, mounts: MountCovariances) -> Array:
    """Errors (3R, k) of R mounts, m and rad, by what is shared; (3R, 0) where nothing is."""
    rows = np.concatenate([root.mounts[robot] for robot in mounts.robots])
    if not root.shared.size:
        return np.zeros((len(rows), 0))
    return np.where(rows[:, None] < 0, 0.0, root.shared[rows])


def pair_covariances(
    root: InformationRoot, rows: IntArray, maps: Array, pairs: IntArray
) -> tuple[Array, Array]:
    """Covariances of quantities that are linear in states, and between pairs of them.

    The time is that of a forward substitution for each quantity along its cliques: with n
    quantities of a graph whose cliques are as wide as w and d deep about n d w².

    Args:
        root: of the graph.
        rows: (n, k) first rows of the k states that each quantity depends on.
        maps: (n, k, 3, 3) its derivatives by their errors.
        pairs: (p, 2) numbers of quantities.

    Returns:
        (n, 3, 3) of each with itself, (p, 3, 3) of the first of each pair with the second.
    """
    starts = np.concatenate([[0], np.cumsum(root.own)])
    widths = np.concatenate([[0], np.cumsum(root.width)])
    values = np.concatenate([[0], np.cumsum(root.own * (root.own + root.width))])
    at = np.searchsorted(starts, rows, side="right") - 1  # (n, k) cliques
    entering = _by_clique(at)
    meeting = _by_clique(_first_common(root.above, at.max(axis=1), pairs)[:, None])
    own_cov, cross = np.zeros((len(rows), 3, 3)), np.zeros((len(pairs), 3, 3))
    below: dict[int, list[tuple[IntArray, IntArray, IntArray, Array]]] = defaultdict(list)
    place = np.empty(len(rows), dtype=np.int64)
    for c in reversed(range(len(root.own))):
        n, m = int(root.own[c]), int(root.width[c])
        parts, new = below.pop(c, []), entering.get(c)
        if not parts and new is None:
            continue
        use = np.unique(
            np.concatenate([part[0] for part in parts] + ([] if new is None else [new]))
        )
        active = np.concatenate([meeting.get(c, _NONE), *(part[1] for part in parts)])
        place[use] = np.arange(len(use))
        # the right sides: what is left of those from below, and what enters here
        separator = root.separators[widths[c] : widths[c + 1]]
        columns = np.concatenate([np.arange(starts[c], starts[c + 1]), separator])
        b = np.zeros((n + m, len(use), 3))
        for queries, _, part_rows, rest in parts:
            b[np.ix_(_places(columns, part_rows), place[queries])] += rest
        if new is not None:
            for q, k in zip(*np.nonzero(at[new] == c), strict=True):
                begin = int(rows[new[q], k] - starts[c])
                b[begin : begin + 3, place[new[q]]] += maps[new[q], k].T
        block = root.values[values[c] : values[c + 1]].reshape(n, n + m)
        y, _ = dtrtrs(block[:, :n], b[:n].reshape(n, 3 * len(use)), trans=1)
        rest = (b[n:].reshape(m, 3 * len(use)) - block[:, n:].T @ y).reshape(m, len(use), 3)
        y = y.reshape(n, len(use), 3)
        own_cov[use] += np.einsum("rqi,rqj->qij", y, y)
        by_query = y.transpose(1, 2, 0)  # (q, 3, n)
        step = max(1, _CHUNK // (6 * n))
        for begin in range(0, len(active), step):
            some = active[begin : begin + step]
            ends = place[pairs[some]]
            cross[some] += by_query[ends[:, 0]] @ by_query[ends[:, 1]].mT
        if root.above[c] >= 0:
            below[int(root.above[c])].append((use, active, separator, rest))
    if root.shared.size:
        of_states = root.shared[rows[:, :, None] + np.arange(3)]  # (n, k, 3, errors)
        by_shared = np.einsum("qkij,qkjs->qis", maps, of_states)
        own_cov += by_shared @ by_shared.mT
        cross += by_shared[pairs[:, 0]] @ by_shared[pairs[:, 1]].mT
    return own_cov, cross


_NONE = np.zeros(0, dtype=np.int64)


def _by_clique(at: IntArray) -> dict[int, IntArray]:
    """Clique -> the numbers (rows) that ``at`` (n, k) puts there, each once."""
    n, k = at.shape
    found = np.unique(np.column_stack([at.ravel(), np.repeat(np.arange(n), k)]), axis=0)
    found = found[found[:, 0] >= 0]
    cliques, first = np.unique(found[:, 0], return_index=True)
    parts = np.split(found[:, 1], first[1:]) if len(found) else []
    return dict(zip(cliques.tolist(), parts, strict=True))


def _first_common(above: IntArray, at: IntArray, pairs: IntArray) -> IntArray:
    """The first clique (p,) that both ends of pairs come to on their way up; -1 without any."""
    a, b = at[pairs[:, 0]].copy(), at[pairs[:, 1]].copy()
    while (apart := a != b).any():
        # what is above has a smaller number: the larger one moves
        upper = apart & (a > b)
        lower = apart & ~upper
        a[upper] = above[a[upper]]
        b[lower] = above[b[lower]]
    return a


def _places(columns: IntArray, wanted: IntArray) -> IntArray:
    """Where ``wanted`` are among ``columns``, which have all of them once."""
    order = np.argsort(columns)
    return np.asarray(order[np.searchsorted(columns, wanted, sorter=order)])
