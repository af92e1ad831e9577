"""What a scenario file may say: one record per table, units in the keys.

Angles in files are degrees, since people write them; everything behind this module is in
radians. Bounds of the numbers are in the fields' metadata and checked by
`graphslam.simulation.scenario_parser`. docs/simulator.md explains the keys.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

Point = tuple[float, float]

POSITIVE = {"above": 0.0}
NOT_NEGATIVE = {"least": 0.0}
SHARE = {"least": 0.0, "most": 1.0}
RELATIVE = {"above": -1.0, "most": 1.0}

# ---------------------------------------------------------------- the world


@dataclass(frozen=True)
class Wall:
    """Straight stretches from point to point; ``closed`` joins the last to the first.

    may_cross: whether it may cut through other things, which otherwise is taken for a mistake.
    """

    name: str
    points_m: tuple[Point, ...]
    closed: bool = False
    may_cross: bool = False


@dataclass(frozen=True)
class Box:
    """A rectangle that stands on the floor: table, cupboard, pillar; ``angle_deg`` of its length.

    size_m: length and width.
    """

    name: str
    center_m: Point
    size_m: Point = field(metadata=POSITIVE)
    angle_deg: float = 0.0
    may_cross: bool = False


@dataclass(frozen=True)
class Board:
    """A thin plate, seen from both sides: a board that leans on a wall, a table on its side."""

    name: str
    center_m: Point
    length_m: float = field(metadata=POSITIVE)
    angle_deg: float
    may_cross: bool = False


@dataclass(frozen=True)
class Cylinder:
    """A vertical cylinder: tree, pole, round pillar."""

    name: str
    center_m: Point
    radius_m: float = field(metadata=POSITIVE)


@dataclass(frozen=True)
class Door:
    """A leaf on a hinge; it points along closed_deg when shut, opening_deg more when open."""

    name: str
    hinge_m: Point
    width_m: float = field(metadata=POSITIVE)
    closed_deg: float
    opening_deg: float = 0.0
    may_cross: bool = False


@dataclass(frozen=True)
class StaticObjects:
    """Everything that stands still."""

    walls: tuple[Wall, ...] = ()
    boxes: tuple[Box, ...] = ()
    boards: tuple[Board, ...] = ()
    cylinders: tuple[Cylinder, ...] = ()
    doors: tuple[Door, ...] = ()


# ---------------------------------------------------------------- robots


@dataclass(frozen=True)
class Body:
    """Outline that others see: a circle, or a rectangle of which rear_m lies behind the axle."""

    radius_m: float = field(default=0.0, metadata=NOT_NEGATIVE)
    length_m: float = field(default=0.0, metadata=NOT_NEGATIVE)
    width_m: float = field(default=0.0, metadata=NOT_NEGATIVE)
    rear_m: float = field(default=0.0, metadata=NOT_NEGATIVE)


@dataclass(frozen=True)
class Leg:
    """One part of a drive: through points, or a turn on the spot, or a wait; from rest to rest.

    through_m: the polyline from where the robot stands, its corners rounded. A robot that does not
    look along the first stretch turns on the spot first. reverse: backwards. speed_m_s: over the
    robot's own; 0 = the robot's own.
    """

    through_m: tuple[Point, ...] = ()
    reverse: bool = False
    turn_deg: float = 0.0
    wait_s: float = field(default=0.0, metadata=NOT_NEGATIVE)
    speed_m_s: float = field(default=0.0, metadata=NOT_NEGATIVE)


@dataclass(frozen=True)
class RobotClock:
    """What the robot's clock reads: true time plus offset plus drift per second."""

    offset_s: float = 0.0
    drift_ppm: float = 0.0


@dataclass(frozen=True)
class Encoders:
    """Wheel encoders, and the odometry that the robot computes from them (thesis 2.1-2.12).

    wheel_radius_m and axle_m: nominal, what the robot believes. The true radii and the true axle
    length are larger by the shares radius_error_left, radius_error_right, axle_error.
    slip_m: wheel travel gets white noise of this sigma per square root of metre travelled.
    odometry, joint_states: which messages to write.
    """

    period_s: float = field(default=0.1, metadata=POSITIVE)
    phase_s: float = field(default=0.0, metadata=NOT_NEGATIVE)
    latency_s: float = field(default=0.0, metadata=NOT_NEGATIVE)
    counts_per_turn: int = field(default=2000, metadata=POSITIVE)
    wheel_radius_m: float = field(default=0.1, metadata=POSITIVE)
    axle_m: float = field(default=0.5, metadata=POSITIVE)
    radius_error_left: float = field(default=0.0, metadata=RELATIVE)
    radius_error_right: float = field(default=0.0, metadata=RELATIVE)
    axle_error: float = field(default=0.0, metadata=RELATIVE)
    slip_m: float = field(default=0.0, metadata=NOT_NEGATIVE)
    odometry: bool = True
    joint_states: bool = False


@dataclass(frozen=True)
class Laser:
    """A planar laser like the SICK LMS 200; beams from -field/2 to +field/2.

    mount_m, mount_deg: its pose in the base frame. range_sigma_m: white noise. bias_sigma_m: sigma
    of the constant by which a material is measured too far. dropout_share: beams without a
    return; spurious_share: beams with a return from somewhere in front. mixed_share: how many of
    the beams at a range edge larger than mixed_gap_m fall between its two sides.
    resolution_m: ranges are rounded to multiples of it; 0 = not rounded.
    """

    period_s: float = field(default=0.3, metadata=POSITIVE)
    phase_s: float = field(default=0.0, metadata=NOT_NEGATIVE)
    latency_s: float = field(default=0.0, metadata=NOT_NEGATIVE)
    field_deg: float = field(default=180.0, metadata={"above": 0.0, "most": 360.0})
    step_deg: float = field(default=0.5, metadata=POSITIVE)
    range_min_m: float = field(default=0.05, metadata=NOT_NEGATIVE)
    range_max_m: float = field(default=8.0, metadata=POSITIVE)
    mount_m: Point = (0.0, 0.0)
    mount_deg: float = 0.0
    range_sigma_m: float = field(default=0.015, metadata=NOT_NEGATIVE)
    bias_sigma_m: float = field(default=0.01, metadata=NOT_NEGATIVE)
    dropout_share: float = field(default=0.0, metadata=SHARE)
    spurious_share: float = field(default=0.0, metadata=SHARE)
    mixed_share: float = field(default=0.0, metadata=SHARE)
    mixed_gap_m: float = field(default=0.1, metadata=NOT_NEGATIVE)
    resolution_m: float = field(default=0.001, metadata=NOT_NEGATIVE)

    @property
    def beams(self) -> int:
        """Number of beams, both ends of the field included."""
        return round(self.field_deg / self.step_deg) + 1


@dataclass(frozen=True)
class SightingSensor:
    """A sensor that sees cylinders or other robots as such, from the robot's base.

    names: what it sees; empty = all that the scenario has. direction_sigma_deg: 0 = the direction
    is not measured (cylinders have none). identified: whether the identity is in the message.
    """

    of: str
    period_s: float = field(default=0.5, metadata=POSITIVE)
    phase_s: float = field(default=0.0, metadata=NOT_NEGATIVE)
    latency_s: float = field(default=0.0, metadata=NOT_NEGATIVE)
    names: tuple[str, ...] = ()
    field_deg: float = field(default=360.0, metadata={"above": 0.0, "most": 360.0})
    range_max_m: float = field(default=8.0, metadata=POSITIVE)
    range_sigma_m: float = field(default=0.02, metadata=POSITIVE)
    bearing_sigma_deg: float = field(default=0.5, metadata=POSITIVE)
    direction_sigma_deg: float = field(default=0.0, metadata=NOT_NEGATIVE)
    identified: bool = True


@dataclass(frozen=True)
class Robot:
    """A robot: where it starts, what it looks like, how it drives, what it carries.

    corner_m: how far before a corner of the drive the robot leaves the straight line.
    """

    start_m: Point
    body: Body
    start_deg: float = 0.0
    drive: tuple[Leg, ...] = ()
    speed_m_s: float = field(default=0.4, metadata=POSITIVE)
    acceleration_m_s2: float = field(default=0.3, metadata=POSITIVE)
    turn_rate_deg_s: float = field(default=45.0, metadata=POSITIVE)
    corner_m: float = field(default=0.5, metadata=POSITIVE)
    clock: RobotClock = field(default_factory=RobotClock)
    encoders: Encoders = field(default_factory=Encoders)
    laser: Laser | None = None
    sightings: tuple[SightingSensor, ...] = ()


# ---------------------------------------------------------------- a second visit


@dataclass(frozen=True)
class Move:
    """A thing that stands elsewhere at the second visit: turned about a point, then shifted."""

    name: str
    turn_deg: float = 0.0
    about_m: Point = (0.0, 0.0)
    shift_m: Point = (0.0, 0.0)


@dataclass(frozen=True)
class LaterDrive:
    """Another start and drive of a robot."""

    start_m: Point
    start_deg: float = 0.0
    drive: tuple[Leg, ...] = ()


@dataclass(frozen=True)
class LaterVisit:
    """The second visit: what moved, vanished or appeared, and who drives differently."""

    moved: tuple[Move, ...] = ()
    vanished: tuple[str, ...] = ()
    appeared: StaticObjects = field(default_factory=StaticObjects)
    robots: Mapping[str, LaterDrive] = field(default_factory=dict)


@dataclass(frozen=True)
class Scenario:
    """A whole scenario. duration_s: 0 = until the last drive is over.

    world_of: name or file of another scenario whose world this one has. name: the file's; it is
    not a key.
    """

    robots: Mapping[str, Robot]
    world: StaticObjects = field(default_factory=StaticObjects)
    world_of: str = ""
    description: str = ""
    duration_s: float = field(default=0.0, metadata=NOT_NEGATIVE)
    truth_period_s: float = field(default=0.1, metadata=POSITIVE)
    later: LaterVisit | None = None
    name: str = field(default="", metadata={"hidden": True})
