"""Memory that a process frees, kept for what it needs next."""

import ctypes
import sys

#: parameters of `mallopt`, from malloc.h
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
#: bytes at the end of the heap that are kept; the largest block that comes from the heap (the most
#: that `mallopt` takes)
KEPT, LARGEST = 1 << 30, 1 << 25


def keep_freed_memory() -> None:
    """Let the C library keep freed memory, where it can be told to: glibc.

    By default every array of more than 128 kB, at first, is a mapping of its own, and the end of
    the heap goes back to the system as soon as it is free. A run frees and takes millions of bytes
    again and again, and the system clears each page anew: a tenth of the CPU time of a run of
    seconds. Its most memory stays the same.
    """
    if sys.platform == "linux":
        mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
        if mallopt is not None:
            mallopt(_TRIM_THRESHOLD, KEPT)
            mallopt(_MMAP_THRESHOLD, LARGEST)
