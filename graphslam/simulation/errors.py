"""What is wrong with a scenario."""

from graphslam.core.errors import GraphSlamError


class ScenarioError(GraphSlamError):
    """A scenario cannot be read or cannot take place; the message names file and key or place."""
