"""Bad input, refused in one line that names robot, landmark and time."""

import numpy as np

from graphslam.core.errors import EstimationError
from graphslam.core.geometry import Array
from graphslam.core.records import Association


def sighting(seen: Association) -> str:
    """An observation in words."""
    kind = "robot" if isinstance(seen.target, str) else "landmark"
    return f"{kind} {seen.target}, seen from robot {seen.robot} at {seen.time_ns} ns"


def indeterminate(what: str) -> EstimationError:
    """The error of something that determines nothing, said in words."""
    return EstimationError(
        f"the estimate is indeterminate at {what}: it says nothing, or its noise is no covariance"
    )


def check_finite(what: str, *values: Array) -> None:
    """Refuse infinities and what is not a number.

    Raises:
        EstimationError: it names ``what``.
    """
    if not all(np.isfinite(value).all() for value in values):
        raise indeterminate(what)


def check_positive(cov: Array, what: str) -> None:
    """Refuse a matrix (k, k) that is no positive definite covariance.

    Raises:
        EstimationError: it names ``what``.
    """
    try:
        np.linalg.cholesky(cov)
    except np.linalg.LinAlgError:
        raise indeterminate(what) from None
