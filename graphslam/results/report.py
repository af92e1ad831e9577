"""One HTML file that shows a result, readable offline, on a phone, in light and in dark.

`report_page` has the order and the words, `report_maps` and `report_plots` draw, `report_tables`
has the numbers, `report_figure` and `drawing` turn drawings into SVG in the colours of the page.
"""

from collections.abc import Mapping
from typing import Any

from graphslam.core.records import Result
from graphslam.results.report_page import page


def render(
    result: Result,
    evaluation: Mapping[str, Any] | None = None,
) -> str:
    """The report as one self-contained HTML document; the same input gives the same text.

    Args:
        result: what `smooth` returned; its configuration is printed in full.
        evaluation: its errors against the truth, from `graphslam.evaluation.metrics.evaluate`;
            adds a section.
    """
    return page(result, evaluation)
