"""Whether loops are closed by scans."""

import pytest
from room_log import drive

from graphslam.core.config_io import load_config
from graphslam.logs import open_logs
from graphslam.slam.smooth import smooth


@pytest.mark.parametrize("is_closed", [True, False])
def test_loops_are_closed_by_scans_only_if_the_setting_says_so(tmp_path, is_closed):
    """`backend.close_loops`: once round a box. Without, no pair of places is compared."""
    drive(tmp_path / "room.mcap")
    config = load_config(
        overrides=[f"backend.close_loops={str(is_closed).lower()}", "loop_closure.revisit_path_m=8"]
    )
    asked = []

    def look(closures, submaps):
        asked.append(len(submaps))
        return closures

    smooth(open_logs([tmp_path / "room.mcap"], config), config, tamper=look)
    assert any(asked) == is_closed
