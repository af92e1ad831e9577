"""Decentralised smoothing, simulated: a graph per robot, and condensed messages between them.

Every robot smooths its own measurements. From time to time it tells the others what it measured
since the last time. States that nobody else refers to are eliminated: what is left of a stretch of
them is a Gaussian over its ends and the landmarks seen on it, sent as information with the place it
was linearised at (DDF-SAM: A. Cunningham, M. Paluri, F. Dellaert, IROS 2010, DOI
10.1109/IROS.2010.5652875, who send the whole condensed map anew each time; here each message is of
its own span). Shared are landmarks, states at meetings, and the first and last state of the span.
What nothing is eliminated from is sent as measured, and so is a stretch that is smaller that way.

No information counts twice: a message is made of the sender's own measurements of one span, never
of messages, so all messages and the receiver's own measurements are different factors of one graph,
and their sum is the centralised one, but for two losses: what was condensed keeps the place it was
linearised at and its robust weights, and until the next message nothing is known of the others.

There is no network in it: every message reaches everybody, and identities of landmarks are agreed.
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import gtsam
import numpy as np

from graphslam.core.config import Config
from graphslam.core.errors import EstimationError
from graphslam.core.geometry import Array
from graphslam.core.observation_models import MODELS
from graphslam.core.records import Estimate, Step
from graphslam.estimation import factors
from graphslam.estimation.factor_graph import GraphBackend, GraphBuilder, Part, read, write
from graphslam.estimation.isam2 import isam2_parameters, optimise

#: bytes of a number, and of the name of a variable
NUMBER, NAME = 8, 8
KEPT = "evidence about a state before the last message: its robot keeps it"


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """Factors of one measurement, and its bytes as it is."""

    factors: tuple[gtsam.NonlinearFactor, ...]
    size: int

    def keys(self) -> set[int]:
        """Its variables."""
        return {key for factor in self.factors for key in factor.keys()}  # noqa: SIM118


@dataclass(frozen=True, slots=True, eq=False)
class Message:
    """What a robot tells the others: factors, a value of every variable in them, and its bytes."""

    factors: tuple[gtsam.NonlinearFactor, ...]
    values: Mapping[int, Array]
    size: int


@dataclass(slots=True, eq=False)
class Member:
    """One robot's own estimator: all it measured and all it was told.

    ``dims`` are its variables; ``fresh`` factors and values of now, ``unsent`` its own factors
    since the last message, ``frontier`` the number of its state then; ``sent`` and ``measured``
    count the bytes of its messages and of its measurements as they are.
    """

    name: str
    isam: gtsam.ISAM2
    graph: gtsam.NonlinearFactorGraph = field(default_factory=gtsam.NonlinearFactorGraph)
    dims: dict[int, int] = field(default_factory=dict)
    fresh: gtsam.NonlinearFactorGraph = field(default_factory=gtsam.NonlinearFactorGraph)
    values: dict[int, Array] = field(default_factory=dict)
    unsent: list[Measured] = field(default_factory=list)
    frontier: int = 0
    sent: int = 0
    measured: int = 0

    def take(self, made: Iterable[gtsam.NonlinearFactor], new: Mapping[int, Array]) -> None:
        """Factors for the next update; ``new`` are first values of what it may not know yet."""
        for factor in made:
            self.fresh.add(factor)
        for key, value in new.items():
            if key not in self.dims:
                self.dims[key] = len(value)
                self.values[key] = value

    def update(self) -> None:
        """Bring the tree up to date."""
        if not self.fresh.size():
            return
        values = gtsam.Values()
        for key, value in self.values.items():
            write(values, key, value)
        self.graph.push_back(self.fresh)
        self.isam.update(self.fresh, values)
        self.fresh, self.values = gtsam.NonlinearFactorGraph(), {}

    def value(self, key: int) -> Array:
        """Current estimate (2,) or (3,) of a variable that it knows."""
        if key in self.values:
            return self.values[key]
        if self.dims[key] == 3:
            return factors.array3(self.isam.calculateEstimatePose2(key))
        return np.asarray(self.isam.calculateEstimatePoint2(key))

    def message(self, shared: set[int]) -> Message:
        """Its own measurements since the last message, states that are not ``shared`` eliminated.

        A prior on what is eliminated is not needed: it hangs on the chain of states.
        """
        unsent, self.unsent = self.unsent, []
        estimate = self.isam.calculateBestEstimate()
        told: list[gtsam.NonlinearFactor] = []
        size = 0
        for stretch, inner in _stretches(unsent, shared):
            as_measured = sum(measured.size for measured in stretch)
            if inner:
                made, smaller = _condensed(stretch, inner, estimate, self.dims)
                if smaller < as_measured:
                    told += made
                    size += smaller
                    continue
            told += [factor for measured in stretch for factor in measured.factors]
            size += as_measured
        keys = {key for factor in told for key in factor.keys()}  # noqa: SIM118
        self.sent += size
        return Message(
            tuple(told), {key: read(estimate, key, self.dims[key]) for key in keys}, size
        )


def _stretches(
    unsent: Sequence[Measured], shared: set[int]
) -> Iterator[tuple[list[Measured], list[int]]]:
    """Measurements that hang together by states nobody else needs, and those states.

    Those without any such state come together.
    """
    root: dict[int, int] = {}

    def find(key: int) -> int:
        while root[key] != key:
            key = root[key]
        return key

    inner = [[k for k in m.keys() if factors.is_state(k) and k not in shared] for m in unsent]  # noqa: SIM118
    for keys in inner:
        for key in keys:
            root.setdefault(key, key)
            root[find(key)] = find(keys[0])
    groups: dict[int | None, list[Measured]] = defaultdict(list)
    states: dict[int | None, set[int]] = defaultdict(set)
    for measured, keys in zip(unsent, inner, strict=True):
        group = find(keys[0]) if keys else None
        groups[group].append(measured)
        states[group] |= set(keys)
    for group, found in groups.items():
        yield found, sorted(states[group])


def _condensed(
    stretch: Sequence[Measured],
    inner: Sequence[int],
    estimate: gtsam.Values,
    dims: Mapping[int, int],
) -> tuple[list[gtsam.NonlinearFactor], int]:
    """What is left of measurements when states are eliminated, and its bytes.

    Per factor the names of its variables, information (upper triangle) and vector; once per
    variable the place that it was linearised at.
    """
    graph = gtsam.NonlinearFactorGraph()
    for measured in stretch:
        for factor in measured.factors:
            graph.add(factor)
    order = gtsam.Ordering(list(inner))
    left = graph.linearize(estimate).eliminatePartialSequential(order, gtsam.EliminateQR)[1]
    made = gtsam.LinearContainerFactor.ConvertLinearGraph(left, estimate)
    every = [made.at(n) for n in range(made.size())]
    size = sum(NUMBER * dims[key] for key in {key for f in every for key in f.keys()})  # noqa: SIM118
    for factor in every:
        keys = factor.keys()
        dim = sum(dims[key] for key in keys)
        size += NAME * len(keys) + NUMBER * (dim * (dim + 1) // 2 + dim)
    return every, size


class DecentralisedBackend(GraphBackend):
    """See the module's docstring; what a robot is asked for, its own estimator answers."""

    smooths = True

    def __init__(self, config: Config) -> None:
        super().__init__(GraphBuilder(config.robust))
        self._config = config
        self._period_ns = round(1e9 * config.backend.exchange_s)
        self._next_ns: int | None = None
        self._members: list[Member] = []
        self._asked: Member | None = None  # whose state was asked for last
        self._meetings: list[Part] = []  # since the last exchange
        self.messages = 0

    @property
    def sent(self) -> dict[str, int]:
        """Robot -> bytes of its messages, each counted once, however many hear it."""
        return {member.name: member.sent for member in self._members}

    @property
    def measured(self) -> dict[str, int]:
        """Robot -> bytes of its measurements as they are: what a centralised estimate needs."""
        return {member.name: member.measured for member in self._members}

    # ------------------------------------------------------------ taking in

    def add(self, step: Step) -> None:
        """See `Backend`; an exchange comes before the first step after its time."""
        self._joints.clear()
        if self._next_ns is None:
            self._next_ns = step.time_ns + self._period_ns
        if step.time_ns >= self._next_ns:
            self.exchange()
            self._next_ns += self._period_ns * (
                1 + (step.time_ns - self._next_ns) // self._period_ns
            )
        for part in self.builder.parts(step, self.value):
            self._take(part)
        self._update()

    def _take(self, part: Part) -> None:
        """A part of a step, to the robot that measured it."""
        keys = list(dict.fromkeys(key for f in part.factors for key in f.keys()))  # noqa: SIM118
        states = [key for key in keys if factors.is_state(key)]
        key = part.observed[0] if part.observed else states[-1]
        member = self._member(key)
        size = _measured_bytes(part)
        member.measured += size
        late = [k for k in states if factors.number_of(k)[1] < self._member(k).frontier]
        if len({factors.number_of(k)[0] for k in states}) > 1:
            if late:
                self.builder.skipped[KEPT] += 1
            else:
                self._meetings.append(part)
            return
        new = dict([part.new] if part.new else [])
        made = list(part.factors)
        if part.observed and part.observed[1] not in {*member.dims, *new}:
            # known to others, but not to this one before their message
            _, target, seen = part.observed
            new[target] = MODELS[seen.model].invert(seen.z, self.value(key, 3))
            if seen.model == "line":  # till then it needs to know where on the line, too
                member.take([factors.line_gauge_factor(key, target, seen)], {})
        member.take(made, new)
        if late:
            self.builder.skipped[KEPT] += 1
        else:
            member.unsent.append(Measured(part.factors, size))

    def exchange(self) -> None:
        """Everybody tells everybody what was measured since the last time."""
        self._joints.clear()
        met = {key for part in self._meetings for f in part.factors for key in f.keys()}  # noqa: SIM118
        messages = []
        for n, member in enumerate(self._members):
            last = len(self.builder.states.times[member.name]) - 1
            ends = {factors.state_key(n, number) for number in (member.frontier, last)}
            messages.append(member.message(met | ends))
            member.frontier = last
            self.messages += 1
        for member in self._members:
            for message, sender in zip(messages, self._members, strict=True):
                if sender is not member:
                    member.take(message.factors, message.values)
            for part in self._meetings:
                member.take(part.factors, {})
        for part in self._meetings:
            self._member(part.factors[0].keys()[0]).sent += _measured_bytes(part)
        self._meetings = []
        self._update()

    def _update(self) -> None:
        for member in self._members:
            try:
                member.update()
            except RuntimeError as error:
                raise self.builder.explain(error) from error

    def _member(self, key: int) -> Member:
        """The robot whose state it is."""
        index, _ = factors.number_of(key)
        assert index is not None  # a landmark is nobody's
        while len(self._members) <= index:
            name = self.builder.robots[len(self._members)]
            tree = gtsam.ISAM2(isam2_parameters(self._config, "QR"))
            self._members.append(Member(name, tree))
        return self._members[index]

    # ------------------------------------------------------------ answers

    def value(self, key: int, dim: int) -> Array:
        """Of a state, what its robot thinks; of a landmark, whoever was asked last or knows it."""
        if factors.is_state(key):
            self._asked = self._member(key)
            return self._asked.value(key)
        return self._knowing(key).value(key)

    def _knowing(self, key: int) -> Member:
        first = [self._asked] if self._asked is not None else []
        return next(m for m in (*first, *self._members) if key in m.dims)

    def landmark_means(self, landmarks: Sequence[int]) -> list[Array]:
        """See `Backend`: by the first robot that knows each."""
        self._asked = None
        return super().landmark_means(landmarks)

    def covariance(self, keys: list[int]) -> Array:
        """See `GraphBackend`; what the first one's robot does not know comes as independent."""
        member = self._member(keys[0])
        known = [key for key in keys if key in member.dims]
        others = {
            key: self._member(key) if factors.is_state(key) else self._knowing(key)
            for key in keys
            if key not in known
        }
        owner = [others.get(key, member) for key in keys]
        ends = np.cumsum([m.dims[key] for m, key in zip(owner, keys, strict=True)])
        place = {
            key: np.arange(end - m.dims[key], end)
            for m, key, end in zip(owner, keys, ends, strict=True)
        }
        cov = np.zeros((ends[-1], ends[-1]))
        groups = [(member, known)] + [
            (m, [key]) for m, key in zip(owner, keys, strict=True) if key not in known
        ]
        for m, group in groups:
            where = np.concatenate([place[key] for key in group])
            cov[np.ix_(where, where)] = self._marginal(m, group)
        return cov

    def _marginal(self, member: Member, keys: list[int]) -> Array:
        try:
            if len(keys) == 1:
                cov = np.asarray(member.isam.marginalCovariance(keys[0]))
            else:
                cov = np.asarray(member.isam.jointMarginalCovariance(keys).fullMatrix())
        except RuntimeError as error:
            raise self.builder.explain(error) from error
        if not np.isfinite(cov).all():
            raise self._diagnosed(member)
        return cov

    def _diagnosed(self, member: Member) -> EstimationError:
        """Which variable is indeterminate: QR answers NaN for all of them, Cholesky names one."""
        try:
            values = member.isam.calculateBestEstimate()
            marginals = gtsam.Marginals(member.graph, values)
            for key in member.dims:
                marginals.marginalCovariance(key)
        except RuntimeError as error:
            return self.builder.explain(error)
        return self.builder.explain(RuntimeError(""))

    def finish(self) -> Estimate:
        """See `Backend`: after a last exchange each robot optimises what it has, to convergence.

        States are those of their own robots, landmarks those of the first robot, whose graph the
        error is of.
        """
        self.exchange()
        means: dict[int, Array] = {}
        covs: dict[int, Array] = {}
        error = 0.0
        for n, member in enumerate(self._members):
            try:
                start = member.isam.calculateBestEstimate()
                values = optimise(member.graph, start, self._config.robust)
                isam = gtsam.ISAM2(isam2_parameters(self._config, "QR"))
                isam.update(member.graph, values)
            except RuntimeError as problem:
                raise self.builder.explain(problem) from problem
            member.isam = isam
            for key, dim in member.dims.items():
                robot, _ = factors.number_of(key)
                if robot == n or (robot is None and key not in means):
                    means[key] = read(values, key, dim)
                    covs[key] = self._marginal(member, [key])
            error = error if n else float(member.graph.error(values))
        return self._estimate(means, covs, error)


def _measured_bytes(part: Part) -> int:
    """A measurement as it is: names of its variables, values, covariance (upper triangle)."""
    rows = len(part.observed[2].z) if part.observed else 3
    names = len(part.factors[-1].keys())
    return NAME * names + NUMBER * (rows + rows * (rows + 1) // 2)


def exchanged_bytes(backend: object) -> tuple[dict[str, int], dict[str, int]] | None:
    """Bytes sent and bytes measured, per robot; None for a back end that exchanges nothing."""
    if isinstance(backend, DecentralisedBackend):
        return backend.sent, backend.measured
    return None


__all__ = ["DecentralisedBackend", "Member", "Message", "exchanged_bytes"]
