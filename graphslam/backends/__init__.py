"""The estimators, all behind one interface; `BACKENDS` is the table to extend."""

import math
from collections.abc import Callable

from graphslam.backends.base import Backend, Joint
from graphslam.backends.compressed import BatchBackend, CompressedBackend
from graphslam.backends.dead_reckoning import DeadReckoningBackend
from graphslam.backends.decentralised import DecentralisedBackend
from graphslam.backends.ekf import EkfBackend
from graphslam.backends.factor_ekf import FactorEkfBackend
from graphslam.backends.fixed_lag import FixedLagBackend
from graphslam.backends.invariant_ekf import InvariantEkfBackend
from graphslam.backends.rbpf import RbpfBackend
from graphslam.config import Config


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
