"""What was probably meant by a name that is not known."""

from collections.abc import Iterable


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """``; did you mean X?`` to be added to an error, or nothing where no name is close."""
    import difflib  # noqa: PLC0415 -- only where something is wrong

    close = difflib.get_close_matches(name, list(known), n=1)
    return f"; did you mean {close[0]}?" if close else ""
