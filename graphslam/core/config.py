"""The tree of settings: one frozen dataclass per table; `graphslam.core.config_io` reads them.

Every key carries its unit in its name. There are no settings for a single log: the defaults are
meant for all logs.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from graphslam.core.sensor_config import (
    CalibrationParameter,
    FrontEndConfig,
    KeyframeConfig,
    LimitsConfig,
    LogsConfig,
    OdometryConfig,
    RobotConfig,
    ScanMatchingConfig,
)

__all__ = [
    "AssociationConfig",
    "BackendConfig",
    "CalibrationParameter",
    "ChangesConfig",
    "Config",
    "EkfConfig",
    "FrontEndConfig",
    "ImmConfig",
    "KeyframeConfig",
    "LimitsConfig",
    "LogsConfig",
    "LoopClosureConfig",
    "MultiRobotConfig",
    "NetworkConfig",
    "OdometryConfig",
    "RbpfConfig",
    "RobotConfig",
    "RobustConfig",
    "ScanMatchingConfig",
    "StartConfig",
]


@dataclass(frozen=True)
class AssociationConfig:
    """Which observation belongs to which landmark (thesis 3.21-3.25 and section 4.6).

    method: `greedy` is the thesis' variant of the NNSF, `optimal` minimises the sum of distances.
    identities: `use` or `ignore` those in the log. robot_sightings: `use` or `ignore` sightings of
    other robots. max_distance_m: eq. 3.23. nearness: what that is for walls: `across` = the
    distance across the line, with overlap along it, segments of other lengths being compared as
    lines; `middle` = that of the middles, as printed, and nothing else. directed: a line has two
    sides; false compares directions modulo pi (3.24). gate_probability: of the chi-square gate
    (3.25). floor_m, floor_rad: added to the innovations' sigmas before gating, for model errors, to
    those of a wall where it passes the robot (while one robot's scans are tracked, at the origin of
    its landmark); they never enter the estimate. new_landmark_probability: an observation is a new
    landmark only if its distance to every landmark exceeds this second, higher quantile.
    overlap_gap_m: largest gap along the line between an observed segment and the landmark's extent.
    overlap_ratio: share of the shorter of the two that must overlap while one robot's scans are
    tracked, where the landmarks are those of the last metres (back end batch).
    sightings_to_promote: a tentative landmark enters the graph at this many sightings. tentative_s,
    tentative_m: one not observed again within this time and path is deleted. delete_s: one in the
    graph that is not observed for this long is not associated again, and a filter deletes it
    (section 4.6). reacquire_m: a landmark not observed for this much path counts as old; old lines
    are matched again only if reacquire_min of them, not all parallel, agree, or if the estimate
    knows to 0.1 m and 0.05 rad (sigma) where the robot should see it. reassociation_gate_m
    (across), reassociation_gate_rad: largest residual of an observation when the solved log is
    associated again, and distance of one landmark's visits.
    """

    method: Literal["optimal", "greedy"] = "optimal"
    identities: Literal["use", "ignore"] = "use"
    robot_sightings: Literal["use", "ignore"] = "use"
    max_distance_m: float = 1.5
    nearness: Literal["across", "middle"] = "across"
    directed: bool = True
    gate_probability: float = 0.99
    floor_m: float = 0.03
    floor_rad: float = 0.03
    new_landmark_probability: float = 0.9999
    overlap_gap_m: float = 0.3
    overlap_ratio: float = 0.2
    sightings_to_promote: int = 3
    tentative_s: float = 20.0
    tentative_m: float = 5.0
    delete_s: float = math.inf
    reacquire_m: float = 10.0
    reacquire_min: int = 3
    reassociation_gate_m: float = 0.3
    reassociation_gate_rad: float = 0.15


@dataclass(frozen=True)
class RobustConfig:
    """How observation factors treat outliers.

    kernel: the M-estimator. scale: its parameter, in sigmas (Cauchy: 95 % efficient at 2.385).
    motions: the same of motions, for wheels that slip: of `isam2`, `batch` and `decentralised`. The
    last solution of `smooth`, in which the odometry's calibration is unknown too, does without.
    """

    kernel: Literal["none", "huber", "cauchy", "geman-mcclure"] = "cauchy"
    scale: float = 2.0
    motions: Literal["none", "huber", "cauchy", "geman-mcclure"] = "none"


@dataclass(frozen=True)
class BackendConfig:
    """The estimator.

    name: which one; batch solves a whole log at once. causal: of a log of scans, estimate the
    causal trajectories too, which takes as long as isam2 (other back ends, and logs of sightings,
    always have them). relinearize_threshold: change of a variable (m, rad) above which it is
    relinearised; relinearize_every: steps between two checks for that in the first 1000 steps,
    twice as many in the next 1000, and so on. local_landmarks: how many landmarks the filter in
    front of isam2's tree holds; querying another one updates the tree, which takes longer than a
    larger filter. optimise_at_end: optimise to convergence at the end;
    reoptimise: then apply the final calibration to the whole log, merge duplicate landmarks and
    optimise again (smoothers only); close_loops: before that, add loop closures verified by scans.
    verify_closures: use relative poses recorded in a log only if they are mutually consistent.
    horizon_s: how long a past pose stays in isam2's graph before it is marginalised out: inf = full
    smoothing, 0 = the extended Kalman filter. exchange_s: time between two messages of a robot in
    `decentralised`.
    """

    name: Literal[
        "isam2",
        "batch",
        "ekf",
        "invariant-ekf",
        "imm",
        "rbpf",
        "dead-reckoning",
        "decentralised",
    ] = "batch"
    causal: bool = False
    horizon_s: float = math.inf
    exchange_s: float = 30.0
    relinearize_threshold: float = 0.05
    relinearize_every: int = 20
    local_landmarks: int = 32
    optimise_at_end: bool = True
    reoptimise: bool = True
    close_loops: bool = True
    verify_closures: bool = True

    def __post_init__(self) -> None:
        """A finite horizon is that of isam2: a batch has none."""
        if self.name == "batch" and math.isfinite(self.horizon_s):
            object.__setattr__(self, "name", "isam2")


@dataclass(frozen=True)
class LoopClosureConfig:
    """Loop closure by matching submaps.

    submap_spacing_m: path between two submaps. submap_reach_m: path that a submap takes in before
    and after its middle. revisit_path_m: path without observing a place after which observing it
    again is another visit. search_max_m, search_max_rad: half the window in which a submap is
    searched for, at most.
    """

    submap_spacing_m: float = 3.0
    submap_reach_m: float = 3.0
    revisit_path_m: float = 15.0
    search_max_m: float = 5.0
    search_max_rad: float = 0.5


@dataclass(frozen=True)
class EkfConfig:
    """The extended Kalman filter of the thesis, and the invariant one (which has its own error).

    error: which errors are Gaussian: `world` = additive along world axes, as in the thesis; `body`
    = in the tangent space at each pose, as in GTSAM. lines: `model` = no row along a line, as in
    the smoother; `thesis` = eq. 4.33-4.34, a large variance along it (along_sigma_m).
    iterations: linearisations per observation; more than 1 = the iterated filter (always 1 in the
    invariant one).
    past_states: how many of each robot's last poses stay in the state, also of isam2 with horizon
    0. Sightings from before a landmark's promotion refer to them; promotion may take
    association.tentative_m, which is 20 keyframes. 0 = the state of the thesis.
    """

    error: Literal["world", "body"] = "world"
    lines: Literal["model", "thesis"] = "model"
    along_sigma_m: float = 10.0
    iterations: int = 1
    past_states: int = 20


@dataclass(frozen=True)
class ImmConfig:
    """The filter with interacting multiple models, `imm`: motions are normal, or slip.

    slip_probability: that a motion slips after one that did not. grip_probability: that it does not
    after one that did. slip_scale: sigmas of a motion that slips, in those that odometry states.
    """

    slip_probability: float = 0.1
    grip_probability: float = 0.9
    slip_scale: float = 10.0


@dataclass(frozen=True)
class NetworkConfig:
    """The network between robots of `decentralised`, simulated.

    loss_ratio: share of messages that a robot does not receive; each receiver by itself. delay_s:
    messages come late by up to this, uniformly distributed. seed: of the random numbers.
    landmarks: whether all robots have the same names for landmarks (`common`), as on barcodes, or
    each its `own`, so that who receives a message finds out which are the same by the gates of
    [association].
    """

    loss_ratio: float = 0.0
    delay_s: float = 0.0
    seed: int = 0
    landmarks: Literal["common", "own"] = "common"


@dataclass(frozen=True)
class RbpfConfig:
    """The Rao-Blackwellised particle filter; it has no robust kernel.

    particles: number of sampled paths. seed: of the random numbers; equal seeds give equal
    estimates. proposal: what a pose is drawn from: `observation` = motion and observations of the
    step (FastSLAM 2.0), `motion` = motion alone (FastSLAM 1.0).
    """

    particles: int = 500
    seed: int = 0
    proposal: Literal["observation", "motion"] = "observation"


@dataclass(frozen=True)
class StartConfig:
    """Where the robots start.

    poses: robot -> [x m, y m, phi rad]. from_truth: use one truth sample of each robot instead.
    origin_sigma_m, origin_sigma_rad: prior of the robot whose first pose is the world's origin.
    given_sigma_m, given_sigma_rad: prior of a start in poses. truth_sigma_m, truth_sigma_rad: prior
    of a start from truth (a motion capture sample).
    """

    origin_sigma_m: float = 1e-3
    origin_sigma_rad: float = 1e-3
    given_sigma_m: float = 0.05
    given_sigma_rad: float = 0.03
    truth_sigma_m: float = 0.01
    truth_sigma_rad: float = 0.01
    poses: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    from_truth: bool = False


@dataclass(frozen=True)
class MultiRobotConfig:
    """How robots whose start pose is not given are related to the others (docs/several-robots.md).

    sampling_m: a robot is looked for in scans, and a sighting of it is used, once it or its
    observer moved this far since the last time. min_detections: a robot found by its motion in
    scans needs so many detections. min_path_residual_m: root mean square distance of its path
    there from a straight one at constant speed, which is not distinctive. place_cell_m: cells of
    the grid on which a submap is searched for in the map of another robot; of free space, only what
    is nearer to the laser than place_range_m counts. min_place_extent_m: submaps that two robots
    have in common must extend over more than this in both maps, since rooms look alike. Of
    sessions and known maps 0.4 times all that is seen suffices where that is a small room, and
    nothing in it contradicts them.
    """

    sampling_m: float = 0.1
    min_detections: int = 12
    min_path_residual_m: float = 0.25
    place_cell_m: float = 0.3
    place_range_m: float = 12.0
    min_place_extent_m: float = 6.0


@dataclass(frozen=True)
class LiveConfig:
    """Estimates while the robots drive (docs/live.md).

    horizon_s: how long a past pose is still improved, unless backend.horizon_s says it.
    max_states: past poses of all robots that are still improved, at most; the oldest leave first.
        The work on a keyframe grows with the cube of their number.
    reorder_s: how much out of order, by their stamps, messages may come and still be sorted; every
        estimate is that late. wait_s: a recording that has not grown for so long has ended.
    """

    horizon_s: float = 20.0
    max_states: int = 100
    reorder_s: float = 0.2
    wait_s: float = 10.0


@dataclass(frozen=True)
class KnownMapConfig:
    """A map that is known before the log is read (docs/known-maps.md).

    directory: result folder of an earlier log of the same building, in which this one is localised.
    update: continue that map: what is new is added, what is gone is retired.
    """

    directory: str = ""
    update: bool = False


@dataclass(frozen=True)
class ChangesConfig:
    """Change detection (thesis chapter 5).

    false_alarm_rate: share of the later beams that are flagged where nothing changed.
    run_false_alarm_rate: probability that a run without any change reports one. resolution_m: of
    the map; coarser where the map would have more than max_side_cells squared cells, or ranges are
    too noisy for it. min_range_m, max_range_m: nearer returns (the vehicle itself, dust, error
    codes) and farther ones are not used. edge_gap_m, edge_gap_ratio: a return is at an edge, and
    not used, if the next beam's is farther from it than edge_gap_m + edge_gap_ratio * range.
    range_sigma_m: range noise until it is estimated from the scans. max_pose_error_m: largest error
    of a later scan's position that alignment with the reference's surfaces corrects. min_returns,
    min_scans: a surface is compared if it has so many returns from so many scans. flatness_m:
    deviation of a straight surface from a line. bias_sigma_m: range bias that depends on the
    material. gate_m: returns within this distance of a surface are compared with it; beams that end
    farther behind it passed through it. nonrigid_gate_m: gate_m, at least, where the maps are bent
    against each other. min_length_m: smallest change that is reported. min_beams: fewest beams that
    support one. max_displacement_m: what moved farther is reported as vanished and appeared.
    consecutive_beams: of the thesis' method: so many neighbouring beams must differ (section 5.3);
    1 = one is enough.
    """

    false_alarm_rate: float = 0.01
    run_false_alarm_rate: float = 0.01
    resolution_m: float = 0.025
    max_side_cells: int = 2000
    min_range_m: float = 0.1
    max_range_m: float = 30.0
    edge_gap_m: float = 0.06
    edge_gap_ratio: float = 0.025
    range_sigma_m: float = 0.02
    max_pose_error_m: float = 0.5
    min_returns: int = 6
    min_scans: int = 3
    flatness_m: float = 0.004
    bias_sigma_m: float = 0.01
    gate_m: float = 0.15
    nonrigid_gate_m: float = 0.3
    min_length_m: float = 0.1
    min_beams: int = 5
    max_displacement_m: float = 5.0
    consecutive_beams: int = 1


@dataclass(frozen=True)
class Config:
    """The whole tree; `config.toml` in a result folder is this, written out.

    warnings: one line for each key that was given by an old name; no setting itself.
    """

    logs: LogsConfig = field(default_factory=LogsConfig)
    limits: LimitsConfig = field(default_factory=LimitsConfig)
    robots: Mapping[str, RobotConfig] = field(default_factory=dict)
    odometry: OdometryConfig = field(default_factory=OdometryConfig)
    keyframe: KeyframeConfig = field(default_factory=KeyframeConfig)
    front_end: FrontEndConfig = field(default_factory=FrontEndConfig)
    scan_matching: ScanMatchingConfig = field(default_factory=ScanMatchingConfig)
    association: AssociationConfig = field(default_factory=AssociationConfig)
    robust: RobustConfig = field(default_factory=RobustConfig)
    backend: BackendConfig = field(default_factory=BackendConfig)
    loop_closure: LoopClosureConfig = field(default_factory=LoopClosureConfig)
    ekf: EkfConfig = field(default_factory=EkfConfig)
    imm: ImmConfig = field(default_factory=ImmConfig)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    rbpf: RbpfConfig = field(default_factory=RbpfConfig)
    start: StartConfig = field(default_factory=StartConfig)
    multi_robot: MultiRobotConfig = field(default_factory=MultiRobotConfig)
    live: LiveConfig = field(default_factory=LiveConfig)
    known_map: KnownMapConfig = field(default_factory=KnownMapConfig)
    changes: ChangesConfig = field(default_factory=ChangesConfig)
    warnings: tuple[str, ...] = field(default=(), compare=False, metadata={"setting": False})

    @property
    def tracks_scans(self) -> bool:
        """Whether scans of one robot alone are tracked and solved as one batch."""
        return (
            self.backend.name == "batch"
            and self.backend.reoptimise
            and self.keyframe.mode != "all"
            and self.front_end.name != "none"
        )

    def robot(self, name: str) -> RobotConfig:
        """Settings of robot ``name``: its own table, else [robots.default], else the defaults."""
        return self.robots.get(name, self.robots.get("default", RobotConfig()))
