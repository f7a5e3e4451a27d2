"""Reads back the figures a run wrote when it ended."""

import json
from pathlib import Path
from typing import Any

from semcast.common.errors import SourceError
from semcast.common.run_folder import SUMMARY_NAME


def read_summary(folder: Path) -> dict[str, Any]:
    """Return ``summary.json`` of a run folder; empty where the run did not end.

    Raises:
        SourceError: The file is damaged or can't be read.
    """
    path = folder / SUMMARY_NAME
    if not path.is_file():
        return {}
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except OSError as err:
        raise SourceError(f"{path} can't be read: {err}") from err
    except ValueError as err:
        raise SourceError(f"{path} is damaged: {err}") from err
    if not isinstance(value, dict):
        raise SourceError(f"{path} must hold an object, got {type(value).__name__}")
    return value
