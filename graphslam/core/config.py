"""The one tree of settings: frozen dataclasses, read from TOML and ``key=value`` overrides.

Every key carries its unit in its name. An unknown key, a wrong type or a value out of range is a
`ConfigError` that names the key. There are no per-log settings: the defaults are meant for
everything of a kind.
"""

import dataclasses
import difflib
import json
import math
import tomllib
import types
import typing
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from graphslam.core.errors import ConfigError

#: what calibration estimates of a robot, see `graphslam.core.motion_models.nominal_calibration`
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
]


@dataclass(frozen=True)
class LogsConfig:
    """How logs are read.

    reorder_s: messages may arrive this much out of order, by their stamps, and still be placed.
    topics: topics to use, name -> robot; empty means every topic whose schema is known, the robot
        being the topic's namespace.
    """

    reorder_s: float = 2.0
    topics: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class RobotConfig:
    """What the log does not say about a robot; the table [robots.NAME], NAME or `default`.

    laser: [x m, y m, yaw rad] of the laser in the base frame, over what tf_static says.
    wheel_radius_left_m, wheel_radius_right_m, axle_m: the wheels' geometry for JointState logs.
    left_joint, right_joint: names in JointState; empty means the names that contain left/right.
    outline: corners [[x m, y m], ...] of what others' lasers see of it, in its base frame, convex
        and in order; [[radius m]] is a circle. With it the robot is found in others' scans.
    """

    laser: tuple[float, ...] = ()
    wheel_radius_left_m: float = 0.1
    wheel_radius_right_m: float = 0.1
    axle_m: float = 0.5
    left_joint: str = ""
    right_joint: str = ""
    outline: tuple[tuple[float, ...], ...] = ()

    def __post_init__(self) -> None:
        """Raise ConfigError where `laser` is no pose or `outline` no outline."""
        if len(self.laser) not in (0, 3):
            raise ConfigError(f"robots.*.laser: needs [x, y, yaw], got {list(self.laser)}")
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

    The model error is white, its variance grows with path and turning (4.14): k_x_m and k_y_m in
    m² per m, k_x_rad and k_y_rad in m² per rad, k_phi_m in rad² per m, k_phi_rad in rad² per rad.
    The calibration errors are constant within one interval: translation_scale_sigma and
    rotation_scale_sigma are relative, drift_sigma_rad_per_m is turning per metre driven forwards;
    for wheel angles wheel_radius_sigma_m and axle_sigma_m, and count_sigma_rad per reading.
    laser_sigma_m, laser_sigma_rad: how far the laser may sit from where the log says;
    laser_latency_sigma_s: how far its clock may be from the odometry's;
    sighting_latency_sigma_s: the same for a robot without a laser, whose odometry may be commands
    that the motion follows later.
    commanded: poses of odometry are what commanded velocities compound to; turning_lever_sigma_m:
    how far from the middle of the axle the point may be whose speed was commanded.
    floor_sigma_m and floor_sigma_rad are added once per interval in which the robot moved.
    calibrate: learn the calibration errors from the estimate while it grows, at the end together
    with it. fixed: those of them that are held at what the log and [robots.*] say.
    max_gap_s: longest span without odometry that is bridged.
    scan_matching: whether consecutive scans are matched: `auto` = motions that they contradict are
    taken from them; `on` = besides, what lies on no line is a second source of every motion; `off`.
    """

    k_x_m: float = 1e-4
    k_x_rad: float = 1e-5
    k_y_m: float = 1e-4
    k_y_rad: float = 1e-5
    k_phi_m: float = 1e-4
    k_phi_rad: float = 1e-4
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
    commanded: bool = False
    turning_lever_sigma_m: float = 0.2
    floor_sigma_m: float = 0.005
    floor_sigma_rad: float = 0.005
    calibrate: bool = True
    fixed: tuple[CalibrationParameter, ...] = ()
    max_gap_s: float = 5.0
    scan_matching: Literal["auto", "on", "off"] = "auto"


@dataclass(frozen=True)
class KeyframeConfig:
    """When a robot gets a state.

    mode: `motion` = at an observation, once the robot moved distance_m or turned angle_rad since
    its last state, for a scan scan_angle_rad: a laser sees most of what it saw before; `all` = at
    every odometry, scan and sighting stamp. gather_s: in logs of several robots without scans,
    sightings within this span enter together, carried to its end by odometry.
    """

    mode: Literal["motion", "all"] = "motion"
    distance_m: float = 0.25
    angle_rad: float = 0.15
    scan_angle_rad: float = 0.25
    gather_s: float = 0.8


@dataclass(frozen=True)
class FrontEndConfig:
    """Lines and cylinders from scans (thesis 4.7, docs/front-ends.md).

    name: which front end; `both` takes whole segments first, then Hough lines. max_range_m: farther
    returns are not used for lines. gap_m: neighbouring returns farther apart than gap_m + gap_share
    * range start a new chain. split_m: largest orthogonal deviation inside one segment. min_points,
    min_length_m: smaller ones are dropped. range_sigma_m: white range noise. floor_normal_m,
    floor_angle_rad: what a wall's material, flatness and the laser's bias leave however many points
    there are. end_sigma_m: how sharp a segment's real end is. covariance: `incidence` weights each
    point by its own normal noise, `thesis` uses eq. 4.32 as printed. Hough lines (4.7.1-4.7.3):
    hough_delta_d_m is the distance step Δd, equal to the stripe width 2a; hough_gamma_steps the
    number of angles γ in a full turn; hough_d_max_m the largest distance d of a line.
    hough_threshold_m is the threshold of C with g = r times the angle between beams: metres of
    wall, as long as it were seen face on. cylinders: whether to look for them too;
    cylinder_min_radius_m, cylinder_max_radius_m: which radii; cylinder_points: fewest returns.
    moving: what to do with free-standing things where an earlier scan looked through: `drop` keeps
    them out of the map.
    """

    name: Literal["segments", "hough", "both", "none"] = "segments"
    max_range_m: float = 30.0
    gap_m: float = 0.3
    gap_share: float = 0.05
    split_m: float = 0.05
    min_points: int = 6
    min_length_m: float = 0.4
    range_sigma_m: float = 0.02
    floor_normal_m: float = 0.01
    floor_angle_rad: float = 0.005
    end_sigma_m: float = 0.05
    covariance: Literal["incidence", "thesis"] = "incidence"
    hough_delta_d_m: float = 0.025
    hough_gamma_steps: int = 120
    hough_d_max_m: float = 20.0
    hough_threshold_m: float = 0.4
    cylinders: bool = False
    cylinder_min_radius_m: float = 0.03
    cylinder_max_radius_m: float = 0.5
    cylinder_points: int = 4
    moving: Literal["drop", "keep"] = "drop"


@dataclass(frozen=True)
class AssociationConfig:
    """Which observation belongs to which landmark (thesis 3.21-3.25 and section 4.6).

    method: `greedy` is the thesis' variant of the NNSF, `optimal` minimises the sum. identities:
    `use` those in the log or `ignore` them. robots: `use` sightings of other robots or `ignore`
    them. max_distance_m: eq. 3.23. directed: a line has two
    sides; false takes directions modulo pi (3.24). gate_probability: chi-square gate (3.25).
    floor_m, floor_rad: added to the innovations' sigmas before gating, for what the models leave
    out; never enters the estimate. new_probability: an observation is a new landmark only if its
    distance to every landmark exceeds this second, higher quantile. overlap_gap_m: largest gap
    along the line between an observed part and the known extent. sightings_to_promote: a tentative
    landmark enters the graph at this many. tentative_s, tentative_m: one not seen again after this
    time and path is deleted. reacquire_m: a landmark not seen for this much path counts as old;
    old lines are taken up again only if reacquire_min of them that are not all parallel agree.
    """

    method: Literal["optimal", "greedy"] = "optimal"
    identities: Literal["use", "ignore"] = "use"
    robots: Literal["use", "ignore"] = "use"
    max_distance_m: float = 1.5
    directed: bool = True
    gate_probability: float = 0.99
    floor_m: float = 0.05
    floor_rad: float = 0.03
    new_probability: float = 0.9999
    overlap_gap_m: float = 0.3
    sightings_to_promote: int = 3
    tentative_s: float = 20.0
    tentative_m: float = 5.0
    reacquire_m: float = 10.0
    reacquire_min: int = 3


@dataclass(frozen=True)
class RobustConfig:
    """How observation factors treat outliers.

    kernel: which M-estimator. scale: its parameter, in sigmas (Cauchy: 95 % efficient at 2.385).
    """

    kernel: Literal["none", "huber", "cauchy", "geman-mcclure"] = "cauchy"
    scale: float = 2.0


@dataclass(frozen=True)
class BackendConfig:
    """The estimator.

    name: which one. relinearize_threshold: largest change of a variable (m, rad) before it is
    linearised anew; relinearize_every: steps between two looks for such variables in the first
    1000, twice as many in the next, and so on. polish: optimise to convergence at the end;
    reconsider: then apply the final calibration to all of the log, merge landmarks that are one,
    and optimise again (smoothers only); close_loops: in between, close loops that scans confirm.
    verify_closures: believe relative poses that a log brings along only if they agree with each
    other. horizon_s: how long a past pose stays in isam2's graph before it is marginalised out:
    inf = full smoothing, 0 = the extended Kalman filter. exchange_s: time between two messages of a
    robot in `decentralised`.
    """

    name: Literal[
        "isam2", "batch", "ekf", "invariant-ekf", "rbpf", "dead-reckoning", "decentralised"
    ] = "isam2"
    horizon_s: float = math.inf
    exchange_s: float = 30.0
    relinearize_threshold: float = 0.05
    relinearize_every: int = 20
    polish: bool = True
    reconsider: bool = True
    close_loops: bool = True
    verify_closures: bool = True


@dataclass(frozen=True)
class EkfConfig:
    """The extended Kalman filter of the thesis, and the invariant one (which has its own error).

    error: which errors are Gaussian: `world` = additive along world axes, as in the thesis; `body`
    = of the exponential map at each pose, as in GTSAM. lines: `model` = no row along a line, as the
    smoother has it; `thesis` = eq. 4.33-4.34, a large variance along it (along_sigma_m).
    iterations: how often each observation is linearised; more than 1 = the iterated filter (1 in
    the invariant one).
    past_states: how many of each robot's last poses stay in the state, also of isam2 with horizon
    0. Sightings from before a landmark's promotion belong to them; it may wait for
    association.tentative_m, which is 20 keyframes. 0 = the state of the thesis.
    """

    error: Literal["world", "body"] = "world"
    lines: Literal["model", "thesis"] = "model"
    along_sigma_m: float = 10.0
    iterations: int = 1
    past_states: int = 20


@dataclass(frozen=True)
class RbpfConfig:
    """The Rao-Blackwellised particle filter.

    particles: how many paths it samples. seed: of its random numbers; the same seed gives the same
    estimate. proposal: what a pose is drawn from: `observation` = motion and sightings of the step
    (FastSLAM 2.0), `motion` = motion alone (FastSLAM 1.0). It has no robust kernel.
    """

    particles: int = 500
    seed: int = 0
    proposal: Literal["observation", "motion"] = "observation"


@dataclass(frozen=True)
class StartConfig:
    """Where the robots start.

    origin_sigma_m, origin_sigma_rad: prior of the robot whose first pose is the world's origin.
    given_sigma_m, given_sigma_rad: prior of a start that is given. truth_sigma_m,
    truth_sigma_rad: of one read from truth (a motion capture sample). poses: robot -> [x m, y m,
    phi rad]. from_truth: read one truth sample of each robot instead.
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
class ChangesConfig:
    """Change detection (thesis chapter 5).

    false_alarm_rate: share of the later beams that may be flagged where nothing changed.
    run_false_alarm_rate: probability that a run without any change reports one. resolution_m: of
    the map; it gets coarser where it would have more than max_side_cells squared. max_range_m:
    farther returns are not compared. min_returns, min_scans: a surface is compared if so many
    returns of so many scans lie on it. flatness_m: how far a straight surface strays from a line.
    bias_sigma_m: how much too far a material may be measured. gate_m: returns within this distance
    are compared with a surface by how far they lie off it; beams that end farther behind it passed
    through. min_length_m: smallest change that is reported. min_beams: fewest beams that must tell
    of it. max_displacement_m: what moved farther is reported as vanished and appeared.
    """

    false_alarm_rate: float = 0.01
    run_false_alarm_rate: float = 0.01
    resolution_m: float = 0.025
    max_side_cells: int = 2000
    max_range_m: float = 30.0
    min_returns: int = 6
    min_scans: int = 3
    flatness_m: float = 0.004
    bias_sigma_m: float = 0.01
    gate_m: float = 0.15
    min_length_m: float = 0.1
    min_beams: int = 5
    max_displacement_m: float = 5.0


@dataclass(frozen=True)
class Config:
    """The whole tree; `config.toml` in a result folder is this, written out."""

    logs: LogsConfig = field(default_factory=LogsConfig)
    robots: Mapping[str, RobotConfig] = field(default_factory=dict)
    odometry: OdometryConfig = field(default_factory=OdometryConfig)
    keyframe: KeyframeConfig = field(default_factory=KeyframeConfig)
    front_end: FrontEndConfig = field(default_factory=FrontEndConfig)
    association: AssociationConfig = field(default_factory=AssociationConfig)
    robust: RobustConfig = field(default_factory=RobustConfig)
    backend: BackendConfig = field(default_factory=BackendConfig)
    ekf: EkfConfig = field(default_factory=EkfConfig)
    rbpf: RbpfConfig = field(default_factory=RbpfConfig)
    start: StartConfig = field(default_factory=StartConfig)
    changes: ChangesConfig = field(default_factory=ChangesConfig)

    def robot(self, name: str) -> RobotConfig:
        """Settings of robot ``name``: its own table, else [robots.default], else the defaults."""
        return self.robots.get(name, self.robots.get("default", RobotConfig()))

    def __reduce__(self) -> tuple[Any, tuple[str]]:
        """Pickled as its TOML text: read-only mappings have no pickle of their own."""
        return parse_config, (dump_config(self),)


def load_config(path: Path | None = None, overrides: Sequence[str] = ()) -> Config:
    """Default settings, then the TOML file, then ``key=value`` overrides (dotted keys).

    Raises:
        ConfigError: the file cannot be read, a key is unknown, a value has the wrong type.
    """
    tree: dict[str, Any] = {}
    if path is not None:
        try:
            tree = tomllib.loads(path.read_text(encoding="utf-8"))
        except OSError as error:
            raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise ConfigError(f"{path}: not valid TOML: {error}") from error
    for text in overrides:
        key, separator, value = text.partition("=")
        if not separator or not key.strip():
            raise ConfigError(f"--set {text}: write it as key=value, for example keyframe.mode=all")
        _set(tree, _split_key(key.strip()), _parse_value(value.strip()))
    config = _build(Config, tree, "")
    assert isinstance(config, Config)  # narrows the type; _build returns what it is asked for
    return config


def parse_config(text: str) -> Config:
    """Settings from the TOML text that `dump_config` writes.

    Raises:
        ConfigError: a key is unknown, a value has the wrong type.
    """
    config = _build(Config, tomllib.loads(text), "")
    assert isinstance(config, Config)  # narrows the type; _build returns what it is asked for
    return config


def dump_config(config: Config) -> str:
    """The effective configuration as TOML text that `load_config` reads back to an equal tree."""
    lines: list[str] = []
    _dump(config, (), lines)
    return "\n".join(lines).strip() + "\n"


def _split_key(text: str) -> list[str]:
    """The parts of a dotted key; a part with a dot of its own is quoted, as in TOML."""
    try:
        node: Any = tomllib.loads(f"{text} = 0")
    except tomllib.TOMLDecodeError:
        return text.split(".")
    keys = []
    while isinstance(node, dict):
        ((key, node),) = node.items()
        keys.append(key)
    return keys


def _set(tree: dict[str, Any], keys: list[str], value: object) -> None:
    for depth, key in enumerate(keys[:-1]):
        tree = tree.setdefault(key, {})
        if not isinstance(tree, dict):
            raise ConfigError(f"{'.'.join(keys)}: {'.'.join(keys[: depth + 1])} is not a table")
    tree[keys[-1]] = value


def _parse_value(text: str) -> object:
    """A TOML value; what is not valid TOML is taken as a string, so quotes may be left out."""
    try:
        return tomllib.loads(f"v = {text}")["v"]
    except tomllib.TOMLDecodeError:
        return text


def _build(kind: Any, value: Any, key: str) -> Any:
    """The value of type ``kind`` (dataclass, mapping, tuple, literal or scalar) at ``key``."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if dataclasses.is_dataclass(kind):
        return _build_table(kind, value, key)
    if origin is Literal:
        if value not in arguments:
            raise ConfigError(f"{key}: {value!r} is not one of {', '.join(map(str, arguments))}")
        return value
    if origin is Mapping:
        if not isinstance(value, dict):
            raise ConfigError(f"{key}: expected a table, got {value!r}")
        return types.MappingProxyType(
            {name: _build(arguments[1], item, f"{key}.{name}") for name, item in value.items()}
        )
    if origin is tuple:
        if not isinstance(value, list | tuple):
            raise ConfigError(f"{key}: expected a list, got {value!r}")
        return tuple(_build(arguments[0], item, f"{key}[{i}]") for i, item in enumerate(value))
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value) if abs(value) < 2**1000 else float("inf")
    if not isinstance(value, kind) or (kind is int and isinstance(value, bool)):
        raise ConfigError(f"{key}: expected {kind.__name__}, got {value!r}")
    if kind is float and not abs(value) < math.inf and not (value == math.inf and key in _INFINITE):
        raise ConfigError(f"{key}: must be finite, got {value!r}")
    if kind in (int, float) and "[" not in key:
        _check_range(key, value)
    return value


def _check_range(key: str, value: float) -> None:
    """Numbers are between 0 and a million, zero excluded for some, probabilities between 0 and 1.

    Raises:
        ConfigError: the value is outside.
    """
    name = key.rpartition(".")[2]
    if name.endswith(("_probability", "_rate")):
        if not 0 < value < 1:
            raise ConfigError(f"{key}: must be between 0 and 1, got {value!r}")
    elif value < 0:
        raise ConfigError(f"{key}: must not be negative, got {value!r}")
    elif value == 0 and name in _NOT_ZERO:
        raise ConfigError(f"{key}: must be greater than 0")
    elif value > 1e6 and key not in _INFINITE:
        raise ConfigError(f"{key}: must not exceed a million, got {value!r}")


#: settings that may be infinite
_INFINITE = {"backend.horizon_s"}

#: settings that divide, or weld states together, at 0
_NOT_ZERO = {
    "scale",
    "split_m",
    "hough_delta_d_m",
    "hough_gamma_steps",
    "range_sigma_m",
    "max_range_m",
    "max_distance_m",
    "relinearize_every",
    "relinearize_threshold",
    "origin_sigma_m",
    "origin_sigma_rad",
    "given_sigma_m",
    "given_sigma_rad",
    "truth_sigma_m",
    "truth_sigma_rad",
    "wheel_radius_left_m",
    "wheel_radius_right_m",
    "axle_m",
    "floor_sigma_m",
    "floor_sigma_rad",
    "sightings_to_promote",
    "resolution_m",
    "max_side_cells",
    "gate_m",
    "along_sigma_m",
    "iterations",
    "particles",
}


def _build_table(kind: Any, value: Any, key: str) -> Any:
    if not isinstance(value, dict):
        raise ConfigError(f"{key}: is a table of settings, got {value!r}")
    hints = typing.get_type_hints(kind)
    for name in value:
        if name not in hints:
            close = difflib.get_close_matches(name, hints, n=1)
            hint = f"did you mean {close[0]}?" if close else f"known: {', '.join(hints)}"
            raise ConfigError(f"{f'{key}.{name}'.lstrip('.')}: unknown key; {hint}")
    return kind(
        **{n: _build(hints[n], item, f"{key}.{n}".lstrip(".")) for n, item in value.items()}
    )


def _dump(node: Any, path: tuple[str, ...], lines: list[str]) -> None:
    items = (
        [(f.name, getattr(node, f.name)) for f in dataclasses.fields(node)]
        if dataclasses.is_dataclass(node)
        else list(node.items())
    )
    plain = [(n, v) for n, v in items if not dataclasses.is_dataclass(v) and not _is_table(v)]
    if path and (plain or not items):
        lines += ["", f"[{'.'.join(map(_key, path))}]"]
    lines += [f"{_key(name)} = {_value(value)}" for name, value in plain]
    for name, value in items:
        if dataclasses.is_dataclass(value) or _is_table(value):
            _dump(value, (*path, name), lines)


def _is_table(value: object) -> bool:
    return isinstance(value, Mapping)


def _key(name: str) -> str:
    bare = name.replace("_", "").replace("-", "")
    return name if bare.isalnum() and bare.isascii() else _quote(name)


def _quote(text: str) -> str:
    # JSON's escapes are TOML's as well, and DEL is the one control character that JSON leaves alone
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return f"[{', '.join(map(_value, value))}]"
    return _quote(value) if isinstance(value, str) else repr(value)
