"""Settings: every mistake is one line that names its key; what is written is read back."""

import dataclasses
import math
import pickle
import re
import tempfile
import typing
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from graphslam.core import config as module
from graphslam.core import sensor_config
from graphslam.core.config import Config, RobotConfig
from graphslam.core.config_io import (
    RENAMED_KEYS,
    dump_config,
    load_config,
    parse_config,
    settings_of,
)
from graphslam.core.errors import ConfigError

TABLES = {name: kind for name, kind in settings_of(Config).items() if name != "robots"}

#: a value of the type of each renamed key, by its present name, that is not the default
RENAMED_VALUES = {
    "association.new_landmark_probability": "0.999",
    "association.robot_sightings": "'ignore'",
    "backend.optimise_at_end": "false",
    "backend.reoptimise": "false",
    "front_end.dynamic_objects": "'keep'",
    "front_end.gap_ratio": "0.07",
    "keyframe.sighting_window_s": "0.5",
    "odometry.commanded_velocities": "true",
    "odometry.fixed_calibration": "['axle_m']",
}


def from_text(tmp_path, text):
    path = tmp_path / "settings.toml"
    path.write_text(text, encoding="utf-8")
    return load_config(path)


def one_line(error):
    text = str(error.value)
    assert "\n" not in text
    return text


# ------------------------------------------------------------ mistakes


@pytest.mark.parametrize(
    ("setting", "says"),
    [
        ("keyframe.distnce_m=1", "keyframe.distnce_m: unknown key; did you mean distance_m?"),
        ("keyframes.mode=all", "keyframes: unknown key; did you mean keyframe?"),
        ("robust.colour=1", "robust.colour: unknown key; known: kernel, scale"),
        ("robots.r.lazer=[0,0,0]", "robots.r.lazer: unknown key; did you mean laser?"),
        ("keyframe.distance_m=far", "keyframe.distance_m: expected float, got 'far'"),
        ("keyframe.distance_m=true", "keyframe.distance_m: expected float, got True"),
        ("backend.optimise_at_end=1", "backend.optimise_at_end: expected bool, got 1"),
        ("front_end.min_points=2.5", "front_end.min_points: expected int, got 2.5"),
        ("front_end.min_points=true", "front_end.min_points: expected int, got True"),
        ("robust.scale=-1", "robust.scale: must not be negative, got -1.0"),
        ("front_end.min_points=-1", "front_end.min_points: must not be negative, got -1"),
        ("robust.scale=0", "robust.scale: must be greater than 0"),
        ("changes.consecutive_beams=0", "changes.consecutive_beams: must be greater than 0"),
        ("backend.relinearize_every=0", "backend.relinearize_every: must be greater than 0"),
        ("odometry.max_gap_s=1e300", "odometry.max_gap_s: must not exceed a million, got 1e+300"),
        ("association.gate_probability=2", "association.gate_probability: must be between 0 and"),
        ("robots.r.laser=[0.1,0]", "robots.*.laser: needs [x, y, yaw], got [0.1, 0.0]"),
        ("robust.scale=nan", "robust.scale: must be finite, got nan"),
        ("robust.scale=inf", "robust.scale: must be finite, got inf"),
        ("robust.kernel=hubr", "robust.kernel: 'hubr' is not one of none, huber,"),
        ("robust=3", "robust: is a table of settings, got 3"),
        ("robust.kernel.x=3", "robust.kernel: 'huber"),
        ("robots.r=3", "robots.r: is a table of settings, got 3"),
        ("robots=3", "robots: expected a table, got 3"),
        ("robots.r.laser=3", "robots.r.laser: expected a list, got 3"),
        ("robots.r.laser=['x']", "robots.r.laser[0]: expected float, got 'x'"),
        ("logs.topics=scan", "logs.topics: expected a table, got 'scan'"),
        ("logs.topics.scan=3", "logs.topics.scan: expected str, got 3"),
        ("keyframe.mode", "--set keyframe.mode: write it as key=value"),
        ("=all", "--set =all: write it as key=value"),
    ],
)
def test_mistakes_are_named_with_their_key(setting, says):
    """A typo that was ignored would run for an hour with the default."""
    if setting == "robust.kernel.x=3":
        says = "robust.kernel: {'x': 3} is not one of"
    with pytest.raises(ConfigError) as error:
        load_config(overrides=[setting])
    assert one_line(error).startswith(says)


def test_set_below_a_value_says_what_is_no_table(tmp_path):
    path = tmp_path / "c.toml"
    path.write_text("[robust]\nscale = 3.0\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"robust\.scale\.x: robust\.scale is not a table"):
        load_config(path, ["robust.scale.x=1"])


def test_unknown_key_in_a_file_is_named(tmp_path):
    with pytest.raises(
        ConfigError, match=r"keyframe\.distnce_m: unknown key; did you mean distance_m"
    ):
        from_text(tmp_path, "[keyframe]\ndistnce_m = 1.0\n")


@pytest.mark.parametrize("text", ["keyframe = [", "a = 1\na = 2", "[x"])
def test_a_file_that_is_no_toml_is_named(tmp_path, text):
    with pytest.raises(ConfigError, match=r"settings\.toml: not valid TOML") as error:
        from_text(tmp_path, text)
    one_line(error)


def test_a_file_that_is_no_text_is_named(tmp_path):
    path = tmp_path / "binary.toml"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match=r"binary\.toml: not valid TOML"):
        load_config(path)


@pytest.mark.parametrize("name", ["nowhere.toml", "."])
def test_a_file_that_cannot_be_read_is_named(tmp_path, name):
    path = tmp_path / name
    with pytest.raises(ConfigError, match="cannot be read") as error:
        load_config(path)
    assert str(path) in one_line(error)


# ------------------------------------------------------------ what is accepted


def test_nothing_given_is_the_default():
    assert load_config() == Config()


def test_set_wins_over_the_file_and_the_file_over_the_default(tmp_path):
    path = tmp_path / "c.toml"
    path.write_text("[keyframe]\ndistance_m = 1.0\nangle_rad = 0.5\n", encoding="utf-8")
    found = load_config(path, ["keyframe.distance_m=2", "keyframe.distance_m=3"]).keyframe
    assert (found.distance_m, found.angle_rad) == (3.0, 0.5)


@pytest.mark.parametrize(
    ("setting", "read", "value"),
    [
        ("keyframe.mode=all", lambda c: c.keyframe.mode, "all"),
        ("keyframe.mode='all'", lambda c: c.keyframe.mode, "all"),
        (' keyframe.mode = "all" ', lambda c: c.keyframe.mode, "all"),
        ("keyframe.distance_m=1", lambda c: c.keyframe.distance_m, 1.0),
        ("keyframe.distance_m=1e-3", lambda c: c.keyframe.distance_m, 1e-3),
        ("backend.optimise_at_end=false", lambda c: c.backend.optimise_at_end, False),
        ("front_end.min_points=9", lambda c: c.front_end.min_points, 9),
        ("robots.r.laser=[0.1, -2, 0]", lambda c: c.robot("r").laser, (0.1, -2.0, 0.0)),
        ("robots.r.left_joint=a=b", lambda c: c.robot("r").left_joint, "a=b"),
        ("robots.r.left_joint=", lambda c: c.robot("r").left_joint, ""),
        ("logs.topics./robot1/scan=robot1", lambda c: c.logs.topics["/robot1/scan"], "robot1"),
        ("start.poses.b=[1,2,-3]", lambda c: c.start.poses["b"], (1.0, 2.0, -3.0)),
        ("start.poses={b = [1, 2, -3]}", lambda c: c.start.poses["b"], (1.0, 2.0, -3.0)),
    ],
)
def test_forms_of_set(setting, read, value):
    """Bare words are strings, whole numbers will do for lengths, coordinates may be negative."""
    found = read(load_config(overrides=[setting]))
    assert found == value
    assert type(found) is type(value)


def test_a_robots_own_table_then_the_default_table_then_the_defaults(tmp_path):
    config = from_text(tmp_path, "[robots.default]\naxle_m = 0.7\n[robots.b]\naxle_m = 0.9\n")
    assert (config.robot("a").axle_m, config.robot("b").axle_m) == (0.7, 0.9)
    assert Config().robot("a") == RobotConfig()


def test_configurations_are_frozen_all_the_way_down():
    config = load_config(overrides=["robots.a.axle_m=1"])
    with pytest.raises(dataclasses.FrozenInstanceError):
        config.keyframe.mode = "all"
    with pytest.raises(TypeError):
        config.robots["b"] = RobotConfig()


# ------------------------------------------------------------ round trip

#: control characters are no part of any name in a log
NAMES = st.text(st.characters(exclude_categories=("Cc", "Cs")), max_size=12)


def values(kind):
    """A strategy for a field's type."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is typing.Literal:
        return st.sampled_from(arguments)
    if origin is tuple and typing.get_origin(arguments[0]) is typing.Literal:
        return st.lists(values(arguments[0]), max_size=3).map(tuple)
    if origin is tuple:
        items = st.floats(-1e9, 1e9)
        if typing.get_origin(arguments[0]) is tuple:  # corners
            items = st.tuples(items, items)
        return st.sampled_from([0, 3]).flatmap(
            lambda n: st.lists(items, min_size=n, max_size=n).map(tuple)
        )
    if origin is not None:  # a mapping
        return st.dictionaries(NAMES, values(arguments[1]), max_size=3)
    if dataclasses.is_dataclass(kind):
        return tables(kind)
    return {
        float: st.floats(1e-300, 1e6, allow_subnormal=False),
        int: st.integers(1, 10**6),
        bool: st.booleans(),
        str: NAMES,
    }[kind]


def tables(kind):
    hints = settings_of(kind)
    odds = {name for name in hints if name.endswith(("_probability", "_rate"))}
    strategies = {name: values(hint) for name, hint in hints.items() if name not in odds}
    strategies |= {name: st.floats(1e-9, 1 - 1e-9) for name in odds}
    return st.builds(kind, **strategies)


@given(tables(Config))
def test_dump_then_load_is_the_same_configuration(config):
    """config.toml in a result folder repeats the run: every type, to the last digit of every
    float."""
    assert parse_config(dump_config(config)) == config


KEYS = [f"{name}.{key}" for name, kind in TABLES.items() for key in settings_of(kind)]
ODD = ["", "nan", "-inf", "1e999", "true", "[", "{}", "[[1]]", "{a=1}", "'", "0x", "-1", "9" * 400]


@given(st.sampled_from(KEYS) | st.text(), st.sampled_from(ODD) | st.text(), st.sampled_from("=.\n"))
@settings(max_examples=150, derandomize=True)
def test_whatever_is_set_is_a_configuration_or_an_error_of_one_line(key, value, between):
    for read in (lambda text: load_config(overrides=[text]), from_file):
        try:
            assert isinstance(read(f"{key}{between}{value}"), Config)
        except ConfigError as error:
            assert len(str(error).splitlines()) == 1, repr(str(error))


def from_file(text):
    with tempfile.TemporaryDirectory() as folder:
        return from_text(Path(folder), text)


def test_the_default_configuration_survives_a_file(tmp_path):
    assert from_text(tmp_path, dump_config(Config())) == Config()


def test_the_dump_names_every_setting():
    """The effective configuration is complete: nothing is left to a later version's default."""
    text = dump_config(Config())
    for table, kind in TABLES.items():
        for field in dataclasses.fields(kind):
            assert field.name in text or field.type == "Mapping[str, str]", (table, field.name)


# ------------------------------------------------------------ renamed keys


def setting(config, key):
    table, name = key.split(".")
    return getattr(getattr(config, table), name)


@pytest.mark.parametrize("form", ["override", "table override", "file"])
@pytest.mark.parametrize(("old", "new"), RENAMED_KEYS.items())
def test_an_old_key_sets_the_new_one_with_one_warning(tmp_path, old, new, form):
    value = RENAMED_VALUES[new]
    table, key = old.split(".")
    if form == "file":
        config = from_text(tmp_path, f"[{table}]\n{key} = {value}\n")
    elif form == "override":
        config = load_config(overrides=[f"{old}={value}"])
    else:
        config = load_config(overrides=[f"{table}={{{key} = {value}}}"])
    expected = load_config(overrides=[f"{new}={value}"])
    assert setting(config, new) != setting(Config(), new)
    assert (config, expected.warnings) == (expected, ())
    assert config.warnings == (f"{old} is now called {new}",)


def test_an_old_key_in_the_file_and_among_the_overrides_is_one_warning(tmp_path):
    path = tmp_path / "c.toml"
    path.write_text("[keyframe]\ngather_s = 0.1\n", encoding="utf-8")
    config = load_config(path, ["keyframe.gather_s=0.2", "keyframe.gather_s=0.3"])
    assert config.keyframe.sighting_window_s == 0.3
    assert config.warnings == ("keyframe.gather_s is now called keyframe.sighting_window_s",)


def test_an_override_by_the_new_name_wins_over_a_file_with_the_old_one(tmp_path):
    """The config.toml of an older result, repeated with one setting changed."""
    path = tmp_path / "c.toml"
    path.write_text("[backend]\npolish = true\n", encoding="utf-8")
    config = load_config(path, ["backend.optimise_at_end=false"])
    assert config.backend.optimise_at_end is False
    assert len(config.warnings) == 1


@pytest.mark.parametrize("first", [0, 1])
@pytest.mark.parametrize(("old", "new"), RENAMED_KEYS.items())
def test_a_setting_by_both_names_is_refused(tmp_path, old, new, first):
    value = RENAMED_VALUES[new]
    both = [f"{old}={value}", f"{new}={value}"]
    says = f"{old}: is the old name of {new}, which is given too"
    with pytest.raises(ConfigError) as error:
        load_config(overrides=[both[first], both[1 - first]])
    assert one_line(error) == says
    with pytest.raises(ConfigError) as error:
        from_text(tmp_path, "\n".join([both[first], both[1 - first]]))
    assert one_line(error) == says


def test_old_names_are_no_settings_and_new_ones_are():
    for old, new in RENAMED_KEYS.items():
        (table, key), (new_table, new_key) = old.split("."), new.split(".")
        assert table == new_table
        assert new_key in settings_of(TABLES[table]) and key not in settings_of(TABLES[table])


def test_warnings_are_no_setting_and_reach_another_process():
    with pytest.raises(ConfigError, match="warnings: unknown key"):
        load_config(overrides=["warnings=['a']"])
    config = load_config(overrides=["backend.polish=false", "robots.a.axle_m=1"])
    assert "warnings" not in dump_config(config)
    again = pickle.loads(pickle.dumps(config))
    assert (again, again.warnings) == (config, config.warnings)


# ------------------------------------------------------------ the tree itself


@pytest.mark.parametrize("table", sorted(TABLES))
def test_every_float_bears_its_unit(table):
    """Metres, radians, seconds or MB at the end of the name; or a ratio, scale or probability."""
    plain = ("ratio", "scale", "probability", "rate", "threshold", "sigma")
    for field in dataclasses.fields(TABLES[table]):
        if isinstance(field.default, float):
            unit = field.name.rsplit("_", 1)[-1]
            assert unit in ("m", "rad", "s", "mb") or unit in plain, (
                f"{table}.{field.name} has no unit"
            )


@pytest.mark.parametrize("table", sorted(TABLES))
def test_defaults_are_of_their_own_types_and_finite(table):
    kind = TABLES[table]
    hints = typing.get_type_hints(kind)
    for field in dataclasses.fields(kind):
        value = getattr(kind(), field.name)
        if hints[field.name] in (int, float, bool, str):
            assert type(value) is hints[field.name]
        assert not isinstance(value, float) or (
            (math.isfinite(value) or field.name in ("horizon_s", "delete_s", "memory_mb"))
            and value >= 0
        )


def test_there_is_no_setting_for_one_log():
    """Defaults are meant for everything of a kind; a log's name in the tree would be in-sample."""
    for source in (module, sensor_config):
        text = Path(source.__file__).read_text(encoding="utf-8").lower()
        assert not re.search(r"\b(intel|victoria|mrclam|aces|killian)\b", text)
