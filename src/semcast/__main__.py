"""The command ``semcast``, also as ``python -m semcast``: Ctrl-C leaves no traceback while it is imported."""

import sys


def main() -> int:
    """Run the command line and return its exit code: 130 where Ctrl-C ends it, be it as early as here."""
    try:
        from semcast.cli import main as run  # takes longer than all that is before it

        return run()
    except KeyboardInterrupt:
        return 130


if __name__ == "__main__":
    sys.exit(main())
