"""One HTML file that shows a result, readable offline, on a phone, in light and in dark.

`page` says what comes in which order, `maps` and `plots` draw, `tables` count, `figure` turns
drawings into SVG that follows the page's colours. Importing this package does not import
matplotlib: the modules that need it are imported when a report is asked for.
"""

from collections.abc import Mapping
from typing import Any

from graphslam.core.config import Config
from graphslam.core.records import Result


def render(
    result: Result,
    evaluation: Mapping[str, Any] | None = None,
    config: Config | None = None,
) -> str:
    """The report as one self-contained HTML document; the same input gives the same text.

    Args:
        result: what `smooth` found.
        evaluation: what `graphslam.evaluation.metrics.evaluate` says about it; adds a section.
        config: the effective configuration; printed in full so that the run can be repeated.
    """
    # matplotlib takes half a second to import, and most commands draw nothing
    from graphslam.results.report_page import page  # noqa: PLC0415

    return page(result, evaluation, config)
