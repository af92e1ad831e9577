"""Thinning keeps at most what was asked for, at even intervals."""

import numpy as np
import pytest

from graphslam.core.thinning import evenly_thinned, rows_to_the_last


@pytest.mark.parametrize("count", [0, 1, 2, 29, 30, 31, 59, 60, 61, 1000])
def test_never_more_than_asked_for_and_no_fewer_than_half(count):
    """Breaks when the interval is rounded down: 59 of at most 30."""
    kept = evenly_thinned(np.arange(count), 30)
    assert min(count, 15) <= len(kept) <= 30
    assert len(set(np.diff(kept))) <= 1
    assert list(kept[:1]) == list(range(count))[:1]


@pytest.mark.parametrize("count", [1, 2, 29, 30, 31, 59, 60, 61, 1000])
@pytest.mark.parametrize("most", [2, 30])
def test_the_first_and_the_last_row_are_kept_once(count, most):
    kept = rows_to_the_last(count, most)
    assert (kept[0], kept[-1]) == (0, count - 1)
    assert min(count, most // 2) <= len(kept) <= most
    assert (np.diff(kept) > 0).all() and len(set(np.diff(kept)[:-1])) <= 1
