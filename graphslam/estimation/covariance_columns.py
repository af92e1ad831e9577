"""Covariances of all variables with one of them, from the root of the information.

With R'R the information these are the columns (R'R)⁻¹E of that variable: a forward substitution
along its cliques up to the last one, and a back substitution through all of them. M. Kaess and
F. Dellaert, Covariance recovery from a square root information matrix, RAS 57, 2009, DOI
10.1016/j.robot.2009.06.008.
"""

from collections.abc import Sequence

import numpy as np
from scipy.linalg.lapack import dtrtrs

from graphslam.core.geometry import Array
from graphslam.estimation.selected_inverse import CliqueRows


def covariance_columns(cliques: Sequence[CliqueRows], key: int) -> dict[int, Array]:
    """Key of each variable -> its covariance (d, p) with the variable ``key``.

    Errors are those of the root. The time grows with the number of its entries.

    Args:
        cliques: from the last one on, each after the one above it.
        key: of a variable of p dimensions.
    """
    dims = {k: dim for clique in cliques for k, dim in clique.own.items()}
    at: int | None = next(n for n, clique in enumerate(cliques) if key in clique.own)
    width = dims[key]
    right = {key: np.eye(width)}
    forward: dict[int, Array] = {}
    while at is not None:
        clique = cliques[at]
        n = sum(clique.own.values())
        own = [right.get(k, np.zeros((dim, width))) for k, dim in clique.own.items()]
        forward[at], _ = dtrtrs(clique.block[:, :n], np.concatenate(own), trans=1)
        rest, begin = clique.block[:, n:].T @ forward[at], 0
        for k in clique.separator:
            right[k] = right.get(k, 0.0) - rest[begin : begin + dims[k]]
            begin += dims[k]
        at = clique.above
    found: dict[int, Array] = {}
    for number, clique in enumerate(cliques):
        n = sum(clique.own.values())
        b = forward.get(number, np.zeros((n, width)))
        if clique.separator:
            b = b - clique.block[:, n:] @ np.concatenate([found[k] for k in clique.separator])
        x, _ = dtrtrs(clique.block[:, :n], b)
        begin = 0
        for k, dim in clique.own.items():
            found[k] = x[begin : begin + dim]
            begin += dim
    return found
