import io
import json
from pathlib import Path

import pytest
from rich.console import Console

from semcast.commands.evaluate import EVALUATIONS, printed_table
from semcast.evaluation.result_table import LAYOUTS, result_table

RESULTS = Path(__file__).resolve().parents[2] / "evaluation" / "results"
#: Of a measurement whose results are of one's own recordings.
SERVER = {
    "rate_hz": 10.0,
    "image_wh": [640, 480],
    "codec": "3dcsc-lite-vr",
    "results": [
        {
            "frames": {"sent": 50, "tracked": 48},
            "drops": {"superseded": 2},
            "completeness": 0.94,
            "stage_ms": {
                "decode": {"p50": 90.0, "p95": 110.0, "max": 130.0},
                "decoded_to_pose": {"p50": 41.04, "p95": 83.0, "max": 400.0},
            },
        }
    ],
}
#: One result of each other evaluation.
SHIPPED = {
    "trajectory": "trajectory_awgn_phone_150",
    "pairs": "pairs_kitti_06_awgn",
    "codec": "codec_awgn_kodak",
    "confidence": "confidence_awgn_kitti_06",
    "latency": "latency_kitti_06",
    "depth": "depth_room",
    "endurance": "endurance_parking_synth_60",
    "runtime": "runtime_3dcsc_avx2",
    "recording": "recording_cost",
}


def shipped(what):
    if what == "server":
        return SERVER
    return json.loads((RESULTS / f"{SHIPPED[what]}.json").read_text(encoding="utf-8"))


def lines_at_80_columns(what, table):
    console = Console(file=io.StringIO(), width=80)
    console.print(printed_table(what, table))
    return console.file.getvalue().splitlines()


def test_every_evaluation_has_a_table():
    assert set(LAYOUTS) == set(EVALUATIONS) == {*SHIPPED, "server"}


@pytest.mark.parametrize("what", EVALUATIONS)
def test_no_name_of_a_column_is_cut_and_every_row_takes_one_line(what):
    table = result_table(what, shipped(what))
    _, head, _, *body = lines_at_80_columns(what, table)
    assert [name.strip() for name in head.split("  ") if name.strip()] == table.head
    assert [line.split() for line in body] == [row for row in table.rows if row]
    # Where nothing arrives, or no pixel has a depth, nothing is measured; without a link there is no SNR.
    measured = [row for row in table.rows if not {"100%", "0.0%", "none"} & set(row)]
    assert all(cell != "-" for row in measured for cell in row), "every figure is found in the result"


def test_figures_of_published_poses_fit_beside_those_of_the_corrected_path():
    report = shipped("trajectory")
    for cell in report["cells"]:
        for figure in ("ate_at_once_percent", "completeness_at_once"):
            cell.pop(figure, None)
    assert "live %" not in result_table("trajectory", report).head
    assert "Live" not in result_table("trajectory", report).notes[0]
    for cell in report["cells"]:
        cell |= {"ate_at_once_percent": 12.345, "completeness_at_once": 0.9, "recovery_s": 0.1}
    table = result_table("trajectory", report)
    assert {"live %", "posed live", "again"} <= set(table.head)
    assert "as they were published" in table.notes[0]
    _, head, _, *body = lines_at_80_columns("trajectory", table)
    assert [name.strip() for name in head.split("  ") if name.strip()] == table.head
    assert [line.split() for line in body] == table.rows


def test_the_file_of_a_trace_is_named_where_no_column_has_its_snr():
    report = json.loads((RESULTS / "trajectory_outages_shelf_50.json").read_text(encoding="utf-8"))
    table = result_table("trajectory", report)
    assert "SNR dB" not in table.head
    assert table.notes[0] == "SNR and losses are those of deploy/demo/outages.csv."
    report["settings"]["codec"] = "none"
    assert not any("outages.csv" in note for note in result_table("trajectory", report).notes)
    assert not any("losses" in note for note in result_table("trajectory", shipped("trajectory")).notes)


def test_figures_of_a_cloud_are_told_below_the_table():
    report = shipped("depth")
    cloud = {"points": 1234.5, "accuracy_median": 0.0031, "accuracy_p90": None, "completeness": 0.4}
    report["results"] = [{**report["results"][0], "cloud": cloud}, {**report["results"][1], "cloud": None}]
    *_, note = result_table("depth", report).notes
    assert note.startswith("Cloud of none: 1234 points, half of them within 0.31% of a surface")
    assert note.endswith("within -; 40.0% of what was seen has one.")
    assert len(result_table("depth", report).notes) == 2
    cloud |= {"points": 0.0, "accuracy_median": None, "completeness": 0.0}
    assert result_table("depth", report).notes[-1] == "Cloud of none: no points."


def test_a_long_name_takes_several_lines_and_cuts_no_other_column():
    report = shipped("codec")
    name = "checkpoints/mine/a-rather-long-name-of-weights.safetensors"
    report["results"] = [{**report["results"][0], "codec": name}]
    table = result_table("codec", report)
    _, head, _, *body = lines_at_80_columns("codec", table)
    assert head.split() == " ".join(table.head).split()
    assert "".join(line.split()[0] for line in body) == name
    assert body[0].split()[1:] == table.rows[0][1:]


def test_times_say_over_how_many_frames_they_are():
    assert result_table("latency", shipped("latency")).notes == ["46 frames. Bottleneck: decode"]


def test_figures_that_are_not_there_are_dashes():
    report = shipped("confidence")
    del report["results"][0]["keypoint"]["maps"]["keypoint_confidence"]
    report["results"][0]["pixel"]["ece"] = None
    table = result_table("confidence", report)
    assert [table.rows[0][table.head.index(name)] for name in ("corner rank", "pixel ECE")] == ["-", "-"]
    assert table.rows[0][0] == "2"


def test_a_variant_that_did_not_run_says_why_below_the_table():
    report = shipped("runtime")
    report["results"][-1] |= {"p50_ms": None, "p95_ms": None, "fps": None, "error": "no exported encoder"}
    table = result_table("runtime", report)
    assert table.rows[-1][-3:] == ["-", "-", "-"]
    codec = report["results"][-1]["codec"]
    assert table.notes == [f"{codec}, encode, onnx: no exported encoder"]
