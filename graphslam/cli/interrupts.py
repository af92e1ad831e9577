"""Whether an error is Ctrl-C, whatever the interpreter or a library made of it."""

#: what a C extension (gtsam's, NumPy's) raises where a KeyboardInterrupt comes while it is imported
_OF_IMPORTS = (ImportError, SystemError)


def is_interrupt(error: BaseException) -> bool:
    """Whether ``error`` is a KeyboardInterrupt, or was raised from one in its place.

    What fails after Ctrl-C while a program cleans up stays what it is: it has the interrupt as its
    context, and not as its cause. Failed imports do not always state their cause.
    """
    found: BaseException | None = error
    looked_at: list[BaseException] = []
    # an error may be its own cause
    while not (found is None or found in looked_at or isinstance(found, KeyboardInterrupt)):
        looked_at.append(found)
        context = found.__context__ if isinstance(found, _OF_IMPORTS) else None
        found = found.__cause__ or context
    return isinstance(found, KeyboardInterrupt)
