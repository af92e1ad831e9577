"""Thinning keeps at most what was asked for: at even intervals, or near a path."""

import time

import numpy as np
import pytest

from graphslam.core.thinning import evenly_thinned, rows_along, rows_to_the_last


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


def far_off(path, rows):
    """How far a path (n, 2) is at most from the straight lines between its rows."""
    if len(path) == 1:
        return 0.0
    line = np.clip(np.searchsorted(rows, np.arange(len(path)), side="right") - 1, 0, len(rows) - 2)
    begin, along = path[rows[line]], path[rows[line + 1]] - path[rows[line]]
    squared = (along**2).sum(axis=1)
    share = ((path - begin) * along).sum(axis=1) / np.where(squared > 0, squared, 1)
    return np.linalg.norm(path - begin - np.clip(share, 0, 1)[:, None] * along, axis=1).max()


def paths():
    """Legs with a corner every seventh row, a spiral, a random walk, one that stays, one pose."""
    rng = np.random.default_rng(4)
    t = np.linspace(0, 60, 3000)[:, None]
    legs = np.repeat(rng.uniform(-1, 1, (40, 2)), 7, axis=0)
    still = np.zeros((100, 2))
    return {
        "legs": np.cumsum(legs, axis=0),
        "spiral": t * np.hstack([np.cos(t), np.sin(t)]),
        "walk": np.cumsum(rng.normal(0, 0.05, (3000, 2)), axis=0),
        "still": still,
        "one": still[:1],
    }


@pytest.mark.parametrize("name", paths())
@pytest.mark.parametrize("within", [0.02, 0.5])
def test_lines_between_rows_follow_a_path(name, within):
    """Everywhere within what was asked for, and with no more rows than that needs: of straight
    legs one at each corner. The last digits are those of the test's own arithmetic."""
    path = paths()[name]
    rows = rows_along(path, within, 20, len(path) + 20)
    assert set(rows_to_the_last(len(path), 20)) <= set(rows)
    assert (np.diff(rows) > 0).all()
    assert far_off(path, rows) <= within + 1e-12
    if name == "legs":
        assert len(rows) <= 20 + 40


def test_where_rows_are_few_they_are_where_they_matter():
    """Left out is what moves the path least: of as many rows even ones leave it farther off, by
    a fifth at least in a random walk."""
    path = paths()["walk"]
    most = [50, 100, 200, 400]
    off = np.array([far_off(path, rows_along(path, 0.0, 2, count)) for count in most])
    even = np.array([far_off(path, rows_to_the_last(len(path), count)) for count in most])
    assert (np.diff(off) < 0).all() and (1.2 * off < even).all()
    assert len(rows_along(path, 0.0, 2, 50)) == 50


def test_long_paths_take_no_time():
    """160 000 poses that turn all the time take some tenths of a second of a core."""
    path = np.cumsum(np.random.default_rng(5).normal(0, 0.1, (160_000, 2)), axis=0)
    began = time.process_time()
    rows_along(path, 0.01, 250, 20_000)
    assert time.process_time() - began < 2.0
