"""One run on the bench: the drawn steps through one estimator, evaluated against the truth."""

from typing import Any

import numpy as np

from graphslam.core.config import Config
from graphslam.core.geometry import Array, wrap
from graphslam.core.records import Estimate
from graphslam.estimation.backend import Backend
from graphslam.estimation.backends import BACKENDS
from graphslam.estimation.decentralised import exchanged_bytes, landmark_ties
from graphslam.evaluation.monte_carlo_bench import STEP_NS, BenchRun
from graphslam.evaluation.monte_carlo_consistency import (
    joint_errors,
    joint_nees,
    landmark_squares,
)
from graphslam.evaluation.monte_carlo_paths import path_columns


def run_bench(run: BenchRun, config: Config) -> dict[str, Any]:
    """Errors and NEES of an estimator on a run, as plain numbers for a row of results.jsonl.

    ``nees`` of the final joint state with ``dof`` degrees of freedom: the robots' latest poses and
    all landmarks, at the final estimate. ``final`` and ``causal``: mean over the robots of squared
    errors at each step (K+1,), position m² and heading rad²; ``causal.nees`` of the robots' latest
    poses together, 3 degrees of freedom each. ``landmarks``: mean squares of the final map.
    ``end``: final poses at the last step; ``paths``: final and true positions at all of them, see
    `graphslam.evaluation.monte_carlo_paths.path_columns`. ``error_frame``: the frame of the errors.
    ``exchanged``, of robots that send messages: bytes per robot, ``sent`` and as ``measured``;
    ``ties``: how they associated landmarks, if each has names of its own.

    Raises:
        EstimationError: the estimate is indeterminate.
    """
    backend = BACKENDS[config.backend.name](config)
    causal: dict[str, Any] = {name: [] for name in ("nees", "position_m2", "heading_rad2")}
    for k, step in enumerate(run.steps):
        backend.add(step)
        errors, nees = _latest(backend, run, k)
        causal["nees"].append(nees)
        _append_squares(causal, errors[:, None])
    estimate = backend.finish()
    nees, dof = _joint(backend, run, estimate)
    truth = np.array(list(run.truth.values()))
    poses = np.array([estimate.states[name].poses for name in run.truth])
    final: dict[str, Any] = {"position_m2": [], "heading_rad2": []}
    _append_squares(final, poses - truth)
    return {
        "error_frame": backend.error_frame,
        "dof": dof,
        "nees": nees,
        "final": final,
        "causal": causal,
        "landmarks": landmark_squares(estimate.landmarks, run.landmarks),
        "end": poses[:, -1].tolist(),
        "paths": {
            name: path_columns(np.arange(len(run.steps)) * STEP_NS / 1e9, own, true)
            for name, own, true in zip(run.truth, poses, truth, strict=True)
        },
        **_exchanged(backend),
    }


def _exchanged(backend: Backend) -> dict[str, Any]:
    """Bytes per robot and ties of landmarks, see `run_bench`; empty where nothing is sent."""
    found, ties = exchanged_bytes(backend), landmark_ties(backend)
    if found is None:
        return {}
    sent, measured = (sum(one.values()) / len(one) for one in found)
    exchanged = {"exchanged": {"sent": sent, "measured": measured}}
    return exchanged if ties is None else {**exchanged, "ties": ties}


def _append_squares(curves: dict[str, Any], errors: Array) -> None:
    """Append squares of errors (robots, steps, 3), averaged over the robots."""
    curves["position_m2"] += np.square(errors[..., :2]).sum(axis=2).mean(axis=0).tolist()
    curves["heading_rad2"] += np.square(wrap(errors[..., 2])).mean(axis=0).tolist()


def _latest(backend: Backend, run: BenchRun, k: int) -> tuple[Array, float]:
    """Additive errors (robots, 3) of the latest poses, and the NEES of all together."""
    first, *others = run.truth
    joint = backend.joint(first, [], others)
    truth = [run.truth[name][k] for name in run.truth]
    errors, cov = joint_errors(joint, truth[0], [], truth[1:], backend.error_frame)
    return np.array([joint.pose, *joint.others]) - np.array(truth), joint_nees(errors, cov)


def _joint(backend: Backend, run: BenchRun, estimate: Estimate) -> tuple[float, int]:
    """NEES and degrees of freedom of the final joint state."""
    first, *others = run.truth
    ids = sorted(estimate.landmarks)
    errors, cov = joint_errors(
        backend.joint(first, ids, others),
        run.truth[first][-1],
        [run.landmarks[i] for i in ids],
        [run.truth[name][-1] for name in others],
        backend.error_frame,
    )
    return joint_nees(errors, cov), len(errors)
