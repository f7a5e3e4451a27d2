"""A gap in the stream: some seconds in which nothing arrives, and how soon the camera is located again."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semcast.common.errors import ConfigError

#: Share of the recording at either end in which no gap begins or ends: before and after it a map is needed.
_MARGIN_SHARE = 0.2


@dataclass(frozen=True)
class Gap:
    """Frames that did not arrive.

    Attributes:
        first_id: The first of them.
        last_id: The last.
    """

    first_id: int
    last_id: int


def gap_in(frame_ids: Sequence[int], times_ns: NDArray[np.int64], gap_s: float, seed: int) -> Gap:
    """Choose where a gap is, anywhere but in the first and the last fifth.

    Args:
        frame_ids: Frames that are sent, increasing.
        times_ns: Time of every frame of the recording.
        gap_s: Length in seconds.
        seed: Another one, another place.

    Raises:
        ConfigError: There is no room for the gap, or no frame in it.
    """
    t_s = (times_ns[np.asarray(frame_ids)] - times_ns[frame_ids[0]]) * 1e-9
    margin_s = _MARGIN_SHARE * t_s[-1]
    latest_s = t_s[-1] - margin_s - gap_s
    if latest_s < margin_s:
        raise ConfigError(
            f"gap_s must be at most {t_s[-1] - 2 * margin_s:.3g} in {t_s[-1]:.3g} s of frames, got {gap_s:g}"
        )
    begin_s = np.random.default_rng(seed).uniform(margin_s, latest_s)
    inside = np.flatnonzero((t_s >= begin_s) & (t_s < begin_s + gap_s))
    if len(inside) == 0:
        raise ConfigError(f"gap_s must be longer than frames are apart, got {gap_s:g}")
    return Gap(frame_ids[inside[0]], frame_ids[inside[-1]])


def outside(frame_ids: Iterable[int], gap: Gap) -> list[int]:
    """Return the frames that arrive."""
    return [frame_id for frame_id in frame_ids if not gap.first_id <= frame_id <= gap.last_id]


def recovery_s(rows: Iterable[Mapping[str, Any]], gap: Gap) -> float | None:
    """Return the time from the first frame after a gap to the first that has a pose at once.

    Args:
        rows: One per frame that arrived, as ``ReconstructedRun.rows``.
        gap: The gap.

    Returns:
        Seconds of the recording, None if no frame has.
    """
    after = [row for row in rows if row["frame_id"] > gap.last_id]
    posed_ns = next((row["t_source_ns"] for row in after if row["posed"]), None)
    return None if posed_ns is None else float((posed_ns - after[0]["t_source_ns"]) * 1e-9)
