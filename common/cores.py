"""The processor cores this process may use, and the threads it may be told to begin."""

import os
from pathlib import Path

#: Where Linux mounts control groups; a container sees its own here.
_CGROUP = Path("/sys/fs/cgroup")
#: More than any machine has cores for; tens of thousands end the process without a word.
MAX_THREADS = 1024


def check_threads(num_threads: int) -> None:
    """Check that so many threads can be begun.

    Raises:
        ValueError: They can't.
    """
    if not 1 <= num_threads <= MAX_THREADS:
        raise ValueError(f"threads must be in [1, {MAX_THREADS}], got {num_threads}")


def usable_cores(cgroup: Path = _CGROUP) -> int:
    """Return how many cores this process may keep busy, which can be fewer than the machine has.

    Counted are those it may run on, and no more than the time a container was given (``docker run --cpus``)
    fills.

    Args:
        cgroup: Folder of the control group.
    """
    own = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    quota = _quota(cgroup)
    return own if quota is None else max(1, min(own, int(quota)))


def _quota(cgroup: Path) -> float | None:
    """Return the processor time of a control group, in cores; None where it is not limited."""
    try:
        if (cgroup / "cpu.max").exists():  # version 2: "max 100000" or "150000 100000"
            quota, period = (cgroup / "cpu.max").read_text().split()
        else:
            quota, period = ((cgroup / f"cpu/cpu.cfs_{name}_us").read_text() for name in ("quota", "period"))
        cores = float(quota) / float(period)
    except (OSError, ValueError, ZeroDivisionError):
        return None
    return cores if cores > 0.0 else None
