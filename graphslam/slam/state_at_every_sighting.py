"""The final solution of a log whose sightings have white noise: a state at every sighting."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from graphslam.core.config import RobustConfig
from graphslam.core.record import replace
from graphslam.core.records import Estimate, Step
from graphslam.estimation.batch_calibration import calibrate
from graphslam.estimation.calibration_graph import CalibratedSolution
from graphslam.odometry.preintegration import Track
from graphslam.slam.log_noise import LogNoise, with_own_noise
from graphslam.slam.log_pass import LogPass
from graphslam.slam.motion_noise import scale_motion_noise
from graphslam.slam.sensor_latency import has_latency, hold_insignificant_latency
from graphslam.slam.sighting_states import (
    at_states,
    state_times,
    steps_at_sightings,
    with_motions,
)


@dataclass(frozen=True)
class SightingProblem:
    """Steps at the times of sightings, with the noise of their log, and what their motions need.

    ``begun_ns``: see `with_motions`.
    """

    steps: tuple[Step, ...]
    tracks: Mapping[str, Track]
    noise: LogNoise
    kernel: RobustConfig
    begun_ns: Mapping[str, int]

    def solve(
        self, steps: Sequence[Step], start: Estimate, *, rough: bool = False
    ) -> tuple[Estimate, tuple[Step, ...]]:
        """The estimate of ``steps``, `steps` with other associations, and the steps behind it.

        The calibrations of the tracks are set to what is found. ``rough``: not to the end.

        Raises:
            EstimationError: the estimate is indeterminate.
        """
        if not rough:
            start, _ = self._solved(steps, start, rough=True, decide=True)
        return self._solved(steps, start, rough=rough)

    def _solved(
        self, steps: Sequence[Step], start: Estimate, *, rough: bool, decide: bool = False
    ) -> tuple[Estimate, tuple[Step, ...]]:
        """`solve`, once; ``decide`` whether sightings are late, by what the whole log says."""

        def rebuild(estimate: Estimate, _last: bool) -> tuple[Step, ...]:
            made = with_motions(steps, self.tracks, estimate, self.begun_ns)
            return scale_motion_noise(made, self.noise.motion_scales())

        def hold(solved: CalibratedSolution, _steps: Sequence[Step]) -> None:
            for name, track in self.tracks.items():
                if decide and has_latency(track):
                    cov = solved.graph.calibration_covariance(name)
                    track.calibration = replace(track.calibration, cov=cov)
                    hold_insignificant_latency(track)

        return calibrate(rebuild, start, self.tracks, self.kernel, 1, rough=rough, solved_once=hold)

    def at_sightings(
        self, steps: tuple[Step, ...], estimate: Estimate
    ) -> tuple[tuple[Step, ...], Estimate]:
        """``steps`` and their estimate: there is a state wherever something was seen."""
        return steps, estimate

    def finish(
        self, one: LogPass, steps: Sequence[Step], start: Estimate
    ) -> tuple[Estimate, tuple[Step, ...]]:
        """`solve`; the states of the pass ``one`` become those of ``steps``."""
        times = state_times(steps)
        for name, own in times.items():
            one.runs[name].times = own.tolist()
        one.counts["keyframes"] = sum(map(len, times.values()))
        return self.solve(steps, start)


def state_at_every_sighting(
    one: LogPass, estimate: Estimate, noise: LogNoise
) -> tuple[SightingProblem, Estimate]:
    """The problem of a pass with a state at every sighting, and an estimate of these states.

    Args:
        one: the pass; its kernel and the noise of its tracks are set to the ``noise``.
        estimate: of its steps.
        noise: of the log; that of its sightings is white.
    """
    tracks = {name: run.track for name, run in one.started.items()}
    begun_ns = {name: step.time_ns for step in one.steps for name in step.starts}
    late_ns = {name: t.reported_late_ns(t.calibration) for name, t in tracks.items()}
    steps = steps_at_sightings(one.steps, one.sources, late_ns, one.dropped)
    start = at_states(estimate, steps, tracks)
    for name, track in tracks.items():
        track.config = noise.odometry.get(name, track.config)
    one.kernel = noise.kernel(one.config.robust)
    steps = with_own_noise(steps, noise)
    return SightingProblem(steps, tracks, noise, one.kernel, begun_ns), start
