"""Records on disk: exactly what was written comes back, and nothing else is ever made of bytes."""

import io
from collections import Counter, deque
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from graphslam.core.geometry import Array
from graphslam.core.record_codec import CodecError, Kinds, read, write
from graphslam.core.records import Motion, Trajectory
from graphslam.odometry.preintegration import Track

KINDS = Kinds([Trajectory, Motion])


def data(value, kinds=KINDS):
    stream = io.BytesIO()
    write(value, kinds, stream)
    return stream.getvalue()


def there_and_back(value):
    return read(data(value), KINDS)


plain = st.none() | st.booleans() | st.integers() | st.floats() | st.text()
numbers = st.lists(st.floats(), max_size=4).map(np.array) | st.just(np.float32(0.1))
values = st.recursive(
    plain | st.binary() | numbers,
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.lists(inner, max_size=3).map(tuple)
        | st.dictionaries(st.text() | st.tuples(st.integers(), st.text()), inner, max_size=3)
        | st.lists(inner, max_size=3).map(deque)
    ),
    max_leaves=12,
)


def same(a, b):
    """Equal in type, value and order; NaN equals NaN."""
    if type(a) is not type(b):
        return False
    if isinstance(a, (np.ndarray, np.generic)):
        return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    if isinstance(a, dict):
        return same(list(a.items()), list(b.items()))
    if isinstance(a, (list, tuple, deque)):
        return len(a) == len(b) and all(map(same, a, b))
    return a == b or (a != a and b != b)


@given(values)
def test_what_is_written_is_read_to_the_bit(value):
    assert same(there_and_back(value), value)


def test_arrays_keep_their_order_in_memory_and_objects_that_are_one_stay_one():
    by_columns = np.asfortranarray(np.arange(6.0).reshape(2, 3))
    shared = [1]
    way = Trajectory(np.arange(2), by_columns, np.arange(12.0).reshape(3, 4)[:, ::2])
    found, counts, again, (first, second) = there_and_back(
        (way, Counter("aab"), way, (shared, shared))
    )
    assert found.poses.flags.f_contiguous and not found.poses.flags.c_contiguous
    assert np.array_equal(found.covs, way.covs) and found.stamps_ns.flags.writeable
    assert counts == Counter("aab") and counts["c"] == 0
    assert found is again and first is second


@given(values, st.data())
def test_damaged_bytes_are_an_error_of_one_kind_or_other_data(value, chosen):
    whole = bytearray(data((1, value)))
    place = chosen.draw(st.integers(0, len(whole) - 1))
    whole[place] ^= chosen.draw(st.integers(1, 255))
    cut = bytes(whole[: chosen.draw(st.integers(0, len(whole)))])
    for bad in (bytes(whole), cut):
        with suppress(CodecError):
            read(bad, KINDS)


def test_no_class_is_made_that_the_reader_does_not_know_and_nothing_is_called():
    @dataclass
    class Stranger:
        numbers: Array

        def __post_init__(self):
            raise AssertionError("called")

    stranger = Stranger.__new__(Stranger)
    stranger.numbers = np.zeros(3)
    kinds = Kinds([Stranger])
    assert np.array_equal(read(data(stranger, kinds), kinds).numbers, np.zeros(3))
    with pytest.raises(CodecError):
        read(data(stranger, kinds), KINDS)
    for value in (Track, print, object(), np.array([None]), {1: lambda: 0}):
        with pytest.raises(TypeError, match="not kept on disk"):
            data(value)
