"""Bytes that `benchmarks/fuzz.py` found: each was once neither taken nor refused in one line."""

import warnings
from pathlib import Path

import pytest
from hostile_bytes import TARGETS, refused

FOUND = sorted((Path(__file__).parent / "hostile_bytes").glob("*.bytes"))


@pytest.mark.parametrize("name", TARGETS)
def test_what_a_reader_is_begun_with_is_taken(name, tmp_path):
    """Breaks when a target no longer reads what it is for: the search would find nothing."""
    seed = next(TARGETS[name].seeds())
    assert refused(lambda: TARGETS[name].take(seed, tmp_path)) is None


@pytest.mark.parametrize("path", FOUND, ids=lambda path: path.stem)
def test_what_was_found_is_refused_in_one_line_or_taken(path, tmp_path):
    plain = {"".join(c if c.isalnum() else "-" for c in name): name for name in TARGETS}
    (name,) = (own for key, own in plain.items() if path.stem.startswith(key.replace("--", "-")))
    with warnings.catch_warnings(action="error"):
        refused(lambda: TARGETS[name].take(path.read_bytes(), tmp_path))
