"""Fewer of what is too many to be shown: at even intervals, and never more than asked for."""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

_T = TypeVar("_T", bound=np.generic)


def evenly_thinned(items: NDArray[_T], most: int) -> NDArray[_T]:
    """Every n-th row of ``items`` (k, ...), the first one always: at most ``most`` of them."""
    return items[:: max(1, -(-len(items) // most))]


def rows_to_the_last(count: int, most: int) -> NDArray[np.int64]:
    """Numbers of rows at even intervals, of ``count``, the last one always: at most ``most`` >= 2.

    The last interval may be shorter.
    """
    last = count - 1
    return np.append(np.arange(0, last, max(1, -(-last // (most - 1)))), last)
