"""The graph of steps that are all recorded: what is many is made at once.

`BatchGraph` makes the factors of a step one by one, as a log that is being read needs it. Here the
observations of bearing and range, of which a log of sightings has tens of thousands, are arrays.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import gtsam
import numpy as np

from graphslam.core.config import RobustConfig
from graphslam.core.geometry import are_positive
from graphslam.core.records import Association, Estimate, Step
from graphslam.estimation import factors
from graphslam.estimation.factor_graph import covariance_of
from graphslam.estimation.input_checks import describe
from graphslam.estimation.isam2 import BatchGraph


class RecordedGraph(BatchGraph):
    """Every factor of recorded steps, in ``graph``, lines deferred.

    ``motions``: index in the graph, robot, and the keys of the states before and after.
    """

    def __init__(self, kernel: RobustConfig) -> None:
        super().__init__(kernel, defer_lines=True)
        self.motions: list[tuple[int, str, int, int]] = []

    def insert_all(self, steps: Iterable[Step], start: Estimate, values: gtsam.Values) -> None:
        """`insert` all steps; factors of bearings and ranges follow all others.

        Raises:
            EstimationError: a covariance is not positive definite and finite, or a state that a
                step refers to was never made.
        """
        polar: dict[str, list[tuple[int, Association]]] = {m: [] for m in factors.BEARING_RANGE}
        for step in steps:
            for index, robot in enumerate(step.motions, self.graph.size() + len(step.starts)):
                last = self.latest_key(robot, step.time_ns)
                self.motions.append((index, robot, last, last + 1))
            others = []
            for seen in step.associations:
                if seen.model in polar:
                    polar[seen.model].append((step.time_ns, seen))
                else:
                    others.append(seen)
            self.insert(replace(step, associations=tuple(others)), start, values)
        for model, observed in polar.items():
            if observed:
                self._insert_polar(model, observed, start, values)

    def _insert_polar(
        self,
        model: str,
        observed: Sequence[tuple[int, Association]],
        start: Estimate,
        values: gtsam.Values,
    ) -> None:
        """Add observations of bearing and range, each with the time of its step."""
        keys, targets = [], []
        for index, (time_ns, seen) in enumerate(observed, self.graph.size()):
            key = self.state_key(seen.robot, self.states.number(seen.robot, seen.time_ns))
            if isinstance(seen.target, str):
                target = self.state_key(seen.target, self.states.number(seen.target, time_ns))
                self.robot_observations.append((index, (key, target, seen)))
            else:
                target = factors.landmark_key(seen.target)
                if seen.target not in self.landmark_dims:
                    self.introduce(seen)
                    factors.write(values, target, self.value_in(start, target))
            keys.append(key)
            targets.append(target)
        z = np.array([seen.z for _, seen in observed])
        cov = np.array([seen.cov for _, seen in observed])
        for bad in np.flatnonzero(~are_positive(cov)).tolist():
            seen = observed[bad][1]
            with covariance_of(describe(seen), seen.cov):
                factors.gaussian(seen.cov)
        self.rows += z.size
        for factor in factors.bearing_range_factors(model, keys, targets, z, cov, self.kernel):
            self.graph.add(factor)
