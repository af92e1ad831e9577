"""What passes over a log end with."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

from graphslam.core.records import Estimate
from graphslam.estimation.clock_calibration import ClockEstimate
from graphslam.pipeline.log_pass import LogPass
from graphslam.pipeline.robot_state import Causal


class Findings(NamedTuple):
    """Results of a pass besides its estimate.

    ``swapped_identities``: false identity -> right one; ``clocks``: the robots' clocks as their
    sightings of each other show them; ``causal``: causal trajectories.
    """

    swapped_identities: Mapping[str, str]
    clocks: Mapping[str, ClockEstimate]
    causal: Mapping[str, Causal]


class FinishedPass(NamedTuple):
    """The last pass over a log, its final estimate and what it found.

    ``is_settled``: the estimate is at the minimum of the steps, see `graphslam.estimation.settled`.
    ``causal_later``: waits for the causal trajectories and gives them, where they are not in the
    findings yet.
    """

    pipeline: LogPass
    estimate: Estimate
    findings: Findings
    is_settled: bool = False
    causal_later: Callable[[], Mapping[str, Causal]] | None = None
