"""Settings of a log's robots: from the configuration where set there, else from the log's notes."""

import dataclasses
from collections.abc import Mapping
from dataclasses import replace
from typing import TypeVar

from graphslam.core.config import (
    Config,
    FrontEndConfig,
    KeyframeConfig,
    OdometryConfig,
    RobotConfig,
)
from graphslam.core.config_io import load_config
from graphslam.core.errors import ConfigError
from graphslam.core.geometry import Array
from graphslam.core.motion_models import RATES, with_rates
from graphslam.core.records import RelativePose, Scan, Sighting
from graphslam.logs import LogSet
from graphslam.logs.stated_noise import StatedNoise
from graphslam.odometry.noise_estimation import rates_of
from graphslam.odometry.preintegration import Track
from graphslam.odometry.several_lasers import SeveralLasersTrack
from graphslam.perception.robot_outlines import outline_of

#: by how much lasers are noisier than the default where that is taken into account. ACES has 1.4,
#: and equal errors with and without
LEAST_NOISE = 1.5

Settings = TypeVar("Settings", KeyframeConfig, OdometryConfig, RobotConfig)


def check_robots(log: LogSet, config: Config) -> None:
    """Refuse settings of robots that the log does not have.

    Raises:
        ConfigError: naming the key.
    """
    for name in config.robots:
        if name not in (*log.robots, "default"):
            known = ", ".join(log.robots)
            raise ConfigError(f"robots.{name}: the log has no robot {name}, but {known}")


def with_log_settings(log: LogSet, config: Config) -> Config:
    """The configuration with what the log says in place of defaults.

    These are keyframe settings that are noted in it, and the noise of the noisiest laser.
    """
    return replace(
        config,
        keyframe=noted(config.keyframe, "keyframe", log.notes),
        front_end=with_range_noise(log, config.front_end),
    )


def with_range_noise(log: LogSet, config: FrontEndConfig) -> FrontEndConfig:
    """The settings with the noise of ranges that is measured, where that is larger by far."""
    default = FrontEndConfig()
    told = config.range_sigma_m, config.range_sigma_ratio
    if told != (default.range_sigma_m, default.range_sigma_ratio):
        return config
    topics = [t.name for t in (*log.topics, *log.further_lasers) if t.record is Scan]
    known = [noise for noise in map(log.range_noise, topics) if noise is not None]
    # compared where all of them measured
    common_m = min((noise.farthest_m for noise in known), default=0.0)
    noise = max(known, key=lambda one: one.at(common_m), default=None)
    if noise is None or noise.largest_m < LEAST_NOISE * default.range_sigma_m:
        return config
    sigma_m = max(noise.sigma_m, default.range_sigma_m)
    return replace(config, range_sigma_m=sigma_m, range_sigma_ratio=noise.ratio)


def make_tracks(log: LogSet, config: Config) -> dict[str, Track]:
    """An empty track for every robot of a log."""
    kinds = {topic.record for topic in log.topics}
    # invented stamps are those of an order, not of clocks
    late = Sighting in kinds and not kinds & {Scan, RelativePose}
    late &= not log.notes.get("stamps", "").startswith("invented")
    tracks: dict[str, Track] = {}
    for name in log.robots:
        odometry = with_stated_noise(
            odometry_settings(config.odometry, log.notes), log.stated_noise(name)
        )
        odometry = without_laser_calibration(odometry, log.has_scans(name))
        robot = robot_settings(name, config, log.notes)
        further = [sensor for sensor in log.sensors(name).values() if sensor]
        if further and config.tracks_scans:
            tracks[name] = SeveralLasersTrack(odometry, robot, further)
        else:
            tracks[name] = Track(odometry, robot, mounted=True, late=late)
    return tracks


def with_stated_noise(config: OdometryConfig, stated: StatedNoise | None) -> OdometryConfig:
    """Odometry settings with the rates that a log's messages state, unless others are set."""
    default = OdometryConfig()
    if stated is None or any(getattr(config, name) != getattr(default, name) for name in RATES):
        return config
    return with_rates(config, rates_of(stated.twists, stated.seconds, stated.variances))


def without_laser_calibration(config: OdometryConfig, scans: bool) -> OdometryConfig:
    """Odometry settings for a robot with or without scans: without, only latency is calibrated."""
    if scans:
        return config
    return replace(
        config,
        laser_sigma_m=0.0,
        laser_sigma_rad=0.0,
        laser_latency_sigma_s=config.sighting_latency_sigma_s,
    )


def outlines(log: LogSet, config: Config) -> dict[str, Array]:
    """Robot -> corners (k, 2), m, of those whose outline is known."""
    known = {name: robot_settings(name, config, log.notes).outline for name in log.robots}
    return {name: outline_of(corners) for name, corners in known.items() if corners}


def robot_settings(name: str, config: Config, notes: Mapping[str, str]) -> RobotConfig:
    """Settings of a robot: from the configuration where set there, else from the log's notes."""
    with_log_notes = [
        f"{key}={value}" for key, value in notes.items() if key.startswith(f"robots.{name}.")
    ]
    return _noted(
        config.robot(name), load_config(overrides=with_log_notes).robot(name), RobotConfig()
    )


def odometry_settings(config: OdometryConfig, notes: Mapping[str, str]) -> OdometryConfig:
    """Odometry settings: from the configuration where set there, else from the log's notes.

    How accurately commanded velocities are driven is a property of the robots, which the writer of
    the log knows, like the noise of sightings.
    """
    return noted(config, "odometry", notes)


def noted(config: Settings, table: str, notes: Mapping[str, str]) -> Settings:
    """A table of settings, in which a log's notes replace what is at its default."""
    lines = [f"{key}={value}" for key, value in notes.items() if key.startswith(f"{table}.")]
    known: Settings = getattr(load_config(overrides=lines), table)
    default: Settings = getattr(Config(), table)
    return _noted(config, known, default)


def _noted(config: Settings, noted: Settings, default: Settings) -> Settings:
    """``config`` with the values of ``noted`` where it has the default."""
    changes = {
        field.name: getattr(noted, field.name)
        for field in dataclasses.fields(config)
        if getattr(config, field.name) == getattr(default, field.name)
    }
    return replace(config, **changes)
