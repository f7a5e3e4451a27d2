"""The command ``semcast``, also as ``python -m semcast``: Ctrl-C leaves no traceback while it is imported."""

import sys

from semcast.common.leaving import leave_busy_threads


def main() -> int:
    """Run the command line and return its exit code: 130 where Ctrl-C ends it, be it as early as here."""
    note = leave_busy_threads()
    try:
        from semcast.cli import main as run  # takes longer than all that is before it

        return note(run())
    except KeyboardInterrupt:
        return note(130)


if __name__ == "__main__":
    sys.exit(main())
