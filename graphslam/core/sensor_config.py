"""Settings of what goes in: logs, robots, odometry, keyframes, front ends, scan matching."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from graphslam.core.errors import ConfigError

#: what calibration estimates of a robot; see `graphslam.core.motion_models.nominal_calibration`
CalibrationParameter = Literal[
    "translation_scale",
    "rotation_scale",
    "drift_rad_per_m",
    "turning_loss_m2",
    "wheel_radius_left_m",
    "wheel_radius_right_m",
    "axle_m",
    "laser_x_m",
    "laser_y_m",
    "laser_yaw_rad",
    "laser_latency_s",
    "sighting_yaw_rad",
    "sighting_range_scale",
]


@dataclass(frozen=True)
class LogsConfig:
    """How logs are read.

    reorder_s: how much out of order, by their stamps, messages may arrive and still be sorted.
    max_clock_offset_s: largest offset between the clocks of two robots that is searched for.
    undistort: take the motion of the robot during a sweep out of scans whose messages state the
        time between two beams (`time_increment`).
    same_place: the logs are sessions: visits to one place at different times, each with its own
        trajectory. A session has the name of its file where a robot's is asked for.
    topics: topics to use, name -> robot; empty = every topic whose schema is known, with the
        topic's namespace as robot.
    """

    reorder_s: float = 2.0
    max_clock_offset_s: float = 5.0
    undistort: bool = True
    same_place: bool = False
    topics: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class LimitsConfig:
    """What a log may ask for; more is an error of one line, because a damaged log can ask for all.

    memory_mb: of one process. chunk_mb, chunk_records: of a chunk (a block of messages that a file
    holds compressed) when unpacked. `robots`, landmarks: in one run.
    """

    memory_mb: float = math.inf
    chunk_mb: float = 256.0
    chunk_records: int = 1_000_000
    robots: int = 200
    landmarks: int = 200_000


@dataclass(frozen=True)
class RobotConfig:
    """What the log does not say about a robot; the table [robots.NAME], NAME or `default`.

    laser: [x m, y m, yaw rad] of the laser in the base frame; overrides tf_static.
    wheel_radius_left_m, wheel_radius_right_m, axle_m: the wheels' geometry for JointState logs.
    left_joint, right_joint: names in JointState; empty = the names that contain left or right.
    outline: corners [[x m, y m], ...] of the robot's cross-section at the height of other robots'
        lasers, in its base frame, convex and in order; [[radius m]] is a circle. A robot with an
        outline is detected in other robots' scans.
    lasers: as `laser`, of a robot's further lasers, by the names that summary.json gives them.
    """

    laser: tuple[float, ...] = ()
    wheel_radius_left_m: float = 0.1
    wheel_radius_right_m: float = 0.1
    axle_m: float = 0.5
    left_joint: str = ""
    right_joint: str = ""
    outline: tuple[tuple[float, ...], ...] = ()
    lasers: Mapping[str, tuple[float, ...]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Raise ConfigError where `laser` is not a pose or `outline` not an outline."""
        if len(self.laser) not in (0, 3):
            raise ConfigError(f"robots.*.laser: needs [x, y, yaw], got {list(self.laser)}")
        for name, mount in self.lasers.items():
            if len(mount) not in (0, 3):
                raise ConfigError(f"robots.*.lasers.{name}: needs [x, y, yaw], got {list(mount)}")
        # the read-only mapping of a parsed configuration cannot be sent to another process
        object.__setattr__(self, "lasers", dict(self.lasers))
        sizes = [len(corner) for corner in self.outline]
        a_circle = sizes == [1] and self.outline[0][0] > 0
        if self.outline and not a_circle and (len(sizes) < 3 or set(sizes) != {2}):
            raise ConfigError(
                "robots.*.outline: needs three corners [x, y] or more, or one [radius], got "
                f"{[list(corner) for corner in self.outline]}"
            )


@dataclass(frozen=True)
class OdometryConfig:
    """Noise of the motion between two states (thesis 4.8-4.15, see docs/thesis.md).

    The model error is white; its variance grows with path and turning (4.14): k_x_m and k_y_m in
    m² per m, k_x_rad and k_y_rad in m² per rad, k_phi_m in rad² per m, k_phi_rad in rad² per rad;
    and with the time in motion: k_x_s and k_y_s in m² per s, k_phi_s in rad² per s.
    Calibration errors are constant; their prior sigmas: translation_scale_sigma and
    rotation_scale_sigma are relative, drift_sigma_rad_per_m is rotation per metre driven forwards;
    for wheel angles wheel_radius_sigma_m and axle_sigma_m, and count_sigma_rad per reading (white).
    laser_sigma_m, laser_sigma_rad: error of the laser's mounting pose given by the log;
    laser_latency_sigma_s: offset of its clock from the odometry's;
    sighting_latency_sigma_s: the same for a robot without a laser, whose odometry may be commands
    that the motion follows later;
    sighting_sigma_rad, sighting_scale_sigma: by how much a sensor of sightings is mounted turned,
    and its ranges are too long, relative; applied if the log clearly shows it (back end batch).
    commanded_velocities: the odometry poses integrate commanded, not measured, velocities;
    turning_lever_sigma_m: distance between the middle of the axle and the point whose speed was
    commanded.
    parameter_noise: `constant` = a calibration error is the same in every reading; `white` = radii,
    axle and counts are drawn anew in each, as thesis 4.9-4.13 prints it (of odometry that reports
    poses by the wheels of [robots.*]), and no parameter of the odometry is estimated.
    gyroscope: `auto` = the odometry turns as the gyroscope of the log says, if there is one that
    agrees with it by and large; `off`.
    floor_sigma_m and floor_sigma_rad are added once per interval in which the robot moved.
    calibrate: estimate the calibration errors online, and at the end jointly with the trajectory.
    fixed_calibration: parameters held at what the log and [robots.*] say.
    calibration_floor_m, calibration_floor_rad: error of an estimated motion that calibration does
    not explain by odometry (stamps, walls that are not flat).
    max_gap_s: longest span without odometry that is bridged; no pose is reported in a longer one in
    which the robot moved, unless it has scans. max_speed_m_s, max_turn_rad_s: a
    faster motion between two readings means stamps in a burst, which do not tell when it took
    place; half of max_speed_m_s for 10 ms or longer means that the odometry was reset.
    scan_matching: use of relative motions from matching consecutive scans: `auto` = they replace
    odometry motions that they contradict; `on` = in addition every motion is fused with the match
    of the returns that lie on no line; `off`.
    """

    k_x_m: float = 1e-4
    k_x_rad: float = 1e-5
    k_y_m: float = 1e-4
    k_y_rad: float = 1e-5
    k_phi_m: float = 1e-4
    k_phi_rad: float = 1e-4
    k_x_s: float = 0.0
    k_y_s: float = 0.0
    k_phi_s: float = 0.0
    translation_scale_sigma: float = 0.03
    rotation_scale_sigma: float = 0.04
    drift_sigma_rad_per_m: float = 0.03
    wheel_radius_sigma_m: float = 0.0005
    axle_sigma_m: float = 0.005
    count_sigma_rad: float = 0.003
    laser_sigma_m: float = 0.1
    laser_sigma_rad: float = 0.02
    laser_latency_sigma_s: float = 0.05
    sighting_latency_sigma_s: float = 0.2
    sighting_sigma_rad: float = 0.05
    sighting_scale_sigma: float = 0.03
    commanded_velocities: bool = False
    parameter_noise: Literal["constant", "white"] = "constant"
    turning_lever_sigma_m: float = 0.2
    floor_sigma_m: float = 0.005
    floor_sigma_rad: float = 0.005
    calibrate: bool = True
    fixed_calibration: tuple[CalibrationParameter, ...] = ()
    calibration_floor_m: float = 0.02
    calibration_floor_rad: float = 0.01
    max_gap_s: float = 5.0
    max_speed_m_s: float = 20.0
    max_turn_rad_s: float = 20.0
    gyroscope: Literal["auto", "off"] = "auto"
    scan_matching: Literal["auto", "on", "off"] = "auto"


@dataclass(frozen=True)
class KeyframeConfig:
    """When a robot gets a state (a keyframe).

    mode: `motion` = at an observation, once the robot has moved distance_m or turned angle_rad
    since its last state (scan_angle_rad for a scan, which overlaps more with the one before);
    `all` = at every odometry, scan and sighting stamp. A recorded relative pose is an observation
    at both of its ends; in logs of these alone there are states at odometry between distant ends.
    sighting_window_s: in logs of several robots without scans, sightings within this span enter as
    one step, transported to its end by odometry.
    scans_between: how scans without a state follow from the states around them (back end batch):
    `map` = by odometry, and matched to the walls of the final map; `odometry` = by that alone.
    Causal and live poses of smoothers: matched to the walls that the last keyframe saw.
    """

    mode: Literal["motion", "all"] = "motion"
    distance_m: float = 0.25
    angle_rad: float = 0.15
    scan_angle_rad: float = 0.25
    sighting_window_s: float = 0.8
    scans_between: Literal["map", "odometry"] = "map"


@dataclass(frozen=True)
class FrontEndConfig:
    """Lines and cylinders from scans (thesis 4.7, docs/front-ends.md).

    name: which front end; `both` extracts segments first, then Hough lines from the other returns.
    max_range_m: farther returns are not used for lines. gap_m: neighbouring returns farther apart
    than gap_m + gap_ratio * range start a new chain. split_m: largest orthogonal deviation inside
    one segment. split_rule: `deviation` splits a chain by that; `variance` a whole scan until the
    mean square deviation is below (split_m / 2)², as thesis 4.7.6 prints it. hidden_ends: a segment
    of which an end may be hidden is kept as a `line`, or `reject`ed as in thesis 4.7.8. min_points,
    min_length_m: smaller segments are dropped. range_sigma_m, range_sigma_ratio: white range noise,
    and what it grows by with the range (the root of the sum of their squares counts); unless one of
    them is set, the noise of the log's lasers is measured, and used where it is 1.5 times as large.
    What is more than the default adds 2.5 sigmas to split_m (again by squares). floor_normal_m,
    floor_angle_rad: error of a line that does not shrink with the number of points (material,
    flatness, bias of the laser). end_sigma_m: error of a segment's end where the wall ends.
    covariance: `incidence` weights each point by its noise along the normal, `thesis` uses eq. 4.32
    as printed. Hough lines (4.7.1-4.7.3): hough_votes says what counts votes, `opencv`'s transform
    with the thesis' weights to rank and refine its lines, or the weighted accumulator of the
    `thesis`; hough_delta_d_m is the distance step Δd, equal to the stripe width 2a;
    hough_gamma_steps the number of angles γ in a full turn; hough_d_max_m the
    largest distance d of a line. hough_threshold_m is the threshold of C with g = r times the angle
    between beams: metres of wall at normal incidence. cylinders: whether to extract them;
    cylinder_min_radius_m, cylinder_max_radius_m: their radii; cylinder_points: fewest returns.
    dynamic_objects: `drop` removes free-standing objects in space that an earlier scan saw as free;
    `keep` leaves them in.
    """

    name: Literal["segments", "hough", "both", "none"] = "segments"
    max_range_m: float = 30.0
    gap_m: float = 0.3
    gap_ratio: float = 0.05
    split_m: float = 0.05
    split_rule: Literal["deviation", "variance"] = "deviation"
    hidden_ends: Literal["line", "reject"] = "line"
    min_points: int = 6
    min_length_m: float = 0.4
    range_sigma_m: float = 0.02
    range_sigma_ratio: float = 0.0
    floor_normal_m: float = 0.01
    floor_angle_rad: float = 0.005
    end_sigma_m: float = 0.05
    covariance: Literal["incidence", "thesis"] = "incidence"
    hough_votes: Literal["opencv", "thesis"] = "opencv"
    hough_delta_d_m: float = 0.025
    hough_gamma_steps: int = 120
    hough_d_max_m: float = 20.0
    hough_threshold_m: float = 0.4
    cylinders: bool = False
    cylinder_min_radius_m: float = 0.03
    cylinder_max_radius_m: float = 0.5
    cylinder_points: int = 4
    dynamic_objects: Literal["drop", "keep"] = "drop"


@dataclass(frozen=True)
class ScanMatchingConfig:
    """Scans matched with scans: consecutive ones, loop closures, maps of other robots.

    point_sigma_m: error of a point across its surface, by range noise and roughness. cell_m: points
    that are matched are thinned to one per cell of this size. reach_m: largest distance of a point
    from its counterpart where the alignment begins. free_margin_m: a beam shows that space is free
    up to so far before its return. floor_m, floor_rad: errors of a match that do not shrink with
    the number of points. contradiction_m, contradiction_rad: smallest disagreement of consecutive
    scans with odometry that is acted on. search_m, search_rad: half the window in which another
    motion is then searched for, beyond twice the motion.
    """

    point_sigma_m: float = 0.03
    cell_m: float = 0.05
    reach_m: float = 0.6
    free_margin_m: float = 0.4
    floor_m: float = 0.02
    floor_rad: float = 0.004
    contradiction_m: float = 0.05
    contradiction_rad: float = 0.03
    search_m: float = 0.5
    search_rad: float = 0.2
