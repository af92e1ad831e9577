"""Settings of a log's robots: the configuration's where set, else what the log's notes say."""

import dataclasses
from collections.abc import Mapping
from dataclasses import replace
from typing import TypeVar

from graphslam.core.config import Config, KeyframeConfig, OdometryConfig, RobotConfig
from graphslam.core.config_io import load_config
from graphslam.core.errors import ConfigError
from graphslam.core.geometry import Array
from graphslam.logs import LogSet
from graphslam.odometry.preintegration import Track
from graphslam.perception.robot_outlines import outline_of

Settings = TypeVar("Settings", KeyframeConfig, OdometryConfig, RobotConfig)


def check_robots(log: LogSet, config: Config) -> None:
    """Refuse settings about robots that are not there.

    Raises:
        ConfigError: naming the key.
    """
    for name in config.robots:
        if name not in (*log.robots, "default"):
            known = ", ".join(log.robots)
            raise ConfigError(f"robots.{name}: the log has no robot {name}, but {known}")


def make_tracks(log: LogSet, config: Config) -> dict[str, Track]:
    """An empty track for every robot of a log."""
    return {
        name: Track(
            sensing(odometry_settings(config.odometry, log.notes), log.has_scans(name)),
            robot_settings(name, config, log.notes),
            mounted=True,
        )
        for name in log.robots
    }


def sensing(config: OdometryConfig, scans: bool) -> OdometryConfig:
    """Settings of a robot's calibration: without a laser only the latency of its sightings."""
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
    """Settings of a robot: the configuration's where set, else what the log's notes say of it."""
    noted = [f"{key}={value}" for key, value in notes.items() if key.startswith(f"robots.{name}.")]
    return _noted(config.robot(name), load_config(overrides=noted).robot(name), RobotConfig())


def odometry_settings(config: OdometryConfig, notes: Mapping[str, str]) -> OdometryConfig:
    """Settings of odometry: the configuration's where set, else what the log's notes say of it.

    How well velocities are driven that were only commanded is a property of the log's robots, which
    whoever wrote the log knows, as with the noise of sightings.
    """
    return noted(config, "odometry", notes)


def noted(config: Settings, table: str, notes: Mapping[str, str]) -> Settings:
    """A table of settings: those that are not the defaults, the others as a log's notes say."""
    lines = [f"{key}={value}" for key, value in notes.items() if key.startswith(f"{table}.")]
    known: Settings = getattr(load_config(overrides=lines), table)
    default: Settings = getattr(Config(), table)
    return _noted(config, known, default)


def _noted(config: Settings, noted: Settings, default: Settings) -> Settings:
    """Settings as in ``config``, as in ``noted`` where they are the default."""
    changes = {
        field.name: getattr(noted, field.name)
        for field in dataclasses.fields(config)
        if getattr(config, field.name) == getattr(default, field.name)
    }
    return replace(config, **changes)
