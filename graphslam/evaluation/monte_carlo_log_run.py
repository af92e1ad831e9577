"""One run over a simulated log: simulate, smooth, evaluate."""

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType
from typing import Any

import numpy as np

from graphslam.core.config import Config, StartConfig
from graphslam.core.errors import GraphSlamError
from graphslam.core.records import Result, Trajectory
from graphslam.evaluation.ground_truth import truth_of_logs
from graphslam.evaluation.metrics import evaluate, robots_in_own_frame
from graphslam.evaluation.monte_carlo_paths import path_columns
from graphslam.evaluation.trajectory_metrics import pair_poses
from graphslam.logs import LogSet, open_logs
from graphslam.pipeline.start_priors import first_truth
from graphslam.simulation import load_scenario, simulate
from graphslam.simulation.scenario import Scenario
from graphslam.slam.smooth import smooth

#: keys of scenarios that a noise scale multiplies: all errors of the sensors
NOISE = {
    "axle_error",
    "bearing_sigma_deg",
    "bias_sigma_m",
    "direction_sigma_deg",
    "radius_error_left",
    "radius_error_right",
    "range_sigma_m",
    "range_sigma_ratio",
    "slip_m",
}


def scale_noise(scenario: Scenario, scale: float) -> Scenario:
    """The scenario with all errors of its sensors multiplied by ``scale``."""
    result: Scenario = _scaled(scenario, scale)
    return result


def _scaled(node: Any, scale: float) -> Any:
    if is_dataclass(node) and not isinstance(node, type):
        changed = {
            f.name: scale * value if f.name in NOISE else _scaled(value, scale)
            for f in fields(node)
            for value in [getattr(node, f.name)]
        }
        return replace(node, **changed)
    if isinstance(node, Mapping):
        return MappingProxyType({key: _scaled(value, scale) for key, value in node.items()})
    if isinstance(node, tuple):
        return tuple(_scaled(value, scale) for value in node)
    return node


def run_log(
    scenario: str, scale: float, seed: int, config: Config, *, draw_starts: bool = False
) -> dict[str, Any]:
    """Errors of the pipeline on a simulated log, as plain numbers for a row of results.jsonl.

    Keys as in ``evaluate --json``, and ``counts``, ``scans_per_s`` and ``warnings`` of the summary;
    ``paths`` of the robots, see `graphslam.evaluation.monte_carlo_paths.path_columns`.
    Every robot starts at its true pose, with the configured sigma of a start from truth; with
    ``draw_starts`` off it by an error drawn from that prior.

    Raises:
        GraphSlamError: simulating, smoothing or evaluating failed.
    """
    with scratch_folder() as folder:
        path = folder / "log.mcap"
        simulate(scale_noise(load_scenario(scenario), scale), path, seed)
        config = replace(
            config,
            start=replace(config.start, from_truth=True),
            backend=replace(config.backend, causal=True),
        )
        log = open_logs([path], config)
        if draw_starts:
            config = replace(config, start=drawn_starts(log, config.start, seed))
        result = smooth(log, config)
        known = truth_of_logs(log)
    found = evaluate(result, known.trajectories, known.landmarks)
    kept = {key: result.summary.get(key) for key in ("counts", "scans_per_s")}
    warnings = [_without(folder, text) for text in result.summary.get("warnings", ())]
    return {**found, **kept, "warnings": warnings, "paths": _paths(result, known.trajectories)}


def _paths(result: Result, truth: Mapping[str, Trajectory]) -> dict[str, Any]:
    """Final positions of robots in the world frame, beside the true ones."""
    own_frame, found = robots_in_own_frame(result.summary), {}
    for name in sorted(set(result.robots) & set(truth) - own_frame):
        pairs = pair_poses(result.robots[name].final, truth[name])
        if len(pairs):
            seconds = (pairs.stamps_ns - pairs.stamps_ns[0]) / 1e9
            found[name] = path_columns(seconds, pairs.estimate, pairs.truth)
    return found


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """A temporary folder that errors do not name: a row is the same wherever and whenever made."""
    with TemporaryDirectory(prefix="graphslam-") as folder:
        try:
            yield Path(folder)
        except GraphSlamError as error:
            error.args = (_without(Path(folder), str(error)),)
            raise


def _without(folder: Path, text: str) -> str:
    return text.replace(f"{folder}{os.sep}", "")


def drawn_starts(log: LogSet, start: StartConfig, seed: int) -> StartConfig:
    """Starts off the true ones by errors drawn from the prior of a start from truth.

    Raises:
        EstimationError: a robot has no truth near its first odometry.
    """
    rng = np.random.default_rng(np.random.SeedSequence([seed, 1]))  # not what the sensors drew
    sigmas = np.array([start.truth_sigma_m, start.truth_sigma_m, start.truth_sigma_rad])
    poses = {
        robot: tuple((pose + sigmas * rng.normal(size=3)).tolist())
        for robot, pose in sorted(first_truth(log).items())
    }
    return replace(
        start,
        from_truth=False,
        poses=poses,
        given_sigma_m=start.truth_sigma_m,
        given_sigma_rad=start.truth_sigma_rad,
    )
