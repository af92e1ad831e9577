"""Sighting batches: images of a short span that share one step of the estimator.

Five robots whose cameras take four images per second would get twenty states per second, most of
them a few millimetres apart. Instead all images within a span make one step, with one state per
robot at its end, and odometry moves every sighting there.
"""

import itertools
from collections import Counter, defaultdict, deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeAlias

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.geometry import Array, compose, compose_cov, inverse, inverse_cov, rotation3
from graphslam.core.observation_models import MODELS, transport
from graphslam.core.records import Association, Message, Motion, Observation, Sighting
from graphslam.odometry.preintegration import Track, preintegrate_batch
from graphslam.perception.sightings import is_unnamed_robot, sighting_observation
from graphslam.pipeline.synchronisation import ODOMETRY

#: rad: sigma of the relative heading of two robots, used to rotate a short motion
HEADING_SIGMA_RAD = 0.1


@dataclass(slots=True, eq=False)
class SightingBatch:
    """Images (sightings of one robot at one time) of one span, in the order of time."""

    images: list[Sequence[Sighting]] = field(default_factory=list)

    @property
    def first_ns(self) -> int:
        """Time of the earliest image."""
        return self.images[0][0].time_ns

    @property
    def time_ns(self) -> int:
        """Time of the latest image: that of the step."""
        return self.images[-1][0].time_ns

    @property
    def robots(self) -> list[str]:
        """Robots that saw something or were seen, sorted."""
        seen = {s.seen_robot for image in self.images for s in image if s.seen_robot}
        return sorted(seen | {image[0].robot for image in self.images})


#: everything one robot perceived at one time, or all images of a span
Event: TypeAlias = Sequence[Message] | SightingBatch


def batch_sightings(
    events: Iterable[Sequence[Message]], tracks: Mapping[str, Track], span_ns: int, max_gap_ns: int
) -> Iterator[Event]:
    """Events in order of time, images of one span as one `SightingBatch`.

    A batch is complete once the odometry of all its robots has reached its end (waiting at most
    ``max_gap_ns``), or before a scan or a relative pose, which make steps of their own.

    Args:
        events: what one robot perceived at one time, each released by its own robots' odometry.
        tracks: odometry of every robot; it grows while events are taken.
        span_ns: from the first image of a batch to its last; 0 makes no batches.
        max_gap_ns: longest wait for a robot's odometry.
    """
    complete: deque[SightingBatch] = deque()
    filling = SightingBatch()

    def covered(one: SightingBatch, now_ns: int) -> bool:
        late = now_ns - one.time_ns > max_gap_ns
        unnamed = any(is_unnamed_robot(s) for image in one.images for s in image)
        robots = tracks if unnamed else one.robots
        return late or all(tracks[robot].reaches(one.time_ns) for robot in robots)

    for event in events:
        first = event[0]
        if filling.images and first.time_ns - filling.first_ns > span_ns:
            complete.append(filling)
            filling = SightingBatch()
        steps_alone = not isinstance(first, (Sighting, *ODOMETRY))
        if steps_alone and filling.images:
            complete.append(filling)
            filling = SightingBatch()
        while complete and (steps_alone or covered(complete[0], first.time_ns)):
            yield complete.popleft()
        if span_ns and isinstance(first, Sighting):
            filling.images.append([s for s in event if isinstance(s, Sighting)])
        else:
            yield event
    yield from complete
    if filling.images:
        yield filling


def sighting_batches(sightings: Iterable[Sighting], span_ns: int) -> list[SightingBatch]:
    """The batches of sightings in order of time, with nothing in between; see `batch_sightings`."""
    batches: list[SightingBatch] = []
    for _, group in itertools.groupby(sightings, lambda s: (s.robot, s.time_ns)):
        image = list(group)
        if not batches or image[0].time_ns - batches[-1].first_ns > span_ns:
            batches.append(SightingBatch())
        batches[-1].images.append(image)
    return batches


def batch_motions(
    batch: SightingBatch,
    state_ns: Mapping[str, int],
    last_ns: Mapping[str, int],
    tracks: Mapping[str, Track],
) -> tuple[dict[tuple[str, int], Motion], dict[str, Motion]]:
    """The motions of a step, computed together.

    Args:
        batch: the images.
        state_ns: time of each robot's state, before or after an image.
        last_ns: time of its state before that, of robots that get a new one.
        tracks: odometry of every robot.

    Returns:
        (robot, time of an image that it took or was seen in) -> its motion from its state to then;
        robot -> its motion to its new state.
    """
    times: dict[str, set[int]] = defaultdict(set)
    for image in batch.images:
        for robot in sorted({image[0].robot, *(s.seen_robot for s in image if s.seen_robot)}):
            times[robot].add(image[0].time_ns)
    queries: list[tuple[Track, IntArray, IntArray]] = []
    for robot, needed in times.items():
        starts, ends = [state_ns[robot]] * len(needed), sorted(needed)
        if robot in last_ns:
            starts, ends = [*starts, last_ns[robot]], [*ends, state_ns[robot]]
        begin, end = np.array([starts, ends], dtype=np.int64)
        queries.append((tracks[robot], begin, end))
    there: dict[tuple[str, int], Motion] = {}
    new: dict[str, Motion] = {}
    for robot, (_, start_ns, end_ns), moved in zip(
        times, queries, preintegrate_batch(queries), strict=True
    ):
        made = map(moved.one, itertools.count(), start_ns.tolist(), end_ns.tolist())
        images = itertools.islice(made, len(times[robot]))
        there.update(((robot, motion.end_ns), motion) for motion in images)
        new.update((robot, motion) for motion in made)
    return there, new


def to_state_frame(
    sightings: Sequence[Sighting], moved: Sequence[Motion], first_source: int = 0
) -> list[Observation]:
    """Sightings in the base frames of the states at which the motions ``moved`` begin.

    Each motion ends when its sighting was made; without motion the covariance is the sighting's
    own. Observations are numbered from
    ``first_source`` on.
    """
    base = []
    for number, sighting in enumerate(sightings, first_source):
        o = replace(sighting_observation(sighting), source=number)
        if sighting.mount.any():
            z, cov = transport(o.z, o.cov, sighting.mount, np.zeros((3, 3)))
            o = replace(o, z=z, cov=cov)
        base.append(o)
    away = [k for k, motion in enumerate(moved) if motion.start_ns != motion.end_ns]
    for size in (2, 3):
        which = [k for k in away if len(base[k].z) == size]
        if which:
            z, cov = transport_batch(
                np.array([base[k].z for k in which]),
                np.array([base[k].cov for k in which]),
                np.array([moved[k].delta for k in which]),
                np.array([moved[k].cov for k in which]),
            )
            for n, k in enumerate(which):
                base[k] = replace(base[k], z=z[n], cov=cov[n])
    return base


def transport_batch(z: Array, cov: Array, delta: Array, delta_cov: Array) -> tuple[Array, Array]:
    """`transport` of many measurements at once, each by its own motion.

    Args:
        z: (..., 2) bearings and ranges, or (..., 3) poses, at the end of the motion.
        cov: of ``z``.
        delta: (..., 3) motions.
        delta_cov: (..., 3, 3) along the axes of their starts.

    Returns:
        The measurements as from the start of the motion, and their covariances.
    """
    if z.shape[-1] == 3:
        return compose(delta, z), compose_cov(delta, delta_cov, z, cov)
    model = MODELS["point"]
    point = model.invert(z, delta)
    G_x, G_z = model.invert_jacobians(z, delta)
    return _seen_at(point, G_x @ delta_cov @ G_x.mT + G_z @ cov @ G_z.mT)


def robot_observations(
    sightings: Sequence[Sighting],
    seen: Sequence[Observation],
    at: Mapping[str, int],
    moved: Mapping[tuple[str, int], Motion],
    heading: Mapping[str, float],
) -> list[Association]:
    """Sightings of robots as associations between states: the seen robot is moved to its state.

    Args:
        sightings: of a step, of landmarks as well.
        seen: the same in their observers' base frames at their states.
        at: robot -> time of its state.
        moved: (robot, time) -> motion from the robot's state to that time.
        heading: robot -> estimated heading of its state, rad.

    Returns:
        An association of each sighting of a robot, in their order.
    """
    made: dict[int, Association] = {}
    for size, model in ((2, "robot-point"), (3, "robot-pose")):
        which = [
            (k, s.robot, s.seen_robot, moved[s.seen_robot, s.time_ns])
            for k, s in enumerate(sightings)
            if s.seen_robot is not None and len(seen[k].z) == size
        ]
        if not which:
            continue
        apart = np.array([way.start_ns != way.end_ns for *_, way in which])
        z, cov = transport_target(
            np.array([seen[k].z for k, *_ in which]),
            np.array([seen[k].cov for k, *_ in which]),
            np.array([way.delta for *_, way in which]),
            np.array([way.cov for *_, way in which]) * apart[:, None, None],
            np.array([heading[other] - heading[robot] for _, robot, other, _ in which]),
        )
        for n, (k, robot, other, _) in enumerate(which):
            made[k] = Association(
                robot, at[robot], other, model, z[n], cov[n], source=seen[k].source
            )
    return [made[k] for k in sorted(made)]


def transport_target(
    z: Array, cov: Array, delta: Array, delta_cov: Array, turn_rad: Array
) -> tuple[Array, Array]:
    """Measurements of robots, moved from where the robots were seen to their states.

    The motion in between is known along the seen robot's axes. The relative heading that rotates it
    into the observer's frame comes from the estimate and need not be accurate: the motion is short.

    Args:
        z: (..., 2) bearings and ranges, or (..., 3) poses, in the observer's base frame.
        cov: of ``z``.
        delta: (..., 3) motions of the seen robots from their states to when they were seen.
        delta_cov: (..., 3, 3) along the axes of their starts.
        turn_rad: (...,) headings of the seen robots' states relative to the observers'.
    """
    if z.shape[-1] == 3:
        back = inverse(delta)
        return compose(z, back), compose_cov(z, cov, back, inverse_cov(delta, delta_cov))
    model, origin = MODELS["point"], np.zeros(3)
    R = rotation3(turn_rad)[..., :2, :2]
    shift = (R @ delta[..., :2, None])[..., 0]
    side = np.stack([-shift[..., 1], shift[..., 0]], axis=-1)
    _, G = model.invert_jacobians(z, np.broadcast_to(origin, (*z.shape[:-1], 3)))
    point_cov = G @ cov @ G.mT + R @ delta_cov[..., :2, :2] @ R.mT
    point_cov += HEADING_SIGMA_RAD**2 * side[..., :, None] * side[..., None, :]
    return _seen_at(model.invert(z, origin) - shift, point_cov)


def _seen_at(point: Array, cov: Array) -> tuple[Array, Array]:
    """Bearings and ranges (..., 2) of points (..., 2) from the origin, with covariances."""
    model, origin = MODELS["point"], np.zeros(3)
    z = model.predict(origin, point)
    _, H = model.jacobians(z, origin, point)
    return z, H @ cov @ H.mT


def inflate_repeated(associations: Sequence[Association]) -> tuple[Association, ...]:
    """Associations of one step, in which n sightings of one target by one robot count as one.

    Errors of a target's sightings within a short span are nearly equal (MRCLAM: the ranges of
    consecutive images correlate by 0.8), so each gets n times its covariance.
    """
    count = Counter((a.robot, a.target) for a in associations)
    return tuple(
        a.with_measurement(a.z, a.cov * n) if (n := count[a.robot, a.target]) > 1 else a
        for a in associations
    )


def events(messages: Iterable[Message]) -> Iterator[list[Message]]:
    """Messages grouped to events: the sightings of one robot at one time are one image."""

    def key(numbered: tuple[int, Message]) -> tuple[object, ...]:
        number, message = numbered
        if isinstance(message, Sighting):
            return (message.robot, message.time_ns)
        return (number,)  # an event of its own

    for _, group in itertools.groupby(enumerate(messages), key):
        yield [message for _, message in group]
