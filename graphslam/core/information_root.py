"""The root of the information of an estimate: what joint covariances are computed from."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.geometry import Array


@dataclass(frozen=True, slots=True, eq=False)
class InformationRoot:
    """Upper triangular root R of the information of an estimate: R'R, by cliques of its rows.

    A row has entries in its own clique and in later rows only. From the last clique, which depends
    on no other, to the first: ``above`` (C,) is the number of the clique whose rows begin what the
    rows of this one depend on, -1 if there is none, and smaller than its own. ``own`` (C,) is how
    many rows are its own; those of all cliques are numbered in this order. ``width`` (C,) is how
    many rows of others it depends on, ``separators`` (sum of width,) which; ``values`` the dense
    blocks (own, own + width), row by row. ``states[robot]`` (n,) is the first of the three rows of
    each state, ``landmarks[number]`` that of each landmark, ``mounts[robot]`` (3,) those of its
    mount, -1 of what is held. Errors are along the axes of each pose's own frame, in its tangent
    space, so that R is the same in every world frame; those of a mount along the base's.

    ``shared`` (n, k): by how much each row's variable is off for each sigma of k independent errors
    that many measurements share, which R takes for independent; (0, 0) without any. The covariance
    is (R'R)⁻¹ + shared shared'.
    """

    above: IntArray
    own: IntArray
    width: IntArray
    separators: IntArray
    values: Array
    states: Mapping[str, IntArray]
    landmarks: Mapping[int, int] = field(default_factory=dict)
    mounts: Mapping[str, IntArray] = field(default_factory=dict)
    shared: Array = field(default_factory=lambda: np.zeros((0, 0)))
