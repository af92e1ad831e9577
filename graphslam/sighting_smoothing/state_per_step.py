"""The final solution of a log of sightings: a state at every one of them, or one per step."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from graphslam.core.config import Config
from graphslam.core.records import Estimate, Sighting, Step
from graphslam.estimation.log_noise import LogNoise, has_state_at_every_sighting, with_own_noise
from graphslam.odometry.noise_estimation import is_stated
from graphslam.odometry.preintegration import Track
from graphslam.pipeline.log_pass import LogPass
from graphslam.sighting_smoothing.reoptimise_sightings import (
    SightingGroup,
    group_sightings,
    solve_sighting_log,
)
from graphslam.sighting_smoothing.sighting_states import at_states, steps_at_sightings
from graphslam.sighting_smoothing.state_at_every_sighting import (
    FineSolution,
    LastSolution,
    SightingProblem,
    state_at_every_sighting,
)


@dataclass(frozen=True)
class SteppedProblem:
    """Steps as recorded, of several sightings each, whose errors last for seconds.

    ``groups``: the sightings of ``steps``, as measured; for the methods see `SightingProblem`.
    """

    steps: tuple[Step, ...]
    sources: Sequence[Sighting]
    groups: Sequence[SightingGroup]
    tracks: Mapping[str, Track]
    noise: LogNoise
    config: Config

    def of_steps(self, steps: tuple[Step, ...]) -> "SteppedProblem":
        """The same of ``steps``, of which some associations may be left out."""
        return replace(self, steps=steps, groups=group_sightings(steps, self.sources))

    def solve(
        self, steps: Sequence[Step], start: Estimate, *, rough: bool = False
    ) -> tuple[Estimate, tuple[Step, ...]]:
        """The estimate of ``steps``, `steps` with other associations, and the steps behind it.

        It is never ``rough``: `at_sightings` needs its covariances.

        Raises:
            EstimationError: the estimate is indeterminate.
        """
        return self._solved(steps, start)

    def _solved(
        self, steps: Sequence[Step], start: Estimate, last: LastSolution | None = None
    ) -> tuple[Estimate, tuple[Step, ...]]:
        """`solve`; ``last`` keeps what was solved."""
        groups = [_of_steps(group, steps) for group in self.groups]
        return solve_sighting_log(
            steps, start, self.tracks, groups, self.config, 1, self.noise, solved_once=last
        )

    def at_sightings(
        self, steps: tuple[Step, ...], estimate: Estimate
    ) -> tuple[tuple[Step, ...], Estimate]:
        """Steps at the times of the sightings of points in ``steps``, and the estimate there."""
        of_points = [
            replace(step, associations=tuple(a for a in step.associations if a.model == "point"))
            for step in steps
        ]
        made = steps_at_sightings(of_points, self.sources, {}, Counter())
        return with_own_noise(made, self.noise), at_states(estimate, made, self.tracks)

    def finish(self, _one: LogPass, steps: Sequence[Step], start: Estimate) -> FineSolution:
        """`solved_finely`."""
        return self.solved_finely(steps, start)

    def solved_finely(self, steps: Sequence[Step], start: Estimate) -> FineSolution:
        """`solve`, with what was solved."""
        last = LastSolution()
        return last.fine(*self._solved(steps, start, last), self.noise.shared_errors)


def _of_steps(group: SightingGroup, steps: Sequence[Step]) -> SightingGroup:
    """Sightings of landmarks with the numbers that these have in ``steps``."""
    if group.other is not None:
        return group
    targets = [steps[n].associations[k].target for n, k in group.where.tolist()]
    return replace(group, landmarks=np.array(targets, dtype=np.int64))


def sighting_problem(
    one: LogPass,
    estimate: Estimate,
    noise: LogNoise,
    groups: Sequence[SightingGroup] | None = None,
) -> tuple[SightingProblem | SteppedProblem, Estimate]:
    """The problem of a pass as the ``noise`` of its log asks for it, and an estimate of its states.

    Args:
        one: the pass; noise of odometry that nobody states is set to that of the log, and with a
            state at every sighting its kernel and all noise.
        estimate: of its steps.
        noise: of the log.
        groups: the sightings of its steps, if they are known.
    """
    if has_state_at_every_sighting(noise.sightings):
        return state_at_every_sighting(one, estimate, noise)
    steps, tracks = tuple(one.steps), {name: run.track for name, run in one.started.items()}
    for name, track in tracks.items():
        if not is_stated(track):  # noise that is stated keeps its floors
            track.config = noise.odometry.get(name, track.config)
    if groups is None:
        groups = group_sightings(steps, one.sources)
    return SteppedProblem(steps, one.sources, groups, tracks, noise, one.config), estimate
