"""The README's table of how long one image takes at either end."""

import json
import statistics
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from semcast.common.codec import DEFAULT_CODEC
from semcast.evaluation.markdown import number, table

Report = Mapping[str, Any]

#: Networks alone, all variants in turns; and a live server that gets its frames from a recording. Both are of
#: a machine with bfloat16 in hardware.
RUNTIME_FILE, SERVER_FILE = "runtime_3dcsc_avx512.json", "server_shelf_50_bfloat16.json"
#: Work and runtime of a network, and what the table calls it.
_NETWORKS = {
    ("encode", "torch"): "agent: encode",
    ("encode", "onnx"): "agent without torch: encode, in eight bits",
    ("decode", "torch"): "server: decode, with confidence",
}
#: Stages of a server, and what the table calls them.
_STAGES = {
    "decoded_to_pose": "server: from the decoded image to its pose",
    "arrival_to_pose": "server: from a frame's arrival to its pose, decoded by one thread",
}


def speed_table(folder: Path) -> str:
    """Return the times of the default codec and of a live server, in ms for an image of 640x480.

    Args:
        folder: Of the result files.
    """
    runtime, server = (
        json.loads((folder / name).read_text(encoding="utf-8")) for name in (RUNTIME_FILE, SERVER_FILE)
    )
    rows = [[name, *_network_ms(runtime, *key)] for key, name in _NETWORKS.items()]
    rows += [[name, *_stage_ms(server, stage), "-"] for stage, name in _STAGES.items()]
    return "\n".join(table(("ms for an image of 640x480", "median", "p95", "median with AVX2 alone"), rows))


def _network_ms(report: Report, work: str, runtime: str) -> list[str]:
    """Median and p95 with all the machine has, and the median of the fastest that needs AVX2 alone."""
    mine = [
        row
        for row in report["results"]
        if (row["codec"], row["work"], row["runtime"]) == (DEFAULT_CODEC, work, runtime)
    ]
    best = min((row for row in mine if row["isa"] == "all"), key=lambda row: row["p50_ms"])
    avx2 = [row["p50_ms"] for row in mine if row["isa"] == "AVX2"]
    return [number(best["p50_ms"], 0), number(best["p95_ms"], 0), number(min(avx2), 0) if avx2 else "-"]


def _stage_ms(report: Report, stage: str) -> list[str]:
    """Median and p95, of each the median over runs."""
    runs = [run["stage_ms"][stage] for run in report["results"]]
    return [number(statistics.median(run[q] for run in runs), 0) for q in ("p50", "p95")]
