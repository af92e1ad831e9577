"""The estimators, all behind one interface; `BACKENDS` is the table to extend."""

import math
from collections.abc import Callable

from graphslam.core.config import Config
from graphslam.estimation.backend import Backend, Joint
from graphslam.estimation.compressed_filter import BatchBackend, CompressedBackend
from graphslam.estimation.dead_reckoning import DeadReckoningBackend
from graphslam.estimation.decentralised import DecentralisedBackend
from graphslam.estimation.ekf import EkfBackend
from graphslam.estimation.factor_ekf import FactorEkfBackend
from graphslam.estimation.fixed_lag import FixedLagBackend
from graphslam.estimation.invariant_ekf import InvariantEkfBackend
from graphslam.estimation.rbpf import RbpfBackend


def with_horizon(config: Config) -> Backend:
    """The estimator of `isam2` with the configured horizon.

    All of the past, a window of it, or none: see the modules. Horizon 0 is no limit of the window,
    which takes a step's factors together and keeps one place for the Jacobians of each variable.
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
    "invariant-ekf": InvariantEkfBackend,
    "isam2": with_horizon,
    "rbpf": RbpfBackend,
}

__all__ = ["BACKENDS", "Backend", "Joint"]
