"""A limit on the memory of this process, so that a log cannot take that of the whole machine."""

import errno
import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from graphslam.core.errors import LogError


@contextmanager
def limited_memory(memory_mb: float, needed: str = "") -> Iterator[None]:
    """Give the process, and each that it forks, at most ``memory_mb`` of data; inf: no limit.

    A limit within another one does not raise it. ``needed``: what to say if it is not enough.

    Raises:
        LogError: the block needs more.
    """
    if math.isinf(memory_mb) or sys.platform == "win32":
        yield
        return
    import resource  # noqa: PLC0415 (not on Windows)

    before = resource.getrlimit(resource.RLIMIT_DATA)
    most = min(sys.maxsize if limit == resource.RLIM_INFINITY else limit for limit in before)
    resource.setrlimit(resource.RLIMIT_DATA, (min(round(memory_mb * 1e6), most), before[1]))
    try:
        yield
    except (MemoryError, OSError) as error:
        # a call to the system that finds no memory
        if isinstance(error, OSError) and error.errno != errno.ENOMEM:
            raise
        raise LogError(
            needed
            or f"the run needs more memory than limits.memory_mb ({memory_mb:g}) allows; raise it, "
            "or cut the log into pieces"
        ) from error
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, before)
