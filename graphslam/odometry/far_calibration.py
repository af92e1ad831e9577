"""Calibrations of odometry that are far from their prior, by motions that scans contradict.

A robot that skids as it turns, or whose axle is configured wrongly, turns a third less than its
odometry says, by many sigmas of the prior, and scans contradict one turn after another. Each of
these may be a slip. Together they tell a calibration: the likeliest one if what it does not explain
are slips, which cost as much as a residual at the gate (a truncated quadratic: M. J. Black and
A. Rangarajan, DOI 10.1007/BF00131148).
"""

from typing import NamedTuple

import numpy as np

from graphslam.core.arrays import BoolArray
from graphslam.core.geometry import Array
from graphslam.core.motion_models import HELD_SIGMA, Calibration, of_odometry
from graphslam.core.record import replace
from graphslam.odometry.contradicted_motions import EXPLAINED_D2, ContradictedMotions, quadratic
from graphslam.odometry.online_noise import scaled

#: sigmas of the prior beyond which a parameter is far from it, and degrees of freedom of the prior
#: that is used there
FAR_SIGMAS, T_DOF = 3.0, 4.0
#: share of the motions beyond noise which a calibration has to explain: otherwise noise is larger
#: than it is known to be, and any calibration explains some
LEAST_EXPLAINED = 0.5
#: motions by which the calibration is tried that explains each, spread over all; by how much such
#: a motion counts more than it tells; and steps from the best of these to the likeliest
TRIALS, CERTAINTY, ROUNDS = 50, 100.0, 10
#: odometry measures at most ten times, and at least a tenth of the motion
LEAST_SCALE = 0.1


class Explanation(NamedTuple):
    """Which motions (n,) a calibration explains, and what these tell about its p parameters.

    ``information`` (p, p), ``vector`` (p,) that times the mean.
    """

    used: BoolArray
    information: Array
    vector: Array


def explain(
    motions: ContradictedMotions, information: Array, mean: Array, prior: Calibration
) -> Explanation | None:
    """The likeliest calibration, if that is one far from its prior that explains most motions.

    Only the odometry's own parameters are: where mounts and latencies seem to be far from what is
    stated, stamps or scans are wrong.

    Args:
        motions: that scans contradict.
        information: (p, p) about the parameters, without these motions.
        mean: (p,) of the parameters, by that.
        prior: before any data.
    """
    sigma = np.sqrt(np.diag(prior.cov))
    of_own = np.flatnonzero(of_odometry(prior))
    free = np.flatnonzero(sigma[of_own] > HELD_SIGMA)
    if not len(motions.miss) or not len(free):
        return None
    own = of_own[free]
    scales = _Scales(np.array([prior.names[k].endswith("_scale") for k in own]))
    J = scales.slope(mean[own])
    problem = _Problem(
        motions.miss,
        motions.d_cal[:, :, free],
        motions.information,
        scales.of(mean[own]),
        information[np.ix_(own, own)] / np.outer(J, J),
    )
    found, used = problem.likeliest()
    value = scales.inverse(found)
    is_far = np.abs(value - prior.mean[own]) > FAR_SIGMAS * sigma[own]
    beyond_noise = problem.misfits(np.zeros(len(own))) > EXPLAINED_D2
    if not is_far.any() or used[beyond_noise].sum() <= LEAST_EXPLAINED * beyond_noise.sum():
        return None
    J = scales.slope(value)
    about, vector = problem.told(used)
    result = Explanation(used, np.zeros(prior.cov.shape), np.zeros(len(sigma)))
    result.information[np.ix_(own, own)] = J[:, None] * about * J
    result.vector[own] = J * (about @ (J * value) + vector - about @ found)
    return result


def widened(prior: Calibration, found: Calibration) -> Calibration:
    """The prior, of a width by which the calibration found may be.

    A parameter of the odometry that is found beyond `FAR_SIGMAS` is no tail of a normal
    distribution: the robot skids as it turns, or is configured wrongly. Its prior is then Student's
    t of `T_DOF` degrees of freedom, as the normal distribution with the same pull at the value
    found (K. L. Lange, R. J. A. Little and J. M. G. Taylor, DOI 10.1080/01621459.1989.10478852).
    """
    off = (found.mean - prior.mean) ** 2 / np.maximum(np.diag(prior.cov), HELD_SIGMA**2)
    is_far = (off > FAR_SIGMAS**2) & of_odometry(prior)
    wider = np.where(is_far, (T_DOF + off) / (T_DOF + 1.0), 1.0)
    return replace(prior, cov=scaled(prior.cov, wider))


def far_from_prior(
    prior: Calibration, begun: Calibration, found: Calibration
) -> Calibration | None:
    """A calibration found, to begin with when a log is read again; None if near its prior.

    It was found among associations that were made with another. As likely as not some are wrong, so
    it is known no better than to a third of what it moved by.

    Args:
        prior: before any data.
        begun: what the log was read with.
        found: in the solution.
    """
    sigma = np.maximum(np.sqrt(np.diag(prior.cov)), HELD_SIGMA)
    is_far = (np.abs(found.mean - prior.mean) > FAR_SIGMAS * sigma) & of_odometry(prior)
    if not is_far.any():
        return None
    moved = found.mean - begun.mean
    return replace(found, cov=found.cov + np.diag(is_far * (moved / 3) ** 2))


class _Problem(NamedTuple):
    """Linear measurements of k parameters, of which some are wrong.

    ``miss`` (n, 3) are measured, with derivatives (n, 3, k) and information (n, 3, 3). Without them
    the parameters have a ``mean`` (k,) with ``known`` information (k, k).
    """

    miss: Array
    derivative: Array
    information: Array
    mean: Array
    known: Array

    def misfits(self, at: Array) -> Array:
        """Squared Mahalanobis distances (..., n) with parameters (..., k)."""
        explained = (self.derivative @ at[..., None, :, None])[..., 0]
        return quadratic(self.miss - explained, self.information)

    def told(self, which: BoolArray) -> tuple[Array, Array]:
        """Information (k, k) in some measurements, and that times the mean (k,)."""
        infos, vectors = self._each()
        return infos[which].sum(axis=0), vectors[which].sum(axis=0)

    def _each(self) -> tuple[Array, Array]:
        weighted = self.derivative.mT @ self.information
        return weighted @ self.derivative, (weighted @ self.miss[:, :, None])[:, :, 0]

    def likeliest(self) -> tuple[Array, BoolArray]:
        """The parameters (k,) of the least truncated squares, and which measurements agree."""
        infos, vectors = self._each()
        vector = self.known @ self.mean
        some = np.unique(np.linspace(0, len(self.miss) - 1, TRIALS).astype(int))
        exact = self.known + CERTAINTY * infos[some], vector + CERTAINTY * vectors[some]
        tried = np.linalg.solve(exact[0], exact[1][:, :, None])[:, :, 0]
        tried = np.concatenate([self.mean[None], tried])
        off = tried - self.mean
        costs = np.einsum("ni,ij,nj->n", off, self.known, off)
        costs += np.minimum(self.misfits(tried), EXPLAINED_D2).sum(axis=1)
        found = tried[np.argmin(costs)]
        used = self.misfits(found) <= EXPLAINED_D2
        for _ in range(ROUNDS):
            more, told = infos[used].sum(axis=0), vectors[used].sum(axis=0)
            found, before = np.linalg.solve(self.known + more, vector + told), used
            used = self.misfits(found) <= EXPLAINED_D2
            if np.array_equal(used, before):
                break
        return found, used


class _Scales(NamedTuple):
    """Parameters (k,) such that odometry is linear in them at the true motion.

    Odometry that has to be multiplied by 1 + c measures 1 / (1 + c) = 1 - u of the motion. The
    errors of odometry are large, those of scans are not: with c, and the motion as measured, noise
    alone would be explained best by a scale of -1. ``are`` (k,): which parameters are such scales.
    """

    are: BoolArray

    def of(self, c: Array) -> Array:
        """Their u."""
        return np.where(self.are, c / np.maximum(1.0 + c, LEAST_SCALE), c)

    def inverse(self, u: Array) -> Array:
        """Their c."""
        return np.where(self.are, u / np.maximum(1.0 - u, LEAST_SCALE), u)

    def slope(self, c: Array) -> Array:
        """Derivative of u by c."""
        return np.where(self.are, np.maximum(1.0 + c, LEAST_SCALE) ** -2, 1.0)
