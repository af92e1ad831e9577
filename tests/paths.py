"""Where tests find what lies outside them."""

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LOGS = ROOT / "logs"
#: real logs; tests that need them skip where they are absent
DATA = Path(os.environ.get("GRAPHSLAM_DATA", ROOT / "../shared/data"))


def real_data(name):
    """The path of a real log, file or folder; skips the test where it is not there."""
    path = DATA / name
    if not path.exists():
        pytest.skip(f"{path} is not there; set GRAPHSLAM_DATA")
    return path
