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
learns so at once, since the state at which that was must not be eliminated, and that landmark
identities are shared.
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import gtsam
import numpy as np

from graphslam.core.config import Config
from graphslam.core.geometry import Array
from graphslam.core.observation_models import MODELS
from graphslam.core.records import Estimate, Step
from graphslam.estimation import factors
from graphslam.estimation.factor_graph import FactorGroup, GraphBackend, GraphBuilder
from graphslam.estimation.isam2 import isam2_parameters, isam2_tree
from graphslam.estimation.message_link import Inbox, Network, Outbox, Packet
from graphslam.estimation.optimisation import optimise

#: bytes of a number, and of a variable's key
NUMBER_BYTES, KEY_BYTES = 8, 8
NOT_SENT = "evidence about a state before the last message: kept locally, not sent"


@dataclass(frozen=True, slots=True, eq=False)
class Measurement:
    """Factors of one measurement, and its bytes if sent as it is."""

    factors: tuple[gtsam.NonlinearFactor, ...]
    size: int

    def keys(self) -> set[int]:
        """Its variables."""
        return {key for factor in self.factors for key in factor.keys()}  # noqa: SIM118


@dataclass(frozen=True, slots=True, eq=False)
class Message:
    """What a robot sends to the others: factors, and values of their variables.

    ``sightings`` are factors between its states and those of others, ``size`` all of it in bytes.
    """

    factors: Sequence[gtsam.NonlinearFactor]
    values: Mapping[int, Array]
    sightings: Sequence[gtsam.NonlinearFactor]
    size: int


@dataclass(slots=True, eq=False)
class LocalSmoother:
    """One robot's own estimator, of its measurements and the messages it received.

    ``dims`` are its variables. ``new_factors`` and ``new_values`` wait for the next update.
    ``unsent`` are its measurements since its last message, which ended at state number
    ``last_sent``, ``sightings`` those of other robots. ``waiting`` are received sightings of which
    a state is not known yet. ``sent`` and ``measured`` count the bytes of its messages and of its
    measurements as they are.
    """

    name: str
    isam: gtsam.ISAM2
    graph: gtsam.NonlinearFactorGraph = field(default_factory=gtsam.NonlinearFactorGraph)
    dims: dict[int, int] = field(default_factory=dict)
    new_factors: gtsam.NonlinearFactorGraph = field(default_factory=gtsam.NonlinearFactorGraph)
    new_values: dict[int, Array] = field(default_factory=dict)
    unsent: list[Measurement] = field(default_factory=list)
    sightings: list[Measurement] = field(default_factory=list)
    waiting: list[gtsam.NonlinearFactor] = field(default_factory=list)
    outbox: Outbox[Message] = field(default_factory=Outbox)
    inboxes: defaultdict[str, Inbox[Message]] = field(default_factory=lambda: defaultdict(Inbox))
    last_sent: int = 0
    sent: int = 0
    measured: int = 0

    def add(self, made: Iterable[gtsam.NonlinearFactor], values: Mapping[int, Array]) -> None:
        """Add factors for the next update, with initial values for variables that are missing."""
        for factor in made:
            self.new_factors.add(factor)
        for key, value in values.items():
            if key not in self.dims:
                self.dims[key] = len(value)
                self.new_values[key] = value

    def receive(self, messages: Iterable[Message]) -> None:
        """Add messages; sightings wait until both of their states are known."""
        for message in messages:
            self.add(message.factors, message.values)
            self.waiting += message.sightings
        ready = [f for f in self.waiting if all(key in self.dims for key in f.keys())]  # noqa: SIM118
        self.waiting = [f for f in self.waiting if any(key not in self.dims for key in f.keys())]  # noqa: SIM118
        self.add(ready, {})

    def update(self) -> None:
        """Update the tree."""
        if not self.new_factors.size():
            return
        values = gtsam.Values()
        for key, value in self.new_values.items():
            factors.write(values, key, value)
        self.graph.push_back(self.new_factors)
        self.isam.update(self.new_factors, values)
        self.new_factors, self.new_values = gtsam.NonlinearFactorGraph(), {}

    def value(self, key: int) -> Array:
        """Current estimate (2,) or (3,) of one of its variables."""
        if key in self.new_values:
            return self.new_values[key]
        if self.dims[key] == 3:
            return factors.array3(self.isam.calculateEstimatePose2(key))
        return np.asarray(self.isam.calculateEstimatePoint2(key))

    def message(self, shared: set[int]) -> Message:
        """Its own measurements since the last message, states that are not ``shared`` eliminated.

        These need no prior: the chain of states ties them to shared ones.
        """
        unsent, self.unsent = self.unsent, []
        sightings, self.sightings = self.sightings, []
        estimate = self.isam.calculateBestEstimate()
        content: list[gtsam.NonlinearFactor] = []
        size = sum(sighting.size for sighting in sightings)
        for section, inner in _sections(unsent, shared):
            as_measured = sum(measurement.size for measurement in section)
            if inner:
                made, smaller = _condensed(section, inner, estimate, self.dims)
                if smaller < as_measured:
                    content += made
                    size += smaller
                    continue
            content += [factor for measurement in section for factor in measurement.factors]
            size += as_measured
        keys = {key for factor in content for key in factor.keys()}  # noqa: SIM118
        values = {key: factors.read(estimate, key, self.dims[key]) for key in keys}
        return Message(content, values, [f for one in sightings for f in one.factors], size)


def _sections(
    unsent: Sequence[Measurement], shared: set[int]
) -> Iterator[tuple[list[Measurement], list[int]]]:
    """Measurements connected by states that are not ``shared``, and those states.

    Measurements without any such state form one section.
    """
    inner = [[k for k in m.keys() if factors.is_state(k) and k not in shared] for m in unsent]  # noqa: SIM118
    from scipy.cluster.hierarchy import DisjointSet  # noqa: PLC0415 (slow to import)

    connected = DisjointSet({key for keys in inner for key in keys})
    for keys in inner:
        for key in keys[1:]:
            connected.merge(keys[0], key)
    sections: dict[int | None, list[Measurement]] = defaultdict(list)
    states: dict[int | None, set[int]] = defaultdict(set)
    for measurement, keys in zip(unsent, inner, strict=True):
        label = connected[keys[0]] if keys else None
        sections[label].append(measurement)
        states[label].update(keys)
    for label, section in sections.items():
        yield section, sorted(states[label])


def _condensed(
    section: Sequence[Measurement],
    inner: Sequence[int],
    estimate: gtsam.Values,
    dims: Mapping[int, int],
) -> tuple[list[gtsam.NonlinearFactor], int]:
    """Factors that remain of measurements when states are eliminated, and their bytes.

    Per factor the keys of its variables, information (upper triangle) and vector; once per variable
    its linearisation point.
    """
    graph = gtsam.NonlinearFactorGraph()
    for measurement in section:
        for factor in measurement.factors:
            graph.add(factor)
    order = gtsam.Ordering(list(inner))
    rest = graph.linearize(estimate).eliminatePartialSequential(order, gtsam.EliminateQR)[1]
    made = gtsam.LinearContainerFactor.ConvertLinearGraph(rest, estimate)
    condensed = [made.at(n) for n in range(made.size())]
    unique = {key for factor in condensed for key in factor.keys()}  # noqa: SIM118
    size = sum(NUMBER_BYTES * dims[key] for key in unique)
    for factor in condensed:
        keys = factor.keys()
        dim = sum(dims[key] for key in keys)
        size += KEY_BYTES * len(keys) + NUMBER_BYTES * (dim * (dim + 1) // 2 + dim)
    return condensed, size


class DecentralisedBackend(GraphBackend):
    """See the module's docstring; queries about a robot are answered by its own estimator."""

    def __init__(self, config: Config) -> None:
        super().__init__(GraphBuilder(config.robust))
        self._config = config
        self._period_ns = round(1e9 * config.backend.exchange_s)
        self._next_ns: int | None = None
        self._robots: list[LocalSmoother] = []
        self._queried: LocalSmoother | None = None  # the robot whose state was queried last
        self._network: Network[Message] = Network(config.network)
        self._now_ns = 0
        self.messages = 0

    @property
    def sent(self) -> dict[str, int]:
        """Robot -> bytes of its messages, each counted once, whatever the number of receivers."""
        return {robot.name: robot.sent for robot in self._robots}

    @property
    def measured(self) -> dict[str, int]:
        """Robot -> bytes of its measurements as they are: what a centralised estimate needs."""
        return {robot.name: robot.measured for robot in self._robots}

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
        new = dict([group.new] if group.new else [])
        if group.observed and group.observed[1] not in {*robot.dims, *new}:
            # a landmark of other robots, of which this one has no message yet
            _, target, seen = group.observed
            new[target] = MODELS[seen.model].invert(seen.z, self.value(key, 3))
            if seen.model == "line":  # until then its gauge must be fixed here
                robot.add([factors.line_gauge_factor(key, target, seen)], {})
        robot.add(group.factors, new)
        if late:
            self.builder.skipped[NOT_SENT] += 1
        else:
            robot.unsent.append(Measurement(group.factors, size))

    def exchange(self) -> None:
        """Every robot sends its measurements since its last message to all others."""
        self._joints.clear()
        shared = {key for robot in self._robots for one in robot.sightings for key in one.keys()}  # noqa: SIM118
        for n, robot in enumerate(self._robots):
            last = len(self.builder.states.times[robot.name]) - 1
            ends = {factors.state_key(n, number) for number in (robot.last_sent, last)}
            message = robot.message(shared | ends)
            robot.last_sent = last
            self.messages += 1
            sent = robot.outbox.send(message, self._now_ns)
            lacking = {name: inbox.lacking() for name, inbox in robot.inboxes.items()}
            numbers = len(sent) + sum(map(len, lacking.values()))
            robot.sent += sum(one.size for _, one in sent) + NUMBER_BYTES * numbers
            others = (other.name for other in self._robots if other is not robot)
            self._network.send(Packet(robot.name, self._now_ns, sent, lacking), others)
        self._receive()
        self._update()

    def _receive(self) -> None:
        """Let robots take in what has arrived."""
        by_name = {robot.name: robot for robot in self._robots}
        for name, packet in self._network.arrived(self._now_ns):
            robot = by_name[name]
            robot.outbox.ask(packet.lacking.get(name, ()), packet.sent_ns)
            robot.receive(robot.inboxes[packet.sender].accept(packet.messages))

    def _meet(self) -> None:
        """Let every robot give the others what they lack."""
        for sender in self._robots:
            contents = sender.outbox.contents
            lacked: set[int] = set()
            for robot in self._robots:
                if robot is not sender:
                    inbox = robot.inboxes[sender.name]
                    lacked |= set(range(inbox.following, len(contents))) - inbox.early.keys()
                    robot.receive(inbox.accept(enumerate(contents)))
            sender.sent += sum(contents[number].size + NUMBER_BYTES for number in lacked)
        self._update()

    def _update(self) -> None:
        for robot in self._robots:
            try:
                robot.update()
            except RuntimeError as error:
                raise self.builder.explain(error) from error

    def _robot_of(self, key: int) -> LocalSmoother:
        """The robot whose state ``key`` is."""
        index, _ = factors.number_of(key)
        assert index is not None  # a landmark belongs to no robot
        while len(self._robots) <= index:
            name = self.builder.robots[len(self._robots)]
            tree = gtsam.ISAM2(isam2_parameters(self._config, "QR"))
            self._robots.append(LocalSmoother(name, tree))
        return self._robots[index]

    def value(self, key: int, dim: int) -> Array:
        """See `GraphBackend`: of a state by its robot, of a landmark by `_robot_with` it."""
        if factors.is_state(key):
            self._queried = self._robot_of(key)
            return self._queried.value(key)
        return self._robot_with(key).value(key)

    def _robot_with(self, key: int) -> LocalSmoother:
        """The robot queried last if it has the variable, else the first one that has."""
        first = [self._queried] if self._queried is not None else []
        return next(robot for robot in (*first, *self._robots) if key in robot.dims)

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
        for n, robot in enumerate(self._robots):
            try:
                start = robot.isam.calculateBestEstimate()
                values = optimise(robot.graph, start, self._config.robust)
                robot.isam = isam2_tree(self._config, "QR", robot.graph, values)
            except RuntimeError as error:
                raise self.builder.explain(error) from error
            for key, dim in robot.dims.items():
                index, _ = factors.number_of(key)
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
