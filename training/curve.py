"""The curve of a run: one line of JSON for each report and validation."""

import json
import math
from pathlib import Path
from typing import Any

import torch

from semcast.common.image import psnr_of_mse
from semcast.common.whole_file import write_whole

CURVE_NAME = "log.jsonl"


def append_row(path: Path, row: dict[str, Any]) -> None:
    """Add a row, ``step`` among its values; the folder is made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(row) + "\n")


def append_validation(path: Path, step: int, elapsed_s: float, valid: dict[str, float]) -> None:
    """Add the validation of a step, in place of an earlier one of the same step.

    A run that has ended, and is run again, is validated again.
    """
    if path.is_file():
        lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
        kept = [line for line in lines if not (_step_of(line) == step and "valid" in json.loads(line))]
        if len(kept) < len(lines):
            write_whole(path, "".join(kept))
    append_row(path, {"step": step, "elapsed_s": round(elapsed_s, 1), "valid": valid})


def cut_to_step(path: Path, step: int) -> None:
    """Leave out what a run reported after the step it goes on from, and a line it was killed in.

    A run that is killed has reported steps which its checkpoint doesn't hold; they are made again.
    """
    if not path.is_file():
        return
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    kept = [line for line in lines if line.endswith("\n") and _step_of(line) <= step]
    if len(kept) < len(lines):
        write_whole(path, "".join(kept))


def _step_of(line: str) -> float:
    """Return the step of a row, infinity of what is none: another row may have been added to a cut one."""
    try:
        return float(json.loads(line)["step"])
    except ValueError:
        return math.inf


def mean_of(rows: list[dict[str, torch.Tensor]]) -> dict[str, float]:
    """Return the mean of each value over the steps that have it, and the PSNR of the mean squared error."""
    names = {name for row in rows for name in row}
    means = {
        n: float(torch.stack([row[n].float() for row in rows if n in row]).mean()) for n in sorted(names)
    }
    means["psnr_db"] = psnr_of_mse(means["mse"])
    return means
