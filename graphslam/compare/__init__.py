"""Back ends side by side on one log: the same evidence, or each with its own associations.

A back end is asked for by a *spec*, ``NAME[:HORIZON][+key=value...]``: ``ekf``, ``isam2:20``,
``ekf+ekf.error=body``. In mode ``replay`` the log is associated once and its recorded steps go
into every back end, which compares estimation and nothing else. In mode ``associate`` each
associates for itself; its own steps are then replayed into it, so that times mean the same in both.

`specs` says what is compared, `recording` makes the steps, `playing` gives them to a back end,
`rows` judges what comes out, `folder` keeps it.
"""

from graphslam.compare.folder import is_comparison, save_comparison
from graphslam.compare.playing import Played, play, play_apart
from graphslam.compare.recording import Recording, record
from graphslam.compare.rows import MODES, compare
from graphslam.compare.specs import Variant, variants

__all__ = [
    "MODES",
    "Played",
    "Recording",
    "Variant",
    "compare",
    "is_comparison",
    "play",
    "play_apart",
    "record",
    "save_comparison",
    "variants",
]
