"""The scenarios of the package."""

from pathlib import Path

_FOLDER = Path(__file__).parent / "scenarios"

#: name -> file; docs/simulator.md says what each is for
SCENARIOS: dict[str, Path] = {
    name: _FOLDER / f"{name}.toml"
    for name in (
        "lab",
        "corridor",
        "two-robots",
        "robots-in-scans",
        "change",
        "office-loop",
        "two-lasers",
        "long-corridor",
        "forest",
        "fleet",
    )
}
