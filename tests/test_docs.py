"""The documentation says what the program does."""

import importlib.util
from pathlib import Path

from graphslam.cli.commands import app

ROOT = Path(__file__).parents[1]


def test_the_configuration_page_is_what_the_configuration_says():
    spec = importlib.util.spec_from_file_location("configuration", ROOT / "docs/configuration.py")
    generator = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(generator)
    assert generator.PAGE.read_text(encoding="utf-8") == generator.page(), "run `make docs`"


def test_the_readme_has_every_command_and_only_links_that_lead_somewhere():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    for command in app.registered_commands:
        assert f"graphslam {command.name} " in readme
    targets = [part.split(")")[0] for part in readme.split("](")[1:]]
    assert targets
    for target in targets:
        assert target.startswith("https://") or (ROOT / target).exists(), target
