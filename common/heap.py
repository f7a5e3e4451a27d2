"""Memory that a process frees and needs again for its next frame stays its own."""

import ctypes
import sys

#: Parameters of ``mallopt(3)``.
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8
#: Free memory at the end of the heap that is kept, in bytes: more than one frame takes.
_KEPT_BYTES = 512 << 20
#: Smaller blocks come from the heap; glibc allows no more than this.
_LARGEST_BYTES = 32 << 20


def keep_freed_memory() -> bool:
    """Keep what is freed for the next frame, instead of giving it back to the system.

    Arrays of one frame are freed when it is done, and glibc gives their memory back at once. The system then
    has to clear pages for the next frame: thousands of page faults for each one that is decoded, and for each
    adjustment, where they are a quarter of its time. All threads share one heap, so that not each of them
    keeps memory of its own.

    Returns:
        False where another C library than glibc manages memory, and nothing is changed.
    """
    if not sys.platform.startswith("linux"):
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:  # musl
        return False
    wanted = ((_M_MMAP_THRESHOLD, _LARGEST_BYTES), (_M_TRIM_THRESHOLD, _KEPT_BYTES), (_M_ARENA_MAX, 1))
    accepted = [mallopt(parameter, value) for parameter, value in wanted]
    return all(accepted)
