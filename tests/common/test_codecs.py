"""A codec by name and weights by file agree, or one line says that they do not."""

import shutil

import pytest
import torch

from semcast.cli import main
from semcast.common.codecs import check_codec, codec_of_weights, load_codec, named_weights, warn_of_modulation
from semcast.common.errors import CheckpointError, ConfigError
from semcast.training.onnx_export import export_encoder


@pytest.fixture(scope="module")
def files(tiny_weights):
    """The weights of a small ``3dcsc``, and its encoder as ONNX."""
    return {"torch": tiny_weights, "onnx": export_encoder(tiny_weights, tiny_weights.with_suffix(".onnx"))}


@pytest.mark.parametrize("kind", ["torch", "onnx"])
def test_weights_of_another_codec_than_the_named_one_are_refused(files, kind):
    assert load_codec("3dcsc", weights=files[kind], runtime="auto").name == "3dcsc"
    with pytest.raises(ConfigError) as caught:
        load_codec("3dcsc-lite", weights=files[kind], runtime="auto")
    assert str(caught.value) == f"codec must be '3dcsc', that of the weights {files[kind]}, got '3dcsc-lite'"


@pytest.mark.parametrize("kind", ["torch", "onnx"])
def test_weights_say_which_codec_they_are_of(files, kind):
    assert codec_of_weights(files[kind]) == "3dcsc"


def test_a_file_of_weights_stands_for_its_codec(files):
    by_file = load_codec(str(files["torch"]))
    assert (by_file.name, by_file.digest) == ("3dcsc", load_codec("3dcsc", weights=files["torch"]).digest)
    assert named_weights(str(files["torch"])) == ("3dcsc", files["torch"])
    assert named_weights("jpeg-ldpc") == ("jpeg-ldpc", None)


def test_weights_are_sent_with_by_the_exported_encoder_beside_them(files, tmp_path):
    beside = load_codec(str(files["torch"]), runtime="onnx")
    assert beside.digest == load_codec(str(files["torch"])).digest
    alone = tmp_path / "two words.safetensors"
    with pytest.raises(
        CheckpointError, match=r"two words\.onnx beside the weights, .*: semcast onnx '.*' --out '"
    ):
        load_codec(str(alone), runtime="onnx")


def test_an_exported_encoder_is_refused_where_images_are_decoded(files):
    with pytest.raises(
        CheckpointError, match=r"onnx is an exported encoder, which can only send: .*safetensors"
    ):
        load_codec(str(files["onnx"]))


def test_a_codec_is_checked_without_being_loaded(files, tmp_path):
    check_codec("jpeg-ldpc")
    check_codec(str(files["torch"]))
    with pytest.raises(ConfigError, match="got 'jpg-ldpc', did you mean 'jpeg-ldpc'"):
        check_codec("jpg-ldpc")
    with pytest.raises(ConfigError, match="gone.safetensors': no such file"):
        check_codec(str(tmp_path / "gone.safetensors"))


@pytest.mark.parametrize("name", ["none.safetensors", "none.onnx"])
def test_missing_weights_are_one_clear_error(tmp_path, name):
    with pytest.raises(CheckpointError, match="none"):
        codec_of_weights(tmp_path / name)


def test_damaged_weights_are_one_clear_error(files, tmp_path):
    cut = tmp_path / "cut.safetensors"
    shutil.copy(files["torch"].with_suffix(".json"), cut.with_suffix(".json"))
    cut.write_bytes(files["torch"].read_bytes()[:-1])
    with pytest.raises(CheckpointError, match="the manifest says"):
        codec_of_weights(cut)


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a GPU")
def test_a_gpu_that_is_not_there_is_one_clear_error(files):
    with pytest.raises(ConfigError, match="device must be auto or cpu on this machine.* got 'cuda'"):
        load_codec("3dcsc", weights=files["torch"], device="cuda")


def test_an_unknown_device_is_not_taken_for_the_cpu(files):
    with pytest.raises(ConfigError, match="device must be one of auto, cpu, cuda, got 'gpu'"):
        load_codec("3dcsc", weights=files["torch"], device="gpu")


def test_the_onnx_runtime_has_the_precision_of_its_file(files):
    with pytest.raises(ConfigError, match="^precision must be auto with the onnx runtime.*got 'float32'$"):
        load_codec(str(files["onnx"]), runtime="auto", precision="float32")


def test_the_onnx_runtime_does_not_pretend_to_use_a_gpu(files):
    with pytest.raises(ConfigError, match="device must be auto or cpu with the onnx runtime, got 'cuda'"):
        load_codec("3dcsc", weights=files["onnx"], runtime="auto", device="cuda")


def test_what_is_asked_of_a_network_is_told_to_have_no_effect_on_a_conventional_codec(caplog):
    load_codec("jpeg-amc", num_threads=1, device="cpu", runtime="auto")
    assert not caplog.records
    load_codec("jpeg-amc", precision="float32", device="cuda", runtime="onnx")
    told = ["device, runtime, precision: no effect on codec jpeg-amc, which has no network"]
    assert [record.getMessage() for record in caplog.records] == told


def test_a_modulation_that_was_asked_for_is_told_to_do_nothing_where_codecs_choose_theirs(caplog):
    warn_of_modulation("jpeg-amc", {"snr_db"})
    for codec in ("jpeg-ldpc", "3dcsc-lite", (), ("jpeg-amc", "jpeg-ldpc")):
        warn_of_modulation(codec, {"modulation"})
    assert not caplog.records
    warn_of_modulation("jpeg-amc", {"modulation"})
    warn_of_modulation(("jpeg-amc", "webp-amc"), {"modulation": "16qam"})
    assert [record.getMessage() for record in caplog.records] == [
        f"modulation: no effect on codec {names}, which chooses its own"
        for names in ("jpeg-amc", "jpeg-amc, webp-amc")
    ]


@pytest.mark.parametrize("runtime", ["auto", "onnx"])
def test_weights_of_an_agent_may_be_of_two_kinds_and_no_other(runtime, tmp_path, capsys):
    file = tmp_path / "notes.txt"
    file.write_text("buy milk")
    assert main(["agent", "--source", "0", "--weights", str(file), "--runtime", runtime]) == 1
    line = f"semcast agent: --weights must be a .safetensors or .onnx file, got {file}\n"
    assert capsys.readouterr().err == line
