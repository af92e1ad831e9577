"""Which pose one visit's map has in the other's: starts that are hardly known, symmetric rooms."""

from dataclasses import replace

import numpy as np
import pytest
from test_detect import CONFIG, box, drive, visit, walls

from graphslam.change_detection import detect_changes
from graphslam.change_detection.rigid_registration import landmarks_of_map, register
from graphslam.core.errors import OutputError
from graphslam.core.geometry import compose, inverse, transform
from graphslam.core.records import Landmark


def uncertain(landmarks, start, cov):
    """The landmarks where the pose at which the robot begins is known with a covariance."""
    made = []
    for one in landmarks:
        normal, offset, own = one.line
        nx, ny = np.cos(normal), np.sin(normal)
        J = np.array([[0, 0, 1], [nx, ny, nx * start[1] - ny * start[0]]])
        made.append(replace(one, line=(normal, offset, own + J @ cov @ J.T)))
    return tuple(made)


def test_what_is_not_known_of_a_start_does_not_hide_the_shape_of_a_map():
    """The whole map turns about the start: far from it each wall is known to 0.6 m only."""
    rng = np.random.default_rng(1)
    cov, start = np.diag([0.05, 0.05, 0.05]) ** 2, np.array([-12.0, 3.0, 0.4])
    true = np.array([0.8, -0.5, 0.3])
    maps = [uncertain(walls(pose, rng=rng), start, cov) for pose in ((0, 0, 0), true)]
    with pytest.raises(OutputError):
        register(*maps)
    visits = [
        replace(visit([], drive(3), rng, landmarks=own), poses=start[None], covs=cov[None])
        for own in maps
    ]
    found = register(*map(landmarks_of_map, visits))
    np.testing.assert_allclose(found.pose, true, atol=0.02)  # four sigmas
    assert len(found.matched) >= 5 and np.sqrt(found.cov[2, 2]) < 0.005


def test_points_are_as_sure_within_a_map_as_walls():
    start, cov = np.array([1.0, 2.0, 0.0]), np.diag([0.1, 0.2, 0.03]) ** 2
    at, own = np.array([4.0, -3.0]), np.diag([0.01, 0.02]) ** 2
    x, y = at - start[:2]
    J = np.array([[1, 0, -y], [0, 1, x]])
    known = own + J @ cov @ J.T
    post = Landmark(
        1, "point", np.array([*at, np.nan]), known, np.array([at, at]), None, 9, 0, 1, None
    )
    lone = replace(
        visit([], drive(3), np.random.default_rng(2), landmarks=(post,)),
        poses=start[None], covs=cov[None],
    )  # fmt: skip
    (found,) = landmarks_of_map(lone)
    np.testing.assert_allclose(found.cov, own, atol=1e-9)
    # several robots begin at several places
    assert landmarks_of_map(replace(lone, robots=2)) == (post,)


@pytest.mark.parametrize("half_turn", [False, True])
def test_scans_decide_between_poses_of_a_symmetric_room(half_turn):
    """Half a turn explains one landmark more than the truth does, and no box that is seen."""
    rng = np.random.default_rng(3)
    things = [box(5, 4), box(0.4, 2.6, name="other")]
    world = np.array([8.0, 6.0, np.pi]) if half_turn else np.zeros(3)
    marks = walls()[:5]
    about = compose(world, np.array([8.0, 6.0, np.pi]))  # the fifth is at the opposite place there
    seen_from = [*[world] * 4, about]
    turned = [
        replace(one, extent=transform(inverse(at), one.extent), line=line_in(one, at))
        for one, at in zip(marks, seen_from, strict=True)
    ]
    a = visit(things, drive(50), rng, landmarks=marks)
    b = visit(things, drive(50, 0.1), rng, landmarks=turned)
    b = replace(b, poses=compose(inverse(world), b.poses))
    found = detect_changes(a, b, CONFIG)
    assert not found.changes
    off = compose(inverse(world), found.registration.pose)
    np.testing.assert_allclose(np.append(off[:2], np.sin(off[2])), 0.0, atol=0.03)


def line_in(landmark, world):
    """The line of a landmark seen from a world at a pose."""
    normal, offset, cov = landmark.line
    n = np.array([np.cos(normal), np.sin(normal)])
    return normal - world[2], offset - n @ world[:2], cov
