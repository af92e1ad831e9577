"""`--start truth`: the true pose is that of the time at which the odometry begins."""

import numpy as np
import pytest

from graphslam.core.config import Config
from graphslam.core.geometry import between, exp
from graphslam.logs import LogWriter, open_logs
from graphslam.pipeline.start_priors import first_truth

S = 1_000_000_000
TWIST = np.array([0.5, 0.0, 0.5])  # per second


def true_pose(seconds):
    return exp(seconds * TWIST)


@pytest.mark.parametrize("kind", ["increments", "poses"])
@pytest.mark.parametrize(("period_s", "first_s"), [(0.05, 0.0), (1.0, 0.4), (0.5, -0.3)])
def test_the_start_is_where_the_robot_was_when_its_odometry_begins(
    tmp_path, kind, period_s, first_s
):
    """Of increments the pose at the end of the first was taken, 0.5 rad off at one in a second, and
    a sample 0.4 s later as it was: 0.2 m and 0.2 rad off."""
    path, begin = tmp_path / "log.mcap", 10
    with LogWriter(path) as log:
        for k in range(5):
            t = begin + k
            if kind == "increments":
                delta = between(true_pose(t), true_pose(t + 1))
                log.increment("r", t * S, (t + 1) * S, delta=delta, cov=np.eye(3) * 1e-6)
            else:
                log.odometry("r", t * S, true_pose(t))
        for t in np.arange(begin + first_s, begin + 4, period_s):
            log.truth("r", round(t * S), true_pose(t))
        log.sighting("r", 12 * S, [0.0, 1.0], np.eye(2) * 1e-4, identity="p")
    found = first_truth(open_logs([path], Config()))["r"]
    np.testing.assert_allclose(found, true_pose(begin), atol=1e-6)
