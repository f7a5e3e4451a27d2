"""What ``semcast eval`` does around a measurement: results that can't be kept are refused before it."""

import pytest

from semcast.cli import main
from semcast.commands.evaluate import EVALUATIONS

#: Inputs that are not there: that they are missing is said by the measurement itself.
INPUTS = {"codec": ["--images", "missing"], "recording": ["missing.mcap"], "runtime": ["--codec", "missing"]}


@pytest.mark.parametrize("what", EVALUATIONS)
def test_a_result_that_can_not_be_kept_is_said_before_the_measurement(what, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    words = ["eval", what, *INPUTS.get(what, ["--sequence", "missing"])]
    places = {"--json": tmp_path / "file" / "result.json"}
    if any(field == "out" for field in EVALUATIONS[what][0].__dataclass_fields__):
        places["--out"] = tmp_path / "file"
    for flag, place in places.items():
        assert main([*words, flag, str(place)]) == 1
        said = capsys.readouterr().err
        assert said.startswith(f"semcast eval: {flag.removeprefix('--')} "), said
        assert str(place) in said
        assert said.count("\n") == 1
