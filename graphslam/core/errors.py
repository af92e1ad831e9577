"""The errors that a user sees: one line each, saying what, where, and what to do."""


class GraphSlamError(Exception):
    """Base of every error that this package raises on purpose.

    Its text is one line also if a name in it, of a file, a topic or a key, is of several.
    """

    def __str__(self) -> str:
        return " ".join(super().__str__().splitlines())


class LogError(GraphSlamError):
    """A log cannot be read or holds nothing usable; the message names file, topic and time."""


class ConfigError(GraphSlamError):
    """A setting is unknown, of the wrong type or out of range; the message names its key."""


class EstimationError(GraphSlamError):
    """The estimate is indeterminate or diverged; the message names robot, landmark and time."""


class OutputError(GraphSlamError):
    """A result cannot be written or read; the message names the path."""
