"""How far sightings of robots are from a solution that does not contain them.

A sighting that is in the graph has pulled the estimate towards itself. Of a linear estimate it can
be taken out again without another solution: with innovation r, H P Hᵀ and the weighted information
W of the sighting, the estimate without it has the innovation (1 - H P Hᵀ W)⁻¹ r and the covariance
(1 - H P Hᵀ W)⁻¹ H P Hᵀ (leave-one-out; R. D. Cook, Detection of influential observation in linear
regression, Technometrics 19, 1977, DOI 10.1080/00401706.1977.10489493).
"""

from collections.abc import Mapping, Sequence

import gtsam
import numpy as np

from graphslam.core.config import RobustConfig
from graphslam.core.gaussian import mahalanobis_squared
from graphslam.core.geometry import Array, rotation3
from graphslam.core.observation_models import MODELS
from graphslam.core.records import Association, Estimate, Step
from graphslam.estimation import factors
from graphslam.estimation.m_estimators import WEIGHTS
from graphslam.estimation.optimisation import marginals_of
from graphslam.estimation.recorded_graph import RecordedGraph

#: share of its noise that a sighting must leave in its residual, for the rest to say anything
MIN_REDUNDANCY = 0.02


def robot_distances(
    steps: Sequence[Step],
    offers: Sequence[tuple[int, Association]],
    is_used: Sequence[bool],
    estimate: Estimate,
    kernel: RobustConfig,
    floor: Mapping[str, Array],
) -> Array:
    """Squared Mahalanobis distances (n,) of sightings of robots from all else.

    A sighting by which alone two parts of the graph hang together has distance 0.

    Args:
        steps: of the solution.
        offers: time of its step and association, of each.
        is_used: whether it is among ``steps``.
        estimate: the solution.
        kernel: of its observations.
        floor: model -> covariance (rows, rows) added to the innovation, for what the models leave
            out.

    Raises:
        EstimationError: the steps make the estimate indeterminate.
    """
    builder, values = RecordedGraph(kernel), gtsam.Values()
    builder.insert_all(steps, estimate, values)
    builder.rebuild_lines(values)
    number = builder.states.number
    pairs = [
        (
            builder.state_key(a.robot, number(a.robot, a.time_ns)),
            builder.state_key(str(a.target), number(str(a.target), time_ns)),
        )
        for time_ns, a in offers
    ]
    try:
        used, unused = (
            [pair for pair, own in zip(pairs, is_used, strict=True) if bool(own) is of]
            for of in (True, False)
        )
        blocks = marginals_of(builder.graph, values, used, unused, use_qr=builder.is_wide)
    except RuntimeError as error:
        raise builder.explain(error) from error
    d2 = np.zeros(len(offers))
    for name in sorted({a.model for _, a in offers}):
        which = [n for n, (_, a) in enumerate(offers) if a.model == name]
        P = np.array([blocks.joint[pairs[n]] for n in which])
        x, t = (np.array([factors.read(values, pairs[n][end], 3) for n in which]) for end in (0, 1))
        z, cov = (np.array([getattr(offers[n][1], of) for n in which]) for of in ("z", "cov"))
        model = MODELS[name]
        H_x, H_t = model.jacobians(z, x, t)
        H = np.concatenate([H_x @ rotation3(x[:, 2]), H_t @ rotation3(t[:, 2])], axis=2)
        r, R = model.residual(z, x, t), model.noise(z, cov, x, t)
        size = np.sqrt(mahalanobis_squared(r, R)).tolist()
        weight = np.array([WEIGHTS[kernel.kernel](own, kernel.scale) for own in size])
        weight *= np.array([is_used[n] for n in which])
        d2[which] = _left_out(r, R, H @ P @ H.mT, weight, floor[name])
    return d2


def _left_out(r: Array, R: Array, absorbed: Array, weight: Array, floor: Array) -> Array:
    """Squared distances (n,) of residuals from estimates without their measurements.

    Args:
        r: residuals (n, k).
        R: covariances (n, k, k) of the measurements.
        absorbed: (n, k, k) of what the estimate expects.
        weight: (n,) of the measurements in it.
        floor: (k, k) added to the covariances of the innovations.
    """
    left = np.eye(r.shape[1]) - weight[:, None, None] * absorbed @ np.linalg.inv(R)
    alone = np.abs(np.linalg.eigvals(left)).min(axis=1) < MIN_REDUNDANCY
    left[alone] = np.eye(r.shape[1])
    innovation = np.linalg.solve(left, r[:, :, None])[:, :, 0]
    S = np.linalg.solve(left, absorbed) + R + floor
    S = np.asarray(0.5 * (S + S.mT), dtype=np.float64)
    return np.where(alone, 0.0, mahalanobis_squared(np.asarray(innovation, dtype=np.float64), S))
