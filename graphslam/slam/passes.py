"""Passes over a log, repeated until start poses, identities and clocks no longer change.

Mostly one pass is enough. What it finds may show that the log should be read again: landmarks'
identities that were swapped, or robots' clocks that differ.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial

import numpy as np

from graphslam.core.config import Config
from graphslam.core.errors import LogError
from graphslam.core.motion_models import nominal_calibration, of_odometry
from graphslam.core.records import Estimate
from graphslam.core.worker import Future
from graphslam.estimation.clock_calibration import ClockEstimate, estimate_clocks
from graphslam.estimation.isam2 import Isam2Backend
from graphslam.logs import LogSet
from graphslam.mapping.robot_candidates import NOT_THERE
from graphslam.mapping.robot_gating import RobotOffers
from graphslam.multi_robot.identity_swaps import find_swapped_identities
from graphslam.odometry.far_calibration import far_from_prior
from graphslam.pipeline.findings import Findings, FinishedPass
from graphslam.pipeline.log_pass import LogPass, PriorKnowledge, Progress, timed
from graphslam.pipeline.pipeline import Pipeline
from graphslam.pipeline.robot_state import Causal
from graphslam.pipeline.smoothing_job import SmoothingJob
from graphslam.scan_smoothing.causal import causal_of
from graphslam.scan_smoothing.reoptimise_scans import reoptimise_scan_log
from graphslam.sighting_smoothing.unnamed_sightings import solve_unnamed
from graphslam.slam.initialisation import with_identities

#: how often a log is read again at most, with corrected clocks
MAX_CLOCK_PASSES = 1
#: and with calibrations that an earlier pass found
MAX_CALIBRATION_PASSES = 3


def run_passes(job: SmoothingJob, known: PriorKnowledge) -> FinishedPass:
    """Read the log until nothing more is found that would change how it is read.

    Args:
        job: what is to be solved.
        known: what is known before the first pass.

    Raises:
        LogError: no message of the log could be used.
        EstimationError: the estimate is indeterminate, or a robot's start is unknown.
    """
    log, config = job.log, job.config
    clock_passes = calibration_passes = 0
    causal: Mapping[str, Causal] | None = None  # of a pass that began without calibrations found
    while True:
        pipeline = Pipeline(log, config, known, job.tamper)
        estimate, is_rough = job.kept.read_pass(
            pipeline, partial(estimate_of_pass, pipeline, job.progress)
        )
        with timed(pipeline.seconds, "final optimisation"):
            finding = Future(partial(pass_findings, pipeline, estimate))
            # a log is seldom read again, so where reoptimisation is quick it does not wait to know
            at_once = is_rough and is_sighting_log(pipeline) and not finding.done
            final = reoptimise(pipeline, estimate) if at_once else estimate
            findings = finding.result()
            following = decide_next_pass(known, findings, log, config, clock_passes)
            if following is None:
                if is_rough and not at_once:
                    final = reoptimise(pipeline, estimate)
                if is_rough and calibration_passes < MAX_CALIBRATION_PASSES:
                    following = with_far_calibrations(known, pipeline)
                if causal is not None:
                    findings = findings._replace(causal=causal)
                if following is None:
                    return FinishedPass(pipeline, final, findings)
                causal = findings.causal
                calibration_passes += 1
        clock_passes += following.clocks is not known.clocks
        known = following


def decide_next_pass(
    known: PriorKnowledge, findings: Findings, log: LogSet, config: Config, clock_passes: int
) -> PriorKnowledge | None:
    """What another pass is to begin with; None if no further pass is needed.

    Args:
        known: what the last pass began with.
        findings: of the last pass.
        log: opened logs.
        config: settings.
        clock_passes: passes so far whose clocks differed from those of the one before.
    """
    if findings.swapped_identities and not known.identities:
        return with_identities(known, log, config, findings.swapped_identities)
    if clock_passes < MAX_CLOCK_PASSES and any(
        c.needs_correction for c in findings.clocks.values()
    ):
        return replace(known, clocks={robot: c.clock for robot, c in findings.clocks.items()})
    return None


def with_far_calibrations(known: PriorKnowledge, pipeline: Pipeline) -> PriorKnowledge | None:
    """What another pass over unnamed sightings is to begin with, where odometry is far off.

    Sightings without names are associated by odometry: where a robot turns half as much again as
    its odometry says, they are taken for new points until that is known, and the map is there
    twice.

    Args:
        known: what the last pass began with.
        pipeline: the last pass, solved again.

    Returns:
        None if it began with what it found, to a sigma before any data, and was as sure of it.
    """
    if not is_sighting_log(pipeline):
        return None
    found, is_again = {}, False
    for name, run in pipeline.started.items():
        track = run.track
        prior = nominal_calibration(track.source, track.config, track.is_mounted)
        begun = known.calibrations.get(name, prior)
        far = far_from_prior(prior, begun, track.calibration)
        if far is None:
            continue
        found[name] = far
        usual = np.sqrt(np.diag(prior.cov))
        again = np.abs(far.mean - begun.mean) > usual
        again |= np.sqrt(np.diag(begun.cov)) > usual  # read with more doubt than usual
        is_again |= bool(again[of_odometry(prior)].any())
    return replace(known, calibrations=found) if is_again else None


def run_pass(pipeline: Pipeline, progress: Progress) -> Pipeline:
    """The pipeline after it has processed its log.

    Raises:
        LogError: no message of the log could be used.
    """
    pipeline.run(progress)
    if not pipeline.steps:
        path = pipeline.log.files[0].path
        raise LogError(f"{path}: nothing in it could be used; see `graphslam info`")
    pipeline.record_covariances()
    return pipeline


def estimate_of_pass(pipeline: Pipeline, progress: Progress) -> tuple[Estimate, bool]:
    """`current_estimate` after the pipeline has processed its log."""
    run_pass(pipeline, progress)
    with timed(pipeline.seconds, "final optimisation"):
        return current_estimate(pipeline)


def current_estimate(pipeline: Pipeline) -> tuple[Estimate, bool]:
    """The back end's estimate after a pass, and whether it is only the start of `reoptimise`."""
    backend, settings = pipeline.backend, pipeline.config.backend
    if isinstance(backend, Isam2Backend) and settings.optimise_at_end and settings.reoptimise:
        return backend.current_estimate(), True
    return backend.finish(), False


def is_sighting_log(pipeline: Pipeline) -> bool:
    """Whether `reoptimise` solves a log of sightings: without loop closure, in a second or two."""
    return bool(pipeline.sources)


def reoptimise(pipeline: Pipeline, estimate: Estimate) -> Estimate:
    """The whole log solved again from a rough estimate; the pipeline's steps follow the result."""
    tracks = {name: run.track for name, run in pipeline.started.items()}
    config = pipeline.config
    robots = RobotOffers(pipeline.offers, pipeline.sources or pipeline.robot_sightings)
    unused = robots.unused(pipeline.steps)
    pipeline.steps = list(robots.associated_again(pipeline.steps, estimate, config.robust, config))
    pipeline.landmarks.bring_back()
    for name, run in pipeline.started.items():
        if config.odometry.calibrate and (wider := run.calibrator.wider) is not None:
            run.track.prior = wider
            scale = run.calibrator.noise_scale
            pipeline.steps = run.without_explained(pipeline.steps, name, scale)
    if is_sighting_log(pipeline):
        estimate, steps = solve_unnamed(pipeline, estimate)
    else:
        estimate, steps, counts, noise = reoptimise_scan_log(
            pipeline.steps,
            estimate,
            tracks,
            pipeline.landmarks,
            pipeline.keyframe_scans,
            config,
            pipeline.tamper,
            robots,
            pipeline.frames.of,
        )
        pipeline.counts.update(counts)
        pipeline.noise = noise.to_summary()
    pipeline.steps = list(steps)
    if change := robots.unused(steps) - unused:
        pipeline.rejected[NOT_THERE] += change
    for name in tracks:
        pipeline.runs[name].is_calibrated = config.odometry.calibrate
    return estimate


def pass_findings(pipeline: Pipeline, estimate: Estimate) -> Findings:
    """Results of a pass besides its estimate; an estimate that is not optimised is enough."""
    clocks = find_clocks(pipeline, estimate)
    return Findings(find_swapped_names(pipeline, estimate), clocks, causal_of(pipeline))


def find_clocks(
    pipeline: LogPass, estimate: Estimate, *, coarsely: bool = True
) -> dict[str, ClockEstimate]:
    """`Findings.clocks` by an estimate of a pass; ``coarsely``: they may be seconds off."""
    tracks = {name: run.track for name, run in pipeline.started.items()}
    of_robots = [s for s in pipeline.sources if s.seen_robot]
    return estimate_clocks(
        pipeline.steps,
        estimate,
        [*of_robots, *pipeline.robot_sightings] if coarsely else (),
        tracks,
        pipeline.known.clocks,
        pipeline.config,
    )


def find_swapped_names(pipeline: Pipeline, estimate: Estimate) -> dict[str, str]:
    """`Findings.swapped_identities` by an estimate of a pass."""
    if not pipeline.sources or pipeline.config.association.identities == "ignore":
        return {}
    tracks = {name: run.track for name, run in pipeline.started.items()}
    pairs = find_swapped_identities(pipeline.sources, estimate, tracks)
    return {a: b for pair in pairs for a, b in (pair, pair[::-1])}
