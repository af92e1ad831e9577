"""Visits of which much changed, rooms that look alike from two poses, lasers that measure badly.

What is said must be right, and what cannot be said must be told.
"""

import re
from dataclasses import replace

import numpy as np
import pytest
from test_detect import CONFIG, FAN, SIGMA, box, drive, visit, walls

from graphslam.change_detection import detect_changes
from graphslam.change_detection.beam_evidence import BeamEvidence, beams_past_surfaces, null_sigma
from graphslam.change_detection.grid import grid_over
from graphslam.change_detection.regions import find_regions
from graphslam.change_detection.surface_map import fit_surfaces
from graphslam.change_detection.visit import on_surface, scatter_of_ranges
from graphslam.core.geometry import between, inverse

# ------------------------------------------------------------ much changed


def evidence_of(scores):
    """Evidence of as many tested pieces as there are scores, a beam each."""
    n = len(scores)
    none, ones = np.zeros(0, dtype=np.int64), np.ones(n)
    every = np.ones(n, dtype=bool)
    return (BeamEvidence(none, none, scores, ones, ones, 0 * ones, every, np.zeros(n, np.int64)),)


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
    # in a rectangle nothing else is left to tell it from itself after half a turn
    assert all("several poses" in warning for warning in found.warnings)
    assert found.null_sigma < 1.05
    outlines = [
        outline for c in found.changes for outline in (c.polygon, c.before) if outline is not None
    ]
    for thing in (*before, *after):
        middle = thing.points.mean(axis=0)
        assert any(np.hypot(*(o.mean(axis=0) - middle)) < 0.5 for o in outlines)
    assert found.flagged.sum() > 0.2 * found.compared.sum()


# ------------------------------------------------------------ rooms that look alike from two poses


def empty_room(seed, before, after, pose=(8.0, 6.0, np.pi)):
    """Two visits of a room whose walls look the same after half a turn; the later one's frame is at
    ``pose``: which of both its walls explain better is chance."""
    rng = np.random.default_rng(seed)
    a, b = visit(before, drive(50), rng), visit(after, drive(50, 0.1), rng)
    b = b.transformed(inverse(np.array(pose)), np.zeros((3, 3)))
    b = replace(b, landmarks=tuple(walls(pose, rng=rng)[:4]))
    return detect_changes(replace(a, landmarks=tuple(walls(rng=rng)[:4])), b, CONFIG)


@pytest.mark.parametrize("pose", [(0.0, 0.0, 0.0), (8.0, 6.0, np.pi)])
def test_a_symmetric_room_is_told_with_both_poses(pose):
    """A box that stands aside moves by 0.6 m: at the right pose less is elsewhere than after half a
    turn, but not clearly less. Breaks if the landmarks alone decide, or nothing is said."""
    for seed in range(3):
        thing, moved = box(5.2, 3.8, 1.0, 0.6), box(5.8, 3.5, 1.0, 0.6)
        found = empty_room(seed, [thing], [moved], pose)
        # lines of 3 mrad and 5 mm: half a turn is 8 m and 3 rad away
        np.testing.assert_allclose(between(np.array(pose), found.registration.pose), 0, atol=0.1)
        (warning,) = found.warnings
        assert "several poses" in warning
        assert {abs(int(n)) for n in re.findall(r"(-?\d+) deg", warning)} == {0, 180}


def test_a_room_that_furniture_tells_apart_is_not_said_to_look_alike():
    thing = box(5.2, 3.8, 1.0, 0.6)
    found = empty_room(0, [thing], [thing])
    assert not found.warnings and not found.changes


# ------------------------------------------------------------ lasers that measure badly


def noisier(seen, sigma, rng, step=0.01):
    """The visit with range noise of ``sigma`` m in all, rounded to ``step`` m."""
    more = np.sqrt(sigma**2 - SIGMA**2) * rng.normal(size=seen.range_m.shape)
    ranges = np.round((seen.range_m + more) / step) * step
    sweeps = ranges.reshape(len(seen.poses), -1)
    surface = np.concatenate([on_surface(FAN.angles, sweep) for sweep in sweeps])
    return replace(seen, range_m=ranges, surface=surface)


@pytest.mark.parametrize("sigma", [0.016, 0.025, 0.03])
def test_range_noise_is_measured_whatever_the_scene(sigma):
    """From neighbouring beams alone; corners, boxes and rounding to 1 cm change it by a tenth: that
    adds 3 mm in quadrature, and beams farther apart than an edge's gap are left out."""
    rng = np.random.default_rng(40)
    seen = noisier(visit([box(5, 4), box(1, 1, 0.8, 0.4)], drive(40), rng), sigma, rng)
    assert scatter_of_ranges(seen) == pytest.approx(sigma, rel=0.1)


@pytest.mark.parametrize("sigma", [0.025, 0.03, 0.04])
def test_a_noisy_laser_has_coarser_surfaces_and_finds_a_box(sigma):
    """Breaks if cells are finer than the noise is wide: then windows have no direction, up to nine
    tenths of the walls are no surface, and a box of 60 x 50 cm is missed without a word."""
    rng, stays = np.random.default_rng(41), box(1, 1, 0.8, 0.4)
    a, b = visit([stays], drive(60), rng), visit([stays, box(5, 4)], drive(60, 0.1), rng)
    marks = tuple(walls())
    seen = [replace(noisier(v, sigma, rng), landmarks=marks) for v in (a, b)]
    found = detect_changes(*seen, CONFIG)
    assert not found.warnings
    (change,) = found.changes
    assert change.kind == "appeared"
    # two sides of the box are seen, to a cell or two of 4 to 6 cm
    np.testing.assert_allclose(change.polygon.mean(axis=0), [5.2, 4.15], atol=0.2)
    assert found.compared.sum() > 0.6 * len(b.range_m)  # of a precise laser's beams it is 0.85


def test_returns_on_no_surface_are_told():
    """At 12 cm of noise hardly anything is straight. Breaks if nothing is said of it."""
    rng = np.random.default_rng(42)
    a, b = (noisier(visit([], drive(60, t), rng), 0.12, rng) for t in (0.0, 0.1))
    marks = tuple(walls())
    found = detect_changes(replace(a, landmarks=marks), replace(b, landmarks=marks), CONFIG)
    assert any("straight surface" in warning for warning in found.warnings)


def test_where_visits_disagree_all_over_a_change_is_less_certain():
    """Six sigmas are certain if sigmas are as stated. Where a spread of 2 tells that they are not,
    they are not: materials may bias another laser. Breaks if both are by the normal law."""
    rng = np.random.default_rng(43)
    before, after = visit([], drive(60), rng), visit([box(5, 4)], drive(60, 0.1), rng)
    surface = fit_surfaces(after, grid_over(after.ends, 0.025, 10**6), SIGMA, CONFIG)
    past = beams_past_surfaces(surface, before, SIGMA, CONFIG)
    behind = past.scores(1.0) > 10
    assert behind.any()

    def probability(score, sigma):
        """Of the box, its surface being so many sigmas off."""
        offset = np.where(behind, score * sigma * np.sqrt(past.variance), 0.0)
        shown = (replace(past, offset=offset), past.beams, past.rows, past.first_ns)
        return max(r.probability for r in find_regions(surface, *shown, sigma, CONFIG))

    assert probability(6.0, 1.0) > 0.999
    # some 25 m of surface, and Cantelli's 1 / (1 + 36): about even; beams that pass are 30 and more
    assert 0.4 < probability(6.0, 2.0) < 0.75
    assert probability(30.0, 2.0) > 0.95
