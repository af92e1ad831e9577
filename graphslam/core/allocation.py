"""Memory that a process frees, kept for what it needs next, and the most that it ever had."""

import ctypes
import resource
import sys
from collections.abc import Callable

#: parameters of `mallopt`, from malloc.h
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
#: bytes at the end of the heap that are kept; the largest block that comes from the heap (the most
#: that `mallopt` takes)
KEPT, LARGEST = 1 << 30, 1 << 25


def keep_freed_memory() -> None:
    """Let the C library keep freed memory, where it can be told to: glibc.

    By default every array of more than 128 kB, at first, is a mapping of its own, and the end of
    the heap goes back to the system as soon as it is free. A run frees and takes millions of bytes
    again and again, and the system clears each page anew: a twentieth of the time of a run of
    seconds (ACES). Its peak memory stays the same.
    """
    mallopt = _of_glibc("mallopt")
    if mallopt is not None:
        mallopt(_TRIM_THRESHOLD, KEPT)
        mallopt(_MMAP_THRESHOLD, LARGEST)


def give_back_freed_memory(beyond_mb: float = 0.0) -> None:
    """Give the system what is kept: whoever begins something else should not count it as its own.

    Tasks of a campaign follow each other in one process, and each reports its peak memory. Within a
    task it is worth its time (pages are cleared anew) where the process is large, so that the next
    part does not come on top of what lies free in small pieces.

    Args:
        beyond_mb: the peak memory so far from which on this is done.
    """
    if peak_memory_mb() < beyond_mb:
        return
    trim = _of_glibc("malloc_trim")
    if trim is not None:
        trim(0)


def peak_memory_mb() -> float:
    """Largest resident size of this process; macOS counts bytes, Linux kilobytes."""
    peak = float(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
    return peak / 1e6 if sys.platform == "darwin" else peak / 1e3


def _of_glibc(name: str) -> Callable[..., int] | None:
    """A function of the C library; None where it is another one."""
    if sys.platform != "linux":
        return None
    found: Callable[..., int] | None = getattr(ctypes.CDLL(None), name, None)
    return found
