"""The commit that the running code is of, for what is to be repeated later: results and weights."""

import subprocess
from pathlib import Path

import semcast


def source_commit(file: Path = Path(__file__)) -> str:
    """Return the git commit the code comes from, with ``+changes`` when files differ from it.

    An installed copy gives ``semcast <version>``, also one in an environment inside somebody's checkout.

    Args:
        file: One of the code's own.
    """
    version = f"semcast {semcast.__version__}"

    def git(*words: str) -> str:
        done = subprocess.run(
            ["git", "-C", str(file.resolve().parent), *words],
            capture_output=True,
            text=True,
            timeout=10,
            check=True,
        )
        return done.stdout.strip()

    try:
        if git("ls-files", "--", file.name) == "":
            return version
        changed = git("status", "--porcelain", "--untracked-files=no")
        return git("rev-parse", "HEAD") + ("+changes" if changed else "")
    except (OSError, subprocess.SubprocessError):
        return version
