"""Steps and closures solved again and again, while a log of scans is reoptimised."""

from collections.abc import Sequence

from graphslam.core.config import Config
from graphslam.core.records import Closure, Estimate, Step
from graphslam.estimation.isam2 import Reoptimiser


class Solver:
    """Solves steps with closures; ``backend`` is the latest one, for its covariances."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._solved: tuple[Sequence[Step], Estimate] | None = None

    def __call__(
        self,
        steps: Sequence[Step],
        start: Estimate,
        closures: Sequence[Closure] = (),
        *,
        rough: bool = True,
        joint: bool = False,
    ) -> Estimate:
        """The estimate; the graph stays as long as steps are the same and go on from the last."""
        if self._solved is None or self._solved[0] is not steps or self._solved[1] is not start:
            self.backend = Reoptimiser(self._config, steps, start)
        estimate = self.backend.solve(closures, rough=rough, joint=joint)
        self._solved = steps, estimate
        return estimate
