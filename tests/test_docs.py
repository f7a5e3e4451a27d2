"""What the documentation says about the command line is what the command line takes."""

import ast
import dataclasses
import functools
import json
import re
import shlex
from pathlib import Path
from pkgutil import resolve_name
from typing import get_args

import numpy as np
import pytest

from semcast.channel.link import Link
from semcast.channel.registry import MODELS
from semcast.channel.settings import ChannelName
from semcast.cli import VERBS, verb_parser
from semcast.common import keys, sequence
from semcast.common.trajectory import Trajectory
from semcast.evaluation.markdown import with_part
from semcast.evaluation.path_tables import readme_table
from semcast.evaluation.results_page import CONFIDENCE_PARTS, RESULTS, results_page
from semcast.evaluation.speed_table import speed_table
from semcast.reference import reference, with_messages
from semcast.server.frame_rows import FrameRow
from semcast.server.run_summary import summarise

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").glob("*.md")])
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```", re.DOTALL | re.MULTILINE)
LINK = re.compile(r"\]\(([^)#\s]+)(?:#[^)]*)?\)")


def commands(page):
    for language, block in BLOCK.findall(page.read_text(encoding="utf-8")):
        if language not in ("", "sh", "bash", "console"):
            continue
        for line in block.replace("\\\n", " ").splitlines():
            words = shlex.split(line, comments=True) if "semcast " in line else []
            if "semcast" in words:
                yield words[words.index("semcast") + 1 :]


def known_flags(parser, words):
    flags = set()
    while True:
        flags |= set(parser._option_string_actions)
        children = [
            a.choices for a in parser._actions if hasattr(a, "choices") and isinstance(a.choices, dict)
        ]
        if not children or not words or words[0] not in children[0]:
            return flags
        parser, words = children[0][words[0]], words[1:]


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_every_command_in_the_docs_is_one_the_parser_knows(page):
    for words in commands(page):
        if not words or words[0].startswith("-"):
            continue
        assert words[0] in VERBS, f"{page.name}: semcast {words[0]}"
        known = known_flags(verb_parser(words[0]), words[1:])
        given = {w.split("=")[0] for w in words[1:] if w.startswith("--")}
        assert given <= known, f"{page.name}: semcast {' '.join(words)}: {given - known}"


def test_the_docs_are_read_as_they_are_written():
    assert sum(len(list(commands(page))) for page in PAGES) > 40
    assert sum(len(LINK.findall(page.read_text(encoding="utf-8"))) for page in PAGES) > 60


def test_the_reference_page_is_up_to_date():
    assert (ROOT / "docs/commands.md").read_text(encoding="utf-8") == reference(), "run make docs"


def test_the_table_of_messages_is_up_to_date():
    page = (ROOT / "docs/file-formats.md").read_text(encoding="utf-8")
    assert page == with_messages(page), "run make docs"
    assert "`payload_format`" in page
    with pytest.raises(ValueError, match="must hold <!-- messages -->"):
        with_messages("a page without the marks")


def test_the_keys_that_the_page_on_messages_tells_are_those_in_use():
    page = (ROOT / "docs/file-formats.md").read_text(encoding="utf-8")
    by_kind = ("camera", "source", "link", "flow", "channel", "pose", "metric_pose", "map")
    for kind in by_kind:
        assert f"| `{kind}` |" in page
        assert getattr(keys, f"{kind}_key")("agent0") == f"semcast/agent0/{kind}"
    for key in (
        keys.tx_key("agent0"),
        keys.status_key("agent0", "server").replace("server", "<role>"),
        keys.control_key("agent0", "server").replace("server", "<role>"),
    ):
        assert f"`{key.replace('agent0', '<agent>')}`" in page
    assert keys.rx_key("agent0").endswith("/rx/symbols")
    assert "`.../rx/symbols`" in page


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_links_between_pages_lead_somewhere(page):
    for target in LINK.findall(page.read_text(encoding="utf-8")):
        if "://" not in target:
            assert (page.parent / target).exists(), f"{page.name} links to {target}"


def test_the_files_that_the_page_on_the_paper_names_are_there():
    named = re.findall(r"`([\w/]+\.py)`", (ROOT / "docs/paper.md").read_text(encoding="utf-8"))
    assert len(named) > 20
    assert not [file for file in named if not (ROOT / file).is_file()]


def test_the_figures_in_the_docs_are_those_of_the_result_files(monkeypatch):
    monkeypatch.chdir(ROOT)
    assert (ROOT / "docs/results.md").read_text(encoding="utf-8") == results_page(), "run make results-page"
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert readme == with_part(readme, "results", readme_table(RESULTS)), "run make results-page"
    assert readme == with_part(readme, "speed", speed_table(RESULTS)), "run make results-page"
    confidence = (ROOT / "docs/confidence.md").read_text(encoding="utf-8")
    for name, make in CONFIDENCE_PARTS.items():
        assert confidence == with_part(confidence, name, make()), "run make results-page"


@pytest.mark.parametrize(
    "manifest", sorted((ROOT / "common" / "weights").glob("*.json")), ids=lambda p: p.stem
)
def test_the_figures_of_shipped_weights_are_those_of_the_results_they_name(manifest):
    weights = json.loads(manifest.read_text(encoding="utf-8"))
    measured = weights["measured"]["kodak"]
    files = [ROOT / "evaluation" / "results" / Path(file).name for file in measured["file"].split(", ")]
    results = [json.loads(file.read_text(encoding="utf-8")) for file in files]
    rows = {
        (report["settings"]["modulation"], row["snr_db"]): row
        for report in results
        for row in report["results"]
        if row["codec"] == manifest.stem
    }
    for modulation in weights["modulations"]:
        assert measured[modulation], f"{manifest.stem} has no figures of {modulation}"
        for stated in measured[modulation]:
            row = rows[modulation, stated["snr_db"]]
            assert stated["psnr_db"] == pytest.approx(row["psnr_db"], abs=0.002)
            assert stated["ssim"] == pytest.approx(row["ssim"], abs=0.0002)


def test_the_script_of_the_library_page_runs(monkeypatch, capsys):
    monkeypatch.chdir(ROOT)
    # Of half the size, in a third of the time.
    monkeypatch.setattr(sequence, "open_sequence", functools.partial(sequence.open_sequence, resize=0.5))
    page = (ROOT / "docs/library.md").read_text(encoding="utf-8")
    script = re.search(r"```python\n(.*?)```", page, re.DOTALL).group(1)
    exec(compile(script, "library.md", "exec"), {"__name__": "library"})
    *frames, last = capsys.readouterr().out.splitlines()
    assert len(frames) == 8
    assert "tracking" in frames[-1]
    poses, points = (int(word) for word in re.findall(r"\d+", last))
    assert poses == 8
    assert points > 100


def reasons_of_drops():
    """Every constant that the code gives as the reason of a drop."""
    for role in ("agent", "channel", "server"):
        for file in (ROOT / role).rglob("*.py"):
            for call in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
                if not isinstance(call, ast.Call) or not isinstance(call.func, ast.Attribute | ast.Name):
                    continue
                name = call.func.attr if isinstance(call.func, ast.Attribute) else call.func.id
                if name not in ("drop", "_drop", "_on_failure") or not call.args:
                    continue
                reason = call.args[1] if name == "_on_failure" else call.args[0]
                outcomes = [reason.body, reason.orelse] if isinstance(reason, ast.IfExp) else [reason]
                yield from (
                    o.value for o in outcomes if isinstance(o, ast.Constant) and isinstance(o.value, str)
                )


def test_the_names_on_the_library_page_are_there():
    page = (ROOT / "docs/library.md").read_text("utf-8")
    names = set(re.findall(r"semcast(?:\.\w+)+", page))
    assert len(names) > 15
    for name in names:
        resolve_name(name)
    for method in re.findall(r"`Link\.(\w+)", page):
        assert hasattr(Link, method), method


def test_every_channel_that_can_be_set_has_a_model_and_a_row_in_its_page():
    rows = re.findall(r"^\| `(\w+)` \|", (ROOT / "docs/channel-models.md").read_text("utf-8"), re.MULTILINE)
    assert list(get_args(ChannelName)) == list(MODELS) == rows


def test_every_reason_of_a_drop_is_explained_and_no_other():
    page = (ROOT / "docs/troubleshooting.md").read_text(encoding="utf-8")
    table = page.split("## Dropped frames, by reason")[1].split("\n## ")[0]
    cells = re.findall(r"^\| (`.*?) \|", table, re.MULTILINE)
    explained = [reason for cell in cells for reason in re.findall(r"`(\w+)`", cell)]
    assert sorted(explained) == sorted(set(reasons_of_drops()))


def fields_told(title):
    """Names in the first column of a table of fields."""
    page = (ROOT / "docs/file-formats.md").read_text(encoding="utf-8")
    table = page.split(f"## Fields of `{title}`")[1].split("\n## ")[0]
    cells = re.findall(r"^\| (`.*?) \|", table, re.MULTILINE)
    return sorted(name for cell in cells for name in re.findall(r"`(\w+)`", cell))


def test_the_fields_of_a_run_are_told_and_no_others():
    nothing = Trajectory(np.zeros(0), np.zeros((0, 4, 4)))
    figures = summarise([], nothing, {}, None, [], None, {}, 0)
    added = re.findall(r'summary\["(\w+)"\] = ', (ROOT / "server/session.py").read_text(encoding="utf-8"))
    assert fields_told("summary.json") == sorted([*figures, *added])
    assert fields_told("frames.jsonl") == sorted(f.name for f in dataclasses.fields(FrameRow))
