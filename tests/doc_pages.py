"""The pages of the documentation and the code in them."""

import re
import shlex

from paths import ROOT

PAGES = [
    *sorted((ROOT / "docs").glob("*.md")),
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "logs/README.md")),
]
#: an opening fence with its language, what is in it, and the fence that closes it
_BLOCK = re.compile(r"^```([^\n`]*)\n(.*?)^```[ \t]*$", flags=re.M | re.S)


def blocks(page, language):
    """The code blocks of a page in a language, "" for those that name none."""
    text = page.read_text(encoding="utf-8")
    return [code for name, code in _BLOCK.findall(text) if name.strip() == language]


def command_lines(page):
    """The lines that call a program in blocks of a shell: its words, without comments.

    These name no language, or sh. Where a page sends what the program prints is left out.
    """
    for block in [*blocks(page, ""), *blocks(page, "sh")]:
        for line in re.sub(r"\\\n *", "", block).splitlines():
            text = line.removeprefix("$ ").removeprefix(".venv/bin/")
            if re.match(r"(graphslam|python|make) ", text):
                words = shlex.split(text, comments=True)
                yield words[: words.index(">")] if ">" in words else words
