"""The frozen records that modules exchange: messages, motions, observations, estimates, results.

All arrays are float64. Poses are ``(3,)``: x m, y m, heading rad. Covariances are of *additive*
errors (x, y, heading) along the axes of the frame that the quantity is given in, unless a field
says otherwise. Time is integer nanoseconds.

A message has two times. ``stamp_ns`` is its header stamp, unchanged; it identifies the message in
every output. ``time_ns`` is the time it is processed with: equal to the stamp except where the
stamp contradicts the order of recording (see `graphslam.logs.time_order`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.config import Config
from graphslam.core.geometry import Array, path_length
from graphslam.core.information_root import InformationRoot
from graphslam.core.known_landmarks import KnownLandmarks
from graphslam.core.mount_covariances import MountCovariances
from graphslam.core.notebook_views import ResultViews
from graphslam.core.record import Record

#: a time or times (...,), ns
Stamps = int | Sequence[int] | np.ndarray[tuple[int, ...], np.dtype[np.int64]]


@dataclass(frozen=True, slots=True, eq=False)
class Message(Record):
    """Base of all messages of a log: the robot that recorded it and its two times."""

    robot: str
    stamp_ns: int
    time_ns: int


@dataclass(frozen=True, slots=True, eq=False)
class OdometryPose(Message):
    """Pose (3,) of the base in the odometry frame, whose origin is arbitrary."""

    pose: Array


@dataclass(frozen=True, slots=True, eq=False)
class OdometryIncrement(Message):
    """Pose of the base at ``time_ns`` in that at ``start_ns``; ``cov`` (3, 3) along its axes."""

    start_ns: int
    delta: Array
    cov: Array


@dataclass(frozen=True, slots=True, eq=False)
class WheelAngles(Message):
    """Accumulated angles of the left and right wheel, rad, forward positive, never wrapped."""

    left_rad: float
    right_rad: float


@dataclass(frozen=True, slots=True, eq=False)
class Scan(Message):
    """One sweep of a planar laser (``sensor``: see `logs.lasers`) at ``mount`` (3,) in the base.

    ``ranges`` (n,) m, NaN without one; beam i is along ``angle_min_rad + i angle_step_rad``, or its
    ``bearings``, ``beam_period_s`` after the one before (negative: before it), see `sweep_motion`.
    """

    ranges: Array
    angle_min_rad: float
    angle_step_rad: float
    mount: Array
    beam_period_s: float = 0.0
    bearings: Array | None = None
    sensor: str = ""

    @property
    def angles(self) -> Array:
        """Beam directions (n,), rad, in the laser frame."""
        evenly = self.angle_min_rad + self.angle_step_rad * np.arange(len(self.ranges), dtype=float)
        return evenly if self.bearings is None else self.bearings


@dataclass(frozen=True, slots=True, eq=False)
class Sighting(Message):
    """A landmark or another robot measured by bearing and range.

    ``z`` is (bearing rad, range m), in the sensor's frame, maybe with the target's direction, rad,
    relative to the sensor. ``cov`` (2, 2) or (3, 3), if not ``stated``, is to be measured.
    ``identity`` is None when unknown. ``seen_robot`` names a robot; where it is None, ``may_be`` is
    ``landmark``, ``robot``, or ``either``. Sightings of one robot at one stamp are one image.
    """

    z: Array
    cov: Array
    identity: str | None
    seen_robot: str | None
    mount: Array
    may_be: str = "landmark"
    stated: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class RelativePose(Message):
    """Pose (3,) of ``robot`` at ``time_ns`` in the frame of ``other`` at ``start_ns``.

    A loop closure (``other`` is the robot itself at an earlier time) or a measurement between two
    robots.
    ``cov`` (3, 3) is along the axes of the frame at ``start_ns``.
    """

    other: str
    start_ns: int
    delta: Array
    cov: Array


@dataclass(frozen=True, slots=True, eq=False)
class TrueLandmark(Message):
    """The true state of a landmark; ``robot`` is empty. ``kind`` point | segment | line.

    ``pose`` (3,) in the world frame (heading NaN for a point), ``extent`` (2, 2) its end points
    or None.
    """

    identity: str
    kind: str
    pose: Array
    extent: Array | None


@dataclass(frozen=True, slots=True, eq=False)
class TrueAssociations(Message):
    """True targets of the beams of a scan, or of the sightings of one stamp.

    ``targets`` (n,) are places in ``names`` (landmarks' identities, robots' names), -1 for nothing.
    """

    names: tuple[str, ...]
    targets: np.ndarray[tuple[int], np.dtype[np.int64]]


@dataclass(frozen=True, slots=True, eq=False)
class Truth(Message):
    """True pose (3,) of a robot's base in the world frame; used by evaluation only."""

    pose: Array


# ---------------------------------------------------------------- input of an estimator


#: what no estimate may see
TRUE_RECORDS = (Truth, TrueLandmark)


@dataclass(frozen=True, slots=True, eq=False)
class Motion(Record):
    """How a robot moved from ``start_ns`` to ``end_ns`` according to its own sensors.

    ``delta`` (3,) is the end pose in the frame of the start pose, ``cov`` (3, 3) along the start
    frame's axes. ``d_delta_d_calibration`` (3, p) is its derivative with respect to the motion
    source's p calibration parameters (see `graphslam.core.motion_models`); its part of ``cov`` is
    already included. ``length_m`` is the path driven. ``from_scans``: scans contradicted the
    sensors and corrected the motion (`graphslam.odometry.scan_odometry`); ``contradiction``: how.
    """

    start_ns: int
    end_ns: int
    delta: Array
    cov: Array
    d_delta_d_calibration: Array
    length_m: float
    from_scans: bool = False
    contradiction: "Contradiction | None" = None


@dataclass(frozen=True, slots=True, eq=False)
class Contradiction(Record):
    """A motion by ``odometry``, and the same motion by scans that contradict it: ``pose`` (3,).

    ``information`` (3, 3) of scans about it, along its start's axes: singular in a corridor.
    """

    odometry: Motion
    pose: Array
    information: Array


@dataclass(frozen=True, slots=True, eq=False)
class Observation(Record):
    """One observation of a landmark by a front end, in the frame of the sensor.

    ``kind`` says what ``z`` is: ``point`` (bearing, range); ``segment`` and ``line`` a pose on
    the line (its middle, x axis along the line, the sensor on its left). ``cov`` has z's size;
    for a ``line`` its first row and column mean nothing (no information along the line).
    ``extent`` (2,) is where the observed part begins and ends along the line, measured from z,
    m; None for points. ``source`` is the number of the recorded sighting that it was made from,
    where that is kept. ``robots``: those that it may be of; ``is_landmark``: or a landmark.
    """

    kind: str
    z: Array
    cov: Array
    extent: Array | None = None
    identity: str | None = None
    source: int | None = None
    robots: tuple[str, ...] = ()
    is_landmark: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class Association(Record):
    """An observation made from a robot's state, with the target it belongs to.

    ``time_ns`` names the robot's state; ``target`` is a landmark's number or another robot's
    name; ``model`` is the row of `MODELS` that compares them. ``z`` and ``cov`` are in the
    robot's base frame at that state. ``late`` marks evidence from before the landmark's
    promotion: filters skip it, smoothers use it. ``extent`` (2,) m is from where to where a wall
    was seen, along the x axis of ``z``. ``source``: see `Observation`.
    """

    robot: str
    time_ns: int
    target: int | str
    model: str
    z: Array
    cov: Array
    late: bool = False
    extent: Array | None = None
    source: int | None = None

    def with_measurement(self, z: Array, cov: Array) -> "Association":
        """The same with another measurement (k,) and covariance (k, k)."""
        # `dataclasses.replace` takes twice as long, and there are many
        same = self.robot, self.time_ns, self.target, self.model
        return Association(*same, z, cov, self.late, self.extent, self.source)


@dataclass(frozen=True, slots=True, eq=False)
class Start(Record):
    """Prior of a robot's first state: pose (3,), cov (3, 3) along world axes.

    ``base_cov``: ``cov`` without the sensor's mount, where the start of the base was told.
    ``world_cov``: ``cov`` with what is not known of where the map lies that ``cov`` is relative to.
    """

    pose: Array
    cov: Array
    base_cov: Array | None = None
    world_cov: Array | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Closure(Record):
    """Pose (3,) of state (robot, time) in the frame of state (other, other_time), with cov.

    ``verified``: its consistency with all other data was tested, so it gets no robust kernel.
    ``scan_count``: number of scans it was made of; it has their weight against other observations.
    """

    robot: str
    time_ns: int
    other: str
    other_time_ns: int
    delta: Array
    cov: Array
    verified: bool = False
    scan_count: int = 1

    @property
    def pair(self) -> tuple[tuple[str, int], tuple[str, int]]:
        """The two states."""
        return (self.robot, self.time_ns), (self.other, self.other_time_ns)


@dataclass(frozen=True, slots=True, eq=False)
class Step(Record):
    """Everything that enters an estimator together, at one time.

    ``starts`` holds robots that appear for the first time, ``motions`` those that get a new
    state at ``time_ns``; ``deleted`` are landmarks that no later step observes, and that a filter
    may drop. Steps are recorded and can be replayed into another back end. ``known``: landmarks of
    an earlier map, of the first step only.
    """

    time_ns: int
    starts: Mapping[str, Start] = field(default_factory=dict)
    motions: Mapping[str, Motion] = field(default_factory=dict)
    associations: tuple[Association, ...] = ()
    closures: tuple[Closure, ...] = ()
    deleted: tuple[int, ...] = ()
    known: KnownLandmarks | None = None


# ---------------------------------------------------------------- estimates and results


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Poses (n, 3) at stamps (n,) int64 ns, covariances (n, 3, 3) of additive world-axis errors."""

    stamps_ns: np.ndarray[tuple[int], np.dtype[np.int64]]
    poses: Array
    covs: Array

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def index(self, stamps_ns: Stamps) -> Any:
        """Index (...,) of poses by their stamps; the stamps are sorted and each is one of them."""
        return np.searchsorted(self.stamps_ns, stamps_ns)

    def at(self, stamps_ns: Stamps) -> Array:
        """Poses (..., 3) by their stamps, see `index`."""
        return np.asarray(self.poses[self.index(stamps_ns)])

    def index_before(self, times_ns: Stamps) -> Any:
        """Index (...,) of the last pose at or before any times, of the first for earlier ones."""
        last = np.searchsorted(self.stamps_ns, times_ns, side="right") - 1
        return np.maximum(last, 0)


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """The result of a back end: every state and every landmark, world frame.

    ``states[robot]`` is over the robot's states; ``landmarks[id]`` is (state, covariance): (2,)
    and (2, 2) for points, (3,) and (3, 3) for lines and segments, additive world-axis errors.
    ``error`` is half the weighted squared residual (robust weights applied), ``dof`` rows minus
    unknowns. ``root`` has the covariance between any states; None where a back end has none.
    ``mounts``: of robots whose mounts are estimated with their states; None without any.
    """

    states: Mapping[str, Trajectory]
    landmarks: Mapping[int, tuple[Array, Array]]
    error: float
    dof: int
    root: InformationRoot | None = None
    mounts: MountCovariances | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Landmark:
    """A landmark of the map, world frame.

    ``position`` (3,), heading NaN for a point; ``cov`` (2, 2) for a point, else (3, 3);
    ``extent`` (2, 2) its end points (a point repeats itself); ``line`` is (normal direction rad,
    offset m, covariance (2, 2)) of the line through it, None for a point. ``frame``: the robot in
    whose frame it is, None for the world.
    """

    id: int
    kind: str
    position: Array
    cov: Array
    extent: Array
    line: tuple[float, float, Array] | None
    sightings: int
    first_ns: int
    last_ns: int
    identity: str | None
    frame: str | None = None


@dataclass(frozen=True, slots=True, eq=False)
class ScanTies:
    """How the poses of a robot's scans follow from its states: (n,) each, in the scans' order.

    A scan is ``share`` of the way, by motion, from state ``state`` to the next one; its sensor is
    at ``mounts`` (n, 3) in the frame of the robot's states. ``covs`` (n, 3, 3) are of its error
    between the two states, along the axes of the scan's own frame; ``odometry_covs`` (n, 3, 3) are
    what they would be by odometry alone, which is what scans between the same states share.
    """

    state: IntArray
    share: Array
    mounts: Array
    covs: Array
    odometry_covs: Array


@dataclass(frozen=True, slots=True, eq=False)
class JointScans:
    """What the joint covariance of all scans follows from: how they follow from final states.

    ``mounts``: see `Estimate`; without the covariances of the states with them.
    """

    root: InformationRoot
    states: Mapping[str, Trajectory]
    ties: Mapping[str, ScanTies]
    mounts: MountCovariances | None = None


@dataclass(frozen=True, slots=True, eq=False)
class RobotResult:
    """One robot's trajectories: final (by all data) and causal (by data up to each pose's time).

    ``final`` and ``causal`` are poses of the base, ``scan_final`` and ``scan_causal`` poses of the
    laser at each scan (None without scans); the causal ones are None where they were not asked for.
    ``dead_reckoning`` is the base by odometry alone, at the stamps of ``final``. ``scan_ties`` are
    of ``scan_final``; None where it does not follow from the final states.
    """

    final: Trajectory
    causal: Trajectory | None
    scan_final: Trajectory | None
    scan_causal: Trajectory | None
    dead_reckoning: Trajectory
    scan_ties: ScanTies | None = None

    @property
    def driven_m(self) -> float:
        """Length of the final path, m. States would not do: those of several lasers alternate."""
        in_time = np.argsort(self.final.stamps_ns, kind="stable")  # stamps may come late
        return float(path_length(self.final.poses[in_time])[-1])


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeScan(Record):
    """Points of a keyframe's scan: (n, 2) in the frame of its state, seen from ``sensor`` (3,)."""

    robot: str
    time_ns: int
    points: Array
    sensor: Array = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True, slots=True, eq=False)
class Result(ResultViews):
    """What `smooth` returns; `graphslam.results.folder` writes and reads it.

    ``step_ms`` (n,) is the wall time of each step; ``innovations[model]`` (n, 2) time s and d² per
    degree of freedom; ``summary`` is the content of summary.json.
    """

    robots: Mapping[str, RobotResult]
    landmarks: tuple[Landmark, ...]
    estimate: Estimate
    steps: tuple[Step, ...]
    keyframe_scans: tuple[KeyframeScan, ...]
    innovations: Mapping[str, Array]
    step_ms: Array
    summary: Mapping[str, Any]
    config: Config
