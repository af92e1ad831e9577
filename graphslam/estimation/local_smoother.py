"""One robot's own estimator among robots without a centre, and what it sends to the others."""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import gtsam
import numpy as np

from graphslam.core.config import AssociationConfig
from graphslam.core.geometry import Array
from graphslam.core.records import Association
from graphslam.estimation import factors
from graphslam.estimation.landmark_ties import Named, surest_tie, tied
from graphslam.estimation.message_link import Inbox, Outbox
from graphslam.estimation.optimisation import joint_marginal

#: bytes of a number, and of a variable's key
NUMBER_BYTES, KEY_BYTES = 8, 8
#: m and rad: sigma of the difference of landmarks that are the same
TIE_SIGMA = 1e-3
#: bits of a landmark's number; above them is who gave it the name, 0 for the robot itself
NAME_BITS = 40


@dataclass(frozen=True, slots=True, eq=False)
class Measurement:
    """Factors of one measurement, and its bytes if sent as it is."""

    factors: tuple[gtsam.NonlinearFactor, ...]
    size: int

    def keys(self) -> set[int]:
        """Its variables."""
        return {key for factor in self.factors for key in factor.keys()}  # noqa: SIM118


@dataclass(frozen=True, slots=True, eq=False)
class FactorMessage:
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
    a state is not known yet. ``ties`` are pairs of landmarks that were found to be the same, where
    robots have names of their own: in messages its landmarks have ``prefix`` before their numbers.
    ``sent`` and ``measured`` count the bytes of its messages and of its measurements as they are.
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
    prefix: int = 0
    ties: list[tuple[int, int]] = field(default_factory=list)
    outbox: Outbox[FactorMessage] = field(default_factory=Outbox)
    inboxes: defaultdict[str, Inbox[FactorMessage]] = field(
        default_factory=lambda: defaultdict(Inbox)
    )
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

    def receive(self, messages: Iterable[FactorMessage]) -> None:
        """Add messages; sightings wait until both of their states are known."""
        for message in messages:
            self.add(message.factors, message.values)
            self.waiting += message.sightings
        ready = [f for f in self.waiting if all(key in self.dims for key in f.keys())]  # noqa: SIM118
        self.waiting = [f for f in self.waiting if any(key not in self.dims for key in f.keys())]  # noqa: SIM118
        self.add(ready, {})

    def tie_landmarks(self, settings: AssociationConfig) -> None:
        """Tie landmarks that are the same beyond doubt, one after another; see `landmark_ties`."""
        while True:
            self.update()
            owners = {key: owner_of(key) for key in self.dims if not factors.is_state(key)}
            groups = tied(owners, self.ties)
            keys = list(groups)
            if len(frozenset[int]().union(*groups.values())) < 2:
                return
            means = [self.value(key) for key in keys]
            cov = joint_marginal(self.isam, keys)
            found = surest_tie(Named(keys, list(groups.values()), means, cov), settings)
            if found is None:
                return
            self.ties.append(found)
            self.add([_tie_factor(*found, *(self.value(key) for key in found))], {})

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

    def _name(self, key: int) -> int:
        """The name of one of its variables in messages."""
        return key if factors.is_state(key) else key | self.prefix

    def _named(self, measurement: Measurement) -> Measurement:
        """A measurement with the names of variables in messages."""
        if not self.prefix:
            return measurement
        keys = [[self._name(key) for key in f.keys()] for f in measurement.factors]  # noqa: SIM118
        made = [f.rekey(own) for f, own in zip(measurement.factors, keys, strict=True)]
        return Measurement(tuple(made), measurement.size)

    def message(self, shared: set[int]) -> FactorMessage:
        """Its own measurements since the last message, states that are not ``shared`` eliminated.

        These need no prior: the chain of states ties them to shared ones.
        """
        used = {key for one in self.unsent for key in one.keys()}  # noqa: SIM118
        unsent, self.unsent = [self._named(one) for one in self.unsent], []
        sightings, self.sightings = self.sightings, []
        now = self.isam.calculateBestEstimate()
        points = {self._name(key): factors.read(now, key, self.dims[key]) for key in used}
        estimate = gtsam.Values()
        for key, point in points.items():
            factors.write(estimate, key, point)
        dims = {key: len(point) for key, point in points.items()}
        content: list[gtsam.NonlinearFactor] = []
        size = sum(sighting.size for sighting in sightings)
        for section, inner in _sections(unsent, shared):
            as_measured = sum(measurement.size for measurement in section)
            if inner:
                made, smaller = _condensed(section, inner, estimate, dims)
                if smaller < as_measured:
                    content += made
                    size += smaller
                    continue
            content += [factor for measurement in section for factor in measurement.factors]
            size += as_measured
        keys = {key for factor in content for key in factor.keys()}  # noqa: SIM118
        values = {key: points[key] for key in keys}
        return FactorMessage(content, values, [f for one in sightings for f in one.factors], size)


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


def owner_of(key: int) -> int:
    """Whose name a landmark is: 0 the robot's own, else one more than an index; 0 of states."""
    robot, number = factors.number_of(key)
    return number >> NAME_BITS if robot is None else 0


def number_in(landmark: int) -> int:
    """Number of a landmark, whoever named it."""
    return factors.number_of(landmark)[1] & ((1 << NAME_BITS) - 1)


def prefix_of(robot: int) -> int:
    """What a robot of this index puts before its landmarks' numbers in messages."""
    return (1 + robot) << NAME_BITS


def _tie_factor(key: int, other: int, mean: Array, other_mean: Array) -> gtsam.NonlinearFactor:
    """That two points are one, or two walls on one line."""
    if len(mean) == 2:
        noise = gtsam.noiseModel.Isotropic.Sigma(2, TIE_SIGMA)
        return gtsam.BetweenFactorPoint2(key, other, np.zeros(2), noise)
    cov = np.diag([1.0, TIE_SIGMA**2, TIE_SIGMA**2])  # of which the first is not used
    same = Association("", 0, 0, "line", np.zeros(3), cov)
    return factors.observation_factor(key, other, same, factors.NO_KERNEL, mean, other_mean)
