"""SVG elements: lines, areas, texts and pictures in the colours of the page.

User units are tenths of a point, so that all coordinates are integers: the text is short and
repeatable. Colours are those of the light page; `THEMED` maps them to the page's CSS variables.
"""

import base64
import struct
import zlib
from collections.abc import Sequence
from html import escape
from typing import Any, NamedTuple

import numpy as np

from graphslam.core.geometry import Array

Levels = np.ndarray[Any, np.dtype[np.uint8]]

#: user units in a point
UNIT = 10
INK = "#1b1f24"
FAINT = "#d5d9de"
ACCENT = "#c8601a"
#: One colour a robot, told apart with any colour vision: P. Tol, Colour schemes, SRON/EPS/TN/09-002
PALETTE = ("#4477aa", "#ee6677", "#228833", "#aa3377", "#ccbb44", "#66ccee")
#: dashes of paths, in widths, by how often the colours were all taken before
DASHES = ((), (4, 2), (1, 1.5), (5, 1.5, 1, 1.5), (10, 2.5), (6, 1.5, 1, 1.5, 1, 1.5))
#: colour of the light page -> what follows the page
THEMED = {INK: "currentColor", FAINT: "var(--grid)", ACCENT: "var(--accent)"} | {
    color: f"var(--robot{i})" for i, color in enumerate(PALETTE)
}
#: curves are thinned out in columns and along their length by this, user units: half a pixel
_FINE = 4
#: highest opacity of a picture; few levels make it small
OPAQUE = 15


class Style(NamedTuple):
    """Stroke of a curve: widths and dashes in points."""

    color: str
    width: float = 1.2
    opacity: float = 1.0
    dashes: tuple[float, ...] = ()


class Shade(NamedTuple):
    """A picture in one colour: opacity ``levels`` (rows, columns) from 0 to `OPAQUE`."""

    levels: Levels
    color: str


class Box(NamedTuple):
    """Edges of axes in a drawing, user units; y grows downwards."""

    left: float
    top: float
    right: float
    bottom: float


def robot_color(index: int) -> str:
    """Colour of the robot with this number in alphabetical order."""
    return PALETTE[index % len(PALETTE)]


def robot_dashes(index: int) -> tuple[float, ...]:
    """Dashes of this robot's path: with its colour they tell it from all of three dozen robots."""
    return DASHES[index // len(PALETTE) % len(DASHES)]


def svg_element(
    label: str, width_pt: float, height_pt: float, content: Sequence[str], above_pt: float = 0.0
) -> str:
    """An inline <svg> of the page's colours and font, described for screen readers.

    ``above_pt``: room above the origin, for legends of several rows.
    """
    top = max(0, round(above_pt * UNIT))
    return (
        f'<svg role="img" aria-label="{escape(label)}" '
        f'viewBox="0 {-top} {width_pt * UNIT:.0f} {height_pt * UNIT + top:.0f}" '
        'font-family="system-ui, sans-serif" fill="currentColor">\n'
        + "\n".join(content)
        + "\n</svg>"
    )


def path_data(places: Array) -> str:
    """SVG path through places (n, 2), user units; NaN leave gaps."""
    whole = np.isfinite(places).all(axis=1)
    runs = np.flatnonzero(np.diff(np.concatenate([[False], whole, [False]]).astype(np.int8)))
    parts = []
    for begin, end in runs.reshape(-1, 2).tolist():
        points = _thinned(np.rint(places[begin:end]).astype(np.int64))
        # steps are shorter to write than places
        x, y, *steps = np.diff(points, axis=0, prepend=0).ravel().tolist()
        parts.append(f"M{x} {y}l" + " ".join(map(str, steps)) if steps else f"M{x} {y}h0")
    return "".join(parts)


def _thinned(points: Array) -> Array:
    """The points (n, 2) of a curve that are seen.

    Of neighbours in one column the ends and the extremes, and of what is left one in each piece of
    the curve's length.
    """
    if len(points) <= 4:
        return points
    column = points[:, 0] // _FINE
    first = np.flatnonzero(np.diff(column, prepend=column[0] - 1))
    owner = np.repeat(np.arange(len(first)), np.diff(first, append=len(points)))
    order = np.lexsort((points[:, 1], owner))  # by column, then by height
    last = np.append(first[1:], len(points)) - 1
    seen = np.zeros(len(points), dtype=np.bool_)
    seen[first] = seen[last] = seen[order[first]] = seen[order[last]] = True
    points = points[seen]
    piece = np.cumsum(np.hypot(*np.diff(points, axis=0, prepend=points[:1]).T)) // _FINE
    kept = np.diff(piece, prepend=-1) > 0
    kept[-1] = True
    return np.asarray(points[kept])


def _paint(color: str) -> str:
    return THEMED.get(color, color)


def stroked(path: str, style: Style) -> str:
    """A path as a line."""
    more = f";stroke-opacity:{style.opacity:g}" if style.opacity < 1 else ""
    if style.dashes:
        more += ";stroke-dasharray:" + " ".join(
            f"{UNIT * style.width * dash:.0f}" for dash in style.dashes
        )
    line = f"stroke:{_paint(style.color)};stroke-width:{UNIT * style.width:g}{more}"
    return f'<path d="{path}" style="fill:none;{line}"/>'


def filled(path: str, color: str, opacity: float) -> str:
    """A path as an area."""
    return f'<path d="{path}" style="fill:{_paint(color)};fill-opacity:{opacity:g}"/>'


def words(
    text: str, x: float, y: float, size: float, anchor: str = "start", *, halo: bool = False,
    upright: bool = False,
) -> str:  # fmt: skip
    """A line of text; ``upright``: turned by 90 degrees, counter-clockwise."""
    turn = f' transform="rotate(-90 {x:.0f} {y:.0f})"' if upright else ""
    halo_class = ' class="halo"' if halo else ""
    anchored = f' text-anchor="{anchor}"' if anchor != "start" else ""
    return (
        f'<text x="{x:.0f}" y="{y:.0f}" font-size="{size * UNIT:g}"{anchored}{halo_class}{turn}>'
        f"{escape(text)}</text>"
    )


def picture(shade: Shade, box: Box) -> str:
    """An image element; its first row is at the top."""
    data = base64.b64encode(png(shade)).decode()
    return (
        f'<image x="{box.left:.0f}" y="{box.top:.0f}" width="{box.right - box.left:.0f}" '
        f'height="{box.bottom - box.top:.0f}" preserveAspectRatio="none" '
        f'href="data:image/png;base64,{data}"/>'
    )


def png(shade: Shade) -> bytes:
    """A PNG file of four bits a pixel, whose palette is one colour in 16 opacities.

    Source: W3C, Portable Network Graphics Specification, third edition, sections 5, 7 and 11.
    """

    def chunk(kind: bytes, data: bytes) -> bytes:
        check = zlib.crc32(kind + data)
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", check)

    rows, columns = shade.levels.shape
    # depth 4, palette; every row begins with its filter, 0 for none; two pixels a byte
    head = struct.pack(">IIBBBBB", columns, rows, 4, 3, 0, 0, 0)
    even = np.zeros((rows, columns + columns % 2), dtype=np.uint8)
    even[:, :columns] = shade.levels
    lines = np.zeros((rows, 1 + even.shape[1] // 2), dtype=np.uint8)
    lines[:, 1:] = even[:, ::2] << 4 | even[:, 1::2]
    color = bytes.fromhex(shade.color[1:]) * (OPAQUE + 1)
    opacity = bytes(255 * level // OPAQUE for level in range(OPAQUE + 1))
    parts = ((b"IHDR", head), (b"PLTE", color), (b"tRNS", opacity))
    body = (b"IDAT", zlib.compress(lines.tobytes())), (b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*part) for part in (*parts, *body))


def opacity_levels(alpha: Array) -> Levels:
    """Levels (n,) or (rows, columns) of opacities from 0 to 1."""
    return np.round(alpha * OPAQUE).astype(np.uint8)
