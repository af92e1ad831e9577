"""iSAM2 that is looked into rarely: its answers on the way come from a filter that starts from it.

Joint marginals and estimates of a large tree are dear, and a robot asks for them at every state.
Most of the time it sees what it saw just before: then the last joint marginal, carried on by the
extended Kalman filter for a few steps, answers the same to second order. The tree takes those steps
in one update.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import replace

import gtsam

from graphslam.backends.base import Joint
from graphslam.backends.ekf import EkfBackend
from graphslam.backends.graph import read
from graphslam.backends.isam2 import Isam2Backend
from graphslam.config import Config, EkfConfig
from graphslam.geometry import Array
from graphslam.records import Association, Estimate, Step


class RareLooksBackend(Isam2Backend):
    """As iSAM2; with more than one robot, or where the filter cannot follow, it looks every time.

    As long as there is a filter, steps may wait to enter the tree.
    """

    def __init__(self, config: Config) -> None:
        super().__init__(config)
        self._every = config.backend.look_every
        self._filter_config = replace(config, ekf=EkfConfig(past_states=0))
        self._filter: EkfBackend | None = None
        self._waiting: list[Step] = []
        self._lately: deque[set[int]] = deque(maxlen=self._every)  # landmarks seen in steps

    # ------------------------------------------------------------ evidence in

    def add(self, step: Step) -> None:
        """See `Backend`."""
        carried = None if self._filter is None else self._carried(step, self._filter)
        if self._filter is None or carried is None:
            self._take()
            super().add(step)
        else:
            self._filter.add(carried)
            self._waiting.append(step)
            if len(self._waiting) >= self._every:
                self._take()
        self._lately.append({a.target for a in step.associations if isinstance(a.target, int)})

    def _carried(self, step: Step, known: EkfBackend) -> Step | None:
        """What of a step concerns the filter; None if it cannot follow."""
        if step.starts or step.closures or any(robot not in known for robot in step.motions):
            return None
        seen: list[Association] = []
        for a in step.associations:
            # late: of a state that it has forgotten
            if a.late or a.robot not in known or not isinstance(a.target, int):
                return None
            now = step.time_ns if a.robot in step.motions else known.latest_ns(a.robot)
            if a.time_ns != now or (
                a.target not in known and a.target in self._builder.landmark_dims
            ):
                return None
            seen.append(a)
        return replace(step, associations=tuple(seen))

    def _take(self) -> None:
        """Give the tree what waits; it answers from now on."""
        self._filter = None
        waiting, self._waiting = self._waiting, []
        if not waiting:
            return
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()

        def current(key: int, dim: int) -> Array:
            return read(values, key, dim) if values.exists(key) else self.value(key, dim)

        for step in waiting:
            made, new = self._builder.expand(step, current)
            graph.push_back(made)
            values.insert(new)
        self._update(graph, values)

    # ------------------------------------------------------------ knowledge out

    def joint(self, robot: str, landmarks: Sequence[int], others: Sequence[str] = ()) -> Joint:
        """See `Backend`."""
        known = self._filter
        if known is not None and not others and all(k in known for k in (robot, *landmarks)):
            return known.joint(robot, landmarks)
        self._take()
        if others or self._every == 1 or len(self._builder.robots) > 1:
            return super().joint(robot, landmarks, others)
        there = self._builder.landmark_dims
        lately = {k for seen in self._lately for k in seen if k in there} - set(landmarks)
        wanted = [*landmarks, *sorted(lately)]
        found, time_ns = super().joint(robot, wanted), self._builder.states.times[robot][-1]
        self._filter = EkfBackend.from_joint(self._filter_config, robot, time_ns, found, wanted)
        return self._filter.joint(robot, landmarks)

    def state_mean(self, robot: str) -> Array:
        """See `Backend`."""
        known = self._filter
        if known is not None and robot in known:
            return known.state_mean(robot)
        return super().state_mean(robot)

    def landmark_means(self, landmarks: Sequence[int]) -> list[Array]:
        """See `Backend`; of those that the filter does not know, as the last look had them."""
        known = self._filter
        if known is None:
            return super().landmark_means(landmarks)
        near = {k for k in landmarks if k in known}
        far = iter(super().landmark_means([k for k in landmarks if k not in near]))
        return [known.landmark_means([k])[0] if k in near else next(far) for k in landmarks]

    def covariance(self, keys: list[int]) -> Array:
        """See `GraphBackend`."""
        self._take()
        return super().covariance(keys)

    def rough(self) -> Estimate:
        """See `Isam2Backend`."""
        self._take()
        return super().rough()

    def finish(self) -> Estimate:
        """See `Backend`."""
        self._take()
        return super().finish()
