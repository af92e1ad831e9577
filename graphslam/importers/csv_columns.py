"""Which column of a table is what: by the names of its columns, else by their usual order.

Names are compared without case, blanks, underscores, dots and hyphens. They may end with a unit:
``x_m``, ``x [m]``, ``x (m)``. Columns with other names are left out. Files in which a column that
is needed is missing, is there twice or has another unit are refused: their usual order would be a
guess.
"""

import re
from collections.abc import Mapping, Sequence
from itertools import product
from typing import Literal, NamedTuple

from graphslam.core.errors import LogError
from graphslam.importers.csv_tables import Names

#: poses with a stamp, a pose of a laser on the robot, scans
Kind = Literal["poses", "mount", "scans"]

_POSE = ("x", "y", "heading")
_QUATERNION = ("qx", "qy", "qz", "qw")
_NEEDED: dict[Kind, tuple[str, ...]] = {
    "poses": ("stamp", *_POSE),
    "mount": _POSE,
    "scans": ("stamp", "first", "step"),
}
_EXPECTED: dict[Kind, str] = {
    "poses": "stamp (s), x and y (m), and heading (rad) or qx, qy, qz, qw",
    "mount": "x m, y m, heading rad (or qx, qy, qz, qw)",
    "scans": "stamp (s), first and step (rad), and the ranges (m) as ranges or range_0, range_1, "
    "... in a row",
}

_SYNONYMS: dict[str, tuple[str, ...]] = {
    "stamp": ("stamp", "time", "t", "timestamp"),
    "heading": ("heading", "theta", "yaw", "phi", "psi", "angle"),
    "first": ("first", "firstangle", "start", "startangle", "anglemin", "minangle"),
    "step": ("step", "anglestep", "increment", "angleincrement"),
    **{axis: (axis, f"t{axis}", f"p{axis}", f"pos{axis}", f"position{axis}") for axis in "xy"},
    **{f"q{axis}": (f"q{axis}", f"quat{axis}", f"orientation{axis}") for axis in "xyzw"},
}
_RANGE = re.compile(r"ranges?[\[(]?\d*[\])]?|r\d+")

_SECONDS = {"s", "sec", "secs", "second", "seconds"}
_METRES = {"m", "meter", "meters", "metre", "metres"}
_RADIANS = {"rad", "rads", "radian", "radians"}
_UNITS: dict[str, set[str]] = {
    "stamp": _SECONDS,
    "x": _METRES,
    "y": _METRES,
    "heading": _RADIANS,
    "first": _RADIANS,
    "step": _RADIANS,
    "ranges": _METRES,
}
#: parts of a second are often a column of their own, so that there are two of stamps
_PARTS = {f"{short}{long}" for short, long in product(("n", "u", "m"), ("sec", "secs"))}
_PARTS |= {f"{part}{unit}" for part in ("nano", "micro", "milli") for unit in _SECONDS - {"s"}}
_OTHER_UNITS = _PARTS | {"ms", "us", "µs", "ns", "km", "cm", "mm", "deg", "degs", "degree"}
_OTHER_UNITS |= {"degrees", "°", "grad", "turns"}
_ALL_UNITS = _SECONDS | _METRES | _RADIANS | _OTHER_UNITS

_UNIT_IN_BRACKETS = re.compile(r"(.+?)[\s_]*[\[(]\s*(\S+?)\s*[\])]")
_UNIT_AT_THE_END = re.compile(r"(.+)[_\s](\S+)")
_LEFT_OUT = re.compile(r"[\s_.-]")
#: so many names are repeated in a message, and so many characters of each
_MOST_TOLD, _LONGEST_TOLD = 12, 40


class Columns(NamedTuple):
    """Columns of a table, counted from 0.

    ``picked``: those of the stamp (not of a mount), x, y and the heading or the quaternion x y z w;
    of a scan those of the stamp, the first angle and the step. ``ranges``: those of a scan.
    ``with_unit``: what of these has a name with a unit.
    """

    picked: tuple[int, ...]
    ranges: slice = slice(0, 0)
    with_unit: frozenset[str] = frozenset()

    def of(self, fields: Sequence[str]) -> list[str]:
        """What these columns are of the ``fields`` of a line, in this order.

        Raises:
            IndexError: the line has too few.
        """
        return [*(fields[column] for column in self.picked), *fields[self.ranges]]


#: the usual order; of TUM files z is left out
POSES = Columns((0, 1, 2, 3))
TUM_POSES = Columns((0, 1, 2, 4, 5, 6, 7))
MOUNT = Columns((0, 1, 2))
SCANS = Columns((0, 1, 2), slice(3, None))


def columns_of(kind: Kind, names: Names | None, usual: Columns, file: str) -> Columns:
    """The columns of a table of this ``kind``: by their names, ``usual`` if none is known.

    ``file`` is what messages call the file.

    Raises:
        LogError: there are known names, and one that is needed is missing, ambiguous or of another
            unit; or there are not as many names as columns.
    """
    if names is None:
        return usual
    found, units = _found(kind, names.names)
    if not found:
        return usual
    needed = _NEEDED[kind]
    if kind != "scans" and all(name in found for name in _QUATERNION):
        needed = (*needed[:-1], *_QUATERNION)
    ranges, of_ranges = _ranges(found, names.names) if kind == "scans" else (slice(0, 0), "")
    missing = [name for name in needed if name not in found]
    if missing:
        wrong = f"none is {', '.join(missing)}"
    else:
        wrong = _unclear(needed, found, units, names.names) or of_ranges
    if not names.certain and (missing or (wrong and not names.fits)):
        return usual  # a sentence in which such a word stands
    if not wrong and not names.fits:
        wrong = "its lines have another number of columns"
    if wrong:
        raise LogError(
            f"{file} names its columns {_told(names.names)}, but {wrong}; names are "
            f"{_EXPECTED[kind]}"
        )
    picked = tuple(found[name][0] for name in needed)
    return Columns(picked, ranges, frozenset(name for name in needed if units[found[name][0]]))


def _found(kind: Kind, names: Sequence[str]) -> tuple[dict[str, list[int]], list[str]]:
    """Columns by what their names mean, and the units of all columns (empty: none is named)."""
    meanings = (*_NEEDED[kind], *(("ranges",) if kind == "scans" else _QUATERNION))
    found: dict[str, list[int]] = {}
    units = []
    for column, whole in enumerate(names):
        name, unit = _without_unit(whole)
        units.append(unit)
        for meaning in meanings:
            if _means(name, meaning):
                found.setdefault(meaning, []).append(column)
    return found, units


def _without_unit(whole: str) -> tuple[str, str]:
    """A name as it is compared, and its unit."""
    text, unit = whole.strip().strip("\"'").strip().casefold(), ""
    if text in _PARTS:
        return "stamp", text
    for pattern in (_UNIT_IN_BRACKETS, _UNIT_AT_THE_END):
        match = pattern.fullmatch(text)
        if match and match[2] in _ALL_UNITS:
            text, unit = match[1], match[2]
            break
    return _LEFT_OUT.sub("", text), unit


def _means(name: str, meaning: str) -> bool:
    if meaning == "ranges":
        return _RANGE.fullmatch(name) is not None
    return name in _SYNONYMS[meaning]


def _unclear(
    needed: Sequence[str],
    found: Mapping[str, Sequence[int]],
    units: Sequence[str],
    names: Sequence[str],
) -> str:
    """What is unclear of the columns that are needed; empty: nothing."""
    for name in needed:
        if len(found[name]) > 1:
            return f"more than one is {name}: {_told([names[k] for k in found[name]])}"
    for name in (*needed, "ranges"):
        for column in found.get(name, ()):
            if units[column] and units[column] not in _UNITS.get(name, set()):
                return f"{_told([names[column]])} is in another unit"
    return ""


def _told(names: Sequence[str]) -> str:
    """The names for a message: not more than it can have in one line."""
    shown = ["".join(c for c in name if c.isprintable())[:_LONGEST_TOLD] for name in names]
    return ", ".join(shown[:_MOST_TOLD]) + (", ..." if len(shown) > _MOST_TOLD else "")


def _ranges(found: Mapping[str, Sequence[int]], names: Sequence[str]) -> tuple[slice, str]:
    """The columns of ranges, and what is wrong with their names.

    Without names they are those behind the others, if these are the first. The last name may stand
    for all that follow.
    """
    told = len(names)
    while told and not names[told - 1].strip(" .…"):
        told -= 1  # "r0, r1, ..." has no name for the others
    columns = found.get("ranges", ())
    if not columns:
        others = sorted(column for own in found.values() for column in own)
        if others == [0, 1, 2]:
            return slice(3, None), ""
        return slice(0, 0), "none is ranges"
    first, last = columns[0], columns[-1]
    if last - first + 1 != len(columns):
        return slice(0, 0), "those of ranges are not in a row"
    if last == told - 1:
        return slice(first, None), ""
    if len(columns) == 1:
        return slice(0, 0), f"others follow {_told([names[first]])}"
    return slice(first, last + 1), ""
