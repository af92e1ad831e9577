"""Errors that say what no robot does in a log's odometry."""

import numpy as np
import pytest

from graphslam.core.config import Config
from graphslam.core.geometry import exp
from graphslam.logs import LogWriter, open_logs
from graphslam.slam.failures import impossible_odometry

S = 1_000_000_000


@pytest.mark.parametrize(("speed_m_s", "named"), [(0.5, False), (500.0, True)])
def test_an_error_names_odometry_in_the_wrong_unit(tmp_path, speed_m_s, named):
    """Such a log of a laser is indeterminate: nobody looks for millimetres behind that."""
    with LogWriter(tmp_path / "log.mcap") as log:
        for k in range(300):
            log.odometry("r", k * S // 10, exp(np.array([0.1 * k * speed_m_s, 0.0, 0.0])))
            log.scan("r", k * S // 10, [1, 2], angle_min_rad=0, angle_step_rad=1, range_max_m=9)
    config = Config()
    found = impossible_odometry(open_logs([tmp_path / "log.mcap"], config), config)
    assert bool(found) == named
    assert all("r: its odometry" in line and "in metres" in line for line in found)
