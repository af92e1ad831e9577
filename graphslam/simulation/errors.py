"""Errors of scenarios."""

from graphslam.core.errors import GraphSlamError


class ScenarioError(GraphSlamError):
    """A scenario is unreadable or infeasible; the message names file and key or position."""
