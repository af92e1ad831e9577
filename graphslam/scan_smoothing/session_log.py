"""Sessions of one place (`graphslam.logs.sessions`), solved as one batch.

Each session is read and tracked by itself, like the log of one robot (`scan_tracking`). Where they
begin is found by what the whole drives show (`session_joining`). Then loops within and between
sessions are closed, landmarks are tied, and all of it is solved together (`batch_optimisation`).
"""

from collections.abc import Mapping
from dataclasses import replace

from graphslam.core.config import Config
from graphslam.core.errors import LogError
from graphslam.core.stages import announce
from graphslam.logs import LogSet
from graphslam.logs.log_set import ReadReport
from graphslam.multi_robot.frame_tree import FrameAssignment
from graphslam.pipeline.findings import Findings, FinishedPass
from graphslam.pipeline.log_pass import PriorKnowledge, timed
from graphslam.pipeline.recorded_closures import RecordedClosures
from graphslam.pipeline.smoothing_job import SmoothingJob
from graphslam.pipeline.start_priors import origin
from graphslam.scan_smoothing.batch_optimisation import optimise_scan_log
from graphslam.scan_smoothing.localisation import place_path
from graphslam.scan_smoothing.scan_log import track_scan_log
from graphslam.scan_smoothing.scan_tracking import ScanLog, TrackedLog
from graphslam.scan_smoothing.session_joining import join_sessions

#: logs with relative poses are not of this kind
NO_RECORDED = RecordedClosures({}, {}, frozenset(), {})


class SessionLog(TrackedLog):
    """Sessions that were tracked one by one, as one pass; ``paths``: session -> as tracked."""

    def __init__(
        self,
        log: LogSet,
        config: Config,
        known: PriorKnowledge,
        sessions: Mapping[str, ScanLog],
    ) -> None:
        """Put the sessions where ``known`` says that they begin."""
        used = [session.log for session in sessions.values()]
        lasers = tuple(topic for one in used for topic in one.further_lasers)
        super().__init__(replace(log, further_lasers=lasers), config, known)
        report = ReadReport()
        for name, one in sessions.items():
            self._add(name, one)
            report.dropped.update(one.log.dropped)
            report.repaired.update(one.log.repaired)
            report.warnings.extend(w for w in one.log.warnings if w not in log.warnings)
        self.log.update(report)
        self.steps.sort(key=lambda step: step.time_ns)

    def _add(self, name: str, one: ScanLog) -> None:
        start = self.frames.offset_start(name, self.known.frame_assignment.starts[name])
        place_path(one, name, start)
        self.paths[name] = one.paths[name]
        self.runs[name] = one.runs[name]
        self.steps += one.steps
        self.keyframe_scans += one.keyframe_scans
        self.step_ms += one.step_ms
        self.landmarks.add_all(one.landmarks.entries)
        self.landmarks.deleted += one.landmarks.deleted
        for mine, others in (
            (self.counts, one.counts),
            (self.dropped, one.dropped),
            (self.rejected, one.rejected),
            (self.removed_returns, one.removed_returns),
        ):
            mine.update(others)
        for stage, seconds in one.seconds.items():
            self.seconds[stage] += seconds
        for model, values in one.innovations.items():
            self.innovations.setdefault(model, []).extend(values)
        self.first_ns = min(self.first_ns, one.first_ns)
        self.last_ns = max(self.last_ns, one.last_ns)


def solve_session_log(job: SmoothingJob) -> FinishedPass:
    """Sessions of one place as one batch.

    Raises:
        LogError: no message of the logs could be used.
        EstimationError: the estimate is indeterminate, or a start that is told is malformed.
    """
    log, config = job.log, job.config
    announce("sessions")
    sessions: dict[str, ScanLog] = {}
    first = messages = 0
    for robot in log.robots:
        alone = PriorKnowledge(FrameAssignment.one_frame({robot: origin(config)}), NO_RECORDED)
        before = messages

        def count(read: int, before: int = before) -> None:
            job.progress(before + read)

        own = replace(job, log=log.of_robot(robot), progress=count)
        one = track_scan_log(own, alone, first=first)
        messages += one.counts["messages"]
        if one.steps:
            sessions[robot] = one
            first = 1 + max(one.landmarks.entries, default=first - 1)
    if not sessions:
        raise LogError(f"{log.files[0].path}: nothing in it could be used; see `graphslam info`")
    took = {"joining": 0.0}
    with timed(took, "joining"):
        starts = job.kept.stage("starts", lambda: join_sessions(log, sessions, config))
    known = PriorKnowledge(starts, NO_RECORDED)
    joined = SessionLog(log, config, known, sessions)
    joined.seconds.update(took)
    with timed(joined.seconds, "final optimisation"):
        estimate = optimise_scan_log(joined, job.tamper)
    return FinishedPass(joined, estimate, Findings({}, {}, {}), is_settled=True)
