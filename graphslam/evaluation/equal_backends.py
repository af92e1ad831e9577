"""Which rows of a comparison are the same estimator twice, and how far apart they are."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from graphslam.core.config import Config
from graphslam.core.geometry import wrap
from graphslam.evaluation.compare_variants import Variant
from graphslam.results.folder import SavedResult


def equal_pairs(done: Sequence[tuple[Variant, SavedResult]]) -> list[dict[str, Any]]:
    """Every pair of rows that are one estimator, and their largest difference in sigmas.

    `ekf` with body-frame errors and `isam2` with horizon 0 are one filter: their causal poses are
    compared. `isam2` and `batch` end at one optimum: their final poses are.

    Args:
        done: rows that did not fail, with their results.

    Returns:
        ``specs`` of both, ``what`` is compared and ``sigmas``: the largest difference of a
        coordinate in units of its standard deviation.
    """
    found = []
    for number, (one, mine) in enumerate(done):
        for other, theirs in done[number + 1 :]:
            kind = _equal(one.config, other.config) or _equal(other.config, one.config)
            if kind is not None:
                sigmas = largest_difference(mine, theirs, kind)
                found.append({"specs": [one.spec, other.spec], "what": kind, "sigmas": sigmas})
    return found


def _equal(a: Config, b: Config) -> str | None:
    """What of two configurations is equal, if the first is `ekf` or `isam2`; None if nothing is."""
    if replace(a, backend=b.backend, ekf=b.ekf) != b:
        return None
    x, y = a.backend, b.backend
    if x.name == "ekf" and (y.name, y.horizon_s) == ("isam2", 0.0):
        same = a.ekf == replace(b.ekf, error="body") and a.ekf.iterations == 1
        return "causal" if same and a.ekf.lines == "model" else None
    smoothers = x.name == "isam2" and y.name == "batch" and math.isinf(x.horizon_s)
    return "final" if smoothers and x.optimise_at_end else None


def largest_difference(one: SavedResult, other: SavedResult, kind: str) -> float:
    """Of ``kind`` poses of all robots, per coordinate, in its standard deviations in ``one``."""
    worst = 0.0
    for name, robot in one.robots.items():
        a, b = getattr(robot, kind), getattr(other.robots[name], kind)
        off = a.poses - b.poses
        off[:, 2] = wrap(off[:, 2])
        sigma = np.sqrt(np.diagonal(a.covs, axis1=1, axis2=2))
        known = np.isfinite(sigma) & (sigma > 0)
        worst = max(worst, float(np.max(np.abs(off[known]) / sigma[known], initial=0.0)))
    return worst
