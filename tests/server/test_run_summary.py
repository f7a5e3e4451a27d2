"""The summary of a run says what happened."""

import json

import pytest
from rows_of_runs import frame_row, straight_path

from semcast.server.export.outputs import write_json
from semcast.server.run_summary import summarise
from semcast.server.sent_frames import stretches


def row(frame_id, posed=True, **changes):
    state, stage_ms = "tracking" if posed else "lost", {"decode": 20.0 + frame_id, "track": 10.0}
    return frame_row(frame_id, **{"posed": posed, "state": state, "stage_ms": stage_ms, **changes})


def summary_of(rows):
    sent = stretches({r.frame_id: r.frame_id for r in rows})
    part_of = {r.frame_id: 0 for r in rows}
    return summarise(rows, straight_path(list(part_of)), part_of, None, sent, None, {}, 0)


def test_the_summary_has_the_promised_keys_and_values(tmp_path):
    rows = [row(k, posed=k != 3, psnr_db=30.0 + k) for k in range(10)]
    rows.append(row(10, psnr_db=float("inf")))
    kept = [k for k in range(11) if k != 3]
    part_of = {k: 0 if k < 3 else 2 for k in kept}
    sent = stretches({k: k for k in range(16)})
    summary = summarise(
        rows, straight_path(kept), part_of, straight_path(range(20)), sent, 20, {"superseded": 5}, 7
    )
    assert summary["ate_rmse_m"] == pytest.approx(0.0, abs=1e-9)
    assert summary["completeness"] == 10 / 16
    assert summary["psnr_db"] == pytest.approx(34.5)
    assert summary["stage_ms"]["decode"]["p50"] == pytest.approx(25.0)
    assert summary["stage_ms"]["decode"]["p95"] == pytest.approx(29.5)
    assert summary["drops"] == {"superseded": 5}
    assert summary["unposed_frames"] == [(3, 3), (11, 15)]
    assert summary["parts"] == [{"submap": 0, "num_posed": 3}, {"submap": 2, "num_posed": 7}]
    assert summary["frames"] == {"source": 20, "sent": 16, "tracked": 11, "posed": 10, "keyframes": 7}
    assert summary["frame_rate_hz"] == pytest.approx(10 / 1.5), "of 1.5 s in which frames were sent"
    assert summary["processed_rate_hz"] is None
    assert {"ate_percent", "rpe_trans_percent", "rpe_rot_deg"} <= set(summary)
    write_json(tmp_path / "summary.json", summary)
    json.loads((tmp_path / "summary.json").read_text(), parse_constant=pytest.fail)


def test_a_run_without_frames_has_a_summary_too():
    summary = summarise([], straight_path([]), {}, None, [], None, {}, 0)
    assert summary["parts"] == []
    assert summary["completeness"] == 0.0
    assert summary["ate_rmse_m"] is None
    assert summary["psnr_db"] is None
    assert summary["stage_ms"] == {}


def test_a_recording_played_at_half_pace_is_processed_at_half_its_rate():
    summary = summary_of([row(k, t_arrival_ns=7 + k * 200_000_000) for k in range(5)])
    assert summary["frame_rate_hz"] == pytest.approx(10.0)
    assert summary["processed_rate_hz"] == pytest.approx(5.0)


def test_the_rate_by_arrival_survives_a_clock_that_began_anew():
    times_ns = [9_000_000_000, 9_250_000_000, 10_000_000, 260_000_000]
    summary = summary_of([row(k, t_arrival_ns=t) for k, t in enumerate(times_ns)])
    assert summary["processed_rate_hz"] == pytest.approx(4.0)
