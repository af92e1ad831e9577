"""The graph of steps that are all recorded: what is many is made at once.

`BatchGraph` makes the factors of a step one by one, as a log that is being read needs it. Here
motions are arrays, and the observations of bearing and range, of which a log of sightings has tens
of thousands.
"""

from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.config import RobustConfig
from graphslam.core.geometry import Array, are_positive
from graphslam.core.known_landmarks import KnownLandmarks
from graphslam.core.observation_models import MODELS
from graphslam.core.records import Association, Estimate, Motion, Start, Step
from graphslam.estimation import factors
from graphslam.estimation.factor_graph import covariance_of
from graphslam.estimation.input_checks import describe, describe_motion
from graphslam.estimation.isam2 import BatchGraph, observed_ends
from graphslam.estimation.weighed_walls import WeighedWalls, weighed_walls

#: who made an observation of bearing and range, and its row of `MODELS`
Source = tuple[str, str]

#: ns: within this time the errors of one target's sightings may be the same. Ranges by the apparent
#: height of a barcode correlate by 0.9 from image to image and by half after 8 s.
SHARED_NS = 10_000_000_000
#: sigmas of the pose of a known map by which solutions may move it
HELD = 0.1
#: a shared error that a source does not have is still a variable: its variance, of the white one's
NO_SHARED_ERROR = 1e-4


@dataclass(frozen=True, slots=True, eq=False)
class ObservationNoise:
    """Noise of a source of bearings and ranges, as factors (2,) on the variances stated.

    ``white``: of each by itself. ``shared``: of an error that all sightings of one target within
    `SHARED_NS` have in common. ``kernel_scale``: of the kernel, in sigmas of the white part.
    """

    white: Array
    shared: Array
    kernel_scale: float


@dataclass(frozen=True, slots=True, eq=False)
class SharedErrors:
    """Points that stand in for landmarks (n): their offsets are errors that sightings share.

    ``keys`` (n, 2): of the landmark and of the point in its place. ``axes`` (n, 2, 2) take an
    offset to a bearing (first row) and a range; ``variance`` (n, 2) of these.
    """

    keys: IntArray
    axes: Array
    variance: Array


class RecordedGraph(BatchGraph):
    """Every factor of recorded steps, in ``graph``, lines deferred.

    ``motions``: index in the graph, robot, and the keys of the states before and after.
    ``bearings_and_ranges``: by source, keys of the state and of the target of each, and its
    association, and likewise ``segments``; ``polar``: their bearings and ranges (n, 2) and the
    covariances (n, 2, 2), as stated; ``shared_errors`` by source, where its ``noise`` has such a
    part.
    """

    def __init__(
        self, kernel: RobustConfig, noise: Mapping[Source, ObservationNoise] | None = None
    ) -> None:
        """Begin an empty graph.

        ``noise``: of bearings and ranges; as stated and under ``kernel`` where missing.
        """
        super().__init__(kernel, defer_lines=True)
        self.noise = noise or {}
        self.motions: list[tuple[int, str, int, int]] = []
        self.segments: list[tuple[int, int, Association]] = []
        self.bearings_and_ranges: dict[Source, list[tuple[int, int, Association]]] = {}
        self.polar: dict[Source, tuple[Array, Array]] = {}
        self.shared_errors: dict[Source, SharedErrors] = {}
        self._stand_ins = 0
        # with the index of their (first) factor
        self._known_at: list[tuple[int, KnownLandmarks]] = []
        self._relative_starts: list[tuple[int, Start]] = []
        self._held: list[tuple[int, Sequence[int], Array, KnownLandmarks]] = []

    def insert_all(
        self,
        steps: Iterable[Step],
        start: Estimate,
        values: gtsam.Values,
        without_motions: Collection[str] = (),
    ) -> None:
        """`insert` all steps; factors of bearings and ranges follow all others.

        ``without_motions``: robots whose motions get a place in the graph, but no factor yet.

        Raises:
            EstimationError: a covariance is not positive definite and finite, or a state that a
                step refers to was never made.
        """
        polar: dict[Source, list[tuple[int, Association]]] = defaultdict(list)
        motions: list[Motion] = []
        poses = {robot: path.poses.tolist() for robot, path in start.states.items()}
        for step in steps:
            if step.starts or step.known is not None:
                self._note_priors(step)
                self.insert(Step(step.time_ns, step.starts, known=step.known), start, values)
                if step.known is not None and step.known.numbers:
                    self._hold(step.known)
            for robot, motion in step.motions.items():
                last = self.latest_key(robot, step.time_ns)
                number = self.states.append(robot, step.time_ns)
                values.insert(last + 1, gtsam.Pose2(*poses[robot][number]))
                self._reserve_motion(robot, last)
                motions.append(motion)
            others = []
            for seen in step.associations:
                if seen.model in factors.BEARING_RANGE:
                    polar[seen.robot, seen.model].append((step.time_ns, seen))
                elif seen.model == "line":
                    self._insert_line(seen, start, values)
                else:
                    others.append(seen)
                    if seen.model == "segment":
                        self._note_segment(seen)
            if others or step.closures:
                rest = Step(step.time_ns, {}, {}, tuple(others), step.closures)
                self.insert(rest, start, values)
        self._make_motions(motions, without_motions)
        for source, observed in sorted(polar.items(), key=lambda one: (one[0][1], one[0][0])):
            self._insert_polar(source, observed, start, values)

    def _note_priors(self, step: Step) -> None:
        """Note where in the graph the priors of a step will be that are not always the same."""
        index = self.graph.size()
        if step.known is not None:
            self._known_at.append((index, step.known))
            index += len(step.known.numbers)
        starts = enumerate(step.starts.values(), index)
        self._relative_starts += [(k, one) for k, one in starts if one.world_cov is not None]

    def _hold(self, known: KnownLandmarks) -> None:
        """Let a known map stay where it is in solutions, see `place`."""
        self._held.append((self.graph.size(), *known.pose_rows(), known))
        self.graph.resize(self.graph.size() + 1)
        self.place(in_world=False)

    def place(self, *, in_world: bool) -> None:
        """Let a known map, and what is relative to a map, be as uncertain as in the world, or not.

        A log tells nothing of where its map is in the world. In solutions nothing must move it
        there, where that is hardly known: neither a start that the map told nor how its landmarks
        are linear. So the map is held, by `HELD` of its sigmas, and starts are as they are in the
        map. Covariances have neither: they would tell what nobody measured.
        """
        for index, numbers, rows, known in self._held:
            scale = 0.0 if in_world else 1.0 / HELD
            factor = factors.known_landmark_factor(numbers, scale * rows, known.means)
            self.graph.replace(index, factor)
        for index, start in self._relative_starts:
            (key,) = self.graph.at(index).keys()
            cov = start.world_cov if in_world and start.world_cov is not None else start.cov
            self.graph.replace(index, factors.start_factor(key, Start(start.pose, cov)))

    def carry_known(self, values: gtsam.Values) -> None:
        """Put what is known of landmarks in the graph in the axes of their ``values``.

        By their means it would be information about the direction of the map that nothing has,
        where walls were turned, or moved along themselves, since.
        """
        for first, known in self._known_at:
            at = {
                n: factors.read(values, factors.landmark_key(n), len(mean))
                for n, mean in known.means.items()
            }
            for k, (numbers, row) in enumerate(known.rows_at(at)):
                factor = factors.known_landmark_factor(numbers, row, known.means)
                self.graph.replace(first + k, factor)

    def _reserve_motion(self, robot: str, last: int) -> None:
        """Take a place in the graph for the motion from a robot's state of this key to the next."""
        size = self.graph.size()
        self.motions.append((size, robot, last, last + 1))
        self.graph.resize(size + 1)

    def _make_motions(self, motions: Sequence[Motion], but: Collection[str]) -> None:
        """Fill the places of `motions` of all robots ``but`` some."""
        if not motions:
            return
        cov = np.array([motion.cov for motion in motions])
        for bad in np.flatnonzero(~are_positive(cov)).tolist():
            _, robot, _, key = self.motions[bad]
            time_ns = self.states.times[robot][key - self.state_key(robot, 0)]
            with covariance_of(describe_motion(robot, time_ns), cov[bad]):
                factors.gaussian(cov[bad])
        self.rows += 3 * len(motions)
        made = [k for k, (_, robot, *_) in enumerate(self.motions) if robot not in but]
        if made:
            delta = np.array([motions[k].delta for k in made])
            ends = [self.motions[k][2:] for k in made]
            own = factors.motion_factors(ends, delta, cov[made])
            for k, factor in zip(made, own, strict=True):
                self.graph.replace(self.motions[k][0], factor)

    def _note_segment(self, seen: Association) -> None:
        key = self.state_key(seen.robot, self.states.number(seen.robot, seen.time_ns))
        self.segments.append((key, factors.landmark_key(int(seen.target)), seen))

    def _insert_line(self, seen: Association, start: Estimate, values: gtsam.Values) -> None:
        """Note an observation of a line; a new one gets its variable and its gauge."""
        if seen.target not in self.landmark_dims:
            self.insert(Step(seen.time_ns, {}, {}, (seen,)), start, values)
            return
        key = self.state_key(seen.robot, self.states.number(seen.robot, seen.time_ns))
        self.rows += MODELS["line"].rows
        self._lines.append((key, factors.landmark_key(int(seen.target)), seen))

    def pose_reader(self, values: gtsam.Values) -> Callable[[IntArray], Array]:
        """What gives the values (n, 3) of states by their keys (n,).

        ``values`` are of the whole graph, and are read once.
        """
        every = np.concatenate(
            [np.array(self.state_keys(robot), dtype=np.int64) for robot in self.robots]
        )
        poses = factors.read_poses(values)[-len(every) :]
        return lambda keys: np.asarray(poses[np.searchsorted(every, keys)])

    @property
    def observes_walls(self) -> bool:
        """Whether there are lines or segments."""
        return bool(self._lines or self.segments)

    def weigh_walls(
        self, values: gtsam.Values, variances: Mapping[str, Array]
    ) -> list[WeighedWalls]:
        """What walls are observed with, see `weighed_walls`; lines by the noise that a log shows.

        The factors of lines are made again so, Gaussian; those of segments stay.
        """
        found = []
        if self._lines:
            self.reserve_lines()
            lines = self._weighed("line", self._lines, values, variances)
            keys, targets, _ = zip(*self._lines, strict=True)
            given = lines.z, lines.cov, lines.x, lines.t
            made = factors.line_factors(keys, targets, *given, factors.NO_KERNEL)
            for index, factor in zip(self._line_indices, made, strict=True):
                self.graph.replace(index, factor)
            found.append(lines)
        if self.segments:
            found.append(self._weighed("segment", self.segments, values, {}))
        return found

    def _weighed(
        self,
        model: str,
        observed: Sequence[tuple[int, int, Association]],
        values: gtsam.Values,
        variances: Mapping[str, Array],
    ) -> WeighedWalls:
        ends = observed_ends(observed, values)
        return weighed_walls(model, self.robots, observed, ends, variances, self.kernel)

    def _insert_polar(
        self,
        source: Source,
        observed: Sequence[tuple[int, Association]],
        start: Estimate,
        values: gtsam.Values,
    ) -> None:
        """Add a source's observations of bearing and range, each with the time of its step."""
        robot, model = source
        stamps = np.array([seen.time_ns for _, seen in observed], dtype=np.int64)
        number = self.states.numbers(robot, stamps)
        keys = (self.state_key(robot, 0) + number).tolist()
        if model == "point":
            targets = self._landmark_keys([seen for _, seen in observed], start, values)
        else:
            at = [(str(seen.target), time_ns) for time_ns, seen in observed]
            targets = [self.state_key(name, self.states.number(name, ns)) for name, ns in at]
            ends = zip(keys, targets, (seen for _, seen in observed), strict=True)
            self.robot_observations += enumerate(ends, self.graph.size())
        z = np.array([seen.z for _, seen in observed])
        cov = np.array([seen.cov for _, seen in observed])
        for bad in np.flatnonzero(~are_positive(cov)).tolist():
            seen = observed[bad][1]
            with covariance_of(describe(seen), seen.cov):
                factors.gaussian(seen.cov)
        self.rows += z.size
        self.polar[source] = z, cov
        kernel = self.kernel
        if source in self.noise:
            noise = self.noise[source]
            kernel = replace(kernel, scale=noise.kernel_scale)
            if model == "point" and noise.shared.any():
                times = np.array([time_ns for time_ns, _ in observed], dtype=np.int64)
                targets = self._share_errors(source, times, (keys, targets), cov, values)
            cov = cov * np.sqrt(noise.white[:, None] * noise.white)
        made = zip(keys, targets, (seen for _, seen in observed), strict=True)
        self.bearings_and_ranges[source] = list(made)
        for factor in factors.bearing_range_factors(model, keys, targets, z, cov, kernel):
            self.graph.add(factor)

    def _landmark_keys(
        self, observed: Sequence[Association], start: Estimate, values: gtsam.Values
    ) -> list[int]:
        """Keys of the landmarks that are observed; the new ones get their variables."""
        numbers = [int(seen.target) for seen in observed]
        first = dict(zip(reversed(numbers), reversed(observed), strict=True))
        for number in first.keys() - self.landmark_dims.keys():
            self.introduce(first[number])
            key = factors.landmark_key(number)
            factors.write(values, key, self.value_in(start, key))
        return list(map(factors.landmark_key, numbers))

    def _share_errors(
        self,
        source: Source,
        times_ns: IntArray,
        ends: tuple[Sequence[int], Sequence[int]],
        cov: Array,
        values: gtsam.Values,
    ) -> list[int]:
        """Put points in the place of landmarks, one for each time of `SHARED_NS`.

        Args:
            source: of the observations.
            times_ns: (n,) of each.
            ends: keys of their states and landmarks.
            cov: (n, 2, 2) as stated.
            values: those of the states and landmarks; they gain the points.

        Returns:
            Keys of the points that the observations are of.
        """
        landmarks = np.array(ends[1], dtype=np.int64)
        spans = np.column_stack([landmarks, times_ns // SHARED_NS])
        of, group, count = np.unique(spans, axis=0, return_inverse=True, return_counts=True)
        group = group.ravel()
        order = np.argsort(group, kind="stable")
        middle = order[np.cumsum(count) - count + count // 2]  # an observation of each
        x = np.array([factors.read(values, ends[0][k], 3) for k in middle.tolist()])
        t = np.array([factors.read(values, key, 2) for key in of[:, 0].tolist()])
        apart = t - x[:, :2]
        r = np.maximum(np.hypot(apart[:, 0], apart[:, 1]), 1e-3)
        u, v = (apart / r[:, None]).T
        axes = np.stack([np.stack([-v, u], axis=1) / r[:, None], np.stack([u, v], axis=1)], axis=1)
        noise = self.noise[source]
        stated = np.diagonal(cov[middle], axis1=1, axis2=2)
        variance = stated * np.maximum(noise.shared, NO_SHARED_ERROR * noise.white)
        back = np.linalg.inv(axes)
        point_cov = back @ (variance[:, :, None] * back.mT)
        first = int(gtsam.symbol("b", self._stand_ins))
        self._stand_ins += len(of)
        keys = np.column_stack([of[:, 0], first + np.arange(len(of))])
        for (landmark, key), at, spread in zip(keys.tolist(), t, point_cov, strict=True):
            values.insert(key, at)
            model = factors.gaussian(0.5 * (spread + spread.T))
            self.graph.add(gtsam.BetweenFactorPoint2(landmark, key, np.zeros(2), model))
        self.shared_errors[source] = SharedErrors(keys, axes, variance)
        return [int(key) for key in keys[group, 1]]
