"""Tables of the results page say which codec they are of."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from semcast.common.codec import DEFAULT_CODEC
from semcast.evaluation.interruption import Part
from semcast.evaluation.results_page import results_page

RESULTS = Path(__file__).resolve().parents[2] / "evaluation" / "results"


@pytest.mark.parametrize(
    "file", ["confidence_awgn_kitti_06", "latency_kitti_06", "endurance_parking_synth_60"]
)
@pytest.mark.parametrize("codec", [DEFAULT_CODEC, "3dcsc-lite"])
def test_a_table_names_its_codec_be_it_the_default(tmp_path, file, codec):
    shutil.copy(RESULTS / f"{file}.json", tmp_path)
    report = json.loads((tmp_path / f"{file}.json").read_text(encoding="utf-8"))
    report["settings"]["codec"] = codec
    (tmp_path / f"{file}.json").write_text(json.dumps(report), encoding="utf-8")
    assert f"\nCodec `{codec}`.\n" in results_page(tmp_path)


@pytest.mark.parametrize(
    ("file", "unknown"),
    [
        ("readout_room_rolling", ("more_ms", "more_axis", "sigma_ms")),
        ("lens_room_bent", ("more_focal", "more_radial", "more_centre")),
    ],
)
def test_a_trial_whose_residuals_say_nothing_has_dashes(tmp_path, file, unknown):
    report = json.loads((RESULTS / f"{file}.json").read_text(encoding="utf-8"))
    report["trials"][-1] |= dict.fromkeys(unknown)
    (tmp_path / f"{file}.json").write_text(json.dumps(report), encoding="utf-8")
    rows = [line for line in results_page(tmp_path).splitlines() if line.startswith("|")]
    assert [row.endswith("| - |") for row in rows[-2:]] == [False, True]


def test_a_server_alone_has_a_row_for_each_run_and_dashes_where_nothing_was_timed(tmp_path):
    run = {
        "frames": {"sent": 50, "tracked": 48}, "drops": {}, "completeness": 0.94,
        "stage_ms": {"decode": {"p50": 90.04, "p95": 110.0}, "decoded_to_pose": {"p50": 41.0, "p95": 83.0}},
    }  # fmt: skip
    none = {"frames": {"sent": 50, "tracked": 0}, "drops": {}, "completeness": 0.0, "stage_ms": {}}
    report = {"rate_hz": 10.0, "image_wh": [640, 480], "codec": "jpeg-ldpc", "results": [run, none]}
    (tmp_path / "server_shelf.json").write_text(json.dumps(report), encoding="utf-8")
    page = results_page(tmp_path)
    assert "## The server alone, live\n\n### shelf\n\nCodec `jpeg-ldpc`.\n" in page
    assert "10.0 frames a second of 640x480" in page
    assert "| 50 | 48 | 94.0% | 90.0 / 110.0 | 41.0 / 83.0 | - / - |" in page
    assert "| 50 | 0 | 0.0% | - / - | - / - | - / - |" in page


def test_what_an_interrupted_measurement_left_is_on_no_page(tmp_path):
    report = {"rate_hz": 10.0, "image_wh": [640, 480], "codec": "jpeg-ldpc", "results": []}
    whole = tmp_path / "server_shelf.json"
    part = Part()
    part.is_cut = True
    for file in (whole, part.name(whole)):
        file.write_text(json.dumps(report), encoding="utf-8")
    assert [line for line in results_page(tmp_path).splitlines() if line.startswith("### ")] == ["### shelf"]


@pytest.mark.parametrize("module", ["semcast.evaluation.results_page", "semcast.reference"])
def test_outside_a_checkout_it_is_said_that_there_are_no_pages(tmp_path, module):
    done = subprocess.run([sys.executable, "-m", module], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stderr.startswith("the pages are those of a checkout: there is no docs/")
    assert done.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []
