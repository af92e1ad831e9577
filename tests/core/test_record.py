"""Records by the thousand: the same as the standard library makes of them, only faster."""

import dataclasses
import pickle

import numpy as np
import pytest

from graphslam.core.record import packed, replace, unpacked
from graphslam.core.records import Association, Closure, Motion, Sighting, Step

EXAMPLES = [
    Sighting("a", 1, 2, np.array([0.1, 2.0]), np.eye(2), "door", None, np.zeros(3)),
    Motion(1, 2, np.ones(3), np.eye(3), np.zeros((3, 7)), 0.5, from_scans=True),
    Association("a", 1, 7, "line", np.ones(3), np.eye(3), extent=np.array([0.0, 1.0])),
    Closure("a", 2, "b", 1, np.ones(3), np.eye(3), verified=True),
    Step(3, {}, {}, (), ()),
]


def contents(record):
    return [getattr(record, field.name) for field in dataclasses.fields(record)]


@pytest.mark.parametrize("record", EXAMPLES, ids=lambda record: type(record).__name__)
def test_a_record_survives_the_way_to_another_process(record):
    """Every field, those with defaults too, and its class."""
    back = pickle.loads(pickle.dumps(record, pickle.HIGHEST_PROTOCOL))
    assert type(back) is type(record)
    np.testing.assert_equal(contents(back), contents(record))


def test_what_records_share_is_sent_once():
    """Messages share the covariance that their sensor states."""
    cov = np.eye(2)
    sent = [Sighting("a", k, k, np.ones(2), cov, None, None, np.zeros(3)) for k in range(2)]
    first, second = pickle.loads(pickle.dumps(sent))
    assert first.cov is second.cov


def test_records_packed_together_come_out_as_they_were():
    """Of several classes, in their order, arrays of different shapes among them; a covariance that
    two share is shared, an array that only equals another is one of its own."""
    cov = np.eye(2)
    seen = [Sighting("a", k, k, np.full(2, k), cov, None, None, np.zeros(3)) for k in range(3)]
    with_direction = replace(seen[0], z=np.ones(3), cov=np.eye(3))
    for sent in ([seen[0], *EXAMPLES, *seen[1:]], [*seen, with_direction], []):
        back = list(unpacked(pickle.loads(pickle.dumps(packed(sent)))))
        assert [type(record) for record in back] == [type(record) for record in sent]
        np.testing.assert_equal(list(map(contents, back)), list(map(contents, sent)))
    first, second, _ = unpacked(packed(seen))
    assert first.cov is second.cov
    assert first.mount is not second.mount


@pytest.mark.parametrize("record", EXAMPLES, ids=lambda record: type(record).__name__)
def test_a_changed_record_has_the_other_fields_as_they_were(record):
    """As by `dataclasses.replace`: the very same objects, and an error for a field unknown."""
    name = dataclasses.fields(record)[0].name
    changed, expected = (make(record, **{name: 9}) for make in (replace, dataclasses.replace))
    assert type(changed) is type(record)
    assert all(a is b for a, b in zip(contents(changed), contents(expected), strict=True))
    with pytest.raises(TypeError):
        replace(record, no_field=1)
