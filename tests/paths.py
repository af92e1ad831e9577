"""Where tests find what lies outside them."""

import os
from pathlib import Path

ROOT = Path(__file__).parents[1]
LOGS = ROOT / "logs"
#: real logs; tests that need them skip where they are absent
DATA = Path(os.environ.get("GRAPHSLAM_DATA", ROOT / "../shared/data"))
