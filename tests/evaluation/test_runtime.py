import json
import subprocess
import sys

import pytest

from semcast.common.errors import ConfigError, SemcastError
from semcast.evaluation import runtime
from semcast.evaluation.report import cpu_flags
from semcast.evaluation.runtime import RuntimeSettings, evaluate_runtime, variants

pytestmark = pytest.mark.xdist_group("real-time")


AVX2_TOO = {("all", "auto"), ("AVX2", "auto"), ("AVX2", "float32")}


@pytest.mark.parametrize(
    ("flags", "ways"),
    [
        ({"avx2", "avx512f"}, AVX2_TOO),
        ({"avx2", "avx_vnni"}, AVX2_TOO),
        (set(), AVX2_TOO),
        ({"avx2"}, {("all", "auto"), ("all", "float32")}),
        ({"asimd"}, {("all", "auto"), ("all", "float32")}),
    ],
)
def test_every_runtime_encodes_and_torch_alone_decodes(flags, ways):
    """Where AVX2 is the widest there is, no way to compute is timed twice under two names."""
    found = variants(RuntimeSettings(threads=(1, 2)), flags)
    assert len(found) == len(set(found)) == 2 * (2 * len(ways) + 1)
    assert {(v.work, v.isa) for v in found if v.runtime == "onnx"} == {("encode", "all")}
    assert {(v.work, v.isa, v.precision) for v in found if v.runtime == "torch"} == {
        (work, *how) for work in ("encode", "decode") for how in ways
    }


@pytest.mark.slow
@pytest.mark.weights
def test_all_variants_are_timed(tmp_path):
    settings = RuntimeSettings(width=64, height=48, threads=(1,), rounds=2, calls=2, json=tmp_path / "r.json")
    report = evaluate_runtime(settings)
    assert json.loads(settings.json.read_text()) == report
    assert len(report["results"]) == len(variants(settings, cpu_flags()))
    exact = [row for row in report["results"] if row["precision"] == "float32"]
    assert {row["work"] for row in exact} == {"encode", "decode"}
    assert all(row["precision"] in ("float32", "bfloat16", "int8") for row in report["results"])
    for row in report["results"]:
        assert 0.0 < row["p50_ms"] <= row["p95_ms"]
        assert row["fps"] == pytest.approx(1000.0 / row["p50_ms"])


def test_a_codec_without_a_runtime_is_not_timed_under_the_name_of_one():
    with pytest.raises(ConfigError, match="codec must be a learned one, got 'jpeg-ldpc'"):
        evaluate_runtime(
            RuntimeSettings(codecs=("jpeg-ldpc",), width=32, height=32, threads=(1,), rounds=1, calls=1)
        )


def test_an_unknown_codec_is_one_clear_error(monkeypatch):
    monkeypatch.setattr(runtime, "_Child", lambda *_: pytest.fail("seconds of imports for nothing"))
    with pytest.raises(ConfigError, match="^codec must be one of .*got '3dcsc-huge'"):
        evaluate_runtime(RuntimeSettings(codecs=("3dcsc-huge",), threads=(1,), rounds=1))
    with pytest.raises(ValueError, match="threads must be in"):
        RuntimeSettings(threads=(0,))


@pytest.mark.parametrize("values", [{"codecs": ()}, {"codecs": ("3dcsc", "3dcsc")}, {"threads": (2, 2)}])
def test_no_variant_is_timed_twice_and_there_is_one(values):
    with pytest.raises(ValueError, match="(codec|threads) must be one or more different values, got"):
        RuntimeSettings(**values)


def test_a_variant_that_answers_no_json_is_told_and_ended(monkeypatch):
    children, popen = [], subprocess.Popen

    def talkative(command, **options):
        children.append(popen([sys.executable, "-c", "print('a library says hello'); input()"], **options))
        return children[-1]

    monkeypatch.setattr(runtime.subprocess, "Popen", talkative)
    with pytest.raises(
        SemcastError, match="^no variant ran: answered what is no JSON: a library says hello$"
    ):
        evaluate_runtime(RuntimeSettings(threads=(1,), rounds=1))
    assert children
    assert all(child.returncode is not None for child in children)


def test_without_a_variant_that_ran_the_first_one_says_why(monkeypatch):
    children = []

    class Child:
        times_ms: tuple[float, ...] = ()

        def __init__(self, variant, shape_hw):
            self.error, self.closed = f"no {variant.work}", False
            children.append(self)

        def turn(self, calls):
            pass

        def close(self):
            self.closed = True

    monkeypatch.setattr(runtime, "_Child", Child)
    with pytest.raises(SemcastError, match="^no variant ran: no encode$"):
        evaluate_runtime(RuntimeSettings(threads=(1,), rounds=1))
    assert children
    assert all(child.closed for child in children)
