"""Visits of which much changed, rooms that look alike from two poses, lasers that measure badly.

What is said must be right, and what cannot be said must be told.
"""

from dataclasses import replace

import numpy as np
import pytest
from test_detect import CONFIG, box, drive, visit, walls

from graphslam.change_detection import detect_changes
from graphslam.change_detection.beam_evidence import Evidence, null_sigma

# ------------------------------------------------------------ much changed


def evidence_of(scores):
    """Evidence of as many tested pieces as there are scores, a beam each."""
    n = len(scores)
    none, ones = np.zeros(0, dtype=np.int64), np.ones(n)
    every = np.ones(n, dtype=bool)
    return (Evidence(none, none, scores, ones, ones, 0 * ones, every, np.zeros(n, np.int64)),)


@pytest.mark.parametrize("true", [1.0, 3.0])
@pytest.mark.parametrize("changed", [0.0, 0.2, 0.4])
def test_the_null_is_that_of_what_did_not_change(true, changed):
    """Whatever share below a half changed, by 8 to 60 sigmas to one side: passing beams."""
    rng = np.random.default_rng(0)
    scores = true * rng.normal(size=20_000)
    many = int(changed * len(scores))
    scores[:many] = true * rng.uniform(8, 60, many)
    # 1.05: what tails are believed to be wider; the quantile of 12 000 scores is good to 1 %, and 4
    # of the sigmas that are iterated keep a few changed scores at most
    assert null_sigma(evidence_of(scores)) == pytest.approx(1.05 * true, rel=0.04)


def test_a_room_in_which_all_furniture_moved_is_the_same_room():
    """The walls agree to millimetres, so it is one place, and no map is bent. Breaks if the null is
    taken from 80 % of the beams, of which a quarter are on what moved.

    Sigmas of what did not change are as stated, or less: 1.05 is the factor of the tails, and the
    scene has neither bias nor uneven walls."""
    rng = np.random.default_rng(31)
    before = [box(5.2, 3.6, 1.2, 0.8), box(1.0, 0.9, 1.4, 0.6), box(5.6, 1.0, 0.8, 0.8)]
    after = [box(5.2, 2.4, 1.0, 0.6), box(0.6, 2.2, 0.6, 1.4), box(3.0, 0.5, 1.4, 0.7)]
    a, b = visit(before, drive(60), rng), visit(after, drive(60, 0.1), rng)
    marks = tuple(walls())
    found = detect_changes(replace(a, landmarks=marks), replace(b, landmarks=marks), CONFIG)
    assert not found.warnings
    assert found.null_sigma < 1.05
    outlines = [
        outline for c in found.changes for outline in (c.polygon, c.before) if outline is not None
    ]
    for thing in (*before, *after):
        middle = thing.points.mean(axis=0)
        assert any(np.hypot(*(o.mean(axis=0) - middle)) < 0.5 for o in outlines)
    assert found.flagged.sum() > 0.2 * found.compared.sum()
