"""Covariances of an estimate whose sightings share errors and are weighed by less than these."""

import numpy as np

from graphslam.core.config import RobustConfig
from graphslam.core.geometry import compose, rotation3
from graphslam.core.motion_models import Calibration
from graphslam.core.records import Association, Estimate, Motion, Start, Step, Trajectory
from graphslam.estimation.calibration_graph import CalibrationGraph
from graphslam.estimation.recorded_graph import SHARED_NS, ObservationNoise
from graphslam.estimation.sandwich_covariance import (
    SAMPLE,
    covariance_factors,
    weighing_variance,
)

N, PER_SPAN = 24, 8
PERIOD_NS = SHARED_NS // PER_SPAN
POINTS = {1: np.array([1.0, 2.0]), 2: np.array([-1.0, 1.5]), 3: np.array([0.5, -1.0])}
SIGMA, SIGHTING = 0.004, np.array([0.02, 0.05])
WHITE, SHARED = np.array([0.1, 0.3]), np.array([0.9, 0.5])
SOURCE = ("r", "point")


def noise_of(shared):
    return {SOURCE: ObservationNoise(WHITE, shared, 2.0)}


def solved(shared):
    """The graph, its values and its estimate of a robot on an arc; sightings are without error."""
    weighed = weighing_variance(noise_of(shared)[SOURCE], np.array([PER_SPAN]))[0]
    true = [np.zeros(3)]
    for _ in range(N - 1):
        true.append(compose(true[-1], np.array([0.15, 0.0, 0.1])))
    steps = []
    for k, pose in enumerate(true):
        x, y = (
            rotation3(-pose[2])[:2, :2] @ (np.array(list(POINTS.values())) - pose[:2]).T
        ).tolist()
        seen = tuple(
            Association(
                "r", k * PERIOD_NS, n, "point", np.array([np.arctan2(b, a), np.hypot(a, b)]),
                np.diag(weighed * SIGHTING**2),
            )
            for n, a, b in zip(POINTS, x, y, strict=True)
        )  # fmt: skip
        starts = {"r": Start(pose, np.eye(3) * SIGMA**2)} if k == 0 else {}
        motions = {}
        if k:
            delta, cov = np.array([0.15, 0.0, 0.1]), SIGMA**2 * np.eye(3)
            begin, end = (k - 1) * PERIOD_NS, k * PERIOD_NS
            motions["r"] = Motion(begin, end, delta, cov, np.zeros((3, 0)), 0.15)
        steps.append(Step(k * PERIOD_NS, starts, motions, seen))
    states = Trajectory(PERIOD_NS * np.arange(N), np.array(true), np.full((N, 3, 3), np.nan))
    begin = Estimate({"r": states}, {n: (p, np.eye(2)) for n, p in POINTS.items()}, 0.0, 0)
    prior = {"r": Calibration((), np.zeros(0), np.zeros((0, 0)))}
    graph = CalibrationGraph(steps, begin, prior, prior, RobustConfig(kernel="none"))
    estimate, _ = graph.solve(1e-9, marginals=True)
    posterior = graph.posterior()
    return posterior.builder, posterior.values, estimate


def exact_factors(builder, values, shared):
    """Factors on the covariances of all states and landmarks, by the whole sandwich."""
    A, _ = builder.graph.linearize(values).jacobian()
    R = np.eye(len(A))
    seen = builder.bearings_and_ranges[SOURCE]
    first = len(A) - 2 * len(seen)
    span = [(a.target, a.time_ns // SHARED_NS) for *_, a in seen]
    total = WHITE + np.sqrt(PER_SPAN) * shared
    for i, one in enumerate(span):
        for j, other in enumerate(span):
            part = shared / total if one == other else np.zeros(2)
            at = np.ix_(first + 2 * i + np.arange(2), first + 2 * j + np.arange(2))
            R[at] = np.diag(part + (WHITE / total if i == j else 0.0))
    P = np.linalg.inv(A.T @ A)
    cov = P @ A.T @ R @ A @ P
    ratio = [np.trace(np.linalg.solve(P[s, s], cov[s, s])) for s in _blocks(len(P))]
    landmarks, states = ratio[: len(POINTS)], ratio[len(POINTS) :]
    return np.array(states) / 3, np.array(landmarks) / 2


def _blocks(width):
    """Places of landmarks and then states, which is the order of their keys."""
    ends = np.cumsum([2] * len(POINTS) + [3] * N)
    assert ends[-1] == width
    return [slice(end - (2 if k < len(POINTS) else 3), end) for k, end in enumerate(ends)]


def test_factors_are_those_of_the_whole_sandwich():
    """Breaks if errors are shared by others than the sightings of a span, if the rows of sightings
    are not the last of the graph, or if columns are taken for those of other variables."""
    builder, values, _ = solved(SHARED)
    found = covariance_factors(builder, values, noise_of(SHARED))
    states, landmarks = exact_factors(builder, values, SHARED)
    chosen = ((np.arange(SAMPLE) + 0.5) / SAMPLE * N).astype(int)
    assert states.mean() > 1.15  # else nothing is tested
    # the same products in another order
    np.testing.assert_allclose(found.states["r"], states[chosen].mean(), rtol=1e-6)
    np.testing.assert_allclose(found.landmarks, landmarks.mean(), rtol=1e-6)
    # what is said of all states by some: they are 0.96 to 1.45 along this path
    np.testing.assert_allclose(found.states["r"], states.mean(), rtol=0.1)


def test_white_noise_has_the_covariances_of_its_weights():
    """Breaks if weights and errors of sightings without a shared part differ."""
    nothing = np.zeros(2)
    builder, values, estimate = solved(nothing)
    found = covariance_factors(builder, values, noise_of(nothing))
    np.testing.assert_allclose([found.states["r"], found.landmarks], 1.0, rtol=1e-9)
    covs = found.applied_to(estimate).states["r"].covs
    np.testing.assert_allclose(covs, found.states["r"] * estimate.states["r"].covs)
