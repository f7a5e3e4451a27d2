"""SNR over time: constant, ramp, random walk or a recorded CSV file. Time starts at a trace's first frame.

Every trace is a plain function of time, so a lost frame doesn't move what later frames see.
"""

import csv
import itertools
from pathlib import Path
from typing import Protocol

import numpy as np

from semcast.common.errors import ConfigError

SNR_RANGE_DB = (-5.0, 30.0)
#: A random walk takes one step per this many seconds and is linear between steps.
WALK_INTERVAL_S = 0.5
#: A walk longer than this repeats its last value (4.5 hours).
_MAX_WALK_STEPS = 1 << 15
#: Largest file of a trace: half a million lines.
_MAX_BYTES = 16 << 20


class SnrTrace(Protocol):
    """SNR as a function of time."""

    def snr_db(self, elapsed_s: float) -> float:
        """Return the SNR ``elapsed_s`` seconds after the first frame; earlier times give the first value."""


class ConstantTrace:
    """The same SNR for ever."""

    def __init__(self, snr_db: float) -> None:
        self._snr_db = snr_db

    def snr_db(self, elapsed_s: float) -> float:
        """Return the constant."""
        del elapsed_s
        return self._snr_db


class TableTrace:
    """Linear between given points, constant before the first and after the last."""

    def __init__(self, times_s: list[float], values_db: list[float]) -> None:
        if len(times_s) != len(values_db) or not times_s:
            raise ValueError(
                f"a trace needs as many times as values, got {len(times_s)} and {len(values_db)}"
            )
        if any(b <= a for a, b in itertools.pairwise(times_s)):
            raise ValueError("the times of a trace must increase")
        self._times_s = np.asarray(times_s, dtype=np.float64)
        self._values_db = np.asarray(values_db, dtype=np.float64)

    def snr_db(self, elapsed_s: float) -> float:
        """Interpolate the table."""
        return float(np.interp(elapsed_s, self._times_s, self._values_db))


def ramp(start_db: float, end_db: float, duration_s: float) -> TableTrace:
    """Return a trace that goes from start to end in ``duration_s`` and stays there."""
    return TableTrace([0.0, duration_s], [start_db, end_db])


class RandomWalkTrace:
    """Gaussian steps every ``WALK_INTERVAL_S``, reflected at the SNR range."""

    def __init__(self, start_db: float, step_db: float, seed: int) -> None:
        self._knots_db = [start_db]
        self._step_db = step_db
        self._rng = np.random.default_rng((seed, 0x57A1))

    def _extend(self, num: int) -> None:
        low, high = SNR_RANGE_DB
        while len(self._knots_db) < num:
            value = self._knots_db[-1] + self._step_db * float(self._rng.standard_normal())
            # A step is far smaller than the range; the clip catches the rest.
            value = 2.0 * low - value if value < low else 2.0 * high - value if value > high else value
            self._knots_db.append(min(max(value, low), high))

    def snr_db(self, elapsed_s: float) -> float:
        """Interpolate between steps; the walk depends on the seed and not on when it is asked."""
        position = min(max(elapsed_s, 0.0) / WALK_INTERVAL_S, _MAX_WALK_STEPS - 2.0)
        k = int(position)
        self._extend(k + 2)
        part = position - k
        return (1.0 - part) * self._knots_db[k] + part * self._knots_db[k + 1]


class FileTrace(TableTrace):
    """A recorded link: SNR and the share of slots that get lost, each linear between the rows of a file.

    Its first row is the first frame's: what clock the recording had makes no difference.
    """

    def __init__(self, times_s: list[float], values_db: list[float], slot_loss: list[float]) -> None:
        super().__init__([t_s - times_s[0] for t_s in times_s], values_db)
        self._slot_loss = np.asarray(slot_loss, dtype=np.float64)

    def slot_loss(self, elapsed_s: float) -> float:
        """Return the share of slots lost, in [0, 1]."""
        return float(np.interp(elapsed_s, self._times_s, self._slot_loss))


def _numbers(row: dict[str, str], names: tuple[str, ...], where: str) -> list[float]:
    try:
        return [float(row[name]) for name in names]
    except (TypeError, ValueError) as err:
        got = ", ".join(repr(row[name]) for name in names)
        raise ConfigError(f"{where}: {' and '.join(names)} must be numbers, got {got}") from err


def read_trace_csv(path: Path | str) -> FileTrace:
    """Read a trace with the columns ``t_s,snr_db`` and perhaps ``slot_loss``, named in a header line.

    Lines that begin with ``#`` are comments.

    Raises:
        ConfigError: The file can't be read, a column is missing, a value is no number or out of range, times
            don't increase or there is no row. The message names the line.
    """
    path = Path(path)
    times_s: list[float] = []
    values_db: list[float] = []
    losses: list[float] = []
    low, high = SNR_RANGE_DB
    try:
        if path.exists() and not path.is_file():  # reading a pipe or device might never end
            raise ConfigError(f"{path} must be a file with an SNR trace, got something else")
        if path.stat().st_size > _MAX_BYTES:
            raise ConfigError(f"{path} must be an SNR trace of at most {_MAX_BYTES >> 20} MB, got more")
        with path.open(newline="", encoding="utf-8-sig") as file:
            lines = {k: line for k, line in enumerate(file, start=1) if not line.lstrip().startswith("#")}
            rows, numbers = csv.DictReader(lines.values()), list(lines)
            names = [name.strip() for name in rows.fieldnames or []]
            rows.fieldnames = names
            if not {"t_s", "snr_db"} <= set(names):
                # Not what it has instead: the message may go to another machine, the file be any file.
                raise ConfigError(f"{path} must name the columns t_s,snr_db in its first line")
            columns = ("t_s", "snr_db", *(["slot_loss"] if "slot_loss" in names else []))
            for row in rows:
                where = f"{path} line {numbers[rows.line_num - 1]}"
                t_s, value_db, *loss = _numbers(row, columns, where)
                if not low <= value_db <= high:
                    raise ConfigError(f"{where}: snr_db must be in [{low:g}, {high:g}], got {value_db:g}")
                if not all(0.0 <= share <= 1.0 for share in loss):
                    raise ConfigError(f"{where}: slot_loss must be in [0, 1], got {loss[0]:g}")
                if not np.isfinite(t_s) or (times_s and t_s <= times_s[-1]):
                    raise ConfigError(f"{where}: t_s must increase, got {t_s:g}")
                times_s.append(t_s)
                values_db.append(value_db)
                losses.append(loss[0] if loss else 0.0)
    except (OSError, UnicodeDecodeError, csv.Error) as err:
        raise ConfigError(f"{path} can't be read as an SNR trace: {err}") from err
    if not times_s:
        raise ConfigError(f"{path} holds no rows")
    return FileTrace(times_s, values_db, losses)
