# ruff: noqa: RUF001 -- – is meant: people read it
"""The verdict on a result as a section of its report."""

from collections.abc import Mapping
from html import escape
from typing import Any

from graphslam.results import report_html as html


def verdict_section(summary: Mapping[str, Any]) -> str:
    """Verdict, reasons and facts; empty for results of versions that had none."""
    found = summary.get("verdict")
    if not found:
        return ""
    facts = "".join(f"<li>note: {escape(one['text'])}</li>" for one in found.get("facts", ()))
    if not found["reasons"]:
        text = "nothing that was looked at contradicts the result."
        notes = f"<ul>{facts}</ul>" if facts else ""
        return f'<section class="warn good"><p><b>Verdict: good</b> – {text}</p>{notes}</section>'
    paths = [log["path"] for log in summary.get("logs", [])]
    items = "".join(
        f"<li>{escape(one['level'])}: {escape(html.without_folders(one['text'], paths))}</li>"
        for one in found["reasons"]
    )
    verdict = escape(found["verdict"])
    head = f"<h2>Verdict: {verdict}</h2>"
    return f'<section class="warn {verdict}">{head}<ul>{items}{facts}</ul></section>'
