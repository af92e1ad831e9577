"""Checks of a step's contents; errors are one line that names robot, landmark and time."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from graphslam.core.errors import EstimationError
from graphslam.core.geometry import Array
from graphslam.core.records import Association, Closure


def describe_start(robot: str, time_ns: int) -> str:
    """A robot's start in words, for error messages; the others likewise."""
    return f"start of robot {robot} at {time_ns} ns"


def describe_motion(robot: str, time_ns: int) -> str:
    """A motion that ends at ``time_ns``."""
    return f"motion of robot {robot} to {time_ns} ns"


def describe(record: Association | Closure) -> str:
    """An observation of a landmark or a robot, or a closure."""
    if isinstance(record, Closure):
        return f"closure of robot {record.robot} at {record.time_ns} ns"
    kind = "robot" if isinstance(record.target, str) else "landmark"
    return f"{kind} {record.target}, seen from robot {record.robot} at {record.time_ns} ns"


def indeterminate(
    what: str, why: str = "it carries no information, or its covariance is invalid"
) -> EstimationError:
    """The error of an estimate that ``what`` leaves indeterminate."""
    return EstimationError(f"the estimate is indeterminate at {what}: {why}")


@contextmanager
def errors_at(what: str) -> Iterator[None]:
    """Turn a failed factorisation inside into an error that names ``what``."""
    try:
        yield
    except np.linalg.LinAlgError:
        raise indeterminate(what) from None


def check_finite(what: str, *values: Array) -> None:
    """Refuse values that are infinite or NaN.

    Raises:
        EstimationError: it names ``what``.
    """
    if not all(np.isfinite(value).all() for value in values):
        raise indeterminate(what)


def check_positive(cov: Array, what: str) -> None:
    """Refuse a matrix (k, k) that is not a positive definite covariance.

    Raises:
        EstimationError: it names ``what``.
    """
    with errors_at(what):
        np.linalg.cholesky(cov)
