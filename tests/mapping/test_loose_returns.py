"""Returns outside of segments, as observations of walls that are known."""

from dataclasses import replace

import numpy as np
import pytest

from graphslam.core.config import FrontEndConfig
from graphslam.core.geometry import compose, rotation3
from graphslam.core.records import Association, Estimate, KeyframeScan, Start, Step, Trajectory
from graphslam.mapping.landmark_map import Entry
from graphslam.mapping.loose_returns import LEAST_RETURNS, MOST_WALLS, with_loose_returns

CONFIG = FrontEndConfig()
STATE = np.array([2.0, 3.0, 0.4])
#: a wall on the right of the robot, which is on its left
AHEAD = np.array([0.0, -1.2, 0.0])


def entry(number, line, extent=(-10.0, 10.0)):
    """A wall at ``line`` (3,) in the frame of the state."""
    return Entry(
        number, "line", compose(STATE, line), np.eye(3), np.array(extent), 0, 0, None, in_graph=True
    )


def seen(number, line, extent=(-1.0, 1.0), sigmas=(1.0, 0.01, 0.006)):
    turn = rotation3(line[2])
    cov = turn @ np.diag(np.square(sigmas)) @ turn.T
    return Association("r", 5, number, "line", np.array(line), cov, extent=np.array(extent))


def used(points, walls, associations=(), config=CONFIG, sensor=(0.0, 0.0, 0.0), began=None):
    """The associations of one step whose scan has these returns; with a start that ``began``."""
    starts = {} if began is None else {"r": Start(STATE, np.eye(3))}
    stamps = np.array([5] if began in (None, 5) else [began, 5])
    poses = np.tile(STATE, (len(stamps), 1))
    states = {"r": Trajectory(stamps, poses, np.zeros((len(stamps), 3, 3)))}
    marks = {wall.id: (wall.mean, np.eye(3)) for wall in walls}
    scan = KeyframeScan("r", 5, np.array(points, dtype=np.float32), np.array(sensor))
    step = Step(
        5, starts, {}, tuple(associations) or (Association("r", 5, 99, "point", *POINT),), ()
    )
    (made,) = with_loose_returns(
        [step], Estimate(states, marks, 0.0, 0), [scan], {wall.id: wall for wall in walls}, config
    )
    return made.associations


POINT = np.array([0.1, 2.0]), np.eye(2)


def on(line, *along, off=0.0):
    """Points on a line, at distances along it."""
    c, s = np.cos(line[2]), np.sin(line[2])
    return [(line[0] + c * t - s * off, line[1] + s * t + c * off) for t in along]


def test_a_return_far_along_a_wall_tells_its_direction():
    """Breaks if the lever, the sign or the weight of a return is wrong: the answer is by hand."""
    turned = np.array([0.0, -1.2, 0.005])  # as observed; the wall is at 0
    (a,) = used(on(AHEAD, 8.0), [entry(1, AHEAD)], [seen(1, turned)])
    sigma_sq = 2 * CONFIG.floor_normal_m**2  # at grazing incidence the surface alone
    H = np.array([1.0, 8.0])
    V = np.diag([0.01**2, 0.006**2])
    gain = V @ H / (H @ V @ H + sigma_sq)
    offset, turn = gain * (0.0 - 8.0 * 0.005)
    assert a.z[2] == pytest.approx(0.005 + turn, abs=1e-5)
    # by hand to first order in 5 mrad, squares of which are 2.5e-5
    assert a.z[1] == pytest.approx(-1.2 + offset, abs=1e-4)
    left = V - np.outer(gain, H @ V)
    cov = rotation3(-a.z[2]) @ a.cov @ rotation3(-a.z[2]).T
    assert np.allclose(cov[1:, 1:], left, rtol=1e-3, atol=1e-10)
    assert np.sqrt(cov[2, 2]) < 0.003


def test_covariances_hold_the_errors():
    """Mean squared whitened errors of 300 draws. Noise of returns is drawn as it is stated."""
    rng, squared = np.random.default_rng(3), []
    wall, V = entry(1, AHEAD), np.diag([0.01**2, 0.006**2])
    for _ in range(300):
        shift, turn = rng.multivariate_normal([0, 0], V)
        line = np.array([0.0, -1.2 + shift, turn])
        surfaces = rng.normal(0.0, CONFIG.floor_normal_m, 3)
        points = [
            on(AHEAD, t + d, off=surfaces[k] + rng.normal(0.0, CONFIG.floor_normal_m))[0]
            for k, t in enumerate((4.1, 6.1, 8.1))
            for d in (0.0, 0.4)
        ]
        (a,) = used(points, [wall], [seen(1, line)])
        own = rotation3(-a.z[2]) @ a.cov @ rotation3(-a.z[2]).T
        # the line where it is nearest to the sensor
        error = np.array([a.z[1] - a.z[0] * np.tan(a.z[2]) + 1.2, a.z[2]])
        squared.append(error @ np.linalg.solve(own[1:, 1:], error) / 2)
    # 600 degrees of freedom: 1 ± 0.17 (3 sigma); returns beyond the gate are left out, which
    # makes errors smaller than stated
    assert 0.6 < np.mean(squared) < 1.17


def test_a_wall_without_an_observation_gets_one():
    """What two returns tell: where the wall is between them, and hardly its direction."""
    point, line = used(on(AHEAD, 3.0, 3.4), [entry(7, AHEAD)])
    assert point.target == 99 and line.target == 7 and line.model == "line"
    assert line.z == pytest.approx([3.2, -1.2, 0.0], abs=1e-6)
    assert np.allclose(line.extent, [-0.2, 0.2], atol=1e-6)
    # both are on one surface, whose deviation they share
    assert line.cov[1, 1] == pytest.approx(1.5 * CONFIG.floor_normal_m**2, rel=0.01)
    # two points with 1 cm each, 0.4 m apart, tell less than 0.03 rad; 0.2 is what is known before
    assert 0.03 < np.sqrt(line.cov[2, 2]) < 0.2


def test_one_return_makes_no_observation():
    assert LEAST_RETURNS == 2
    assert len(used(on(AHEAD, 3.0), [entry(7, AHEAD)])) == 1


def test_of_several_walls_those_with_the_most_returns():
    """Breaks if every wall is used, or another one."""
    left = np.array([0.0, 1.2, np.pi])
    points = on(AHEAD, 3.0, 3.4) + on(left, -3.0, -3.4, -3.8)
    _, *lines = used(points, [entry(7, AHEAD), entry(8, left)])
    assert MOST_WALLS == 1 and [a.target for a in lines] == [8]


def test_of_the_scan_at_a_start_all_walls_are_used():
    """Breaks if the direction of the world is by fewer walls than the first scan has, or if later
    scans of a robot are taken for its first."""
    left = np.array([0.0, 1.2, np.pi])
    points = on(AHEAD, 3.0, 3.4) + on(left, -3.0, -3.4, -3.8)
    walls = [entry(7, AHEAD), entry(8, left)]
    _, *lines = used(points, walls, began=5)
    assert {a.target for a in lines} == {7, 8}
    _, *later = used(points, walls, began=3)
    assert len(later) == MOST_WALLS


@pytest.mark.parametrize(
    ("points", "why"),
    [
        (on(AHEAD, 11.0, 11.4), "beyond its end"),
        (on(AHEAD, 2.0, 2.4, off=0.1), "in front of it"),
        (on(AHEAD, 0.3, 0.7), "in its segment"),
    ],
)
def test_returns_that_are_not_on_a_wall_change_nothing(points, why):
    before = seen(1, AHEAD)
    (after,) = used(points, [entry(1, AHEAD)], [before])
    assert after is before, why


def test_a_wall_is_not_seen_from_behind():
    """The sensor is on the left of a wall; its other side is another wall."""
    behind = np.array([0.0, -1.2, np.pi])
    assert len(used(on(AHEAD, 3.0, 3.4), [entry(7, behind)])) == 1
    # the same from a laser that sits on the other side
    assert len(used(on(AHEAD, 3.0, 3.4), [entry(7, behind)], sensor=(0.0, -3.0, 0.0))) == 2


def test_a_return_that_may_be_on_either_of_two_walls_is_not_used():
    near, far = AHEAD, np.array([0.0, -1.24, 0.0])
    observed = [seen(1, near), seen(2, far)]
    assert used(on(near, 8.0), [entry(1, near), entry(2, far)], observed) == tuple(observed)
    other = np.array([0.0, -1.5, 0.0])
    one, two = used(on(near, 8.0), [entry(1, near), entry(2, other)], observed)
    assert one is not observed[0] and two is observed[1]


def test_steps_without_scans_or_walls_stay():
    step = Step(5, {}, {}, (seen(1, AHEAD),), ())
    states = {"r": Trajectory(np.array([5]), STATE[None], np.zeros((1, 3, 3)))}
    nothing = Estimate(states, {}, 0.0, 0)
    scan = KeyframeScan("r", 5, np.array([[1.0, 2.0]], dtype=np.float32))
    assert with_loose_returns([step], nothing, [], {1: entry(1, AHEAD)}, CONFIG) == (step,)
    assert with_loose_returns([step], nothing, [scan], {}, CONFIG) == (step,)
    empty = replace(scan, points=np.zeros((0, 2), dtype=np.float32))
    assert with_loose_returns([step], nothing, [empty], {1: entry(1, AHEAD)}, CONFIG) == (step,)
