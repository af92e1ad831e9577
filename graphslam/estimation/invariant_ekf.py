"""The extended Kalman filter with right-invariant errors: heading stays unobservable where it is.

With additive errors, the direction of a turn of the whole world depends on the estimates of the
landmarks. These change from update to update, so the filter gains information about a turn that was
never observed. With the errors of A. Barrau and S. Bonnabel (IEEE TAC 62(4), 2017,
https://doi.org/10.1109/TAC.2016.2594085; for SLAM https://arxiv.org/abs/1510.06263) that direction
is the same at every estimate, and what is unobservable stays so.

A pose (p, phi) has the error xi = (u, omega) with truth = exp(xi) estimate, a turn about the
world's origin. A point shares the omega of one robot, the one that saw it first. (With one robot
this is the group of a pose with many points; with several, a turn of the world is still the same
omega in all.) To first order ``dp = u + omega J p`` with J the quarter turn, so u is
``dp - omega J p``. A filter with additive errors becomes this one by two changes, both in
`_apply_correction`: the correction goes through exp, and since it is u whose covariance is kept,
dp becomes ``dp + omega J (new p - old p)``.
"""

from dataclasses import replace

import numpy as np

from graphslam.core.config import Config
from graphslam.core.errors import ConfigError
from graphslam.core.geometry import Array, compose, exp, wrap
from graphslam.core.observation_models import MODELS
from graphslam.core.records import Association
from graphslam.estimation.ekf import EkfBackend
from graphslam.estimation.filter_base import Member


class InvariantEkfBackend(EkfBackend):
    """The filter; `ekf.error` does not apply.

    The covariance that it keeps and returns is of additive errors along world axes, which equal its
    own errors to first order.
    """

    def __init__(self, config: Config) -> None:
        """Raise ConfigError for more than one iteration: `EkfBackend` iterates additive errors."""
        if config.ekf.iterations != 1:
            raise ConfigError("ekf.iterations: the invariant filter linearises once; leave it at 1")
        super().__init__(replace(config, ekf=replace(config.ekf, error="world")))
        self._anchor: dict[int, str] = {}  # point -> the robot whose heading error it shares

    def _augment(self, seen: Association, source: Member) -> None:
        super()._augment(seen, source)
        if isinstance(seen.target, int) and MODELS[seen.model].dim == 2:
            self._anchor[seen.target] = seen.robot

    def _apply_correction(self, d: Array) -> None:
        """Apply additive errors (n,) to all means by exp, and transform the covariance."""
        gaussian = self._gaussian
        x, P = gaussian.x, gaussian.P
        poses, points = gaussian.blocks(3), gaussian.blocks(2)
        anchors = [
            gaussian.slot(self._anchor[name]).start + 2
            for name in gaussian
            if isinstance(name, int) and name in self._anchor
        ]
        positions = np.concatenate([poses[:, :2], points])
        headings = np.concatenate([poses[:, 2], np.array(anchors, dtype=np.int64)])
        p, omega = x[positions], d[headings, None]
        u = d[positions] - omega * _quarter_turn(p)
        x[positions] = compose(exp(np.hstack([u, omega])), np.pad(p, ((0, 0), (0, 1))))[:, :2]
        x[poses[:, 2]] = wrap(x[poses[:, 2]] + d[poses[:, 2]])
        # each error gains ``lever`` times the error ``turn``: P becomes (I + L) P (I + L)ᵀ
        lever, turn = np.zeros(len(x)), np.arange(len(x))
        lever[positions], turn[positions] = _quarter_turn(x[positions] - p), headings[:, None]
        PL = lever * P[turn].T
        P += PL + PL.T + np.outer(lever, lever) * P[np.ix_(turn, turn)]


def _quarter_turn(p: Array) -> Array:
    """Vectors (n, 2) turned by a right angle, counter-clockwise: J p."""
    return np.stack([-p[:, 1], p[:, 0]], axis=-1)
