"""Numbers as text: read back, they are the same."""

import numpy as np
import pytest

from graphslam.core.number_text import rows_as_text


@pytest.mark.parametrize("separator", [",", " "])
def test_every_number_is_read_back_as_the_same_double(separator):
    """Breaks with fewer digits, or where rows or columns are exchanged."""
    bits = np.random.default_rng(0).integers(0, 2**64, 3000, dtype=np.uint64)
    values = bits.view(float)
    values = values[np.isfinite(values)]  # of all magnitudes
    ends = [0.0, -0.0, 1.0, 5e-324, np.finfo(float).max, -1e22]
    values = np.append(values, ends)
    values = values[: len(values) // 6 * 6].reshape(-1, 6)
    for given in (values, np.asfortranarray(values), values[:, ::2], values[:1], values[:0]):
        rows = rows_as_text(given, separator)
        read = np.array([list(map(float, row.split(separator))) for row in rows])
        assert read.reshape(given.shape).tobytes() == np.ascontiguousarray(given).tobytes()


def test_numbers_that_are_not_finite_have_names_that_are_read_back():
    rows = rows_as_text(np.array([[1.5, np.nan], [-np.inf, 2.0]]), ",")
    assert rows == ["1.5,nan", "-inf,2.0"]
