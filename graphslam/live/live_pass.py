"""The pass over messages that are still to come: it keeps what its window needs, and no history.

The stages are those of `graphslam.pipeline.pipeline`, the back end is a fixed-lag smoother. Memory
is that of the window, of the map and of one small table of the states' times.
"""

import math
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from graphslam.core.config import Config
from graphslam.core.geometry import Array, between, compose, compose_cov, inverse, transform
from graphslam.core.records import Estimate, Landmark, Message, Sighting, Start, Step
from graphslam.estimation.fixed_lag import FixedLagBackend, Restart
from graphslam.live.loop_closing import LoopCloser
from graphslam.logs import LogSet
from graphslam.mapping.landmark_records import make_landmarks
from graphslam.pipeline.log_pass import PriorKnowledge
from graphslam.pipeline.pipeline import Pipeline
from graphslam.pipeline.robot_state import RobotState
from graphslam.pipeline.sighting_batches import Event, SightingBatch
from graphslam.pipeline.synchronisation import ODOMETRY

#: keyframes in a row after which places are compared; else that waits for a scan that becomes none
BUSY = 2
#: s: odometry that is kept, at least
SHORTEST_MEMORY_S = 10.0
#: the beginning of a drive is solved as a batch until there are so many steps, or so long, ns: what
#: follows is compared with its map, moved with its calibration. The last solution takes 0.2 s
LAST_BATCH_STEP, BEGINNING_NS = 600, 900_000_000_000


@dataclass(frozen=True, slots=True, eq=False)
class LiveEstimate:
    """Where a robot was when a sensor saw something, by all data until then.

    Attributes:
        robot: its name.
        stamp_ns: the stamp of the scan, or of the last sighting.
        pose: (3,) of the base in the map, m and rad.
        cov: (3, 3) along the axes of the map.
        odometry: (3,) pose of the base by odometry alone, in the frame where that began.
        jump: (3,) by how much ``pose`` differs from what the estimate before and the odometry since
            would give, in the frame of the base; zeros at first.
        loop_closed: whether landmarks not seen for long were found again since the estimate before.
        frame: the frame of ``pose``: the robot that begins at its origin.
        scan_pose: (3,) of the sensor of a scan; None without scans.
        points: (n, 2) returns of a scan that became a keyframe, in the frame of its sensor; else
            None.
    """

    robot: str
    stamp_ns: int
    pose: Array
    cov: Array
    odometry: Array
    jump: Array
    loop_closed: bool
    frame: str
    scan_pose: Array | None
    points: Array | None = None


class LivePass(Pipeline):
    """A pass that reports each robot where it is, and forgets what is behind its horizon."""

    backend: FixedLagBackend
    # with a growth of 2.0 Intel is worse from 1200 s on; 1.25 is no better
    first_batch_step, batch_step_growth = 20, 1.5

    def __init__(self, log: LogSet, config: Config, known: PriorKnowledge) -> None:
        """For the arguments see `LogPass`; the back end has a finite horizon."""
        self._known_map = known.known_map
        super().__init__(log, config, known)
        self.backend.most_states = config.live.max_states
        memory_s = max(self.config.backend.horizon_s, SHORTEST_MEMORY_S)
        self._memory_ns = round(1e9 * memory_s)
        if self._known_map is not None:
            self.landmarks.add_known(self._known_map.entries(min(self.runs)))
            self.landmarks.begin_at(self._known_map.next_number)
        #: known landmarks that were seen, and how many observations were of them, and of others
        self.known_seen: set[int] = set()
        self.on_map = self.off_map = 0
        self._taken = 0  # of `steps`, by the events before
        self._restart: Restart | None = None
        self._reported: dict[str, LiveEstimate] = {}
        self._closures = 0  # that are in `_closed_ns`, or were reported
        self._closed_ns: dict[str, int] = {}  # from when on a robot's next estimate has a closure
        self._placed = 0  # of `keyframe_scans`
        closes = self.config.backend.close_loops and self._known_map is None
        self._busy = 0  # scans in a row that became keyframes
        self._closer = LoopCloser(self.config, self.backend, self.frames.of) if closes else None

    def estimates(
        self, messages: Iterable[Message], ready: Collection[Message] = ()
    ) -> Iterator[LiveEstimate]:
        """Take in messages, sorted by time; gives the estimates of each event.

        ``ready``: at each time, those that come next without waiting. Where there is odometry among
        them, scans of a single robot are reported together with what follows: those between two
        keyframes are then matched at once, which takes little longer than one.
        """
        alone = len(self.runs) == 1 and all(map(self.log.has_scans, self.runs))
        waiting = False
        for event in self.process(messages):
            if len(self.steps) == self._taken and not waiting and _is_odometry(event):
                continue  # most of a recording: nothing was seen, and nothing is to be forgotten
            self.record_covariances()
            self._note_closures()
            self._add_places()
            # odometry becomes an event as soon as it is taken in, a scan may wait for odometry
            waiting = alone and any(isinstance(message, ODOMETRY) for message in ready)
            if waiting:
                continue
            self._close_loops()
            self.record_covariances()  # of a state that a loop has moved
            for robot, run in self.started.items():
                yield from self._report(robot, run, event)
            self.forget()

    def _add_places(self) -> None:
        """Keep places while their states are in the window."""
        if self._closer is not None:
            self._closer.add(self.keyframe_scans[self._placed :])
            self._placed = len(self.keyframe_scans)

    def _note_closures(self, *, of_places: bool = False) -> None:
        """Landmarks that were found again move what is reported from now on.

        Those ``of_places`` have moved the last state of every robot, and what follows it.
        """
        if self.associator.closures > self._closures:
            self._closures = self.associator.closures
            for robot, run in self.started.items():
                self._closed_ns.setdefault(robot, run.state_ns if of_places else self.last_ns)

    def _close_loops(self) -> None:
        """Look for places that were passed before; what they say moves the estimate."""
        if self._closer is None:
            return
        if self.keyframe_scans:
            self._busy += 1
            if self._busy <= BUSY:
                return  # such a scan takes time enough
        self._busy = 0
        found = self._closer.closures(self.last_ns)
        if not found:
            return
        step = Step(self.last_ns, closures=found)
        self.backend.add(step)
        self.steps.append(step)
        self.associator.closures += 1
        for robot, run in self.started.items():
            # what is reported from now on is seen from there
            run.latest_pose = run.causal_poses[-1] = self.backend.state_mean(robot)
            del run.causal_covs[len(run.times) - 1 :]
        self._note_closures(of_places=True)

    def restarts(self) -> bool:
        """See `StepRecorder`: in the beginning, while all that was seen is kept."""
        return self._known_map is None

    def batch_step(self) -> bool:
        """See `StepRecorder`; a part of it with each step, the last of which moves the estimate.

        Parts are a number of steps, not what fits in a time: estimates are the same in every run.
        """
        if self._restart is None:
            found = self.solve_steps()
            self.batch_is_due = found is not None
            if found is not None:
                self._restart = self.backend.begin_restart(len(self.steps), found)
            return False
        if not self._restart.advance(self.steps):
            return False
        self.backend.finish_restart(self._restart)
        self._restart, self.batch_is_due = None, False
        for robot, run in self.started.items():
            run.latest_pose = self.backend.state_mean(robot)
        return True

    def _is_beginning(self) -> bool:
        """Whether steps and odometry are to be kept, for a batch step that is going on or comes.

        Once it is over there is none any more, however many steps come at once.
        """
        if self.batch_is_due:
            return True
        if self.next_batch_step > LAST_BATCH_STEP or self.last_ns > self.first_ns + BEGINNING_NS:
            self.next_batch_step = math.inf
        return math.isfinite(self.next_batch_step)

    def start_step(self, robot: str, time_ns: int) -> Step:
        """See `StepRecorder`; a known map enters with the first robot."""
        step = super().start_step(robot, time_ns)
        if self._known_map is None or self.started:
            return step
        return replace(step, known=self._known_map.known)

    def start_prior(self, robot: str) -> Start:
        """See `LogPass`; in a known map that is the world of the states, which are the sensor's."""
        if self._known_map is None:
            return super().start_prior(robot)
        told, track = self.starts[robot], self.runs[robot].track
        cov = compose_cov(told.pose, told.cov, track.mount, track.mount_cov)
        return Start(compose(told.pose, track.mount), cov)

    def _report(self, robot: str, run: RobotState, event: Event) -> Iterator[LiveEstimate]:
        """The estimates of a robot at its new scans, or else at its sightings in ``event``."""
        if self.log.has_scans(robot):
            found = sorted(run.scans, key=lambda scan: scan[0])
            stamps, times = [scan[0] for scan in found], [scan[1] for scan in found]
            mounts = np.array([scan[2] for scan in found])
        else:
            times = _seen_at(robot, event)
            stamps = [int(run.clock.to_local(np.array([time]))[0]) for time in times]
            mounts = np.zeros((0, 3))
        if not stamps:
            return
        frame = self.frames.of[robot]
        when = np.array(times, dtype=np.int64)
        causal = run.causal_at_stamps(
            np.array(stamps, dtype=np.int64),
            when,
            mounts,
            None if self._known_map is not None else self.starts[frame].pose,
            self.frames.away.get(frame, 0.0),
        )
        run.scans.clear()
        if run.since_keyframe is not None:
            run.since_keyframe.forget()
        odometry = run.track.pose(when)
        points = {
            (one.robot, one.time_ns): transform(inverse(one.sensor), one.points)
            for one in self.keyframe_scans
        }
        for k, stamp in enumerate(stamps):
            pose, before = causal.base.poses[k], self._reported.get(robot)
            jump = np.zeros(3)
            if before is not None:
                expected = compose(before.pose, between(before.odometry, odometry[k]))
                jump = between(expected, pose)
            scan = None if causal.scan is None else causal.scan.poses[k]
            closed = robot in self._closed_ns and times[k] >= self._closed_ns[robot]
            if closed:
                del self._closed_ns[robot]
            made = LiveEstimate(
                robot, stamp, pose, causal.base.covs[k], odometry[k], jump, closed, frame, scan,
                points.get((robot, times[k])),
            )  # fmt: skip
            self._reported[robot] = made
            yield made

    def known_map_summary(self) -> dict[str, Any] | None:
        """The known map, how many of its landmarks were seen, and what was seen beside; or None."""
        known = self._known_map
        if known is None:
            return None
        return {
            "name": known.name,
            "sha256": known.sha256,
            "verdict": known.verdict,
            "landmarks": len(known.known.means),
            "seen": len(self.known_seen),
            "observations_of_it": self.on_map,
            "observations_of_others": self.off_map,
        }

    def _count_known(self) -> None:
        """Count what the latest steps saw of a known map."""
        if self._known_map is None:
            return
        earlier = self._known_map.known.means.keys()
        seen = [a.target for s in self.steps for a in s.associations if isinstance(a.target, int)]
        of_map = [target for target in seen if target in earlier]
        self.known_seen.update(of_map)
        self.on_map += len(of_map)
        self.off_map += len(seen) - len(of_map)

    def forget(self) -> None:
        """Drop what no later message needs."""
        self._count_known()
        for history in (
            self.offers, self.sources, self.robot_sightings, self.unrelated_sightings,
            self.keyframe_scans, self.step_ms, self.innovations,
        ):  # fmt: skip
            history.clear()
        self._placed = 0
        beginning = self._is_beginning()
        if not beginning:
            self.steps.clear()
        self._taken = len(self.steps)
        before_ns = self.last_ns - self._memory_ns
        for robot, run in self.started.items():
            # from the last state on: while a robot stands its latest scan stays its first one
            self.landmarks.expire(run.state_ns, robot, math.inf, self._memory_ns, 0.0)
            first = min(before_ns, run.state_ns)
            if not beginning:
                run.track.forget_before(first)
            run.repeats.left_out.clear()
            # half of them at a time, so that each is moved once on average
            behind = int(np.searchsorted(run.times[:-1], first))
            if 2 * behind > len(run.times):
                for states in (run.times, run.causal_poses, run.causal_covs, run.calibrations):
                    del states[:behind]
        if not beginning:
            self.backend.forget()

    def landmark_map(self) -> tuple[Landmark, ...]:
        """The landmarks of the map as estimated now, in their frames."""
        ids = self.landmarks.graph_ids()
        self.landmarks.refresh(self.backend, ids)
        transforms = self.transforms()
        moved = self.landmarks.transformed(transforms.landmarks)
        estimate = transforms.estimate(Estimate({}, self.backend.landmark_estimates(ids), 0.0, 0))
        entries = self.landmarks.entries.values()
        return self.frames.label_landmarks(make_landmarks(moved, estimate), entries)


def _is_odometry(event: Event) -> bool:
    return not isinstance(event, SightingBatch) and isinstance(event[0], ODOMETRY)


def _seen_at(robot: str, event: Event) -> list[int]:
    """When a robot saw something in ``event``: once at most."""
    if isinstance(event, SightingBatch):
        return [event.time_ns] if any(i[0].robot == robot for i in event.images) else []
    first = event[0]
    return [first.time_ns] if first.robot == robot and isinstance(first, Sighting) else []
