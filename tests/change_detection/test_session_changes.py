"""Changes between sessions of one map."""

import numpy as np

from graphslam.change_detection.session_changes import LEAST_SIGMAS, _in_the_map
from graphslam.core.records import Trajectory


def test_what_the_whole_map_has_in_common_says_nothing_of_its_scans():
    """An error of the world moves all poses of both sessions alike: it is taken off."""
    first = np.array([2.0, -1.0, 0.7])
    poses = np.array([first, [5.0, 3.0, -1.0], [-4.0, 9.0, 2.0]])
    world = np.diag([0.05, 0.04, 0.03]) ** 2
    own = np.diag([0.01, 0.02, 0.004]) ** 2
    covs = []
    for x, y, _ in poses:
        J = np.array([[1, 0, first[1] - y], [0, 1, x - first[0]], [0, 0, 1]])
        covs.append(J @ world @ J.T + own)
    origin = Trajectory(np.zeros(1, dtype=np.int64), first[None], world[None])
    found = _in_the_map(poses, np.array(covs), origin)
    expected = np.broadcast_to(own + np.diag(LEAST_SIGMAS**2), (3, 3, 3))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)
