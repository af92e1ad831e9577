# ruff: noqa: RUF001 -- – is meant: people read it
"""The HTML that all report pages share: document, header, warnings, figures, tables, numbers."""

from collections.abc import Iterable, Sequence
from html import escape
from pathlib import PurePath

import numpy as np

from graphslam.results.live_figure import scripts
from graphslam.results.report_style import CSS

#: s; above it, time is in minutes
MINUTES_FROM_S = 900.0
#: columns; a table with more does not fit on a phone
WIDE = 4
#: warnings; a longer list is folded
_FOLDED = 8
_SPACE = "\u202f"  # narrow, no break: 13 631


def document(title: str, sections: Sequence[str], css: str = "") -> str:
    """A whole HTML document of the sections that are not empty; ``css`` over the style sheet."""
    body = "\n".join(part for part in sections if part)
    moving = scripts() if 'class="live"' in body else ""
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="color-scheme" content="light dark">\n'
        f"<title>{escape(title)} – graphslam</title>\n<style>{CSS}{css}</style>\n</head>\n"
        f"<body>\n<main>\n{body}\n</main>\n{moving}</body>\n</html>\n"
    )


def header(
    brand: str,
    title: str,
    lead: str,
    tiles: Iterable[tuple[str, str]] = (),
    notes: Iterable[str] = (),
) -> str:
    """The head of a page: title, a leading sentence, notes, and tiles (name, value)."""
    small = "".join(f"<p class=note>{escape(note)}</p>\n" for note in notes)
    shown = "".join(
        f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>" for name, value in tiles
    )
    return (
        f"<header><p class=brand>{escape(brand)}</p><h1>{escape(title)}</h1>\n"
        f"<p class=lead>{escape(lead)}</p>\n{small}"
        f"{f'<dl class=tiles>{shown}</dl>' if shown else ''}</header>"
    )


def warning_box(texts: Iterable[str]) -> str:
    """A box with warnings, a long list folded after the first ones; empty without any."""
    items = [f"<li>{escape(text)}</li>" for text in texts]
    if not items:
        return ""
    first, more = (
        (items, []) if len(items) <= _FOLDED else (items[: _FOLDED - 2], items[_FOLDED - 2 :])
    )
    folded = f"<details><summary>{len(more)} more</summary><ul>{''.join(more)}</ul></details>"
    return (
        f'<section class="warn"><h2>Warnings</h2><ul>{"".join(first)}</ul>'
        f"{folded if more else ''}</section>"
    )


def section(title: str, content: str) -> str:
    """HTML content under a heading; empty without content."""
    return f"<section><h2>{escape(title)}</h2>{content}</section>" if content else ""


def figure_grid(drawings: Sequence[str]) -> str:
    """Figures side by side where there is room."""
    return f'<div class="grid">{"".join(drawings)}</div>'


def figure(drawing: str, title: str, caption: str) -> str:
    """A drawing (SVG) with a caption that begins with its title."""
    caption = caption.replace(" %", f"{_SPACE}%")  # never at the begin of a line
    return (
        f"<figure><figcaption><b>{escape(title)}</b> {escape(caption)}</figcaption>\n"
        f"{drawing}</figure>"
    )


def details(summary: str, content: str) -> str:
    """HTML content that is folded under a line of text."""
    return f"<section><details><summary>{escape(summary)}</summary>{content}</details></section>"


def number(value: object, digits: int = 3) -> str:
    """A number for reading: integers in groups of three, others to ``digits`` significant ones."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int | np.integer):
        return f"{int(value):,}".replace(",", _SPACE)
    if isinstance(value, float | np.floating):
        return _decimal(float(value), digits)
    return "–" if value is None else escape(str(value))


def counted(count: int, noun: str) -> str:
    """A number of things: 1 scan, 13 631 scans."""
    return f"{number(count)} {noun}{'s' * (count != 1)}"


def length(value_m: float, digits: int = 2) -> str:
    """A length for reading, in centimetres below one metre."""
    if abs(value_m) < 0.9995:
        return f"{number(100 * value_m, digits)} cm"
    return f"{number(value_m, digits + 1)} m"


def duration(value_s: float) -> str:
    """A duration for reading, in minutes from a quarter of an hour on, as on the axes."""
    if value_s > MINUTES_FROM_S:
        return f"{number(value_s / 60)} min"
    return f"{number(value_s)} s"


def without_folders(text: str, paths: Iterable[str]) -> str:
    """A text with the names of files in place of their paths: a report tells of no machine."""
    for path in sorted(set(paths), key=len, reverse=True):
        text = text.replace(path, PurePath(path).name)
    return text


def _decimal(value: float, digits: int) -> str:
    if not np.isfinite(value):
        return "–"
    if 0 < abs(value) < 1e-4:
        return f"{value:.{digits - 1}e}"
    places = digits - 1 - int(np.floor(np.log10(abs(value)))) if value else 0
    return f"{value:,.{max(places, 0)}f}".replace(",", _SPACE)


def table(heads: Sequence[str], rows: Iterable[Sequence[object]], caption: str = "") -> str:
    """An HTML table; the first column is a heading, the rest is right-aligned.

    Cells that are numbers are formatted with `number`, texts are escaped.
    """
    top = "".join(f'<th scope="col">{escape(name)}</th>' for name in heads)
    # on a narrow page the rows of a wide table are folded, and every cell shows its head
    wide = len(heads) > WIDE
    labels = [f' data-label="{escape(name)}"' if wide else "" for name in heads]
    body = "".join(
        f'<tr><th scope="row">{number(first)}</th>'
        + "".join(
            f"<td{label}>{number(cell)}</td>" for cell, label in zip(rest, labels[1:], strict=True)
        )
        + "</tr>\n"
        for first, *rest in rows
    )
    title = f"<caption>{escape(caption)}</caption>" if caption else ""
    return (
        f'<div class="scroll"><table{" class=wide" * wide}>{title}<thead><tr>{top}</tr></thead>\n'
        f"<tbody>{body}</tbody></table></div>"
    )
