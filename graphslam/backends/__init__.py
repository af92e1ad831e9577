"""The estimators, all behind one interface; `BACKENDS` is the table to extend."""

from collections.abc import Callable

from graphslam.backends.base import Backend, Joint
from graphslam.backends.dead_reckoning import DeadReckoningBackend
from graphslam.backends.isam2 import BatchBackend, Isam2Backend
from graphslam.config import Config

#: name -> estimator
BACKENDS: dict[str, Callable[[Config], Backend]] = {
    "batch": BatchBackend,
    "dead-reckoning": DeadReckoningBackend,
    "isam2": Isam2Backend,
}

__all__ = ["BACKENDS", "Backend", "Joint"]
