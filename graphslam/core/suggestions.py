"""What to type instead: a name that is not known, an option with its value."""

from collections.abc import Iterable
from shlex import quote


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """``; did you mean X?`` to be added to an error, or nothing where no name is close."""
    import difflib  # noqa: PLC0415 -- only where something is wrong

    close = difflib.get_close_matches(name, list(known), n=1)
    return f"; did you mean {close[0]}?" if close else ""


def start_option(robot: str) -> str:
    """The option that says where ``robot`` starts, as a shell takes it: names may have blanks."""
    return f"--start {quote(f'{robot}=x,y,phi')}"
