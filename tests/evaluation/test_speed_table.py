"""The README's table of times has the default codec's, the fastest way on each kind of machine."""

import json

from semcast.common.codec import DEFAULT_CODEC
from semcast.evaluation.speed_table import RUNTIME_FILE, SERVER_FILE, speed_table


def row(work, runtime, isa, p50_ms, codec=DEFAULT_CODEC):
    return {
        "codec": codec,
        "work": work,
        "runtime": runtime,
        "isa": isa,
        "p50_ms": p50_ms,
        "p95_ms": 2 * p50_ms,
    }


def test_times_are_those_of_the_default_codec_and_medians_over_runs(tmp_path):
    results = [
        row("encode", "torch", "all", 16.2),
        row("encode", "torch", "AVX2", 90.0),
        row("encode", "torch", "AVX2", 44.0),
        row("encode", "torch", "all", 5.0, codec="cnn"),
        row("encode", "onnx", "all", 21.0),
        row("decode", "torch", "all", 29.0),
        row("decode", "torch", "AVX2", 77.0),
    ]
    (tmp_path / RUNTIME_FILE).write_text(json.dumps({"results": results}))
    runs = [
        {
            "stage_ms": {
                "decoded_to_pose": {"p50": p50, "p95": p50 + 10},
                "arrival_to_pose": {"p50": p50 + 50, "p95": p50 + 90},
            }
        }
        for p50 in (20.0, 30.0, 25.0)
    ]
    (tmp_path / SERVER_FILE).write_text(json.dumps({"results": runs}))
    rows = [line.split(" | ") for line in speed_table(tmp_path).splitlines()[2:]]
    assert [[cell.strip(" |") for cell in cells[1:]] for cells in rows] == [
        ["16", "32", "44"],
        ["21", "42", "-"],
        ["29", "58", "77"],
        ["25", "35", "-"],
        ["75", "115", "-"],
    ]
