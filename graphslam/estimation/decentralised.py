"""Decentralised smoothing, simulated: a graph per robot, and condensed messages between them.

Every robot smooths its own measurements and periodically sends the others those since its last
message. States that no other robot needs are eliminated. What remains of a section of them is a
Gaussian over its two ends and the landmarks seen from it, sent as information with its
linearisation point (DDF-SAM: A. Cunningham, M. Paluri, F. Dellaert, IROS 2010, DOI
10.1109/IROS.2010.5652875, who send the whole condensed map each time; here each message covers its
own interval). Shared variables are landmarks, states from which or at which robots observed each
other, and the first and last state of the interval. Measurements are sent as they are where there
is nothing to eliminate, or where that is smaller.

No information is counted twice: a message consists of the sender's own measurements of one
interval, never of messages. All messages and the receiver's own measurements are different factors
of one graph, whose sum is the centralised one, with two losses: condensed factors keep their
linearisation point and robust weights, and between messages the others are unknown.

The network may lose messages or deliver them late, see `message_link`. At the end the robots meet:
each gives the others what they still lack. It is assumed that a robot that is seen by another one
learns so at once, since the state at which that was must not be eliminated. Landmarks have common
names, or each robot has its own (`network.landmarks`): then what it receives is compared with what
it has, see `landmark_ties`. Which of its own observations are of one landmark is as recorded.
"""

from collections import Counter
from collections.abc import Iterable, Sequence

import gtsam
import numpy as np

from graphslam.core.config import Config
from graphslam.core.geometry import Array
from graphslam.core.observation_models import MODELS
from graphslam.core.records import Estimate, Step
from graphslam.estimation import factors
from graphslam.estimation.factor_graph import FactorGroup, GraphBackend, GraphBuilder
from graphslam.estimation.isam2 import isam2_parameters, isam2_tree
from graphslam.estimation.landmark_ties import tied
from graphslam.estimation.local_smoother import (
    KEY_BYTES,
    NUMBER_BYTES,
    FactorMessage,
    LocalSmoother,
    Measurement,
    number_in,
    owner_of,
    prefix_of,
)
from graphslam.estimation.message_link import Network, Packet
from graphslam.estimation.optimisation import optimise

NOT_SENT = "evidence about a state before the last message: kept locally, not sent"


class DecentralisedBackend(GraphBackend):
    """See the module's docstring; queries about a robot are answered by its own estimator.

    ``own_names``: whether robots have landmarks' names of their own.
    """

    def __init__(self, config: Config) -> None:
        super().__init__(GraphBuilder(config.robust))
        self._config = config
        self._period_ns = round(1e9 * config.backend.exchange_s)
        self._next_ns: int | None = None
        self.robots: list[LocalSmoother] = []
        self._queried: LocalSmoother | None = None  # the robot whose state was queried last
        self._network: Network[FactorMessage] = Network(config.network)
        self.own_names = config.network.landmarks == "own"
        self._now_ns = 0
        self.messages = 0

    @property
    def sent(self) -> dict[str, int]:
        """Robot -> bytes of its messages, each counted once, whatever the number of receivers."""
        return {robot.name: robot.sent for robot in self.robots}

    @property
    def measured(self) -> dict[str, int]:
        """Robot -> bytes of its measurements as they are: what a centralised estimate needs."""
        return {robot.name: robot.measured for robot in self.robots}

    def add(self, step: Step) -> None:
        """See `Backend`; an exchange comes before the first step after its time."""
        self._joints.clear()
        self._now_ns = step.time_ns
        if self._next_ns is None:
            self._next_ns = step.time_ns + self._period_ns
        if step.time_ns >= self._next_ns:
            self.exchange()
            elapsed = (step.time_ns - self._next_ns) // self._period_ns
            self._next_ns += self._period_ns * (1 + elapsed)
        self._receive()
        for group in self.builder.factor_groups(step, self.value):
            self._add(group)
        self._update()

    def _add(self, group: FactorGroup) -> None:
        """Give factors to the robot that measured them."""
        keys = list(dict.fromkeys(key for f in group.factors for key in f.keys()))  # noqa: SIM118
        states = [key for key in keys if factors.is_state(key)]
        key = group.observed[0] if group.observed else states[-1]
        robot = self._robot_of(key)
        size = _measured_bytes(group)
        robot.measured += size
        late = any(factors.number_of(k)[1] < self._robot_of(k).last_sent for k in states)
        if len({factors.number_of(k)[0] for k in states}) > 1:
            if late:
                self.builder.skipped[NOT_SENT] += 1
            else:
                robot.sightings.append(Measurement(group.factors, size))
                robot.waiting += group.factors
            return
        new, made = dict([group.new] if group.new else []), group.factors
        if group.observed and group.observed[1] not in {*robot.dims, *new}:
            # a landmark of other robots, of which this one has no message yet
            _, target, seen = group.observed
            new[target] = MODELS[seen.model].invert(seen.z, self.value(key, 3))
            if seen.model == "line":  # until then its gauge must be fixed here
                gauge = factors.line_gauge_factor(key, target, seen)
                if self.own_names:
                    made = (gauge, *made)
                else:
                    robot.add([gauge], {})
        robot.add(made, new)
        if late:
            self.builder.skipped[NOT_SENT] += 1
        else:
            robot.unsent.append(Measurement(made, size))

    def exchange(self) -> None:
        """Every robot sends its measurements since its last message to all others."""
        self._joints.clear()
        shared = {key for robot in self.robots for one in robot.sightings for key in one.keys()}  # noqa: SIM118
        for n, robot in enumerate(self.robots):
            last = len(self.builder.states.times[robot.name]) - 1
            ends = {factors.state_key(n, number) for number in (robot.last_sent, last)}
            message = robot.message(shared | ends)
            robot.last_sent = last
            self.messages += 1
            sent = robot.outbox.send(message, self._now_ns)
            lacking = {name: inbox.lacking() for name, inbox in robot.inboxes.items()}
            numbers = len(sent) + sum(map(len, lacking.values()))
            robot.sent += sum(one.size for _, one in sent) + NUMBER_BYTES * numbers
            others = (other.name for other in self.robots if other is not robot)
            self._network.send(Packet(robot.name, self._now_ns, sent, lacking), others)
        self._receive()
        self._update()

    def _receive(self) -> None:
        """Let robots take in what has arrived."""
        by_name = {robot.name: robot for robot in self.robots}
        for name, packet in self._network.arrived(self._now_ns):
            robot = by_name[name]
            robot.outbox.ask(packet.lacking.get(name, ()), packet.sent_ns)
            self._take(robot, by_name[packet.sender], packet.messages)

    def _take(
        self,
        robot: LocalSmoother,
        sender: LocalSmoother,
        messages: Iterable[tuple[int, FactorMessage]],
    ) -> None:
        """Let a robot use the messages of another one that are next."""
        accepted = robot.inboxes[sender.name].accept(messages)
        robot.receive(accepted)
        if self.own_names and accepted:
            robot.tie_landmarks(self._config.association)

    def _meet(self) -> None:
        """Let every robot give the others what they lack."""
        for sender in self.robots:
            contents = sender.outbox.contents
            lacked: set[int] = set()
            for robot in self.robots:
                if robot is not sender:
                    inbox = robot.inboxes[sender.name]
                    lacked |= set(range(inbox.following, len(contents))) - inbox.early.keys()
                    self._take(robot, sender, enumerate(contents))
            sender.sent += sum(contents[number].size + NUMBER_BYTES for number in lacked)
        self._update()

    def _update(self) -> None:
        for robot in self.robots:
            try:
                robot.update()
            except RuntimeError as error:
                raise self.builder.explain(error) from error

    def _robot_of(self, key: int) -> LocalSmoother:
        """The robot whose state ``key`` is."""
        index, _ = factors.number_of(key)
        assert index is not None  # a landmark belongs to no robot
        while len(self.robots) <= index:
            name = self.builder.robots[len(self.robots)]
            tree = gtsam.ISAM2(isam2_parameters(self._config, "QR"))
            prefix = prefix_of(len(self.robots)) if self.own_names else 0
            self.robots.append(LocalSmoother(name, tree, prefix=prefix))
        return self.robots[index]

    def value(self, key: int, dim: int) -> Array:
        """See `GraphBackend`: of a state by its robot, of a landmark by `_robot_with` it."""
        if factors.is_state(key):
            self._queried = self._robot_of(key)
            return self._queried.value(key)
        return self._robot_with(key).value(key)

    def _robot_with(self, key: int) -> LocalSmoother:
        """The robot queried last if it has the variable, else the first one that has."""
        first = [self._queried] if self._queried is not None else []
        return next(robot for robot in (*first, *self.robots) if key in robot.dims)

    def landmark_means(self, landmarks: Sequence[int]) -> list[Array]:
        """See `Backend`: each by the first robot that has it."""
        self._queried = None
        return super().landmark_means(landmarks)

    def covariance(self, keys: list[int]) -> Array:
        """See `GraphBackend`; variables that the first one's robot lacks count as independent."""
        first = self._robot_of(keys[0])
        blocks = [(first, [key for key in keys if key in first.dims])]
        for key in keys:
            if key not in first.dims:
                is_state = factors.is_state(key)
                blocks.append((self._robot_of(key) if is_state else self._robot_with(key), [key]))
        dims = {key: robot.dims[key] for robot, block in blocks for key in block}
        ends = np.cumsum([dims[key] for key in keys])
        rows = {key: np.arange(e - dims[key], e) for key, e in zip(keys, ends, strict=True)}
        cov = np.zeros((ends[-1], ends[-1]))
        for robot, block in blocks:
            index = np.concatenate([rows[key] for key in block])
            cov[np.ix_(index, index)] = self._marginal(robot, block)
        return cov

    def _marginal(self, robot: LocalSmoother, keys: list[int]) -> Array:
        return self.builder.covariance(robot.isam, robot.graph, keys)

    def finish(self) -> Estimate:
        """See `Backend`: once all has been exchanged each robot optimises its graph to convergence.

        States are by their own robots, landmarks by the first robot, as is the error.
        """
        self.exchange()
        self._meet()
        marginals: dict[int, tuple[Array, Array]] = {}
        half_error = 0.0
        for n, robot in enumerate(self.robots):
            try:
                start = robot.isam.calculateBestEstimate()
                values = optimise(robot.graph, start, self._config.robust)
                robot.isam = isam2_tree(self._config, robot.graph, values)
            except RuntimeError as error:
                raise self.builder.explain(error) from error
            for key, dim in robot.dims.items():
                index, _ = factors.number_of(key)
                if index is None and owner_of(key):
                    continue  # a name that another robot gave
                if index == n or (index is None and key not in marginals):
                    marginals[key] = factors.read(values, key, dim), self._marginal(robot, [key])
            half_error = half_error if n else float(robot.graph.error(values))
        return self.builder.estimate(marginals, half_error)


def _measured_bytes(group: FactorGroup) -> int:
    """Bytes of a measurement: keys of its variables, values, covariance (upper triangle)."""
    rows = len(group.observed[2].z) if group.observed else 3
    keys = len(group.factors[-1].keys())
    return KEY_BYTES * keys + NUMBER_BYTES * (rows + rows * (rows + 1) // 2)


def exchanged_bytes(backend: object) -> tuple[dict[str, int], dict[str, int]] | None:
    """Bytes sent and bytes measured, per robot; None for other back ends."""
    if isinstance(backend, DecentralisedBackend):
        return backend.sent, backend.measured
    return None


def landmark_ties(backend: object) -> dict[str, int] | None:
    """How robots with names of their own have associated landmarks; None for other back ends.

    All robots together, judged by the recorded numbers: pairs that are ``right`` and ``wrong``, and
    those ``missed``: landmarks that a robot knows by two names and has not tied.
    """
    if not isinstance(backend, DecentralisedBackend) or not backend.own_names:
        return None
    found = Counter(right=0, wrong=0, missed=0)
    for robot in backend.robots:
        keys = [key for key in robot.dims if not factors.is_state(key)]
        for pair in robot.ties:
            a, b = (number_in(key) for key in pair)
            found["right" if a == b else "wrong"] += 1
        groups = tied({key: owner_of(key) for key in keys}, robot.ties)
        found["missed"] += len(groups) - len({number_in(key) for key in groups})
    return dict(found)
