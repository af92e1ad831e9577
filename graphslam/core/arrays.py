"""Types of arrays of integers, of complex numbers and of flags, and where flags are set.

Arrays of floats are `graphslam.core.geometry.Array`.
"""

from typing import Any

import numpy as np

IntArray = np.ndarray[Any, np.dtype[np.int64]]
ComplexArray = np.ndarray[Any, np.dtype[np.complex128]]
BoolArray = np.ndarray[Any, np.dtype[np.bool_]]


def stretches(flags: BoolArray) -> list[tuple[int, int]]:
    """Where flags (n,) are true without a break: first place, and the one after the last."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]
