"""Central finite differences, the twin that every analytic derivative is held against."""

from collections.abc import Callable

import numpy as np

from graphslam.core.geometry import Array

#: the truncation error h² f''' and the rounding error 1e-16 |f| / h are about equal here, 1e-11
#: for functions of size ten
STEP = 1e-5


def jacobian(function: Callable[[Array], Array], at: Array) -> Array:
    """Derivative (m, n) of a function (n,) -> (m,) at ``at``."""
    columns = []
    for k in range(len(at)):
        step = np.zeros(len(at))
        step[k] = STEP
        columns.append((function(at + step) - function(at - step)) / (2 * STEP))
    return np.stack(columns, axis=-1)
