import json
import re
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest

from semcast.channel.link import Link
from semcast.channel.settings import ChannelSettings
from semcast.common.codecs import load_codec
from semcast.common.errors import ConfigError, SourceError
from semcast.common.link_report import LinkReporter
from semcast.common.rate import coded_shape
from semcast.evaluation import codec as codec_evaluation
from semcast.evaluation.codec import CodecSettings, evaluate_codec, read_images
from semcast.evaluation.picture_strip import picture_strip, write_picture_strip
from semcast.evaluation.result_table import result_table
from semcast.evaluation.sounding import told_at_first
from semcast.training.onnx_export import export_encoder


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("images")
    rng = np.random.default_rng(0)
    for k in range(3):
        image = cv2.GaussianBlur(rng.uniform(0, 255, (256, 320, 3)), (0, 0), 6.0)
        image = cv2.normalize(image, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
        cv2.imwrite(str(folder / f"image{k}.png"), image)
    (folder / "notes.txt").write_text("not an image")
    return folder


@pytest.fixture(scope="module")
def report(folder, tmp_path_factory):
    out = tmp_path_factory.mktemp("out")
    settings = CodecSettings(
        images=folder,
        codec=("jpeg-ldpc", "jpeg-amc"),
        snr_db=(3.0, 10.0),
        json=out / "result.json",
        out=out,
        max_images=2,
    )
    return settings, evaluate_codec(settings)


def test_no_image_that_is_timed_is_the_first_of_its_size(phase_codec, tmp_path, monkeypatch):
    for k, shape in enumerate([(64, 96), (64, 96), (96, 64)]):
        cv2.imwrite(str(tmp_path / f"{k}.png"), np.full((*shape, 3), 90, np.uint8))
    sizes, encode = [], phase_codec.encode
    monkeypatch.setattr(
        phase_codec, "encode", lambda image, snr_db: sizes.append(image.shape) or encode(image, snr_db)
    )
    settings = CodecSettings(images=tmp_path, codec=("phase",), snr_db=(20.0,), rate="1/48")
    evaluate_codec(settings, [phase_codec])
    wide, high = ((*coded_shape(shape, "1/48"), 3) for shape in ((64, 96), (96, 64)))
    assert wide != (64, 96, 3)
    assert sizes == [wide, high, wide, wide, high]


def trace_file(tmp_path):
    file = tmp_path / "trace.csv"
    file.write_text("t_s,snr_db\n0,4\n0.1,12\n")
    return ChannelSettings(channel="trace", trace="file", trace_file=file)


def test_several_snrs_are_refused_where_a_file_has_its_own(folder, tmp_path):
    link = trace_file(tmp_path)
    with pytest.raises(ValueError, match="snr_db must be a single value with --trace file, .*, got 2 8"):
        CodecSettings(images=folder, snr_db=(2.0, 8.0), link=link)
    assert [link.trace for link in CodecSettings(images=folder, link=link).links.values()] == ["file"]
    CodecSettings(images=folder, snr_db=(2.0, 8.0), link=replace(link, trace="walk"))


def test_a_trace_has_no_curve_over_snr_and_states_no_snr_it_never_had(folder, tmp_path):
    ramp = ChannelSettings(channel="trace", trace="ramp")
    for link, stated, heading, picture in (
        (trace_file(tmp_path), None, [], "pictures_trace.png"),
        (ramp, 12.0, ["start dB"], "pictures_ramp_from_12db.png"),
    ):
        out = tmp_path / link.trace
        report = evaluate_codec(
            CodecSettings(
                images=folder, codec=("jpeg-ldpc",), snr_db=(12.0,), link=link, max_images=1, out=out
            )
        )
        assert report["results"][0]["snr_db"] == stated
        assert [path.name for path in out.iterdir()] == [picture]
        head = result_table("codec", report).head
        assert [name for name in head if name in ("SNR dB", "start dB")] == heading


def test_a_learned_codec_is_told_the_snr_its_trace_starts_with(folder, tmp_path):
    image = next(iter(read_images(folder)[0].values()))
    link = Link(trace_file(tmp_path), 0)
    codec = load_codec("3dcsc-lite")
    assert told_at_first(codec, image, link, LinkReporter(codec.name), 0.0) == 4.0


def test_an_exported_encoder_serves_the_same_decoder(folder):
    both = {
        runtime: evaluate_codec(
            CodecSettings(images=folder, codec=("3dcsc-lite",), snr_db=(10.0,), max_images=1, runtime=runtime)
        )["results"][0]
        for runtime in ("torch", "onnx")
    }
    assert both["onnx"]["psnr_db"] != both["torch"]["psnr_db"], "other arithmetic"
    assert both["onnx"]["psnr_db"] == pytest.approx(both["torch"]["psnr_db"], abs=0.3)


def test_an_exported_encoder_of_other_weights_is_refused(folder, tiny_weights, tmp_path):
    mine = tmp_path / "mine.safetensors"
    shutil.copy(tiny_weights, mine)
    shutil.copy(tiny_weights.with_suffix(".json"), mine.with_suffix(".json"))
    export_encoder("3dcsc-lite", mine.with_suffix(".onnx"))
    settings = CodecSettings(images=folder, codec=(str(mine),), snr_db=(10.0,), max_images=1, runtime="onnx")
    with pytest.raises(ConfigError, match=r"exported encoder of .*mine.safetensors is of other weights"):
        evaluate_codec(settings)


def test_weights_of_ones_own_stand_beside_the_shipped_ones(folder, tiny_weights):
    codecs = ("3dcsc-lite", str(tiny_weights))
    settings = CodecSettings(images=folder, codec=codecs, snr_db=(10.0,), max_images=1)
    found = rows(evaluate_codec(settings))
    assert found[tiny_weights.name, 10.0]["psnr_db"] < found["3dcsc-lite", 10.0]["psnr_db"] - 3, (
        "they were never trained"
    )


def test_who_chooses_a_rate_is_told_at_first_what_the_receiver_knows(folder):
    image = next(iter(read_images(folder)[0].values()))

    def told(codec, perfect_csi):
        link = Link(ChannelSettings(snr_db=10.0), 0)
        return told_at_first(
            load_codec(codec), image, link, LinkReporter(codec), 0.0, perfect_csi=perfect_csi
        )

    assert told("jpeg-amc", True) == pytest.approx(10.0, abs=0.05)
    assert told("jpeg-amc", False) == pytest.approx(10.0, abs=1.0)
    assert abs(told("jpeg-amc", False) - 10.0) > 0.1, "estimated from pilots"
    assert told("3dcsc-lite", False) == 10.0


def rows(report):
    return {(row["codec"], row["snr_db"]): row for row in report["results"]}


def test_every_codec_and_snr_has_one_row_with_the_promised_keys(report):
    by_cell = rows(report[1])
    assert set(by_cell) == {(c, s) for c in ("jpeg-ldpc", "jpeg-amc") for s in (3.0, 10.0)}
    row = by_cell["jpeg-ldpc", 10.0]
    assert {"psnr_db", "ssim", "ms_ssim", "cbr", "outage", "encode_ms", "decode_ms", "confidence"} <= set(row)
    assert row["cbr"] == pytest.approx(1 / 16)
    assert [image["image"] for image in row["images"]] == ["image0.png", "image1.png"]
    assert row["psnr_db"] == pytest.approx(np.mean([image["psnr_db"] for image in row["images"]]))
    assert row["snr_db_estimate"] == pytest.approx(10.0, abs=1.0)


def test_the_cliff_of_the_fixed_code_and_the_adaptive_one_beyond_it(report):
    by_cell = rows(report[1])
    assert by_cell["jpeg-ldpc", 3.0]["outage"] == 1.0
    assert by_cell["jpeg-ldpc", 3.0]["psnr_db"] < 20.0
    assert by_cell["jpeg-ldpc", 10.0]["outage"] == by_cell["jpeg-amc", 3.0]["outage"] == 0.0
    grey_db = by_cell["jpeg-ldpc", 3.0]["psnr_db"]
    assert by_cell["jpeg-ldpc", 10.0]["psnr_db"] > by_cell["jpeg-amc", 3.0]["psnr_db"] > grey_db + 3.0
    assert by_cell["jpeg-ldpc", 10.0]["confidence"]["ece"] < 0.05


def test_result_curves_and_pictures_are_written(report):
    settings, result = report
    assert json.loads(settings.json.read_text()) == result
    assert result["command"].startswith("semcast eval codec --images")
    for name in ("fig7_psnr.png", "fig8_ssim.png", "ms_ssim.png"):
        assert cv2.imread(str(settings.out / name)) is not None
    strip = cv2.imread(str(settings.out / "pictures_10db.png"))
    assert strip.shape[1] == 3 * 384 + 2 * 4


def test_curves_and_pictures_say_what_they_are_of(folder, phase_codec, tmp_path, monkeypatch):
    titles, labels = [], []
    monkeypatch.setattr(
        codec_evaluation,
        "plot_against_snr",
        lambda path, snr_db, curves, y_label, title: titles.append(title),
    )
    monkeypatch.setattr(codec_evaluation, "write_picture_strip", lambda path, strip: labels.extend(strip[0]))
    link = ChannelSettings(channel="erasure", slot_loss=0.01)
    evaluate_codec(
        CodecSettings(
            images=folder, codec=("jpeg-ldpc",), snr_db=(10.0,), link=link, max_images=1, out=tmp_path
        )
    )
    assert set(titles) == {"erasure, CBR 1/16, mean of 1 image"}
    assert re.fullmatch(r"jpeg-ldpc: \d+\.\d\d dB, SSIM \d\.\d{3}", labels[1])
    titles.clear()
    settings = CodecSettings(images=folder, snr_db=(10.0,), max_images=2, out=tmp_path)
    assert evaluate_codec(settings, [phase_codec])["settings"]["codec"] == ["phase"]
    assert set(titles) == {f"awgn, {phase_codec.modulation} (learned codecs), CBR 1/16, mean of 2 images"}


def test_the_same_seed_gives_the_same_figures(folder, report):
    again = evaluate_codec(
        CodecSettings(images=folder, codec=("jpeg-amc",), snr_db=(3.0,), max_images=2, seed=0)
    )
    assert again["results"][0]["images"] == rows(report[1])["jpeg-amc", 3.0]["images"]


def test_traces_and_fading_go_on_from_image_to_image(folder, monkeypatch):
    seen = []
    transmit = Link.transmit

    def watched(self, *arguments):
        sent = transmit(self, *arguments)
        seen.append((sent.snr_db_set, complex(sent.truth.h[0])))
        return sent

    monkeypatch.setattr(Link, "transmit", watched)
    for link in (
        ChannelSettings(channel="trace", trace="ramp", trace_end_db=0.0, trace_s=1.0),
        ChannelSettings(channel="rayleigh", doppler_hz=20.0),
    ):
        seen.clear()
        evaluate_codec(CodecSettings(images=folder, codec=("jpeg-ldpc",), snr_db=(12.0,), link=link))
        assert len(set(seen[-2:])) == 2


def test_a_lost_frame_counts_as_an_outage(folder):
    result = evaluate_codec(
        CodecSettings(
            images=folder, codec=("jpeg-ldpc",), snr_db=(12.0,), link=ChannelSettings(frame_loss=1.0)
        )
    )
    row = result["results"][0]
    assert row["outage"] == 1.0
    assert row["decode_ms"] == {"p50": None, "p95": None}
    assert row["snr_db_estimate"] is None


def test_perfect_csi_reaches_the_equaliser(folder):
    row = evaluate_codec(
        CodecSettings(images=folder, codec=("jpeg-ldpc",), snr_db=(9.0,), max_images=1, perfect_csi=True)
    )["results"][0]
    assert row["snr_db_estimate"] == pytest.approx(9.0, abs=0.2)


def test_image_folders_are_checked(folder, tmp_path):
    images, left_out = read_images(folder, 2)
    assert list(images) == ["image0.png", "image1.png"]
    assert left_out == []
    with pytest.raises(SourceError, match="missing can't be read"):
        read_images(tmp_path / "missing")
    with pytest.raises(SourceError, match=r"holds no images \(\.png.*webp\)$"):
        read_images(tmp_path)
    inside = tmp_path / "images"
    inside.mkdir()
    cv2.imwrite(str(inside / "0.png"), images["image0.png"])
    with pytest.raises(SourceError, match=f"holds no images .*; {inside} does$"):
        read_images(tmp_path)
    (tmp_path / "broken.png").write_bytes(b"nothing")
    with pytest.raises(SourceError, match=r"broken\.png"):
        read_images(tmp_path)


def test_a_damaged_image_is_told_and_left_out(folder, tmp_path, caplog):
    for image in folder.iterdir():
        shutil.copy(image, tmp_path)
    whole = (tmp_path / "image0.png").read_bytes()
    (tmp_path / "image0.png").write_bytes(whole[: len(whole) // 2])
    result = evaluate_codec(CodecSettings(images=tmp_path, codec=("jpeg-ldpc",), snr_db=(12.0,)))
    assert result["images_left_out"] == ["image0.png"]
    assert result["num_images"] == len(list(folder.glob("*.png"))) - 1
    assert result["results"][0]["images"][0]["image"] == "image1.png"
    assert caplog.text.count("left out") == 1
    assert "image0.png" in caplog.text


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"snr_db": (99.0,)}, r"snr_db must be one or more values in \[-5, 30\], got 99$"),
        ({"snr_db": (6.0, -5.5)}, r"snr_db must be one or more values in \[-5, 30\], got 6 -5.5$"),
        ({"snr_db": ()}, "snr_db must be one or more values .* got none$"),
        ({"codec": ("a", "a")}, "codec must be one or more different names"),
        ({"max_images": 0}, "max_images must be at least 1, got 0"),
        ({"threads": 0}, r"threads must be in \[1, 1024\], got 0"),
        ({"seed": -1}, "seed must be at least 0, got -1"),
        ({"seed": 2**31}, "last of the seeds must be at most 2147483647, got 2147483648"),
    ],
)
def test_bad_settings_are_named(tmp_path, values, message):
    with pytest.raises(ValueError, match=message):
        CodecSettings(images=tmp_path, **values)


def test_an_unknown_codec_is_named(folder):
    with pytest.raises(ConfigError, match="got 'jpeg'"):
        evaluate_codec(CodecSettings(images=folder, codec=("jpeg",)))


def test_a_strip_holds_every_image_once(tmp_path):
    red = np.full((60, 120, 3), (200, 0, 0), np.uint8)
    blue = np.full((60, 120, 3), (0, 0, 200), np.uint8)
    strip = picture_strip([{"a": red, "b": blue}, {"a": blue}])
    # Cells of 384 pixels: 192 of picture under 26 of label, gaps of 4.
    assert strip.shape == (2 * (192 + 26) + 4, 2 * 384 + 4, 3)
    assert strip[100, 100].tolist() == [200, 0, 0]
    assert strip[100, 500].tolist() == strip[350, 100].tolist() == [0, 0, 200]
    assert strip[350, 500].tolist() == [255, 255, 255]
    # The fifth image goes on below the first, the next row below that.
    long = picture_strip([{**dict.fromkeys("abcd", blue), "e": red}, {"a": blue}])
    assert long.shape == (3 * (192 + 26) + 2 * 4, 4 * 384 + 3 * 4, 3)
    assert long[350, 100].tolist() == [200, 0, 0]
    assert long[350, 500].tolist() == [255, 255, 255]
    assert long[550, 100].tolist() == [0, 0, 200]
    label = "gpu_run_2/3dcsc-lite-vr-of-october.safetensors: 29.37 dB, SSIM 0.8"
    one, other = (picture_strip([{label + last: red}])[:26] for last in "38")
    assert (one != other).any(), "a label ends within its cell"
    write_picture_strip(tmp_path / "new" / "strip.png", [{"a": red}])
    assert (tmp_path / "new" / "strip.png").stat().st_size > 0
    with pytest.raises(ValueError, match="at least one image in each row"):
        picture_strip([])
