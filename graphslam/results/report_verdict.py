"""The verdict on a result as a section of its report."""

from collections.abc import Mapping
from html import escape
from typing import Any

from graphslam.results import report_html as html


def verdict_section(summary: Mapping[str, Any]) -> str:
    """Verdict and reasons; empty for results of versions that had none."""
    found = summary.get("verdict")
    if not found:
        return ""
    if not found["reasons"]:
        text = "<p>good: nothing that was looked at contradicts the result.</p>"
        return html.section("Verdict", text)
    paths = [log["path"] for log in summary.get("logs", [])]
    items = "".join(
        f"<li>{escape(one['level'])}: {escape(html.without_folders(one['text'], paths))}</li>"
        for one in found["reasons"]
    )
    return (
        f'<section class="warn"><h2>Verdict: {escape(found["verdict"])}</h2>'
        f"<ul>{items}</ul></section>"
    )
