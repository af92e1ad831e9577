"""A log of named sightings as steps, all at once: no estimate is needed to associate them.

`Pipeline` estimates while it reads, since association needs an estimate. Where every sighting says
what it is of, the steps follow from odometry alone. Motions and measurements are computed when the
steps are solved (`sighting_solution`) or replayed (`causal_sightings`), many at once.
"""

from functools import cached_property

import numpy as np

from graphslam.core.config import Config
from graphslam.core.records import (
    Association,
    Motion,
    RelativePose,
    Scan,
    Sighting,
    Step,
)
from graphslam.logs import LogSet
from graphslam.odometry.readings import integrate_pending
from graphslam.perception.sightings import sighting_observation
from graphslam.slam.pipeline import Pipeline, Progress
from graphslam.slam.reoptimise_sightings import SightingGroup, group_sightings
from graphslam.slam.sighting_batches import SightingBatch
from graphslam.slam.step_recorder import PriorKnowledge


def can_solve_at_once(log: LogSet, config: Config) -> bool:
    """Whether the steps of a log may not depend on estimates, as far as its topics tell.

    It then has sightings by several robots, but no scans and no relative poses.
    """
    kinds = {topic.record for topic in log.topics}
    return (
        Sighting in kinds
        and not kinds & {Scan, RelativePose}
        and len(log.robots) > 1
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
        self._batches: list[tuple[int, SightingBatch]] = []  # after so many starts

    def run(self, progress: Progress) -> None:
        """See `Pipeline`."""
        super().run(progress)
        starts, self.steps = self.steps, []
        if not (self.all_named and self._batches):
            return
        integrate_pending(run.track for run in self.runs.values())
        done = 0
        for before, batch in self._batches:
            self.steps += starts[done:before]
            done = before
            step = self._step(batch)
            if step.motions or step.associations:
                self.steps.append(step)
        self.steps += starts[done:]

    @cached_property
    def groups(self) -> list[SightingGroup]:
        """The sightings of the steps as arrays."""
        return group_sightings(self.steps, self.sources)

    def start(self, robot: str, time_ns: int) -> None:
        """See `StepRecorder`; there is no back end."""
        start = self.prior(robot)
        self.steps.append(Step(time_ns, starts={robot: start}))
        self.record_state(robot, time_ns, start.pose)

    def record_covariances(self) -> None:
        """Nothing: without a back end there are none."""

    def add_sighting_batch(self, batch: SightingBatch) -> None:
        """Note a batch; its step is made when the odometry of the whole log is there."""
        self.record_time(batch.first_ns)
        self.record_time(batch.time_ns)
        for image in batch.images:
            self.start_if_needed(image[0].robot, image[0].time_ns)
        for robot in sorted(_mutual(batch)):
            self.start_if_needed(robot, batch.time_ns)
        self.all_named &= all(s.identity or s.seen_robot for image in batch.images for s in image)
        self._batches.append((len(self.steps), batch))

    def _step(self, batch: SightingBatch) -> Step:
        """The step of a batch: who gets a state there, and what was seen from which state.

        The rule is that of `Pipeline.add_sighting_batch`.
        """
        step_ns, mutual = batch.time_ns, _mutual(batch)
        motions = {}
        for robot in batch.robots:
            run = self.runs[robot]
            if step_ns > run.state_ns and (
                robot in mutual or self.keyframes.has_moved(run, run.state_ns, step_ns)
            ):
                motions[robot] = _timed_motion(run.state_ns, step_ns)
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
            entry.in_graph = True
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


def _mutual(batch: SightingBatch) -> set[str]:
    """Robots that saw a robot or were seen."""
    return {
        robot
        for image in batch.images
        for s in image
        if s.seen_robot is not None
        for robot in (s.robot, s.seen_robot)
    }


def _timed_motion(start_ns: int, end_ns: int) -> Motion:
    """A motion of which only the times are known yet."""
    unknown = np.full(3, np.nan)
    return Motion(start_ns, end_ns, unknown, np.full((3, 3), np.nan), np.zeros((3, 0)), 0.0)
