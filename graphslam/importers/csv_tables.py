"""Tables of numbers as text: what is between their columns, the names of these, and their rows.

Columns of a table are separated by semicolons, by tabs, by commas or by blanks, the first of these
that is in most lines of numbers. Next to semicolons and tabs a comma is that of a decimal number.
Lines that begin with ``#`` are comments.
"""

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import NamedTuple

#: characters with which a number begins
_NUMERIC = frozenset("0123456789+-.")
#: between names that are not separated like the numbers
_ANY_SEPARATOR = re.compile(r"[;,\s]+")
#: blanks before the bracket of a unit: "x [m]"
_BEFORE_BRACKET = re.compile(r"\s+(?=[\[(])")


class Names(NamedTuple):
    """Names of columns, as they stand in the file.

    ``certain``: the line is one of names, else it may be a comment or a sentence. ``fits``: there
    are as many as columns, where rows have equally many.
    """

    names: tuple[str, ...]
    certain: bool
    fits: bool


class Table(NamedTuple):
    """The lines of a table that are neither empty, nor comments, nor names.

    ``separator`` is what is between its columns, None: blanks. ``width`` is how many columns a line
    must have, None: any number.
    """

    lines: list[str]
    separator: str | None
    width: int | None
    names: Names | None

    def rows(self) -> Iterator[list[str] | None]:
        """The columns of each line; None for one that has not as many as it must."""
        for line in self.lines:
            fields = _fields(line, self.separator)
            yield fields if self.width in (None, len(fields)) else None


def read_table(text: str, *, same_width: bool) -> Table:
    """The table in ``text``.

    With ``same_width`` its lines have as many columns as its names, or as most: a comma in others
    may be a decimal one.
    """
    # tabs at the ends of a line are those of empty columns
    whole = [line.strip(" \r\n") for line in text.splitlines()]
    whole = [line for line in whole if line.strip()]
    lines = [line for line in whole if not _is_comment(line)]
    separator = _separator(lines)
    heading = lines.pop(0) if lines and not _is_numeric(lines[0]) else ""
    width = _width(heading, lines, separator) if same_width else None
    if heading:
        return Table(lines, separator, width, _names(heading, separator, width))
    # numpy writes names as a comment
    first = next((k for k, line in enumerate(whole) if not _is_comment(line)), 0)
    names = _names(whole[first - 1].strip().lstrip("#") if first else "", separator, width)
    usable = names._replace(certain=False) if names.fits else None
    return Table(lines, separator, width, usable)


def _is_comment(line: str) -> bool:
    return line.lstrip().startswith("#")


def _is_numeric(line: str) -> bool:
    return line.lstrip()[:1] in _NUMERIC


def _separator(lines: Sequence[str]) -> str | None:
    """What is between the columns of most lines of numbers; None: blanks."""
    numeric = [line for line in lines if _is_numeric(line)]
    for separator in (";", "\t", ","):
        if 2 * sum(_separates(separator, line) for line in numeric) > len(numeric):
            return separator
    return None


def _separates(separator: str, line: str) -> bool:
    """Whether it is between columns of the line; tabs beside blanks or commas only align them."""
    if separator not in line:
        return False
    fields = [field.strip() for field in line.split(separator)]
    aligned = any(" " in field or field[:1] == "," or field[-1:] == "," for field in fields)
    return separator != "\t" or not aligned


def _fields(line: str, separator: str | None) -> list[str]:
    """The columns of a line of numbers."""
    if separator in (";", "\t"):
        line = line.replace(",", ".")
    return [field.strip() for field in line.split(separator)]


def _width(heading: str, lines: Sequence[str], separator: str | None) -> int:
    """How many columns the lines have: as many as names, where these are separated like numbers."""
    if separator is not None and separator in heading:
        return len(heading.split(separator))
    widths = Counter(len(_fields(line, separator)) for line in lines if _is_numeric(line))
    return widths.most_common(1)[0][0] if widths else 0


def _names(heading: str, separator: str | None, width: int | None) -> Names:
    """The names in a line; without the separator of the numbers it may be a sentence."""
    if separator is not None and separator in heading:
        names = [name.strip() for name in heading.split(separator)]
        return Names(tuple(names), certain=True, fits=width in (None, len(names)))
    names = [name for name in _ANY_SEPARATOR.split(_BEFORE_BRACKET.sub("", heading)) if name]
    return Names(tuple(names), certain=width == len(names), fits=width in (None, len(names)))
