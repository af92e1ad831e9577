"""Contents of a scenario file: one record per table, units in the keys.

Angles in files are in degrees, as people write them; all other modules use radians. Bounds of the
numbers are in the fields' metadata and checked by `graphslam.simulation.scenario_parser`.
docs/simulator.md explains the keys.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from graphslam.core.errors import GraphSlamError

Point = tuple[float, float]

POSITIVE = {"above": 0.0}
NOT_NEGATIVE = {"least": 0.0}
SHARE = {"least": 0.0, "most": 1.0}
RELATIVE = {"above": -1.0, "most": 1.0}


class ScenarioError(GraphSlamError):
    """A scenario is unreadable or infeasible; the message names file and key or position."""


# ---------------------------------------------------------------- the world


@dataclass(frozen=True)
class StaticObject:
    """Anything that stands still, by its name."""

    name: str


@dataclass(frozen=True)
class FacetedObject(StaticObject):
    """An object with straight faces.

    may_cross: whether it may intersect other objects, which otherwise is an error.
    """

    may_cross: bool = field(default=False, kw_only=True)


@dataclass(frozen=True)
class Wall(FacetedObject):
    """A polyline; ``closed`` joins the last point to the first."""

    points_m: tuple[Point, ...]
    closed: bool = False


@dataclass(frozen=True)
class Box(FacetedObject):
    """A rectangle: table, cupboard, pillar. size_m: length and width. angle_deg: of its length."""

    center_m: Point
    size_m: Point = field(metadata=POSITIVE)
    angle_deg: float = 0.0


@dataclass(frozen=True)
class Board(FacetedObject):
    """A thin plate with two visible sides: a board that leans on a wall, a table on its side."""

    center_m: Point
    length_m: float = field(metadata=POSITIVE)
    angle_deg: float


@dataclass(frozen=True)
class Door(FacetedObject):
    """A leaf on a hinge with direction closed_deg when shut, opening_deg more when open."""

    hinge_m: Point
    width_m: float = field(metadata=POSITIVE)
    closed_deg: float
    opening_deg: float = 0.0


@dataclass(frozen=True)
class Cylinder(StaticObject):
    """A vertical cylinder: tree, pole, round pillar."""

    center_m: Point
    radius_m: float = field(metadata=POSITIVE)


@dataclass(frozen=True)
class StaticObjects:
    """All static objects of a world."""

    walls: tuple[Wall, ...] = ()
    boxes: tuple[Box, ...] = ()
    boards: tuple[Board, ...] = ()
    cylinders: tuple[Cylinder, ...] = ()
    doors: tuple[Door, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all objects, kind by kind."""
        kinds = (self.walls, self.boxes, self.boards, self.cylinders, self.doors)
        return tuple(thing.name for kind in kinds for thing in kind)


# ---------------------------------------------------------------- robots


@dataclass(frozen=True)
class Body:
    """Outline in other robots' scans: a circle, or a rectangle with rear_m behind the axle."""

    radius_m: float = field(default=0.0, metadata=NOT_NEGATIVE)
    length_m: float = field(default=0.0, metadata=NOT_NEGATIVE)
    width_m: float = field(default=0.0, metadata=NOT_NEGATIVE)
    rear_m: float = field(default=0.0, metadata=NOT_NEGATIVE)


@dataclass(frozen=True)
class Leg:
    """One part of a drive from rest to rest: a path, a turn on the spot, or a wait.

    through_m: a polyline from the current position, its corners rounded. A robot with another
    heading turns on the spot first. reverse: drive backwards. speed_m_s: instead of the robot's;
    0 = the robot's.
    """

    through_m: tuple[Point, ...] = ()
    reverse: bool = False
    turn_deg: float = 0.0
    wait_s: float = field(default=0.0, metadata=NOT_NEGATIVE)
    speed_m_s: float = field(default=0.0, metadata=NOT_NEGATIVE)


@dataclass(frozen=True)
class RobotClock:
    """Error of a robot's clock: it reads true time plus offset plus drift times true time."""

    offset_s: float = 0.0
    drift_ppm: float = 0.0


@dataclass(frozen=True)
class Sensor:
    """Timing of a sensor: one sample per period_s, the first at phase_s.

    latency_s: stamp minus true time of a sample. The default of period_s depends on the sensor.
    """

    phase_s: float = field(default=0.0, metadata=NOT_NEGATIVE, kw_only=True)
    latency_s: float = field(default=0.0, metadata=NOT_NEGATIVE, kw_only=True)


@dataclass(frozen=True)
class Encoders(Sensor):
    """Wheel encoders, and the odometry that the robot computes from them (thesis 2.1-2.12).

    wheel_radius_m and axle_m: nominal values that the robot uses. The true radii and the true axle
    length are larger by the shares radius_error_left, radius_error_right, axle_error.
    slip_m: sigma of white noise of wheel travel per square root of metre. turn_slip: wheels
    turn by this share more than the robot where it turns. odometry, joint_states: which messages
    to write.
    """

    period_s: float = field(default=0.1, metadata=POSITIVE)
    counts_per_turn: int = field(default=2000, metadata=POSITIVE)
    wheel_radius_m: float = field(default=0.1, metadata=POSITIVE)
    axle_m: float = field(default=0.5, metadata=POSITIVE)
    odometry: bool = True
    joint_states: bool = False
    radius_error_left: float = field(default=0.0, metadata=RELATIVE)
    radius_error_right: float = field(default=0.0, metadata=RELATIVE)
    axle_error: float = field(default=0.0, metadata=RELATIVE)
    slip_m: float = field(default=0.0, metadata=NOT_NEGATIVE)
    turn_slip: float = field(default=0.0, metadata=NOT_NEGATIVE)


@dataclass(frozen=True)
class Gyroscope(Sensor):
    """The gyroscope of an IMU: mean rate of turning over each period.

    rate_sigma_deg_s: white noise of one reading. bias_deg_s: at the start; bias_wander_deg_s: sigma
    of its random walk per root of a second. scale_error: share by which it turns too far.
    """

    period_s: float = field(default=0.02, metadata=POSITIVE)
    rate_sigma_deg_s: float = field(default=0.2, metadata=NOT_NEGATIVE)
    bias_deg_s: float = 0.0
    bias_wander_deg_s: float = field(default=0.0, metadata=NOT_NEGATIVE)
    scale_error: float = field(default=0.0, metadata=RELATIVE)


@dataclass(frozen=True)
class Laser(Sensor):
    """A planar laser like the SICK LMS 200; beams from -field/2 to +field/2.

    mount_m, mount_deg: its pose in the base frame; mount_error_m, mount_error_deg: what the
    transform in the log adds to it, along the axes of the base. range_sigma_m: white noise;
    range_sigma_ratio: more of it, as a share of the range (the root of the sum of their squares
    counts). bias_sigma_m: sigma of the constant range bias of a material. dropout_share: share of
    beams without a return; spurious_share: with a return from a random range in front of the
    surface.
    mixed_share: share of the beams at a range discontinuity above mixed_gap_m that return a range
    between its two sides.
    resolution_m: ranges are rounded to multiples of it; 0 = not rounded. sweep_s: time from the
    first beam to the last, which are measured one after the other; 0 = all at once.
    """

    period_s: float = field(default=0.3, metadata=POSITIVE)
    field_deg: float = field(default=180.0, metadata={"above": 0.0, "most": 360.0})
    step_deg: float = field(default=0.5, metadata=POSITIVE)
    range_min_m: float = field(default=0.05, metadata=NOT_NEGATIVE)
    range_max_m: float = field(default=8.0, metadata=POSITIVE)
    mount_m: Point = (0.0, 0.0)
    mount_deg: float = 0.0
    mount_error_m: Point = (0.0, 0.0)
    mount_error_deg: float = 0.0
    range_sigma_m: float = field(default=0.015, metadata=NOT_NEGATIVE)
    range_sigma_ratio: float = field(default=0.0, metadata=NOT_NEGATIVE)
    bias_sigma_m: float = field(default=0.01, metadata=NOT_NEGATIVE)
    dropout_share: float = field(default=0.0, metadata=SHARE)
    spurious_share: float = field(default=0.0, metadata=SHARE)
    mixed_share: float = field(default=0.0, metadata=SHARE)
    mixed_gap_m: float = field(default=0.1, metadata=NOT_NEGATIVE)
    resolution_m: float = field(default=0.001, metadata=NOT_NEGATIVE)
    sweep_s: float = field(default=0.0, metadata=NOT_NEGATIVE)

    @property
    def beam_period_s(self) -> float:
        """Time between two beams."""
        return self.sweep_s / max(self.beams - 1, 1)

    @property
    def beams(self) -> int:
        """Number of beams, both ends of the field included."""
        return round(self.field_deg / self.step_deg) + 1


@dataclass(frozen=True)
class SightingSensor(Sensor):
    """A sensor that measures bearing and range of cylinders or other robots, at the base frame.

    of: `landmarks` or `robots`. names: its targets; empty = all of the scenario.
    direction_sigma_deg: 0 = the direction is not measured (cylinders have none). identified:
    whether the identity, of a robot its name, is in the message. told_apart: without it, whether
    the message says that it is a robot, or a landmark. exchanged_share: share of the sightings
    under the name of another target. false_share: sightings of nothing, anywhere in the field of
    view and under any name, for each true one.
    """

    of: str
    period_s: float = field(default=0.5, metadata=POSITIVE)
    names: tuple[str, ...] = ()
    field_deg: float = field(default=360.0, metadata={"above": 0.0, "most": 360.0})
    range_max_m: float = field(default=8.0, metadata=POSITIVE)
    range_sigma_m: float = field(default=0.02, metadata=POSITIVE)
    bearing_sigma_deg: float = field(default=0.5, metadata=POSITIVE)
    direction_sigma_deg: float = field(default=0.0, metadata=NOT_NEGATIVE)
    identified: bool = True
    told_apart: bool = True
    exchanged_share: float = field(default=0.0, metadata=SHARE)
    false_share: float = field(default=0.0, metadata=SHARE)


@dataclass(frozen=True)
class DrivePlan:
    """Start pose and legs of a robot's drive."""

    start_m: Point
    start_deg: float = field(default=0.0, kw_only=True)
    drive: tuple[Leg, ...] = field(default=(), kw_only=True)


@dataclass(frozen=True)
class Robot(DrivePlan):
    """A robot: its drive, outline, limits of motion, clock and sensors.

    corner_m: distance before a corner of the drive at which the robot leaves the straight line.
    lasers: more lasers, or all of several, by name; each is on a topic of its own.
    """

    body: Body
    speed_m_s: float = field(default=0.4, metadata=POSITIVE)
    acceleration_m_s2: float = field(default=0.3, metadata=POSITIVE)
    turn_rate_deg_s: float = field(default=45.0, metadata=POSITIVE)
    corner_m: float = field(default=0.5, metadata=POSITIVE)
    clock: RobotClock = field(default_factory=RobotClock)
    encoders: Encoders = field(default_factory=Encoders)
    gyroscope: Gyroscope | None = None
    laser: Laser | None = None
    lasers: Mapping[str, Laser] = field(default_factory=dict)
    sightings: tuple[SightingSensor, ...] = ()

    @property
    def scanners(self) -> dict[str, Laser]:
        """All lasers by name; ``laser`` is the first."""
        return ({} if self.laser is None else {"laser": self.laser}) | dict(self.lasers)


# ---------------------------------------------------------------- a second visit


@dataclass(frozen=True)
class Move:
    """An object with another pose at the second visit: turned about a point, then shifted."""

    name: str
    turn_deg: float = 0.0
    about_m: Point = (0.0, 0.0)
    shift_m: Point = (0.0, 0.0)


@dataclass(frozen=True)
class LaterVisit:
    """The second visit: objects that moved, vanished or appeared, and robots' other drives."""

    moved: tuple[Move, ...] = ()
    vanished: tuple[str, ...] = ()
    appeared: StaticObjects = field(default_factory=StaticObjects)
    robots: Mapping[str, DrivePlan] = field(default_factory=dict)


@dataclass(frozen=True)
class Scenario:
    """A whole scenario. duration_s: 0 = until the end of the last drive.

    world_of: name or file of another scenario whose world is used. name: that of the file; not a
    key.
    """

    robots: Mapping[str, Robot]
    world: StaticObjects = field(default_factory=StaticObjects)
    world_of: str = ""
    description: str = ""
    duration_s: float = field(default=0.0, metadata=NOT_NEGATIVE)
    truth_period_s: float = field(default=0.1, metadata=POSITIVE)
    later: LaterVisit | None = None
    name: str = field(default="", metadata={"hidden": True})
