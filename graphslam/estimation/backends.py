"""The table of estimators by name, `BACKENDS`: the place to register another one."""

import math
from collections.abc import Callable

from graphslam.core.config import Config
from graphslam.estimation.backend import Backend
from graphslam.estimation.compressed_filter import BatchBackend, CompressedBackend
from graphslam.estimation.dead_reckoning import DeadReckoningBackend
from graphslam.estimation.decentralised import DecentralisedBackend
from graphslam.estimation.ekf import EkfBackend
from graphslam.estimation.factor_ekf import FactorEkfBackend
from graphslam.estimation.fixed_lag import FixedLagBackend
from graphslam.estimation.imm import ImmBackend
from graphslam.estimation.invariant_ekf import InvariantEkfBackend
from graphslam.estimation.rbpf import RbpfBackend


def isam2_with_horizon(config: Config) -> Backend:
    """The estimator for the configured horizon: full smoothing, fixed lag, or a filter.

    Horizon 0 is not the limit of the fixed-lag smoother, which adds a step's factors together and
    keeps one linearisation point for the Jacobians of each variable.
    """
    if config.backend.horizon_s == 0:
        return FactorEkfBackend(config)
    if math.isinf(config.backend.horizon_s):
        return CompressedBackend(config)
    return FixedLagBackend(config)


#: name -> estimator
BACKENDS: dict[str, Callable[[Config], Backend]] = {
    "batch": BatchBackend,
    "dead-reckoning": DeadReckoningBackend,
    "decentralised": DecentralisedBackend,
    "ekf": EkfBackend,
    "imm": ImmBackend,
    "invariant-ekf": InvariantEkfBackend,
    "isam2": isam2_with_horizon,
    "rbpf": RbpfBackend,
}

__all__ = ["BACKENDS", "Backend"]
