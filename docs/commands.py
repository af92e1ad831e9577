"""Writes docs/commands.md from the command line itself, and docs/schemas.md from its messages.

Run: python docs/commands.py   (or `make pages`)
"""

import textwrap
from itertools import takewhile
from pathlib import Path
from typing import Any

import typer

from graphslam.cli.commands import app
from graphslam.logs import schemas
from graphslam.logs.translations import TRANSLATIONS

FOLDER = Path(__file__).parent
PAGES = ("commands.md", "schemas.md")

COMMANDS = """\
# Commands

Every command with its arguments and options. The page is made from the program by `make pages`.

- Every command has `-h` with examples (here at the end of each section), `--json` (exactly one
  object on stdout, see [formats](formats.md#what-commands-print-with---json)) and `--debug`
  (tracebacks).
- Exit codes are in [formats](formats.md#exit-codes).
- Settings (`--config`, `--set`) are in [configuration](configuration.md).
- `graphslam --install-completion` completes commands, options and names in the shell."""

SCHEMAS = """\
# Messages

Which messages are read, and the definitions of our own. The page is made from the program by
`make pages`. What topics mean and how they are found: [logs](logs.md).

## Messages of ROS 2 that are read

{ros}

Encodings: `{translated}`; ROS 1 and Foxglove messages are translated to these.

## Our own messages

Their definitions are in every log that has them, so that any tool decodes them.

{own}"""


def commands() -> str:
    """The page of commands."""
    group = typer.main.get_command(app)
    parts = [COMMANDS, _contents(group)]
    for name, command in sorted(group.commands.items()):
        own = [p for p in command.params if p.name not in ("help", "json", "debug")]
        usage = [p.metavar for p in own if p.param_type_name == "argument"]
        text, _, examples = (command.help or "").partition("\b\nExamples:\n")
        line = " ".join(["graphslam", name, *usage, "[OPTIONS]"])
        told = textwrap.fill(" ".join(text.split()), 120, break_on_hyphens=False)
        parts.append(f"## {name}\n\n{told}\n\n```text\n{line}\n```")
        rows = [f"| `{_cell(_written(p))}` | {_cell(p.help or '')} |" for p in own]
        parts.append("\n".join(["| | |", "|---|---|", *rows]))
        shown = "\n".join(line.strip() for line in examples.splitlines())
        parts += [f"```\n{shown}\n```"] if shown else []
    return "\n\n".join(parts) + "\n"


def _contents(group: Any) -> str:
    """A table of all commands: the first sentence of what each does."""
    firsts = {
        name: " ".join((command.help or "").split()).split(". ")[0].rstrip(".")
        for name, command in sorted(group.commands.items())
    }
    rows = [f"| [{name}](#{name}) | {_cell(first)} |" for name, first in firsts.items()]
    return "\n".join(["| command | what it does |", "|---|---|", *rows])


def _written(parameter: Any) -> str:
    """A parameter as one writes it: ``-o, --output DIR``."""
    if parameter.param_type_name == "argument":
        return str(parameter.metavar)
    flags = ", ".join([*parameter.opts, *parameter.secondary_opts])
    return f"{flags} {parameter.metavar or ''}"


def messages() -> str:
    """The page of messages."""
    own = schemas.DEFINITIONS
    ros = sorted(name for name in schemas.KNOWN if name not in own)
    head = SCHEMAS.format(
        ros="\n".join(f"- `{name}`" for name in ros),
        translated="`, `".join(sorted(TRANSLATIONS)),
        own="\n".join(
            ["| message | what it is |", "|---|---|", *map(_message_row, sorted(own.items()))]
        ),
    )
    parts = [head]
    parts += [f"### {name}\n\n```text\n{text.strip()}\n```" for name, text in sorted(own.items())]
    return "\n\n".join(parts) + "\n"


def _message_row(item: tuple[str, str]) -> str:
    """A message and the comment with which its definition begins."""
    name, definition = item
    lines = takewhile(lambda line: line.startswith("#"), definition.strip().splitlines())
    return f"| `{name}` | {_cell(' '.join(line.strip('# ') for line in lines))} |"


def _cell(text: str) -> str:
    return " ".join(str(text).split()).replace("|", "\\|")


if __name__ == "__main__":
    for page, text in zip(PAGES, (commands(), messages()), strict=True):
        (FOLDER / page).write_text(text, encoding="utf-8")
