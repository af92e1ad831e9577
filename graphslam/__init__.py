"""Cooperative 2-D graph SLAM: robot logs in; trajectories, landmarks and covariances out.

This module is the public Python interface; what its names do is what the commands do::

    result = graphslam.smooth("drive.mcap", keyframe={"distance_m": 0.5}, output="result")
    errors = graphslam.evaluate(result)  # against the truth in the log

Everything else in the package is internal and may change with every version.

Settings are keywords with the names, checks and defaults of docs/configuration.md: a table as a
mapping (``keyframe={"mode": "all"}``), a dotted key (``**{"keyframe.mode": "all"}``), or for the
tables that have a ``name`` just that (``backend="ekf"``); ``preset="thesis"`` stands for those of a
preset, under all others. They go over ``config``, which is a `Config` or the path of a TOML file.
A wrong setting is a `ConfigError` that names its key.

Paths are strings or path objects. A ``recording`` is an MCAP file, a folder of rosbag2, a ``.db3``
or a ROS 1 bag, several of these that belong together, or what `open_logs` returned, whose settings
are then the default. With ``output`` a function also writes the folder that its command writes, and
replaces an existing one only with ``force``; what cannot be written is an `OutputError`.
``progress`` is called with the number of messages read so far and of all.

Matrices are small, and a linear algebra library that uses a thread per core for them takes up to
half as much time again. The commands tell it to use one; a script must do so itself, in the
environment (``OMP_NUM_THREADS=1``) or in ``os.environ`` before anything imports NumPy.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

if TYPE_CHECKING:
    from graphslam.change_detection import Change, ChangeResult
    from graphslam.core.config import Config
    from graphslam.core.errors import (
        ConfigError,
        EstimationError,
        GraphSlamError,
        LogError,
        OutputError,
    )
    from graphslam.core.records import (
        Estimate,
        Landmark,
        OdometryIncrement,
        OdometryPose,
        RelativePose,
        Result,
        RobotResult,
        Scan,
        Sighting,
        Trajectory,
        WheelAngles,
    )
    from graphslam.evaluation.relation_metrics import Relations
    from graphslam.live.follow import follow
    from graphslam.live.live_pass import LiveEstimate
    from graphslam.live.session import Session
    from graphslam.logs import GroundTruth, LogSet, LogWriter
    from graphslam.results.folder import SavedResult
    from graphslam.results.map_files import MapFiles
    from graphslam.results.report_comparison import Comparison
    from graphslam.simulation import Scenario, ScenarioError, Simulation

    PathLike: TypeAlias = str | os.PathLike[str]
    Recording: TypeAlias = PathLike | Sequence[PathLike] | LogSet
    Truth: TypeAlias = PathLike | Sequence[PathLike] | GroundTruth

__version__ = "0.1.0"

#: module -> the public names that it defines
_CLASSES = {
    "change_detection": ("Change", "ChangeResult"),
    "core.config": ("Config",),
    "core.errors": ("ConfigError", "EstimationError", "GraphSlamError", "LogError", "OutputError"),
    "core.records": (
        "Estimate",
        "Landmark",
        "OdometryIncrement",
        "OdometryPose",
        "RelativePose",
        "Result",
        "RobotResult",
        "Scan",
        "Sighting",
        "Trajectory",
        "WheelAngles",
    ),
    "evaluation.relation_metrics": ("Relations",),
    "live.follow": ("follow",),
    "live.live_pass": ("LiveEstimate",),
    "live.session": ("Session",),
    "logs": ("GroundTruth", "LogSet", "LogWriter"),
    "results.folder": ("SavedResult",),
    "results.map_files": ("MapFiles",),
    "results.report_comparison": ("Comparison",),
    "simulation": ("Scenario", "ScenarioError", "Simulation"),
}

__all__ = [
    "Change", "ChangeResult", "Comparison", "Config", "ConfigError", "Estimate", "EstimationError",
    "GraphSlamError", "GroundTruth", "Landmark", "LiveEstimate", "LogError", "LogSet", "LogWriter",
    "MapFiles", "OdometryIncrement", "OdometryPose", "OutputError", "Relations", "RelativePose",
    "Result", "RobotResult", "SavedResult", "Scan", "Scenario", "ScenarioError", "Session",
    "Sighting", "Simulation", "Trajectory", "WheelAngles", "__version__", "changes_between",
    "compare", "evaluate", "follow", "load_config", "load_result", "make_map", "open_logs",
    "simulate", "smooth", "write_viewer",
]  # fmt: skip

if not TYPE_CHECKING:  # a type checker would take every name for defined

    def __getattr__(name: str) -> Any:
        """A public name, imported when it is first used."""
        for module, names in _CLASSES.items():
            if name in names:
                return getattr(importlib.import_module(f"{__name__}.{module}"), name)
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def load_config(
    config: Config | PathLike | None = None, *, preset: str | None = None, **settings: Any
) -> Config:
    """The defaults, over them preset, TOML file, ``settings``; over a `Config` the other two.

    Raises:
        ConfigError: the file cannot be read, or a setting is wrong.
    """
    from graphslam.core.config_io import chosen_config

    return chosen_config(config, preset=preset, **settings)


def open_logs(
    paths: PathLike | Sequence[PathLike],
    /,
    *,
    config: Config | PathLike | None = None,
    **settings: Any,
) -> LogSet:
    """Open files or folders as one recording and find out what is in it.

    Raises:
        LogError: a file is missing, empty or of no known container, or holds nothing usable.
    """
    from graphslam.logs import open_logs
    from graphslam.slam.given_recording import paths_of

    return open_logs(paths_of(paths), load_config(config, **settings))


def smooth(
    recording: Recording,
    /,
    *,
    config: Config | PathLike | None = None,
    output: PathLike | None = None,
    force: bool = False,
    resume: bool = False,
    progress: Callable[[int, int], None] | None = None,
    **settings: Any,
) -> Result:
    """Estimate the trajectories of all robots and a landmark map: the main job.

    Arguments as in the module's docstring. The folder has a report, with a section on the errors
    where the logs hold the truth. ``resume``: keep every stage beside ``output`` until it is
    written, and go on with a run of the same logs and settings that was killed.

    Raises:
        LogError: a log cannot be read, or no message of it could be used.
        ConfigError: also where a setting is about a robot that is not in the log, or about the
            reading of logs that are open already.
        EstimationError: the estimate is indeterminate, or a robot's start is unknown.
    """
    from graphslam.core.memory_limit import limited_memory
    from graphslam.core.worker import Future
    from graphslam.pipeline.progress import of_all
    from graphslam.results.target_folder import check_target
    from graphslam.slam.given_recording import reading_ahead, settle

    settled = settle(recording, config, settings)
    before = None
    if output is not None:
        prior_map = settled.known_map.directory
        before = check_target(Path(output), force=force, known_map=prior_map)
    limit = limited_memory(settled.limits.memory_mb)
    with limit, reading_ahead(recording, settled) as (log, ahead):
        # imported while the second process reads
        from graphslam.core.stages import announce
        from graphslam.pipeline.checkpoint import checkpoint
        from graphslam.results.folder import save
        from graphslam.results.known_map_file import known_map_files, known_map_of
        from graphslam.slam.smooth import smooth

        if output is not None:  # for the processes that read the truth and draw the report
            from graphslam.evaluation.ground_truth import errors_of_run, truth_later
            from graphslam.results.report import render

        earlier = known_map_of(settled)

        with checkpoint(output, log, settled, earlier, resume=resume) as kept:
            truth = None if output is None else truth_later(log)
            result = smooth(log, settled, of_all(log, progress), None, ahead, kept, earlier)
            if settled.logs.same_place:
                from graphslam.change_detection.session_changes import with_session_changes

                result = with_session_changes(result)
            if output is not None and truth is not None:
                announce("report")
                errors = errors_of_run(result, truth.result())
                page = Future(partial(render, result, errors))
                more = known_map_files(result, earlier)
                save(
                    result, Path(output), more, force=force, before=before,
                    report=lambda _result: page.result(),
                )  # fmt: skip
            return result


def load_result(directory: PathLike) -> SavedResult:
    """Read a result folder back.

    Raises:
        OutputError: it is not a result folder, or a file of it is malformed.
        ConfigError: its config.toml is not valid.
    """
    from graphslam.results.folder import load

    return load(Path(directory))


def make_map(
    directory: PathLike,
    *,
    output: PathLike | None = None,
    resolution_m: float | None = None,
    mode: str = "trinary",
    force: bool = False,
) -> MapFiles:
    """Make a grid map, drawings of the line map and tables of a result folder.

    Args:
        directory: the result folder.
        output: the folder for the files; default: the result folder itself.
        resolution_m: edge of a cell of the grid map; default: as fine as the scans allow.
        mode: of the grid map, ``trinary`` or ``scale``, as map_server calls them.
        force: replace files that exist.

    Raises:
        OutputError: it is no result folder, a file exists, or nothing can be written there.
        ConfigError: the map would have too many cells of ``resolution_m``.
    """
    from graphslam.results.map_files import make_map

    target = Path(output or directory)
    return make_map(Path(directory), target, resolution_m=resolution_m, mode=mode, force=force)


def write_viewer(
    directory: PathLike, kind: str = "mcap", *, output: PathLike | None = None, force: bool = False
) -> list[str]:
    """Write a result for a viewer, ``mcap`` (Foxglove, Lichtblick, RViz) or ``rrd`` (Rerun).

    Returns the names of the files. Arguments as for `make_map`.

    Raises:
        OutputError: see `make_map`; also where rerun-sdk is missing.
        ValueError: an unknown kind.
    """
    from graphslam.results.viewers import write_viewer

    return write_viewer(Path(directory), kind, Path(output or directory), force=force)


def evaluate(
    result: Result | SavedResult | PathLike,
    *,
    truth: Truth | None = None,
    relations: Relations | PathLike | None = None,
) -> dict[str, Any]:
    """Errors and consistency of a result, in the shape of ``evaluate --json`` (docs/formats.md).

    Args:
        result: what `smooth` returned, or a result folder.
        truth: logs (``LOG.mcap``) or TUM files (``FILE.tum``, ``ROBOT=FILE.tum``) with true poses
            of the base; default, without ``relations``: the logs of the run.
        relations: file with reference relations between scans.

    Raises:
        OutputError: ``result`` is no result folder, a file cannot be read, or nothing in it can be
            compared.
        LogError: a log cannot be read, or none holds any truth.
    """
    from graphslam.evaluation.ground_truth import truth_given, truth_of_run
    from graphslam.evaluation.metrics import evaluate
    from graphslam.evaluation.relation_metrics import relations_given
    from graphslam.logs import GroundTruth

    if isinstance(result, str | os.PathLike):
        result = load_result(result)
    reference = relations_given(relations)
    if truth is not None:
        known = truth_given(truth, tuple(result.robots), result.config)
    else:
        known = truth_of_run(result) if reference is None else GroundTruth({}, ())
    return evaluate(result, known.trajectories, known.landmarks, reference)


def compare(
    recording: Recording,
    /,
    backends: str | Sequence[str] = ("ekf", "ekf+ekf.error=body", "isam2:0", "isam2", "batch"),
    *,
    mode: str = "replay",
    truth: Truth | None = None,
    relations: Relations | PathLike | None = None,
    config: Config | PathLike | None = None,
    output: PathLike | None = None,
    force: bool = False,
    progress: Callable[[int, int], None] | None = None,
    announce: Callable[[str], None] = lambda _text: None,
    **settings: Any,
) -> Comparison:
    """Compare back ends on one recording: errors, consistency, time, memory.

    Each back end runs in a process of its own, which is spawned: a script that calls this needs
    ``if __name__ == "__main__":``. A back end that fails has its error in its row.

    Args:
        recording: see the module, as ``config``, ``output``, ``force`` and ``progress``.
        backends: ``NAME[:HORIZON][+key=value...]`` each: ekf, isam2:20, ekf+ekf.error=body.
        mode: ``replay`` (the same recorded steps for all) or ``associate`` (each for itself).
        truth: as for `evaluate`; default: that in the logs, if any.
        relations: as for `evaluate`.
        announce: called with a line on what is done next.

    Raises:
        LogError: a log cannot be read, or no message of it could be used.
        ConfigError: also where a back end or the mode is unknown.
        EstimationError: the log cannot be associated, or every back end failed.
        OutputError: also where the truth is of other robots.
    """
    from graphslam.evaluation.compare_backends import compare
    from graphslam.evaluation.compare_folder import is_comparison, save_comparison
    from graphslam.evaluation.compare_variants import parse_variants
    from graphslam.evaluation.ground_truth import truth_given, truth_of_logs
    from graphslam.evaluation.relation_metrics import relations_given
    from graphslam.pipeline.progress import of_all
    from graphslam.results.target_folder import check_target
    from graphslam.slam.given_recording import opened, settle

    settled = settle(recording, config, settings)
    rows = parse_variants(backends.split(",") if isinstance(backends, str) else backends, settled)
    before = None
    if output is not None:
        before = check_target(Path(output), force=force, replaceable=is_comparison)
    log = opened(recording, settled)
    comparison = compare(
        log,
        settled,
        rows,
        mode,
        truth=truth_of_logs(log) if truth is None else truth_given(truth, log.robots, settled),
        relations=relations_given(relations),
        progress=of_all(log, progress),
        say=announce,
    )
    if output is not None:
        save_comparison(comparison, settled, Path(output), force=force, before=before)
    return comparison


def changes_between(
    reference: PathLike,
    later: PathLike,
    *,
    reference_span_s: tuple[float, float] | None = None,
    later_span_s: tuple[float, float] | None = None,
    config: Config | PathLike | None = None,
    output: PathLike | None = None,
    force: bool = False,
    **settings: Any,
) -> ChangeResult:
    """Find what changed between two visits, and how certain that is.

    Args:
        reference: result folder of the earlier visit.
        later: result folder of the later visit; it may be the same one, with two spans.
        reference_span_s: scans to use, s since the first one.
        later_span_s: the same of the later visit.

    The other arguments are described in the module's docstring; of the settings those of the table
    ``changes`` are used.

    Raises:
        OutputError: a folder is not a result, has no scans or covariances, or the two have nothing
            in common.
        LogError: a log is not where it was, or is another one now.
    """
    from graphslam.change_detection import changes_between, render_changes, save_changes
    from graphslam.change_detection.folder import check_changes_target

    chosen = load_config(config, **settings).changes
    before = None
    if output is not None:
        before = check_changes_target(Path(output), force=force)
    names = (Path(reference).name, Path(later).name)
    found = changes_between(Path(reference), Path(later), chosen, reference_span_s, later_span_s)
    if output is not None:
        page = partial(render_changes, config=chosen, names=names)
        save_changes(found, Path(output), force=force, report=page, before=before)
    return found


def simulate(
    scenario: Scenario | PathLike, output: PathLike, *, seed: int = 0, force: bool = False
) -> Simulation:
    """Write a simulated recording with its truth; equal scenarios and seeds give equal bytes.

    Args:
        scenario: the name of a scenario of the package, or a scenario file.
        output: the log; of a scenario with two visits, the folder for both.
        seed: of the noise.
        force: replace what is at ``output``.

    Raises:
        ScenarioError: the scenario cannot be read or cannot take place.
        OutputError: something is at ``output``, or nothing can be written there.
    """
    from graphslam.core.errors import OutputError
    from graphslam.simulation import Scenario, load_scenario, simulate

    known = scenario if isinstance(scenario, Scenario) else load_scenario(os.fspath(scenario))
    if os.path.lexists(output) and not force:
        raise OutputError(f"{os.fspath(output)}: already exists; give --force to replace it")
    return simulate(known, Path(output), seed)
