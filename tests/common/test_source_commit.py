import subprocess

import pytest

import semcast
from semcast.common.source_commit import source_commit

VERSION = f"semcast {semcast.__version__}"


def git(folder, *words):
    name = ("-c", "user.name=A", "-c", "user.email=a@b.c")
    done = subprocess.run(["git", "-C", folder, *name, *words], capture_output=True, text=True, check=True)
    return done.stdout.strip()


@pytest.fixture
def checkout(tmp_path):
    """A repository with one committed file, ``code.py``."""
    git(tmp_path, "init", "--quiet")
    (tmp_path / "code.py").write_text("1\n")
    git(tmp_path, "add", "code.py")
    git(tmp_path, "commit", "--quiet", "--message", "first")
    return tmp_path


def test_code_of_a_checkout_is_of_its_commit_and_changes_are_told(checkout):
    head = git(checkout, "rev-parse", "HEAD")
    assert source_commit(checkout / "code.py") == head
    (checkout / "code.py").write_text("2\n")
    assert source_commit(checkout / "code.py") == f"{head}+changes"


def test_code_installed_inside_a_checkout_of_something_else_is_not_of_that_commit(checkout):
    installed = checkout / ".venv" / "code.py"
    installed.parent.mkdir()
    installed.write_text("1\n")
    assert source_commit(installed) == VERSION


def test_code_outside_of_any_checkout_is_of_its_version(tmp_path):
    (tmp_path / "code.py").write_text("1\n")
    assert source_commit(tmp_path / "code.py") == VERSION
