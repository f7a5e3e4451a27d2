"""An agent starts where nothing of the server is installed; its codec is loaded later."""

import subprocess
import sys

import pytest

BLOCKED = ("torch", "onnxruntime", "gtsam", "rerun", "poselib", "mcap", "matplotlib")


@pytest.mark.parametrize("module", ["semcast.commands.agent", "semcast.commands.channel"])
def test_it_imports_without_the_servers_libraries(module):
    code = (
        f"import sys\nfor name in {BLOCKED!r}: sys.modules[name] = None\n"
        f"import importlib; importlib.import_module({module!r})"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_shipped_weights_are_described_without_torch():
    code = (
        f"import sys\nfor name in {(*BLOCKED, 'safetensors')!r}: sys.modules[name] = None\n"
        "from semcast.cli import main\nsys.exit(main(['info', '3dcsc-lite']))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "3dcsc-lite" in done.stdout
