"""The path of a robot through a log of scans, tracked against the last metres of it.

Nothing here waits for an estimate of the whole log. What comes out are the steps of
`batch_optimisation`, which solves them.
"""

import itertools
import time
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from graphslam.core.config import Config
from graphslam.core.geometry import Array, compose, compose_cov, wrap
from graphslam.core.records import KeyframeScan, Motion, Step
from graphslam.logs import LogSet
from graphslam.mapping.local_tracking import LocalTracker
from graphslam.odometry.online_calibration import (
    CalibrationEvidence,
    Learnt,
    TrackedMotions,
    learnt_from_evidence,
)
from graphslam.odometry.preintegration import Track
from graphslam.pipeline.log_pass import LogPass, PriorKnowledge, Progress, timed
from graphslam.scan_smoothing.log_reader import Reading, read_keyframes_ahead
from graphslam.scan_smoothing.motion_checks import MotionChecker, ScanKeyframe
from graphslam.scan_smoothing.scan_keyframes import KeyframeBlock, ReadLog


@dataclass(slots=True, eq=False)
class TrackedPath:
    """The path of one robot as tracked: lists over its states, of which the first is the start.

    ``times`` ns; ``poses`` (3,) in the world; ``motions`` between consecutive states, according to
    odometry. ``anchors``: states at which submaps are centred; ``from_anchor``: pose of each state
    seen from the anchor before it (the first one from itself), with its covariance.
    """

    times: list[int] = field(default_factory=list)
    poses: list[Array] = field(default_factory=list)
    motions: list[Motion] = field(default_factory=list)
    anchors: list[int] = field(default_factory=list)
    from_anchor: list[tuple[Array, Array]] = field(default_factory=list)

    def anchor_steps(self) -> tuple[Array, Array]:
        """Poses (k - 1, 3) of anchors seen from the ones before, and covariances (k - 1, 3, 3)."""
        steps = [self.from_anchor[k] for k in self.anchors[1:]]
        poses, covs = [p for p, _ in steps], [c for _, c in steps]
        return np.array(poses).reshape(-1, 3), np.array(covs).reshape(-1, 3, 3)


def recalibrate_path(path: TrackedPath, track: Track) -> None:
    """Apply the calibration found in the end to the whole path, also where it was not known yet.

    The pose of a state seen from its anchor is a mean of odometry and landmarks, weighted by their
    information; only the part of odometry changes.
    """
    used = np.array([k for k, m in enumerate(path.motions) if not m.from_scans], dtype=np.int64)
    if not len(used):
        return
    ends = np.array([(m.start_ns, m.end_ns) for m in path.motions], dtype=np.int64)
    old = np.array([m.delta for m in path.motions])
    noise = np.array([m.cov for m in path.motions])
    new = old.copy()
    new[used] = track.motions(ends[used, 0], ends[used, 1]).delta
    begins = np.array(path.anchors)
    lasts = np.append(begins[1:], len(path.times) - 1)
    poses, seen = np.array(path.poses), np.array([pose for pose, _ in path.from_anchor])
    known = [cov for _, cov in path.from_anchor]
    covs = np.array(known)
    by_old = np.zeros((len(begins), 3))
    by_new, total = by_old.copy(), np.zeros((len(begins), 3, 3))
    for k in range(1, int((lasts - begins).max(initial=0)) + 1):  # the k-th state after each
        at = np.flatnonzero(begins + k <= lasts)
        states = begins[at] + k
        total[at] = compose_cov(by_old[at], total[at], old[states - 1], noise[states - 1])
        by_old[at] = compose(by_old[at], old[states - 1])
        by_new[at] = compose(by_new[at], new[states - 1])
        change = by_new[at] - by_old[at]
        change[:, 2] = wrap(change[:, 2])
        seen[states] += (covs[states] @ np.linalg.solve(total[at], change[:, :, None]))[:, :, 0]
    for begin, last in zip(begins.tolist(), lasts.tolist(), strict=True):
        poses[begin + 1 : last + 1] = compose(poses[begin], seen[begin + 1 : last + 1])
    path.poses, path.from_anchor = list(poses), list(zip(seen, known, strict=True))


class TrackedLog(LogPass):
    """A pass that has tracked paths: ``paths`` of the robots."""

    def __init__(self, log: LogSet, config: Config, known: PriorKnowledge) -> None:
        """Without paths."""
        super().__init__(log, config, known)
        self.paths: dict[str, TrackedPath] = {}


class ScanLog(TrackedLog):
    """A pass over a log of scans of one robot; `run` reads and tracks it, see ``paths``."""

    def __init__(self, log: LogSet, config: Config, known: PriorKnowledge, first: int = 0) -> None:
        """Reads nothing yet; landmarks are numbered from ``first``, or after a known map's."""
        super().__init__(log, config, known)
        (self._robot,) = log.robots
        self._path = TrackedPath()
        self._checker = MotionChecker(self._robot, config)
        self.paths[self._robot] = self._path
        self._tracker: LocalTracker | None = None
        self._anchor_m = 0.0
        known_map = known.known_map
        self._first = first if known_map is None else known_map.next_number  # of its landmarks
        #: see `ReadLog`
        self.wrong_lasers: dict[str, float] = {}
        #: what was learnt, if the calibration is far from its prior
        self.far: Learnt | None = None

    def run(
        self, progress: Progress, ahead: Reading | None = None, before: Learnt | None = None
    ) -> None:
        """Take in every message of the log; ``progress`` gets the number of messages read.

        ``ahead``: the keyframes, if they are read already. ``before``: what a pass before this one
        has learnt.
        """
        known: CalibrationEvidence | None = None
        learnt: Learnt | None = None
        with ahead or read_keyframes_ahead(self.log, self.given_config, before) as reading:
            while (item := reading.receive()) is not None:
                if isinstance(item, ReadLog):
                    self._finish(item, learnt)
                if not isinstance(item, KeyframeBlock):
                    continue
                progress(item.messages)
                began = time.perf_counter()
                moved = self._track(item)
                if self.config.odometry.calibrate:
                    with timed(self.seconds, "calibration"):
                        known = self._evidence(item, moved, known)
                        learnt = learnt_from_evidence(known, item.prior)
                # the next block is being read; this is for the one after it
                reading.send(learnt)
                if moved:
                    took = item.seconds + time.perf_counter() - began
                    self.step_ms += [1e3 * took / len(moved)] * len(moved)

    def _track(self, block: KeyframeBlock) -> list[tuple[Motion | None, Array, Array]]:
        """Each keyframe's motion by odometry and by tracking (3,), with its covariance (3, 3)."""
        if self._tracker is None:
            start = self.start_prior(self._robot)
            self.steps.append(Step(block.start_ns, starts={self._robot: start}))
            self._tracker = LocalTracker(
                self._robot, self.config.association, start.pose, itertools.count(self._first)
            )
            self._add_state(self._tracker, block.start_ns)
            self._set_anchor(self._tracker)
        with timed(self.seconds, "scan matching"):
            keyframes = self._checker.checked(block.keyframes, block.pairs, block.last)
        with timed(self.seconds, "tracking"):
            return [self._track_one(self._tracker, keyframe) for keyframe in keyframes]

    def _track_one(
        self, tracker: LocalTracker, keyframe: ScanKeyframe
    ) -> tuple[Motion | None, Array, Array]:
        """One state: associate what was seen there, and make the step."""
        robot, path, motion = self._robot, self._path, keyframe.motion
        state_ns = path.times[-1] if motion is None else keyframe.time_ns
        if motion is not None:
            tracker.move(motion)
        associations, moved, cov = tracker.track(state_ns, keyframe.seen)
        closures = () if keyframe.matched is None else (keyframe.matched,)
        motions = {} if motion is None else {robot: motion}
        self.steps.append(Step(keyframe.time_ns, {}, motions, associations, closures))
        self.keyframe_scans.append(
            KeyframeScan(robot, state_ns, keyframe.points.astype(np.float32), keyframe.mount)
        )
        if motion is not None:
            path.motions.append(motion)
            self._add_state(tracker, keyframe.time_ns)
            if tracker.path_m - self._anchor_m >= self.config.loop_closure.submap_spacing_m:
                self._set_anchor(tracker)
        return motion, moved, cov

    def _add_state(self, tracker: LocalTracker, time_ns: int) -> None:
        self._path.times.append(time_ns)
        self._path.poses.append(tracker.pose)
        self._path.from_anchor.append(tracker.anchor())
        self.counts["keyframes"] += 1

    def _set_anchor(self, tracker: LocalTracker) -> None:
        """A submap is centred at the present state."""
        tracker.set_anchor()
        self._anchor_m = tracker.path_m
        self._path.anchors.append(len(self._path.times) - 1)

    def _evidence(
        self,
        block: KeyframeBlock,
        tracked: Sequence[tuple[Motion | None, Array, Array]],
        known: CalibrationEvidence | None,
    ) -> CalibrationEvidence:
        """What the motions so far tell about the calibration, with those of a block."""
        known = known or CalibrationEvidence.none(len(block.prior.mean))
        against = [m.contradiction for m, _, _ in tracked if m is not None and m.contradiction]
        known = known.with_contradictions(against, block.source)
        used = [(m, at, cov) for m, at, cov in tracked if m is not None and not m.from_scans]
        if not used:
            return known
        motions, moved, covs = zip(*used, strict=True)
        found = TrackedMotions(
            np.array([m.delta for m in motions]),
            np.array([m.cov for m in motions]),
            np.array([m.d_delta_d_calibration for m in motions]),
            block.source,
            block.noise_scale,
            np.array(moved),
            np.array(covs),
        )
        return known.with_motions(found, self.runs[self._robot].track.config)

    def _finish(self, read: ReadLog, learnt: Learnt | None) -> None:
        """The end of the log: the last landmarks, and an anchor at the last state."""
        tracker, path, run = self._tracker, self._path, read.run
        self.wrong_lasers = read.wrong_lasers
        self.first_ns, self.last_ns = read.span_ns
        self.counts.update(read.counts)
        self.dropped.update(read.dropped)
        self.removed_returns.update(read.removed_returns)
        for stage, seconds in read.seconds.items():
            self.seconds[stage] += seconds
        self.log.update(read.report)
        self.runs[self._robot] = run
        run.contradicted = self._checker.contradicted
        if tracker is None:
            return
        run.times = path.times
        run.track.calibration = learnt.calibration if learnt else run.track.prior
        if path.anchors[-1] != len(path.times) - 1:
            path.anchors.append(len(path.times) - 1)
        if self.config.odometry.calibrate:
            self.far = learnt if learnt is not None and learnt.is_far else None
            recalibrate_path(path, run.track)
        tracker.retire_all()
        self.landmarks.add_all(tracker.entries)
        self.landmarks.deleted += tracker.deleted
        self.rejected.update(tracker.rejected)
        for model, values in tracker.innovations.items():
            self.innovations.setdefault(model, []).extend(values)
