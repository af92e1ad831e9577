"""Only the description for the package index, where links within the repository lead nowhere.

They lead to the repository where pyproject.toml names its address (`Repository` in
`[project.urls]`); without it their words stand alone.
"""

import re
import tomllib
from pathlib import Path

from setuptools import setup

ROOT = Path(__file__).parent


def description() -> str:
    """README.md with links that work anywhere."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    address = project.get("urls", {}).get("Repository")
    to = rf"[\1]({address}/blob/main/\2)" if address else r"\1"
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    return re.sub(r"\[([^\]]+)\]\((?!https?:)([^)]+)\)", to, text)


setup(long_description=description(), long_description_content_type="text/markdown")
