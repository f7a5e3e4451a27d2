"""Who may import whom, and where each outside library lives."""

import ast
import functools
import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("common", "channel", "agent", "server", "training", "evaluation")
MAY_IMPORT = {
    "common": {"common"},
    "channel": {"channel", "common"},
    "agent": {"agent", "common", "channel"},
    "server": {"server", "common", "channel"},
    "training": {"training", "common", "channel"},
    "evaluation": {"evaluation", "common", "channel", "agent", "server", "training"},
}
HOMES = {
    "zenoh": {"common/transport.py"},
    "msgpack": {"common/wire.py"},
    "gtsam": {"server/mapping/bundle.py", "server/mapping/pose_graph.py"},
    "rerun": {"server/view/rerun_viewer.py"},
    "mcap": {"common/recording_writer.py"},
    "matplotlib": {"evaluation/plots.py"},
    "poselib": {
        *(
            f"server/geometry/{name}.py"
            for name in ("lo_ransac", "pnp", "ransac", "two_view_candidates", "wide_search")
        ),
        "server/mapping/planar_ambiguity.py",
    },
    "rosbags": {"agent/ros_bag.py"},
    "safetensors": {"common/nets/checkpoint.py"},
    "onnxruntime": {"common/nets/onnx_encoder.py", "training/onnx_int8.py"},
    "onnx": {"training/onnx_export.py"},
}


def python_files(folder):
    return sorted(p for p in (ROOT / folder).rglob("*.py") if "build" not in p.parts)


@functools.cache
def nodes_of(path):
    """Everything in a file that a rule here is about."""
    kinds = ast.Import | ast.ImportFrom | ast.FunctionDef | ast.AsyncFunctionDef
    return [node for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(node, kinds)]


def imports_of(path):
    for node in nodes_of(path):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield "." * node.level + (node.module or "")


@pytest.mark.parametrize("folder", FOLDERS)
def test_imports_go_one_way(folder):
    wrong = []
    for path in python_files(folder):
        for name in imports_of(path):
            if name.startswith(".") or name.split(".")[0] in FOLDERS:
                wrong.append(f"{path.relative_to(ROOT)} imports {name}: use semcast.<folder>")
            parts = name.split(".")
            if parts[0] == "semcast" and len(parts) > 1 and parts[1] not in MAY_IMPORT[folder]:
                wrong.append(f"{path.relative_to(ROOT)} imports {name}")
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize(
    ("folder", "may_import"),
    [
        ("geometry", {"geometry"}),
        ("mapping", {"geometry", "mapping"}),
        ("dense", {"geometry", "mapping", "dense"}),
        ("view", {"mapping", "dense", "view"}),
        ("export", {"export", "geometry", "view"}),
    ],
)
def test_the_servers_folders_are_layers(folder, may_import):
    # The process that works beside the server knows nothing of it.
    below = {"worker"}
    wrong = []
    for path in python_files(f"server/{folder}"):
        for name in imports_of(path):
            parts = name.split(".")
            if parts[:2] == ["semcast", "server"] and not set(parts[2:3]) <= may_import | below:
                wrong.append(f"{path.relative_to(ROOT)} imports {name}")
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize(
    "folder",
    sorted(
        str(path.parent.relative_to(ROOT)) for top in FOLDERS for path in (ROOT / top).rglob("__init__.py")
    ),
)
def test_the_guide_to_a_folder_names_each_of_its_modules_once(folder):
    docstring = ast.get_docstring(ast.parse((ROOT / folder / "__init__.py").read_text(encoding="utf-8")))
    named = re.findall(r"^ {4}(\w+) +\S", docstring, re.MULTILINE)
    modules = [path.stem for path in (ROOT / folder).glob("*.py") if path.stem != "__init__"]
    assert sorted(named) == sorted(modules)


@pytest.mark.parametrize("library", sorted(HOMES))
def test_each_outside_library_has_one_home(library):
    users = {
        str(path.relative_to(ROOT))
        for folder in (*FOLDERS, "src/semcast")
        for path in python_files(folder)
        if any(name.split(".")[0] == library for name in imports_of(path))
    }
    assert users == HOMES[library], f"{library} is imported in {HOMES[library]} alone, found {users}"


def test_torch_stays_out_of_the_light_part_of_common():
    users = {
        path.relative_to(ROOT / "common").parts[0]
        for path in python_files("common")
        if any(name.split(".")[0] == "torch" for name in imports_of(path))
    }
    assert users <= {"nets", "phy", "image.py"}


def test_the_package_list_is_the_folders():
    setup = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]
    roots = {name: ROOT / folder for name, folder in setup["package-dir"].items()}
    found = set()
    for name, folder in roots.items():
        for init in folder.rglob("__init__.py"):
            found.add(".".join((name, *init.parent.relative_to(folder).parts)))
    assert found == set(setup["packages"])


@pytest.mark.parametrize("folder", [*FOLDERS, "src/semcast"])
def test_no_python_file_is_longer_than_500_lines(folder):
    long = {
        str(p.relative_to(ROOT)): n
        for p in python_files(folder)
        if (n := len(p.read_text().splitlines())) > 500
    }
    assert not long


def functions_of(path):
    return [node for node in nodes_of(path) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]


def lines_without_docstring(function):
    lines = function.end_lineno - function.lineno + 1
    if ast.get_docstring(function, clean=False) is None:
        return lines
    docstring = function.body[0]
    return lines - (docstring.end_lineno - docstring.lineno + 1)


@pytest.mark.parametrize("folder", [*FOLDERS, "src/semcast"])
def test_no_function_is_longer_than_60_lines_besides_its_docstring(folder):
    long = {
        f"{path.relative_to(ROOT)}: {function.name}": lines
        for path in python_files(folder)
        for function in functions_of(path)
        if (lines := lines_without_docstring(function)) > 60
    }
    assert not long
