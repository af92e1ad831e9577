"""The final solution of a log of sightings with a state at every sighting."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from graphslam.core.config import RobustConfig
from graphslam.core.record import replace
from graphslam.core.records import Estimate, Step
from graphslam.estimation.batch_calibration import calibrate
from graphslam.estimation.calibration_graph import CalibratedSolution
from graphslam.estimation.log_noise import LogNoise, weighed, with_own_noise
from graphslam.estimation.motion_noise import scale_motion_noise
from graphslam.estimation.recorded_graph import ObservationNoise, Source
from graphslam.odometry.preintegration import Track
from graphslam.pipeline.log_pass import LogPass
from graphslam.sighting_smoothing.sensor_latency import (
    has_latency,
    hold_insignificant_latency,
    shows_latency,
)
from graphslam.sighting_smoothing.sighting_states import (
    at_states,
    state_times,
    steps_at_sightings,
    with_motions,
    with_states_between,
)


@dataclass(frozen=True, slots=True, eq=False)
class FineSolution:
    """The final solution of a log: the estimate, the steps behind it, and what was solved.

    ``shared``: noise of sightings that share errors.
    """

    estimate: Estimate
    steps: tuple[Step, ...]
    solved: CalibratedSolution
    made: Sequence[Step]
    shared: Mapping[Source, ObservationNoise] | None


class LastSolution:
    """Keeps what `calibrate` solved last."""

    def __call__(self, solved: CalibratedSolution, steps: Sequence[Step]) -> None:
        """Keep this one."""
        self._solved, self._steps = solved, steps

    def fine(
        self,
        estimate: Estimate,
        steps: tuple[Step, ...],
        shared: Mapping[Source, ObservationNoise] | None,
    ) -> FineSolution:
        """What `calibrate` returned, with what is kept."""
        return FineSolution(estimate, steps, self._solved, self._steps, shared)


@dataclass(frozen=True)
class SightingProblem:
    """Steps at the times of sightings, as measured, the noise of their log, and what motions need.

    ``begun_ns``: see `with_motions`.
    """

    steps: tuple[Step, ...]
    tracks: Mapping[str, Track]
    noise: LogNoise
    kernel: RobustConfig
    begun_ns: Mapping[str, int]

    def of_steps(self, steps: tuple[Step, ...]) -> "SightingProblem":
        """The same of ``steps``, of which some associations may be left out."""
        return replace(self, steps=steps)

    def solve(
        self, steps: Sequence[Step], start: Estimate, *, rough: bool = False
    ) -> tuple[Estimate, tuple[Step, ...]]:
        """The estimate of ``steps``, `steps` with other associations, and the steps behind it.

        The calibrations of the tracks are set to what is found. ``rough``: not to the end.

        Raises:
            EstimationError: the estimate is indeterminate.
        """
        return self._solved(steps, start, rough=rough)

    def decide_latencies(self, start: Estimate) -> Estimate:
        """Decide whether sightings are late, by what the whole log says; a rough estimate.

        Raises:
            EstimationError: the estimate is indeterminate.
        """

        def decide(solved: CalibratedSolution, _steps: Sequence[Step]) -> None:
            covs = solved.graph.calibration_covariances()
            for name, track in self.tracks.items():
                if has_latency(track):
                    track.calibration = replace(track.calibration, cov=covs[name])
                    hold_insignificant_latency(track)

        estimate, _ = self._solved(self.steps, start, rough=True, solved_once=decide)
        return estimate

    def _solved(
        self,
        steps: Sequence[Step],
        start: Estimate,
        *,
        rough: bool,
        solved_once: Callable[[CalibratedSolution, Sequence[Step]], None] | None = None,
    ) -> tuple[Estimate, tuple[Step, ...]]:
        """`solve`; for ``solved_once`` see `calibrate`."""
        seen = weighed(steps, self.noise)

        def rebuild(estimate: Estimate, _last: bool) -> tuple[Step, ...]:
            made = with_motions(seen, self.tracks, estimate, self.begun_ns)
            return scale_motion_noise(made, self.noise.motion_scales())

        return calibrate(
            rebuild,
            start,
            self.tracks,
            self.kernel,
            1,
            rough=rough,
            solved_once=solved_once,
            shared=self.noise.shared_errors,
            settle=not rough,
        )

    def at_sightings(
        self, steps: tuple[Step, ...], estimate: Estimate
    ) -> tuple[tuple[Step, ...], Estimate]:
        """``steps`` and their estimate: there is a state wherever something was seen."""
        return with_own_noise(steps, self.noise), estimate

    def finish(self, one: LogPass, steps: Sequence[Step], start: Estimate) -> FineSolution:
        """`solve`; the states of the pass ``one`` become those of ``steps``."""
        times = state_times(steps)
        for name, own in times.items():
            one.runs[name].times = own.tolist()
        one.counts["keyframes"] = sum(map(len, times.values()))
        return self.solved_finely(steps, start)

    def solved_finely(self, steps: Sequence[Step], start: Estimate) -> FineSolution:
        """`solve` to the end, with what was solved."""
        last = LastSolution()
        found = self._solved(steps, start, rough=False, solved_once=last)
        return last.fine(*found, self.noise.shared_errors)


def state_at_every_sighting(
    one: LogPass, estimate: Estimate, noise: LogNoise
) -> tuple[SightingProblem, Estimate]:
    """The problem of a pass with a state at every sighting, and an estimate of these states.

    It is decided whether sightings are late, since a robot's first state depends on that.

    Args:
        one: the pass; its kernel and the noise of its tracks are set to the ``noise``.
        estimate: of its steps.
        noise: of the log.

    Raises:
        EstimationError: the estimate is indeterminate.
    """
    for name, run in one.started.items():
        run.track.config = noise.odometry.get(name, run.track.config)
    one.kernel = noise.kernel(one.config.robust)
    dropped: Counter[str] = Counter()
    late_ns = _late_ns(one)
    problem, start = _problem(one, estimate, noise, late_ns, dropped)
    if not noise.of_whole_log:  # else it is decided
        start = problem.decide_latencies(start)
    if (decided_ns := _late_ns(one)) != late_ns:
        dropped.clear()
        problem, start = _problem(one, start, noise, decided_ns, dropped)
    one.dropped.update(dropped)
    return problem, start


def _late_ns(one: LogPass) -> dict[str, int]:
    """Robot -> by how much its sightings are stamped late, where the log shows that clearly."""
    tracks = {name: run.track for name, run in one.started.items()}
    return {
        name: track.reported_late_ns(track.calibration)
        for name, track in tracks.items()
        if shows_latency(track)
    }


def _problem(
    one: LogPass,
    estimate: Estimate,
    noise: LogNoise,
    late_ns: Mapping[str, int],
    dropped: Counter[str],
) -> tuple[SightingProblem, Estimate]:
    """`state_at_every_sighting`, with robots that begin as ``late_ns`` says."""
    tracks = {name: run.track for name, run in one.started.items()}
    begun_ns = {name: step.time_ns for step in one.steps for name in step.starts}
    steps = steps_at_sightings(one.steps, one.sources, late_ns, dropped)
    steps = with_states_between(steps, tracks)
    problem = SightingProblem(steps, tracks, noise, one.kernel, begun_ns)
    return problem, at_states(estimate, steps, tracks)
