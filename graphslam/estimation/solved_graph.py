"""A solution of a recorded graph, as what is computed from it afterwards needs it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.geometry import Array
from graphslam.core.information_root import InformationRoot
from graphslam.core.motion_models import Calibration
from graphslam.estimation import factors
from graphslam.estimation.joint_covariances import information_root
from graphslam.estimation.recorded_graph import RecordedGraph
from graphslam.estimation.selected_inverse import CliqueRows


@dataclass(frozen=True, slots=True, eq=False)
class SolvedGraph:
    """A graph, the values at its minimum, and the root of its information.

    ``calibrations``: robot -> key of its calibration, if any of it is unknown, and what is before
    any data. Its rows of the root are in the place of a mount's. ``poses_at``: see
    `RecordedGraph.pose_reader`.
    """

    builder: RecordedGraph
    values: gtsam.Values
    root: InformationRoot
    calibrations: Mapping[str, tuple[int, Calibration]]
    poses_at: Callable[[IntArray], Array]

    @classmethod
    def of(
        cls,
        builder: RecordedGraph,
        values: gtsam.Values,
        rows: Sequence[CliqueRows],
        calibrations: Mapping[str, tuple[int, Calibration]],
    ) -> "SolvedGraph":
        """Of the ``rows`` of the root, as they were eliminated."""
        keys = {robot: builder.state_keys(robot) for robot in builder.robots}
        marks = {number: factors.landmark_key(number) for number in builder.landmark_dims}
        own = {robot: (key, range(len(prior.cov))) for robot, (key, prior) in calibrations.items()}
        root = information_root(rows, keys, marks, own)
        return cls(builder, values, root, calibrations, builder.pose_reader(values))

    def gradient(self) -> Array:
        """That of half the squared error, (R,) by rows of the root; zero at the very minimum."""
        builder, root, first = self.builder, self.root, dict[int, int]()
        for robot in builder.robots:
            first.update(zip(builder.state_keys(robot), root.states[robot].tolist(), strict=True))
        first |= {factors.landmark_key(i): row for i, row in root.landmarks.items()}
        first |= {key: int(root.mounts[r][0]) for r, (key, _) in self.calibrations.items()}
        by_key = builder.graph.linearize(self.values).gradientAtZero()
        found = np.zeros(int(root.own.sum()))
        for key, row in first.items():
            own = by_key.at(key)
            found[row : row + len(own)] = own
        return found
