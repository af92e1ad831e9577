"""What is made of a log of a batch: a result folder, or a comparison of back ends."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from graphslam.campaigns.one_log import MAP, LogTask, Row, do_log
from graphslam.campaigns.tasks import forget_peak_memory
from graphslam.core.config import Config
from graphslam.core.errors import OutputError
from graphslam.core.records import Result, Step
from graphslam.evaluation.compare_backends import compare
from graphslam.evaluation.compare_folder import failed_backends, save_comparison
from graphslam.evaluation.compare_variants import parse_variants
from graphslam.evaluation.ground_truth import errors_of_run, truth_of_logs
from graphslam.evaluation.timed_replay import TimedReplay, timed_replay
from graphslam.logs import open_logs
from graphslam.results.folder import save
from graphslam.results.known_map_file import known_map_files, known_map_of
from graphslam.results.report import render
from graphslam.results.small_map import draw, small_map
from graphslam.slam.smooth import smooth


def work_on_log(task: LogTask) -> Row:
    """Smooth a log, or compare back ends on it; see `do_log`."""
    return do_log(task, _compare if task.backends else _smooth)


def _smooth(task: LogTask, folder: Path) -> Row:
    """Write a result folder with a small map.

    Raises:
        OutputError: the known map is no longer that which the row would name.
    """
    log = open_logs([Path(task.path)], task.config)
    known_map = known_map_of(task.config)
    if known_map is not None and known_map.sha256 != task.known_map:
        folder_of_map = task.config.known_map.directory
        raise OutputError(f"{folder_of_map}: has changed since the batch began; call it again")
    result = smooth(log, task.config, known_map=known_map)
    errors = errors_of_run(result, truth_of_logs(log))
    report = render(result, errors)
    more = known_map_files(result, known_map)
    save(result, folder, more, force=False, report=lambda _result: report)
    (folder / MAP).write_text(small_map(result), encoding="utf-8")
    return _figures(result, errors)


def _compare(task: LogTask, folder: Path) -> Row:
    """Write the folder of a comparison with a small map of the reference's path."""
    log = open_logs([Path(task.path)], task.config)
    variants = parse_variants(task.backends, task.config)
    truth = truth_of_logs(log)
    comparison = compare(log, task.config, variants, task.mode, truth=truth, run=_replay)
    save_comparison(comparison, task.config, folder, force=False)
    found = comparison.summary
    paths = next(
        lane.paths["final"] for lane in comparison.backends if lane.spec == found["reference"]
    )
    drawn = {name: path.poses[:, :2] for name, path in paths.items()}
    (folder / MAP).write_text(draw(drawn, ()), encoding="utf-8")
    return {
        "error": failed_backends(found) or None,  # the folder holds the others
        "robots": sorted(log.robots),
        "warnings": list(found["warnings"]),
        "reference": found["reference"],
        "backends": {row["spec"]: _backend(row) for row in found["rows"]},
    }


def _replay(steps: Sequence[Step], config: Config) -> TimedReplay:
    """A replay in this worker, which may have no children; its peak memory begins anew."""
    forget_peak_memory()
    return timed_replay(steps, config)


def _backend(row: Mapping[str, Any]) -> Row:
    """What the overview says of a back end on a log."""
    final, causal = ((row.get("joint") or {}).get(kind) or {} for kind in ("final", "causal"))
    return {
        "label": row["label"],
        "error": row["error"],
        "error_m": final.get("ate_aligned_rmse_m"),
        "causal_error_m": causal.get("ate_aligned_rmse_m"),
        "nees_per_dof": final.get("nees_per_dof"),
        "difference_m": ((row.get("difference") or {}).get("final") or {}).get("rmse_m"),
        "total_s": row.get("total_s"),
        "memory_mb": (row.get("memory_mb") or {}).get("peak"),
    }


def _figures(result: Result, errors: Mapping[str, Any] | None) -> Row:
    """The numbers of the overview."""
    summary = result.summary
    states = result.estimate.states.values()
    spans = [p.stamps_ns[[0, -1]] for p in states if len(p.stamps_ns)]
    covs = np.concatenate([robot.final.covs[:, :2, :2] for robot in result.robots.values()])
    covs = covs[np.isfinite(covs).all(axis=(1, 2))]
    sigmas = np.sqrt(np.maximum(np.linalg.eigvalsh(covs)[:, -1], 0.0))
    final = ((errors or {}).get("joint") or {}).get("final") or {}
    return {
        "verdict": summary["verdict"]["verdict"],
        "reasons": [reason["text"] for reason in summary["verdict"]["reasons"]],
        "robots": sorted(result.robots),
        "length_m": round(sum(robot.driven_m for robot in result.robots.values()), 3),
        "duration_s": round(1e-9 * float(max(s[1] for s in spans) - min(s[0] for s in spans)), 3),
        "error_m": final.get("ate_aligned_rmse_m"),
        "sigma_m": float(np.median(sigmas)) if len(sigmas) else None,
        "loops": summary["counts"]["loop_closures"],
        "warnings": list(summary["warnings"]),
        "messages": summary["counts"]["messages"],
        "scans": summary["counts"]["scans"],
        "landmarks": len(result.landmarks),
        "memory_mb": summary["peak_memory_mb"],
    }
