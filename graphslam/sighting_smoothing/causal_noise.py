"""The noise of sightings as a log shows it up to a time, for the causal trajectories.

Where sightings of one target share errors, a row of them tells far less than as many others. How
much they share is measured as for the final solution (`sighting_noise`), from what was read until
then.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.config import Config
from graphslam.core.records import Estimate, Sighting, Step
from graphslam.estimation.log_noise import LogNoise
from graphslam.estimation.recorded_graph import SHARED_NS, Source
from graphslam.odometry.preintegration import Track
from graphslam.sighting_smoothing.reoptimise_sightings import SightingGroup
from graphslam.sighting_smoothing.sighting_noise import estimate_noise

#: sightings after which the noise is measured: fewer tell less, more leave less of the log
MEASURED_AFTER = 3000


class NoiseSoFar:
    """The noise of the sightings of a log, from its first part.

    ``groups``: all sightings of the log, by that noise once it is known. ``known``: the sources
    whose errors are shared, or that state no noise; n sightings of one target in a step count as
    one for the others, and have the noise that is stated.
    """

    def __init__(
        self,
        steps: Sequence[Step],
        groups: Sequence[SightingGroup],
        sources: Sequence[Sighting],
        config: Config,
    ) -> None:
        """Begin before the first of all ``steps`` of a log.

        Args:
            steps: as recorded.
            groups: their sightings, as measured.
            sources: `Association.source` is an index into them.
            config: settings.
        """
        self.groups, self.known = groups, frozenset[Source]()
        self._steps, self._sources, self._config = steps, sources, config
        seen = np.cumsum([len(step.associations) for step in steps])
        #: number of steps after which the noise is measured
        self._first = int(np.searchsorted(seen, MEASURED_AFTER)) + 1
        self._done = False

    def is_due(self, taken: int) -> bool:
        """Whether the noise is to be measured, after so many steps."""
        return not self._done and self._first <= taken < len(self._steps)

    def measure(self, taken: int, estimate: Estimate, tracks: Mapping[str, Track]) -> bool:
        """Measure the noise; whether it is used, so that the ``groups`` are others.

        It is where errors are shared, or noise is not stated.

        Args:
            taken: number of the steps so far.
            estimate: of their states and landmarks.
            tracks: odometry of every robot; they stay as they are.

        Raises:
            EstimationError: the estimate is indeterminate.
        """
        self._done = True
        own = {name: tracks[name] for name in estimate.states}
        before = {name: (track.calibration, track.prior) for name, track in own.items()}
        try:
            # one round tells whether errors are shared; noise that is white is used as stated
            noise = estimate_noise(
                self._steps[:taken], self._sources, estimate, own, self._config, rounds=1
            )
        finally:
            for name, (calibration, prior) in before.items():
                own[name].calibration, own[name].prior = calibration, prior
        shared = frozenset(s for s, found in noise.sightings.items() if found.shared.any())
        self.known = shared | noise.unstated.keys()
        self.groups = [
            _with_noise(group, noise) if _source(group) in self.known else group
            for group in self.groups
        ]
        return bool(self.known)


def _source(group: SightingGroup) -> Source:
    """Who made the sightings of a group, and their model."""
    kind = "point" if group.z.shape[1] == 2 else "pose"
    return group.robot, kind if group.other is None else f"robot-{kind}"


def _with_noise(group: SightingGroup, noise: LogNoise) -> SightingGroup:
    """Sightings by the noise of a log; what they share counts as often as there were sightings.

    Of their target, in the same step and in the last `SHARED_NS`: later ones are not known.
    """
    own = noise.sightings[_source(group)]
    count = count_so_far(group.landmarks, group.seen_ns, group.step_ns)
    sigma = np.sqrt(own.white + count[:, None] * own.shared)
    cov = group.cov * sigma[:, :, None] * sigma[:, None, :]
    return replace(group, cov=cov, share=np.ones_like(group.share))


def count_so_far(targets: IntArray, seen_ns: IntArray, until_ns: IntArray) -> IntArray:
    """How many (n,) sightings of each one's target are not later than a time.

    Those more than `SHARED_NS` before it do not count.

    Args:
        targets: (n,) numbers.
        seen_ns: (n,) times of the sightings.
        until_ns: (n,) the times to count to.
    """
    count = np.zeros(len(targets), dtype=np.int64)
    for target in np.unique(targets).tolist():
        own = np.flatnonzero(targets == target)
        times = np.sort(seen_ns[own])
        first = np.searchsorted(times, seen_ns[own] - SHARED_NS, side="right")
        count[own] = np.searchsorted(times, until_ns[own], side="right") - first
    return count
