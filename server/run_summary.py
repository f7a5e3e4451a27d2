"""The figures of a run, made of its rows and its path, and what they come to in words."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from semcast.common.metrics import drops_in_words, duration_percentiles
from semcast.common.trajectory import Trajectory
from semcast.common.trajectory_error import trajectory_summary
from semcast.server.export.parts import count_parts
from semcast.server.frame_rows import FrameRow
from semcast.server.sent_frames import Stretch, unposed_ranges

#: Share of the frames beyond which those that were skipped are what is wrong with a run.
_MOST = 0.5


def summarise(
    rows: list[FrameRow],
    trajectory: Trajectory,
    part_of: Mapping[int, int],
    truth: Trajectory | None,
    sent: Sequence[Stretch],
    num_frames: int | None,
    drops: Mapping[str, int],
    num_keyframes: int,
) -> dict[str, Any]:
    """Return the figures of a run; None where one has no meaning.

    ``frame_rate_hz`` counts tracked frames by the source's time, from the first that was sent to the last;
    ``processed_rate_hz`` by when they arrived. ``snr_estimated_db`` is of tracked frames.

    Args:
        rows: One per frame that reached the tracker.
        trajectory: All posed frames after the last correction.
        part_of: Frame id of each -> the part of the map it is in.
        truth: Reference poses in metres, or None.
        sent: Frames that were sent: those count for completeness.
        num_frames: Frames the source had; None where it did not come to its end.
        drops: Frames that never reached the tracker, by reason.
        num_keyframes: Keyframes the map rests on.
    """
    posed_ids = set(part_of)
    num_sent = max(sum(stretch.num for stretch in sent), len(posed_ids))
    psnr_db = np.array([row.psnr_db for row in rows if row.psnr_db is not None and np.isfinite(row.psnr_db)])
    stages = sorted({stage for row in rows for stage in row.stage_ms})
    stage_ms = {s: duration_percentiles(row.stage_ms[s] for row in rows if s in row.stage_ms) for s in stages}
    stage_ms["arrival_to_pose"] = duration_percentiles(row.age_ms for row in rows)
    span_s = 0.0
    if len(rows) > 1:
        ids = rows[-1].frame_id - rows[0].frame_id
        all_ids = max(ids, sent[-1].last_id - sent[0].first_id) if sent else ids
        span_s = (rows[-1].t_source_ns - rows[0].t_source_ns) * 1e-9 * all_ids / ids
    return {
        **trajectory_summary(trajectory, truth, num_sent),
        "psnr_db": float(psnr_db.mean()) if len(psnr_db) else None,
        "psnr_p50_db": float(np.median(psnr_db)) if len(psnr_db) else None,
        "snr_estimated_db": _mean(row.snr_estimated_db for row in rows),
        "confidence_mean": _mean(row.confidence_mean for row in rows),
        "num_inliers_p50": float(np.median([row.num_inliers for row in rows])) if rows else None,
        "reprojection_error_px": _mean(row.reprojection_error_px for row in rows),
        "stage_ms": {name: value for name, value in stage_ms.items() if value is not None},
        "frames": {
            "source": max(num_frames or 0, num_sent),
            "sent": num_sent,
            "tracked": len(rows),
            "posed": len(posed_ids),
            "keyframes": num_keyframes,
        },
        "parts": count_parts(part_of.values()),
        "frame_rate_hz": (len(rows) - 1) / span_s if span_s > 0 else None,
        "processed_rate_hz": _arrival_rate_hz([r.t_arrival_ns for r in rows if r.t_arrival_ns is not None]),
        "drops": dict(drops),
        "states": dict(Counter(row.state for row in rows)),
        "unposed_frames": unposed_ranges(sent, posed_ids),
    }


def run_line(summary: Mapping[str, Any]) -> str:
    """Return in a line what became of the frames of a run."""
    frames, drops = summary["frames"], summary["drops"]
    text = f"{frames['tracked']} frames tracked, {frames['posed']} with a pose"
    return f"{text}; {drops_in_words(drops)}"


def too_much(summary: Mapping[str, Any]) -> str | None:
    """Say in words that most frames were skipped as there was no time for them; None where they were not."""
    num_sent = (summary.get("frames") or {}).get("sent") or 0
    drops = summary.get("drops") or {}
    num_skipped = sum(drops.get(reason, 0) for reason in ("superseded", "too_old"))
    if num_skipped <= _MOST * num_sent:
        return None
    return (
        f"the server had no time for {num_skipped} of {num_sent}; a smaller --resize, a larger --stride or a "
        "machine with less other work leaves it more"
    )


def _arrival_rate_hz(times_ns: Sequence[int]) -> float | None:
    gaps_ns = np.diff(np.array(times_ns, dtype=np.int64))
    gaps_ns = gaps_ns[gaps_ns > 0]  # the clock begins anew where the machine was started again in between
    return float(1e9 / gaps_ns.mean()) if len(gaps_ns) else None


def _mean(values: Iterable[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return float(np.mean(known)) if known else None
