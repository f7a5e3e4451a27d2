"""Parts of a map: frames and landmarks whose poses and positions fit together.

After tracking was lost for long a new part begins. Its place and scale in the world are guessed until it
meets an older one and becomes part of it; what is left apart at the end never met.
"""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from semcast.common.errors import SourceError
from semcast.common.run_folder import RunData

ALL = "all"
LARGEST = "largest"


def count_parts(parts: Iterable[int]) -> list[dict[str, int]]:
    """Return number and posed frames of each part, by number.

    Args:
        parts: The part of each posed frame.
    """
    counts = Counter(int(part) for part in parts)
    return [{"submap": part, "num_posed": counts[part]} for part in sorted(counts)]


def parts_line(parts: Sequence[Mapping[str, int]]) -> str | None:
    """Say of what parts a map is; None where it is of one piece.

    Args:
        parts: As ``count_parts`` gives them.
    """
    if len(parts) < 2:
        return None
    each = ", ".join(f"part {part['submap']}: {part['num_posed']} frames" for part in parts)
    return f"{len(parts)} ({each}); the place and scale of all but the first are guessed"


def after_gaps(posed_ids: Iterable[int], unposed_ids: Iterable[int]) -> frozenset[int]:
    """Return the posed frames before which others were tracked that have no pose: no line leads to them.

    Args:
        posed_ids: Frames that have a pose in the end.
        unposed_ids: Frames that had none when they were tracked.
    """
    posed = np.sort(np.fromiter(posed_ids, np.int64))
    unposed = np.setdiff1d(np.fromiter(unposed_ids, np.int64), posed)
    places = np.searchsorted(posed, unposed)
    return frozenset(posed[places[(places > 0) & (places < len(posed))]].tolist())


def select_part(data: RunData, part: str) -> RunData:
    """Return one part of a run, where it is in the world.

    Args:
        data: The run.
        part: The part's number, ``largest`` for the one with most posed frames, or ``all``.

    Raises:
        SourceError: The run has no such part.
        ValueError: ``part`` is neither a number nor one of the words.
    """
    if part == ALL:
        return data
    counts = count_parts(data.frame_submap.tolist())
    if part == LARGEST:
        # Of equal ones the first: its place is not guessed.
        number = max(counts, key=lambda c: c["num_posed"], default={"submap": 0})["submap"]
    elif part.isdecimal():
        number = int(part)
    else:
        raise ValueError(f"part must be a number, {LARGEST} or {ALL}, got {part!r}")
    known = [c["submap"] for c in counts]
    if counts and number not in known:
        raise SourceError(f"part must be one of {', '.join(map(str, known))}, got {number}")
    frames, landmarks = data.frame_submap == number, data.landmark_submap == number
    keyframe_ids = data.keyframe_ids[np.isin(data.keyframe_ids, data.frame_ids[frames])]
    observed = np.isin(data.observed_keyframe_ids, keyframe_ids) & np.isin(
        data.observed_landmark_ids, data.landmark_ids[landmarks]
    )
    return replace(
        data,
        frame_ids=data.frame_ids[frames],
        t_source_ns=data.t_source_ns[frames],
        T_world_cam=data.T_world_cam[frames],
        frame_submap=data.frame_submap[frames],
        keyframe_ids=keyframe_ids,
        landmark_ids=data.landmark_ids[landmarks],
        xyz=data.xyz[landmarks],
        rgb=data.rgb[landmarks],
        confidence=data.confidence[landmarks],
        landmark_submap=data.landmark_submap[landmarks],
        observed_landmark_ids=data.observed_landmark_ids[observed],
        observed_keyframe_ids=data.observed_keyframe_ids[observed],
        observed_xy=data.observed_xy[observed],
    )
