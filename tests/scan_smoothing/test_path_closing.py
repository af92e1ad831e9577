"""Whether loops are closed by scans."""

import pytest
from room_log import drive

from graphslam.core.config_io import load_config
from graphslam.logs import open_logs
from graphslam.slam.smooth import smooth


@pytest.mark.parametrize("is_closed", [True, False])
@pytest.mark.parametrize("backend", ["batch", "isam2"])
def test_loops_are_closed_by_scans_only_if_the_setting_says_so(tmp_path, backend, is_closed):
    """`backend.close_loops`: once round a box. Without, no pair of places is compared, neither in a
    batch nor after a pass step by step."""
    drive(tmp_path / "room.mcap")
    overrides = ["loop_closure.revisit_path_m=8", f"backend.name={backend}"]
    overrides.append(f"backend.close_loops={str(is_closed).lower()}")
    config = load_config(overrides=overrides)
    asked = []

    def look(closures, submaps):
        asked.append(len(submaps))
        return closures

    smooth(open_logs([tmp_path / "room.mcap"], config), config, tamper=look)
    assert any(asked) == is_closed
