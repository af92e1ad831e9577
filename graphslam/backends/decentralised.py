"""Decentralised smoothing, simulated: a graph per robot, and condensed messages between them.

Every robot smooths its own measurements. From time to time it eliminates, from what it measured
since the last time, all states that nobody else refers to; what is left is a Gaussian over
landmarks, its first and last state of the span, and its states at meetings. That, with the place it
was linearised at, is its message (DDF-SAM: A. Cunningham, M. Paluri, F. Dellaert, IROS 2010, DOI
10.1109/IROS.2010.5652875, who send the whole condensed map anew each time; here each message is of
its own span). Sightings of robots are sent as measured: they are as small as anything that could be
made of them, and whoever made one cannot linearise it, not knowing the other's heading.

No information counts twice: a message is made of the sender's own measurements of one span, never
of messages, so all messages and the receiver's own measurements are different factors of one graph,
and their sum is the centralised one, but for two losses: what a message was linearised at and
weighted with stays, and until the next message nothing is known of the others.

There is no network in it: every message reaches everybody, and identities of landmarks are agreed.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import gtsam
import numpy as np

from graphslam import factors
from graphslam.backends.graph import GraphBackend, GraphBuilder, Part, read, write
from graphslam.backends.isam2 import isam2_parameters, optimise
from graphslam.config import Config
from graphslam.errors import EstimationError
from graphslam.geometry import Array
from graphslam.models import MODELS
from graphslam.records import Estimate, Step

#: bytes of a number, and of the name of a variable
NUMBER, NAME = 8, 8
KEPT = "evidence about a state before the last message: its robot keeps it"


@dataclass(frozen=True, slots=True, eq=False)
class Message:
    """What a robot tells the others: linear factors, and where they are linearised."""

    factors: tuple[gtsam.NonlinearFactor, ...]
    point: Mapping[int, Array]

    @property
    def size(self) -> int:
        """Bytes: per factor its names, information (upper triangle) and vector; and the point."""
        total = sum(NAME + NUMBER * len(value) for value in self.point.values())
        for factor in self.factors:
            dim = sum(len(self.point[key]) for key in factor.keys())  # noqa: SIM118
            total += NAME * len(factor.keys()) + NUMBER * (dim * (dim + 1) // 2 + dim)
        return total


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
    unsent: list[gtsam.NonlinearFactor] = field(default_factory=list)
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

    def condensed(self, shared: set[int]) -> Message:
        """Its own measurements since the last message, states that are not ``shared`` eliminated.

        A prior on what is eliminated is not needed: it hangs on the chain of states.
        """
        graph = gtsam.NonlinearFactorGraph()
        for factor in self.unsent:
            graph.add(factor)
        self.unsent = []
        if not graph.size():
            return Message((), {})
        values = self.isam.calculateBestEstimate()
        linear, keys = graph.linearize(values), graph.keyVector()
        inner = [key for key in keys if key not in shared and _is_state(key)]
        if inner:
            order = gtsam.Ordering(inner)
            linear = linear.eliminatePartialSequential(order, gtsam.EliminateQR)[1]
        left = gtsam.LinearContainerFactor.ConvertLinearGraph(linear, values)
        point = {key: read(values, key, self.dims[key]) for key in keys if key not in inner}
        message = Message(tuple(left.at(n) for n in range(left.size())), point)
        self.sent += message.size
        return message


def _is_state(key: int) -> bool:
    return chr(gtsam.Symbol(key).chr()) == "x"


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
        states = [key for key in keys if _is_state(key)]
        key = part.observed[0] if part.observed else states[-1]
        member = self._member(key)
        member.measured += _measured_bytes(part)
        late = [k for k in states if _number(k) < self._member(k).frontier]
        if len({_robot(k) for k in states}) > 1:
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
            member.unsent += made

    def exchange(self) -> None:
        """Everybody tells everybody what was measured since the last time."""
        self._joints.clear()
        met = {key for part in self._meetings for f in part.factors for key in f.keys()}  # noqa: SIM118
        messages = []
        for n, member in enumerate(self._members):
            last = len(self.builder.states.times[member.name]) - 1
            ends = {factors.state_key(n, number) for number in (member.frontier, last)}
            messages.append(member.condensed(met | ends))
            member.frontier = last
            self.messages += 1
        for member in self._members:
            for message, sender in zip(messages, self._members, strict=True):
                if sender is not member:
                    member.take(message.factors, message.point)
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
        index = _robot(key)
        while len(self._members) <= index:
            name = self.builder.robots[len(self._members)]
            isam = gtsam.ISAM2(isam2_parameters(self._config, "QR"))
            self._members.append(Member(name, isam))
        return self._members[index]

    # ------------------------------------------------------------ answers

    def value(self, key: int, dim: int) -> Array:
        """Of a state, what its robot thinks; of a landmark, whoever was asked last or knows it."""
        if _is_state(key):
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
        owner = [
            member if key in known else self._member(key) if _is_state(key) else self._knowing(key)
            for key in keys
        ]
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
                own = _is_state(key) and _robot(key) == n
                if own or (not _is_state(key) and key not in means):
                    means[key] = read(values, key, dim)
                    covs[key] = self._marginal(member, [key])
            error = error if n else float(member.graph.error(values))
        return self._estimate(means, covs, error)


def _robot(key: int) -> int:
    return int(gtsam.Symbol(key).index() >> 40)


def _number(key: int) -> int:
    return int(gtsam.Symbol(key).index() & ((1 << 40) - 1))


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
