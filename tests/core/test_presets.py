"""Presets are differences from the defaults, and `graphslam config` says all there is to set."""

import json
import tomllib

import pytest
from command_line import call

import graphslam
from graphslam.core.config import Config
from graphslam.core.config_io import (
    dump_config,
    load_config,
    parse_config,
    settings_of,
    with_preset,
)
from graphslam.core.config_text import documented_settings, settings_tree, unit_of
from graphslam.core.errors import ConfigError
from graphslam.core.presets import PRESETS, preset_purpose, preset_settings


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_changes_every_setting_that_it_names(name):
    """A setting equal to the default would say that it matters when it does not."""
    default, changed = load_config(), load_config(preset=name)
    for table, settings in preset_settings(name).items():
        for key in settings:
            if table != "robots":
                assert getattr(getattr(changed, table), key) != getattr(
                    getattr(default, table), key
                ), f"{table}.{key}"
    assert changed != default
    assert len(preset_purpose(name)) > 20


def test_a_file_and_settings_go_over_a_preset(tmp_path):
    file = tmp_path / "own.toml"
    file.write_text("[ekf]\npast_states = 7\n[association]\ndelete_s = 5.0\n", encoding="utf-8")
    made = load_config(file, ["association.delete_s=9"], "thesis")
    assert (made.ekf.past_states, made.association.delete_s) == (7, 9.0)
    assert made.ekf.lines == "thesis"  # what the file does not name stays the preset's
    assert graphslam.load_config(file, preset="thesis", ekf={"past_states": 3}).ekf.past_states == 3
    assert with_preset(Config(), "thesis") == load_config(preset="thesis")
    assert graphslam.load_config(Config(), preset="thesis") == load_config(preset="thesis")


def test_an_unknown_preset_is_named():
    with pytest.raises(ConfigError, match=r"--preset theses: is not one of thesis"):
        load_config(preset="theses")


def test_what_config_prints_are_the_defaults():
    text = documented_settings()
    assert load_config() == parse_config(text)
    tables = tomllib.loads(text)
    assert set(settings_of(Config)) - set(tables) == {"robots"}
    for name in PRESETS:
        assert f"preset {name}" in text


def test_units_follow_from_names():
    units = {
        "k_phi_rad": "rad²/rad", "max_speed_m_s": "m/s", "drift_sigma_rad_per_m": "rad/m",
        "gap_ratio": None, "gate_probability": "0 to 1", "floor_m": "m",
    }  # fmt: skip
    assert {key: unit_of(key) for key in units} == units


def test_the_command_prints_toml_and_json(tmp_path):
    done = call("config", "--preset", "thesis")
    assert parse_config(done.out) == load_config(preset="thesis")
    found = json.loads(call("config", "--json").out)
    assert found == json.loads(json.dumps(settings_tree()))
    assert found["settings"]["association"]["delete_s"]["default"] == "inf"
    assert found["presets"]["thesis"]["settings"]["ekf"]["past_states"] == 0
    saved = tmp_path / "all.toml"
    saved.write_text(call("config").out, encoding="utf-8")
    assert dump_config(load_config(saved)) == dump_config(load_config())


def test_the_thesis_filter_has_the_thesis_error():
    """Additive along world axes: the default, so the preset does not repeat it."""
    assert load_config(preset="thesis").ekf.error == "world"
