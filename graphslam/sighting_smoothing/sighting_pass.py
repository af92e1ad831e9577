"""A log of named sightings as steps, all at once: no estimate is needed to associate them.

`Pipeline` estimates while it reads, since association needs an estimate. Where every sighting says
what it is of, the steps follow from odometry alone. Motions and measurements are computed when the
steps are solved (`sighting_solution`) or replayed (`causal_sightings`), many at once.
"""

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.config import Config
from graphslam.core.record import replace
from graphslam.core.records import (
    Association,
    RelativePose,
    Scan,
    Sighting,
    Step,
)
from graphslam.logs import LogSet
from graphslam.logs.clock import to_common_clock
from graphslam.odometry.preintegration import Track
from graphslam.odometry.readings import integrate_pending
from graphslam.perception.sightings import sighting_observation
from graphslam.pipeline.log_pass import PriorKnowledge, Progress, timed
from graphslam.pipeline.pipeline import Pipeline
from graphslam.pipeline.sighting_batches import SightingBatch, sighting_batches
from graphslam.pipeline.synchronisation import ODOMETRY
from graphslam.sighting_smoothing.reoptimise_sightings import SightingGroup, group_sightings
from graphslam.sighting_smoothing.sighting_states import timed_motion


def can_solve_at_once(log: LogSet, config: Config) -> bool:
    """Whether the steps of a log may not depend on estimates, as far as its topics tell.

    It then has sightings by several robots, but no scans and no relative poses.
    """
    kinds = {topic.record for topic in log.topics}
    return (
        Sighting in kinds
        and not kinds & {Scan, RelativePose}
        and config.association.identities == "use"
        and config.keyframe.mode != "all"
        and config.keyframe.sighting_window_s > 0
        and config.odometry.calibrate
    )


class SightingPass(Pipeline):
    """One pass over the named sightings of several robots, without a back end.

    After `run` the ``steps`` are without numbers: motions have their times alone, and associations
    what was measured. ``all_named``: whether every sighting has an identity; else there are no
    steps.
    """

    def __init__(self, log: LogSet, config: Config, known: PriorKnowledge) -> None:
        """Reads nothing yet."""
        super().__init__(log, config, known)
        self.all_named = True
        if known.known_map is not None:
            self.landmarks.add_known(known.known_map.entries(min(self.runs)))
            self.landmarks.begin_at(known.known_map.next_number)

    def run(self, progress: Progress) -> None:
        """Read the log and make the steps; see `Pipeline`."""
        with timed(self.seconds, "read"):
            sightings = self._covered(self._read(progress))
        self.all_named = all(s.identity or s.seen_robot for s in sightings)
        if not self.all_named:
            return
        span_ns = round(1e9 * self.config.keyframe.sighting_window_s)
        batches = sighting_batches(sightings, span_ns)
        starts = deque(self._starts())
        times = {*(batch.time_ns for batch in batches), *(time_ns for time_ns, _ in starts)}
        driven = self._driven(np.array(sorted(times), dtype=np.int64))
        for batch in batches:
            while starts and starts[0][0] <= batch.time_ns:
                self._start(*starts.popleft())
            step = self._step(batch, driven)
            if step.motions or step.associations:
                self.steps.append(step)
        while starts:
            self._start(*starts.popleft())
        if self.known.known_map is not None and self.steps:
            self.steps[0] = replace(self.steps[0], known=self.known.known_map.known)

    def _read(self, progress: Progress) -> list[Sighting]:
        """All sightings that may be used; odometry goes into the tracks."""
        sightings: list[Sighting] = []
        read = self.messages(progress)
        first_ns = last_ns = None
        for message in self.accepted(to_common_clock(read, self.known.clocks)):
            if isinstance(message, ODOMETRY):
                self.runs[message.robot].track.add(message)
            elif isinstance(message, Sighting):
                sightings.append(message)
            else:
                continue
            last_ns = message.time_ns
            first_ns = last_ns if first_ns is None else first_ns
        if first_ns is not None and last_ns is not None:
            self.record_time(first_ns)
            self.record_time(last_ns)
        return sightings

    def _covered(self, sightings: Sequence[Sighting]) -> list[Sighting]:
        """The sightings at times that the odometry of all their robots covers."""
        integrate_pending(run.track for run in self.runs.values())
        max_gap_ns = round(1e9 * self.config.odometry.max_gap_s)
        times = np.array([s.time_ns for s in sightings], dtype=np.int64)
        reached = {
            name: run.track.covers_each(times, max_gap_ns).tolist()
            for name, run in self.runs.items()
        }
        covered = []
        for n, s in enumerate(sightings):
            own, other = s.robot, s.seen_robot
            if other is not None and other not in reached:
                self.dropped[f"sighting: robot {other} is not in the log"] += 1
            elif own in reached and reached[own][n] and (other is None or reached[other][n]):
                covered.append(s)
            else:
                self.dropped["sighting: no odometry near it"] += 1
        return covered

    def _starts(self) -> list[tuple[int, str]]:
        """When each robot starts: with its odometry. Sorted by time."""
        runs = self.runs.items()
        return sorted((run.track.first_ns, name) for name, run in runs if len(run.track))

    def _start(self, time_ns: int, robot: str) -> None:
        """Give a robot its first state."""
        start = self.start_prior(robot)
        self.steps.append(Step(time_ns, starts={robot: start}))
        self.record_state(robot, time_ns, start.pose)

    @property
    def tracks(self) -> dict[str, Track]:
        """Odometry of the robots that have a state."""
        return {name: run.track for name, run in self.started.items()}

    @property
    def seen_robots(self) -> list[Sighting]:
        """Sightings of robots in the steps."""
        return [sighting for sighting in self.sources if sighting.seen_robot]

    @cached_property
    def groups(self) -> list[SightingGroup]:
        """The sightings of the steps as arrays."""
        return group_sightings(self.steps, self.sources)

    def keep_steps(self, steps: Iterable[Step]) -> None:
        """Replace the steps by others with the same states."""
        self.steps = list(steps)
        self.__dict__.pop("groups", None)

    def _driven(self, times_ns: IntArray) -> dict[str, dict[int, list[float]]]:
        """Path, m, and heading, rad, of each robot by odometry at each of some times.

        All at once: asked for one by one they took a third of a pass.
        """
        return {
            name: dict(zip(times_ns.tolist(), run.track.driven(times_ns).tolist(), strict=True))
            for name, run in self.runs.items()
            if len(run.track)
        }

    def _step(self, batch: SightingBatch, driven: Mapping[str, Mapping[int, list[float]]]) -> Step:
        """The step of a batch: who gets a state there, and what was seen from which state.

        The rule is that of `Pipeline.add_sighting_batch`; ``driven``: see `_driven`.
        """
        step_ns = batch.time_ns
        mutual = {
            robot
            for image in batch.images
            for s in image
            if s.seen_robot is not None
            for robot in (s.robot, s.seen_robot)
        }
        motions = {}
        for robot in batch.robots:
            run, own = self.runs[robot], driven[robot]
            if step_ns > run.state_ns and (
                robot in mutual or self.keyframes.is_keyframe(own[run.state_ns], own[step_ns])
            ):
                motions[robot] = timed_motion(run.state_ns, step_ns)
                run.times.append(step_ns)
                self.counts["keyframes"] += 1
        associations = []
        for image in batch.images:
            for sighting in image:
                found = self._association(sighting)
                if found is not None:
                    associations.append(found)
        return Step(step_ns, {}, motions, tuple(associations))

    def _association(self, sighting: Sighting) -> Association | None:
        """A sighting with its target, as measured; None if its identity is of another kind."""
        robot, o = sighting.robot, sighting_observation(sighting)
        run, source = self.runs[robot], len(self.sources)
        self.sources.append(sighting)
        self.counts["observations"] += 1
        if sighting.seen_robot is not None:
            model = "robot-point" if o.kind == "point" else "robot-pose"
            target: int | str = sighting.seen_robot
            return Association(robot, run.state_ns, target, model, o.z, o.cov, source=source)
        landmarks = self.associator.map
        number = landmarks.by_identity.get(str(o.identity))
        if number is None:
            # where it is follows when the steps are solved
            entry = landmarks.add(o, np.zeros(3), run.state_ns)
            landmarks.promote(entry)
        else:
            entry = landmarks.entries[number]
        if entry.kind != o.kind:
            self.associator.rejected["identity: known as a landmark of another kind"] += 1
            return None
        entry.sightings += 1
        entry.last_ns = max(entry.last_ns, run.state_ns)
        entry.path_m[robot] = 0.0
        return Association(
            robot, run.state_ns, entry.id, o.kind, o.z, o.cov, extent=o.extent, source=source
        )
