"""Comparison of back ends on one recording: a row of numbers and the curves of each."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from graphslam.core.config import Config
from graphslam.core.errors import ConfigError, EstimationError, OutputError, described
from graphslam.core.geometry import Array, compose, transform, wrap
from graphslam.core.records import Step, Trajectory
from graphslam.evaluation.compare_variants import NAMES, Variant
from graphslam.evaluation.equal_backends import equal_pairs
from graphslam.evaluation.error_statistics import nees
from graphslam.evaluation.metrics import evaluate
from graphslam.evaluation.recorded_steps import RecordedSteps, record_steps
from graphslam.evaluation.relation_metrics import Relations
from graphslam.evaluation.timed_replay import TimedReplay, growth_exponent, timed_replay_in_process
from graphslam.evaluation.trajectory_metrics import PosePairs, align, pair_poses
from graphslam.logs import GroundTruth, LogSet
from graphslam.pipeline.log_pass import Progress
from graphslam.results.folder import SavedResult
from graphslam.results.report_comparison import BackendCurves, Comparison, ErrorCurve, TimedPath

FORMAT = "graphslam-comparison-1"
#: the same recorded steps for all, or each with its own data association
MODES = ("replay", "associate")
#: the error of a back end for which memory was short
NO_MEMORY = "there is not enough memory; see the setting limits.memory_mb"
#: tables of settings that the recorded steps depend on: in mode `replay` the same for all
PERCEPTION = ("logs", "robots", "odometry", "keyframe", "front_end", "association", "start")


def compare(
    log: LogSet,
    config: Config,
    rows: Sequence[Variant],
    mode: str = "replay",
    *,
    truth: GroundTruth | None = None,
    relations: Relations | None = None,
    progress: Progress = lambda _count: None,
    say: Callable[[str], None] = lambda _text: None,
    run: Callable[[Sequence[Step], Config], TimedReplay] = timed_replay_in_process,
) -> Comparison:
    """Run every back end of ``rows`` on one log, one after another.

    A back end that fails, by whatever error, has it in its row, and the others go on.

    Args:
        log: opened logs.
        config: settings of the recording in mode ``replay``.
        rows: see `parse_variants`.
        mode: one of `MODES`.
        truth: true poses and landmarks; without it rows are compared with each other only.
        relations: reference relations between scans, see `evaluate`.
        progress: called with the number of messages read so far.
        say: called with a line on what is done next.
        run: how a back end is run: `timed_replay_in_process`, or `timed_replay`, with which
            numbers on memory are meaningless.

    Raises:
        LogError: no message of the log could be used.
        ConfigError: no such mode, rows differ in more than estimation in mode ``replay``, or there
            is a known map, in which no back end begins here.
        EstimationError: data association failed, or every back end did.
        OutputError: the truth is of other robots.
    """
    if mode not in MODES:
        raise ConfigError(f"--mode {mode}: is not one of {', '.join(MODES)}")
    if any(own.known_map.directory for own in (config, *(row.config for row in rows))):
        raise ConfigError("known_map.directory: back ends are compared without a known map")
    truth = truth or GroundTruth({}, ())
    if truth.trajectories and not set(truth.trajectories) & set(log.robots):
        raise OutputError(
            f"the truth is of {', '.join(truth.trajectories)}, "
            f"the log of {', '.join(log.robots)}; write --truth ROBOT=FILE.tum"
        )
    shared = None
    if mode == "replay":
        _check_perception(config, rows)
        if config.backend.name == "batch":  # nothing causal comes of a batch
            config = replace(config, backend=replace(config.backend, name="isam2"))
        say(f"associating with {NAMES.get(config.backend.name, config.backend.name)}")
        shared = record_steps(log, config, progress)
    runs, failures = list[_BackendRun](), list[Exception]()
    for variant in rows:
        say(variant.label)
        try:
            recording = shared or record_steps(log, variant.config, progress)
            if variant.config.backend.name == "dead-reckoning":
                # what the other back ends learned of the odometry is no merit of the odometry
                recording = recording.with_recorded_odometry()
            runs.append(_BackendRun.of(variant, recording, run(recording.steps, variant.config)))
        except Exception as error:  # also a defect of one back end is no loss of the others
            runs.append(_BackendRun(variant, error=described(error, NO_MEMORY)))
            failures.append(error)
    done = [run for run in runs if run.result is not None]
    if not done:
        raise EstimationError(
            f"every back end failed; {runs[0].variant.spec}: {runs[0].error}"
        ) from failures[0]
    # the reference: batch, else a smoother, else the first
    reference = min(
        done,
        key=lambda one: (
            one.variant.config.backend.name != "batch",
            bool(one.row["final_is_causal"]),
        ),
    )
    warnings = [text for variant in rows for text in variant.config.warnings]
    for one in done:
        one.evaluate_against(truth, relations, reference, warnings)
    if not all(one.row.get("common_frame", True) for one in done):
        warnings.append(
            "the start was not given: only aligned errors are meaningful (give --start truth)"
        )
    given = config.start.from_truth or bool(config.start.poses)
    known = {
        name: path
        for name, path in truth.trajectories.items()
        if any(name in one.row.get("robots", {}) for one in done)
    }
    found = {
        "format": FORMAT,
        "mode": mode,
        "recorded_by": config.backend.name if mode == "replay" else None,
        "logs": [{"path": str(file.path), "sha256": file.sha256} for file in log.files],
        "start_given": given,
        "reference": reference.variant.spec,
        "rows": [run.row for run in runs],
        "equal": equal_pairs([(one.variant, one.finished()) for one in done]),
        "warnings": list(dict.fromkeys([*log.warnings, *warnings])),
    }
    lanes = [one.curves(known, reference) for one in done]
    return Comparison(found, tuple(lanes), {name: t.poses[:, :2] for name, t in known.items()})


def _check_perception(config: Config, rows: Sequence[Variant]) -> None:
    for variant in rows:
        for table in PERCEPTION:
            if getattr(variant.config, table) != getattr(config, table):
                raise ConfigError(
                    f"--backends {variant.spec}: {table}.* belongs to the recording, which is the "
                    "same for all; give it with --set, or compare with --mode associate"
                )


class _BackendRun:
    """One back end of a comparison: its row, and the curves of the report."""

    def __init__(self, variant: Variant, error: str | None = None) -> None:
        self.variant = variant
        self.result: SavedResult | None = None
        self.row: dict[str, Any] = {"spec": variant.spec, "label": variant.label, "error": error}
        self.step_ms = self.landmarks = self.path_m = np.empty(0)

    @property
    def error(self) -> str | None:
        """Why it failed; None if it did not."""
        error: str | None = self.row["error"]
        return error

    @classmethod
    def of(cls, variant: Variant, recording: RecordedSteps, timed: TimedReplay) -> "_BackendRun":
        """A run that succeeded."""
        self, done = cls(variant), timed.replay
        result = recording.result(done, variant.config)
        is_filter = all(robot.final is robot.causal for robot in result.robots.values())
        self.result, self.step_ms = result, done.step_ms
        self.landmarks, self.path_m = recording.growth()
        p50, p99, most = np.quantile(done.step_ms, [0.5, 0.99, 1.0]).tolist()
        name = variant.config.backend.name
        if name == "ekf" or (is_filter and name != "dead-reckoning"):
            # this choice changes a filter as much as smoothing does
            self.row["label"] += f", {timed.error_frame}-frame errors"
        self.row |= {
            "error_frame": timed.error_frame,
            "lines": variant.config.ekf.lines if name == "ekf" else "model",
            "kernel": variant.config.robust.kernel,
            "past_states": _past_states(variant.config, is_filter=is_filter),
            "final_is_causal": is_filter,
            "steps": len(recording.steps),
            "states": sum(map(len, done.causal.values())),
            "map_landmarks": len(result.landmarks),
            "associations": recording.associations,
            "late": done.late,
            "skipped": dict(timed.skipped),
            "recording_s": recording.seconds,
            "ms_per_step": {"p50": p50, "p99": p99, "max": most},
            "finish_ms": done.finish_ms,
            "total_s": 1e-3 * (float(done.step_ms.sum()) + done.finish_ms),
            "memory_mb": {"peak": timed.peak_mb, "growth": timed.peak_mb - timed.before_mb},
            "growth_exponent": {
                "landmarks": growth_exponent(self.landmarks, done.step_ms),
                "path": growth_exponent(self.path_m, done.step_ms),
            },
        }
        if timed.exchanged is not None:
            sent, measured = timed.exchanged
            self.row["exchanged"] = {
                robot: {"sent_bytes": sent[robot], "measured_bytes": measured[robot]}
                for robot in sorted(sent)
            }
        return self

    def evaluate_against(
        self,
        truth: GroundTruth,
        relations: Relations | None,
        reference: "_BackendRun",
        warnings: list[str],
    ) -> None:
        """Add the errors and the distance to the reference to the row."""
        assert self.result is not None  # only runs that succeeded are evaluated
        try:
            self.row |= evaluate(self.result, truth.trajectories, truth.landmarks, relations)
        except OutputError as error:
            # truth of another time, or relations without scans: the rest is still valid
            warnings.append(f"not evaluated: {error}")
        self.row["difference"] = {
            kind: _difference([pairs for _, pairs in self.pairs(kind, reference.final())])
            for kind in ("final", "causal")
        }

    def finished(self) -> SavedResult:
        """The result of a run that succeeded."""
        assert self.result is not None  # see `evaluate_against`
        return self.result

    def final(self) -> dict[str, Trajectory]:
        """The final trajectory of each robot."""
        assert self.result is not None  # see `evaluate_against`
        return {name: robot.final for name, robot in self.result.robots.items()}

    def pairs(self, kind: str, other: Mapping[str, Trajectory]) -> Iterator[tuple[str, PosePairs]]:
        """Poses of each robot paired with those of ``other``, as far as there are any."""
        assert self.result is not None  # see `evaluate_against`
        for name, robot in self.result.robots.items():
            if name in other and len(found := pair_poses(getattr(robot, kind), other[name])):
                yield name, found

    def curves(self, truth: Mapping[str, Trajectory], reference: "_BackendRun") -> BackendCurves:
        """What the report draws; aligned with the truth if not in its frame."""
        assert self.result is not None  # see `evaluate_against`
        same_frame = bool(self.row.get("common_frame", True))
        paths, curves = {}, {}
        for kind in ("final", "causal"):
            moved = np.zeros(3)
            found = dict(self.pairs(kind, truth or reference.final()))
            if truth and not same_frame and found:
                moved = align(
                    np.concatenate([p.estimate[:, :2] for p in found.values()]),
                    np.concatenate([p.truth[:, :2] for p in found.values()]),
                )
            curves[kind] = {
                name: _curve(p, moved, consistency=bool(truth) and same_frame)
                for name, p in found.items()
            }
            paths[kind] = {
                name: TimedPath(path.stamps_ns, compose(moved, path.poses))
                for name, robot in self.result.robots.items()
                for path in [getattr(robot, kind)]
            }
        return BackendCurves(
            self.row["spec"], self.row["label"], paths, curves, self.step_ms, self.landmarks,
            self.path_m,
        )  # fmt: skip


def _past_states(config: Config, *, is_filter: bool) -> int | str:
    """How many past poses of a robot a back end can still use."""
    if config.backend.name == "dead-reckoning":
        return 0
    if is_filter:
        return config.ekf.past_states
    finite = np.isfinite(config.backend.horizon_s)
    return f"{config.backend.horizon_s:g} s" if finite else "all"


def _difference(pairs: Sequence[PosePairs]) -> dict[str, float] | None:
    """Distance between two estimates of the same poses of all robots; None without any."""
    if not pairs:
        return None
    off = np.concatenate([p.estimate - p.truth for p in pairs])
    distance = np.hypot(off[:, 0], off[:, 1])
    return {
        "rmse_m": float(np.sqrt(np.mean(distance**2))),
        "max_m": float(distance.max()),
        "heading_rmse_rad": float(np.sqrt(np.mean(wrap(off[:, 2]) ** 2))),
    }


def _curve(pairs: PosePairs, moved: Array, *, consistency: bool) -> ErrorCurve:
    """Errors over time after the estimate was moved by ``moved`` (3,)."""
    off = pairs.estimate - pairs.truth
    off[:, 2] = wrap(off[:, 2] + moved[2])
    off[:, :2] = transform(moved, pairs.estimate[:, :2]) - pairs.truth[:, :2]
    values = nees(off, pairs.covs) / 3 if consistency else np.full(len(off), np.nan)
    return ErrorCurve(pairs.stamps_ns, np.hypot(off[:, 0], off[:, 1]), np.abs(off[:, 2]), values)
