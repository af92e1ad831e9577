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


def described(error: BaseException, of_memory: str = "there is not enough memory") -> str:
    """An error of any kind as one line that says what and where; ``of_memory`` where that is out.

    What nobody raised on purpose is told to be a defect.
    """
    if isinstance(error, GraphSlamError):
        return str(error)
    if isinstance(error, MemoryError):
        return of_memory
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename or 'the system'}: {error.strerror}"
    text = " ".join(str(error).splitlines())
    return f"unexpected {type(error).__name__}: {text}; this is a defect of graphslam"
