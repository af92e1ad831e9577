"""What scans say of the path along walls: doors tell it from twice the path, bare walls do not."""

import numpy as np
import pytest

from graphslam.core.records import KeyframeScan, Scan, Trajectory
from graphslam.perception.along_walls import misfits, near_returns
from graphslam.pipeline.path_evidence import (
    FACTORS,
    SPEEDS_M_S,
    better_fit,
    path_misfits,
    speed_misfits,
)

S = 1_000_000_000
ANGLES = np.radians(np.arange(-120.0, 121.0))
DOORS_M = np.cumsum([1.0, 3.2, 2.1, 4.0, 2.7, 3.6, 2.2, 3.9])


def ranges_at(x_m, doors_m, rng):
    """Ranges of a laser in the middle of a corridor along x, doors 12 cm behind its walls."""
    sides, ahead = np.abs(np.sin(ANGLES)), np.cos(ANGLES)
    ranges = 1.2 / np.maximum(sides, 1e-9)
    # doors left of the robot are those at the right, 1.5 m further
    at = x_m + ranges * ahead - np.where(ANGLES > 0, 1.5, 0.0)
    in_door = (np.abs(at[:, None] - doors_m[None]) < 0.45).any(axis=1)
    ranges = np.where(in_door, ranges * 1.1, ranges) + rng.normal(0, 0.01, len(ANGLES))
    return np.where(ranges < 25, ranges, np.nan)


def scan_at(k, x_m, doors_m, rng):
    ranges = ranges_at(x_m, doors_m, rng)
    return Scan("tom", k * S, k * S, ranges, ANGLES[0], np.radians(1.0), np.zeros(3))


def keyframes(doors_m, factor):
    """Keyframes of a drive of 20 m, and states whose path is multiplied by a factor."""
    rng, path = np.random.default_rng(0), np.arange(0.0, 20.0, 0.25)
    scans = []
    for k, x in enumerate(path):
        ranges = ranges_at(x, doors_m, rng)
        points = (ranges * np.array([np.cos(ANGLES), np.sin(ANGLES)])).T
        scans.append(KeyframeScan("tom", k * S, points[np.isfinite(ranges)].astype(np.float32)))
    poses = np.column_stack([factor * path, 0 * path, 0 * path])
    return scans, Trajectory(np.arange(len(path)) * S, poses, np.zeros((len(path), 3, 3)))


@pytest.mark.parametrize("factor", [1.0, 0.5, 2.0, -1.0])
def test_doors_tell_how_long_the_path_is(factor):
    found = path_misfits(*keyframes(DOORS_M, factor))
    best = better_fit(found.misfits)
    assert len(found.times_ns) > 20
    assert (best is None) == (factor == 1.0)
    assert best is None or FACTORS[best] == 1 / factor


@pytest.mark.parametrize("factor", [1.0, 0.5, 2.0])
def test_bare_walls_tell_nothing(factor):
    """Of beams at the same angles a robot that stands fits best, by their noise: no reason."""
    assert better_fit(path_misfits(*keyframes(np.zeros(0), factor)).misfits) is None


@pytest.mark.parametrize(("speed_m_s", "doors_m"), [(0.0, DOORS_M), (0.5, DOORS_M), (0.5, [])])
def test_a_robot_that_is_said_to_stand_moves_past_doors(speed_m_s, doors_m):
    rng = np.random.default_rng(1)
    scans = [scan_at(k, 2.0 + speed_m_s * k, np.array(doors_m), rng) for k in range(8)]
    best = better_fit(speed_misfits(scans))
    assert (best is not None) == bool(speed_m_s and len(doors_m))
    assert best is None or abs(SPEEDS_M_S[best]) == speed_m_s


def test_scans_of_few_returns_and_few_scans_are_no_evidence():
    scans, states = keyframes(DOORS_M, 2.0)
    few = [KeyframeScan("tom", scan.time_ns, scan.points[:20]) for scan in scans]
    assert better_fit(path_misfits(few, states).misfits) is None
    assert better_fit(path_misfits(scans[:5], states).misfits) is None
    assert better_fit(path_misfits([], states).misfits) is None


def test_what_a_pose_puts_out_of_view_does_not_speak_against_it():
    """A wall of which the second scan sees 2 m more than the first could: on the wall all the
    same. Returns beyond the first one's view counted as far from it, so less motion fitted
    better. A pose that puts most of them there is no explanation, however."""
    along = np.arange(0.5, 5.7, 0.02)
    wall = np.column_stack([along, np.full(len(along), 1.2)])
    first = near_returns(wall, np.zeros(3))
    poses = np.array([[2.0, 0.0, 0.0], [4.5, 0.0, 0.0], [2.0, 0.3, 0.0]])
    right, beyond, aside = misfits(first, first, poses)
    assert right < 0.1 and beyond > 8.0 and aside > 8.0
