"""What works on many scans at once gives what it gives for each."""

from dataclasses import replace

import numpy as np
import pytest

from graphslam.core.config import FrontEndConfig, ScanMatchingConfig
from graphslam.core.geometry import compose
from graphslam.core.observation_arrays import ObservationArrays
from graphslam.core.records import Observation, Scan
from graphslam.perception.dynamic_objects import dynamic_returns, dynamic_returns_of_all
from graphslam.perception.front_ends import FRONT_ENDS, observe_block
from graphslam.perception.ordered_scan import make_sweep, scan_points
from graphslam.perception.scan_matching import fits, make_submap
from graphslam.perception.scan_pairs import fit_pairs

BEAMS, STEP = 361, np.radians(0.5)
NONE = np.zeros(3)


def room_scan(pose, rng, man=None):
    """A scan (ranges with 1 cm noise) of a room of 8 m by 6 m with a box, perhaps with a man."""
    angles = pose[2] - np.pi / 2 + STEP * np.arange(BEAMS)
    d = np.column_stack([np.cos(angles), np.sin(angles)])
    r = np.full(BEAMS, np.inf)
    for low, high in (((-4, -3), (4, 3)), ((1, -1), (2, 0.5))):
        for axis in (0, 1):
            for side in (low, high):
                with np.errstate(divide="ignore", invalid="ignore"):
                    t = (side[axis] - pose[axis]) / d[:, axis]
                    other = pose[1 - axis] + t * d[:, 1 - axis]
                hit = (t > 0) & (other >= low[1 - axis]) & (other <= high[1 - axis])
                r = np.where(hit & (t < r), t, r)
    if man is not None:
        to = np.asarray(man) - pose[:2]
        along = d @ to
        miss2 = to @ to - along**2
        hit = (along > 0) & (miss2 < 0.2**2)
        r = np.where(hit, np.minimum(r, along - np.sqrt(np.maximum(0.04 - miss2, 0))), r)
    r = r + rng.normal(0, 0.01, BEAMS)
    r[rng.random(BEAMS) < 0.02] = np.nan
    return Scan("a", 0, 0, r, -np.pi / 2, STEP, NONE)


@pytest.fixture(scope="module")
def drive():
    """Scans along a path, the last ones with a man who walks, and their poses."""
    rng, pose, scans, poses = np.random.default_rng(3), np.array([-2.5, -2.0, 0.3]), [], []
    for k in range(12):
        man = (-1.0 + 0.25 * k, 1.5) if k > 3 else None
        scans.append(room_scan(pose, rng, man))
        poses.append(pose)
        pose = compose(pose, np.array([0.15, 0.0, 0.08]))
    # a robot that stands sees the same twice, to the digit
    return [*scans, scans[-1]], np.array([*poses, poses[-1]])


@pytest.mark.parametrize("rule", ["deviation", "variance"])
def test_segments_of_a_block_are_those_of_each_scan(drive, rule):
    """To the digit: breaks when a wall is joined across the border of two scans, or the point of
    another scan is taken for its own."""
    scans, _ = drive
    config = FrontEndConfig(split_rule=rule)
    sweeps = [make_sweep(scan, config.max_range_m) for scan in scans]
    found = observe_block(scans, sweeps, config)
    assert len(found) == len(scans) and sum(map(len, found)) > 3 * len(scans)
    for scan, seen in zip(scans, found, strict=True):
        alone = ObservationArrays.of(FRONT_ENDS["segments"](scan, config))
        for name in ("kind", "z", "cov", "extent"):
            np.testing.assert_array_equal(getattr(seen, name), getattr(alone, name))


def test_moving_objects_of_a_block_are_those_of_each_scan(drive):
    scans, poses = drive
    sweeps = [make_sweep(scan, 30.0) for scan in scans]
    # another laser, last, with its beams twice as far apart
    other = replace(scans[-1], ranges=scans[-1].ranges[::2], angle_step_rad=2 * STEP)
    coarser, poses = make_sweep(other, 30.0), np.concatenate([poses, poses[-1:]])
    views, expected = [], []
    for lag in range(1, 5):
        earlier = np.roll(poses, lag, axis=0)
        c, s = np.cos(earlier[:, 2]), np.sin(earlier[:, 2])
        x, y = (poses - earlier)[:, :2].T
        views.append(np.column_stack([c * x + s * y, c * y - s * x, poses[:, 2] - earlier[:, 2]]))
    for k, sweep in enumerate(sweeps):
        past = [(sweeps[k - lag], views[lag - 1][k]) for lag in range(1, 5) if k >= lag]
        expected.append(dynamic_returns(sweep, past))
    for every in (sweeps, [*sweeps, coarser], sweeps[:1]):
        found = dynamic_returns_of_all(every, views)
        assert len(every) == 1 or np.concatenate(found).any()
        for one, alone in zip(found, expected, strict=False):
            np.testing.assert_array_equal(one, alone)


def test_pairs_of_a_block_fit_as_each_pair_does(drive):
    """At the true motion nearly all points lie on others and the step is small; half a metre off
    few do. As `fits` says, within 0.1: it takes a surface's direction from neighbours in space."""
    scans, _ = drive
    config = ScanMatchingConfig()
    clouds = [scan_points(scan, 30.0) for scan in scans[:4]]
    at, later = np.array([0, 1, 2]), np.array([1, 2, 3])
    true = np.tile([0.15, 0.0, 0.08], (3, 1))
    good = fit_pairs(clouds, at, later, true, config)
    bad = fit_pairs(clouds, at, later, true + np.array([0.5, 0.3, 0.0]), config)
    assert good.share.min() > 0.85 and bad.share.max() < 0.5
    assert np.abs(good.step).max() < 0.02
    for k in range(3):
        maps = [make_submap(np.zeros((1, 3)), [clouds[n]], config) for n in (at[k], later[k])]
        share, _, cov = fits(maps[1:], maps[:1], true[k : k + 1])
        assert abs(good.share[k] - share[0]) < 0.1
        assert 0.5 < np.sqrt(good.cov[k, 2, 2] / cov[0, 2, 2]) < 2.0


def test_observations_as_arrays_and_back():
    seen = [
        Observation(
            "line", np.array([1.0, 2.0, 0.3]), np.diag([1.0, 2.0, 3.0]), np.array([-1, 1.0])
        ),
        Observation("point", np.array([0.3, 4.0]), np.diag([0.1, 0.2])),
    ]
    arrays = ObservationArrays.of(seen)
    for k, o in enumerate(seen):
        again = arrays.one(k)
        assert again.kind == o.kind
        np.testing.assert_array_equal(again.z, o.z)
        np.testing.assert_array_equal(again.cov, o.cov)
    np.testing.assert_allclose(arrays.poses()[1, :2], 4 * np.array([np.cos(0.3), np.sin(0.3)]))
