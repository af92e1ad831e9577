"""Whether an error is Ctrl-C, whatever the interpreter or a library made of it."""

#: what a C extension (gtsam's, NumPy's) raises where a KeyboardInterrupt comes while it is imported
_OF_IMPORTS = (ImportError, SystemError)


def is_interrupt(error: BaseException) -> bool:
    """Whether ``error`` is a KeyboardInterrupt, or was raised from one in its place.

    What fails after Ctrl-C while a program cleans up stays what it is: it has the interrupt as its
    context, and not as its cause. Failed imports do not always state their cause.
    """
    found: BaseException | None = error
    while found is not None and not isinstance(found, KeyboardInterrupt):
        context = found.__context__ if isinstance(found, _OF_IMPORTS) else None
        found = found.__cause__ or context
    return found is not None
