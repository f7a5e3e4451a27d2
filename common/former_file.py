"""A file that is about to be written and is there already: it is kept under another name."""

import itertools
import logging
from pathlib import Path

logger = logging.getLogger(__name__)


def keep_former(file: Path) -> Path | None:
    """Rename a file that is not empty to the first free ``<stem>-<n><suffix>``.

    Returns:
        Its new name, None where there was nothing to keep.

    Raises:
        OSError: It can't be renamed.
    """
    if not file.is_file() or file.stat().st_size == 0:
        return None
    names = (file.with_name(f"{file.stem}-{n}{file.suffix}") for n in itertools.count(1))
    kept = next(name for name in names if not name.exists())
    file.rename(kept)
    logger.warning("%s was there already and is kept as %s", file, kept.name)
    return kept
