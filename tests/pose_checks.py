"""Poses compared with the heading modulo a whole turn."""

import numpy as np

from graphslam.core.geometry import wrap


def assert_same_pose(a, b, atol=1e-12):
    """Poses (..., 3) are equal to ``atol`` m and rad."""
    np.testing.assert_allclose(a[..., :2], b[..., :2], atol=atol)
    np.testing.assert_allclose(wrap(a[..., 2] - b[..., 2]), 0, atol=atol)
