"""How noisy observations of lines are, as the estimate of a log shows it.

The noise that the front end states has a floor for walls that are not flat
(`front_end.floor_normal_m`), and takes each observation for independent. In a building of flat
walls it is too large; where walls are uneven, consecutive scans see the same unevenness and are off
alike. So residuals are added up along a few metres of path: those of one wall within them count as
one, and that is compared with what independent ones would come to.
"""

import numpy as np

from graphslam.core.geometry import Array
from graphslam.estimation.line_residuals import LineResiduals
from graphslam.estimation.posterior_residuals import Residuals

#: m of path along which one wall's errors may be the same: over 10 m they add up to no more
SHARED_M = 3.0
#: spans whose residuals are looked at, at most, evenly spread
MOST_SPANS = 300
#: share of the variance of a sum that the solution must leave: what else is wrong there (another
#: wall, odometry) would otherwise be taken for noise of these observations
LEAST_LEFT = 0.3
#: the noise as stated counts like so many sums that have shown it
AS_STATED = 3


def fit_line_noise(residuals: LineResiduals) -> dict[str, Array]:
    """Robot -> factors (2,) on the variances of its lines' normal offsets and directions."""
    found = {}
    for robot in residuals.robots:
        targets, path = residuals.seen_along(robot)
        spans = np.column_stack([targets, (path // SHARED_M).astype(np.int64)])
        spans, of = np.unique(spans, axis=0, return_inverse=True)
        shown = np.unique(np.linspace(0, len(spans) - 1, MOST_SPANS).astype(np.int64))
        found[robot] = _factors(residuals.sums(robot, of.ravel(), shown))
    return found


def _factors(sums: Residuals) -> Array:
    factors = np.ones(2)
    for k in range(2):
        used = sums.redundancy[:, k] > LEAST_LEFT
        count = int(used.sum())
        if count:
            parts = (sums.residual, sums.variance, sums.absorbed)
            shown = Residuals(*(part[used, k : k + 1] for part in parts)).variance_factor()[0]
            factors[k] = (count * shown + AS_STATED) / (count + AS_STATED)
    return factors
