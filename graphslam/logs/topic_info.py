"""What is known of a topic and of a robot once all messages of a log were read."""

from dataclasses import dataclass

from graphslam.logs.laser_noise import BeamNoise
from graphslam.logs.topic_context import ScanShape


@dataclass(frozen=True, slots=True)
class Gap:
    """An interval without messages of a topic."""

    start_ns: int
    duration_s: float


@dataclass(frozen=True, slots=True)
class TopicInfo:
    """A topic of the logs. Fields after ``count`` are None or empty if nothing can be decoded.

    ``robot`` is None for a topic of unknown schema; ``used``: whether smoothing reads the topic.
    ``rate_hz`` is the mean over the log; ``median_period_s`` is shorter than its inverse if
    messages come in bursts. ``jumps_back`` counts messages stamped earlier than the one recorded
    before, ``glitches`` those whose stamp is replaced, ``too_late`` those that are dropped, up to
    ``latest_s`` late. ``no_return_m`` is the detected range that means no return, ``dropouts`` the
    share of beams without a usable range, ``range_noise`` that of the others, by their scatter.
    ``recorded_after_s`` is the median time from the stamp of a message to its recording, by the
    clock of the recorder; ``by_log_time``: the messages have no stamps, and that of their recording
    is taken. ``joints`` are the names in a JointState of which no message can be used.
    """

    name: str
    schema: str
    robot: str | None
    used: bool
    count: int
    first_ns: int | None = None
    last_ns: int | None = None
    rate_hz: float | None = None
    median_period_s: float | None = None
    gaps: tuple[Gap, ...] = ()
    jumps_back: int = 0
    duplicates: int = 0
    glitches: int = 0
    too_late: int = 0
    latest_s: float = 0.0
    scan: ScanShape | None = None
    no_return_m: float | None = None
    dropouts: float | None = None
    range_noise: BeamNoise | None = None
    recorded_after_s: float | None = None
    by_log_time: bool = False
    joints: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class RobotInfo:
    """A robot of the logs; ``problem`` says why it is not usable, empty if it is.

    ``speed_m_s`` is the mean over the log, ``top_speed_m_s`` the largest mean over one second,
    because odometry in bursts has no speed between two messages. ``reverses``: whether odometry
    ever goes backwards. ``odometry`` is a topic, or says that scans are matched: then nothing more
    is known.
    """

    name: str
    problem: str
    odometry: str | None = None
    path_m: float | None = None
    turning_rad: float | None = None
    speed_m_s: float | None = None
    top_speed_m_s: float | None = None
    reverses: bool | None = None
