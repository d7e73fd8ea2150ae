"""Test whether the code counts as changed since its commit."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest

from flexsheet.launch.running.code_state import read_git_state


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    """Create a repository with one commit of a package, a launch file and a page."""
    for name in ("nodes/twin/node.py", "launch/demo.yaml", "docs/index.md"):
        write(tmp_path, name)
    identity = ["-c", "user.name=tester", "-c", "user.email=tester@example.org"]
    for arguments in (["init", "-q"], ["add", "."], [*identity, "commit", "-q", "-m", "first"]):
        subprocess.run(["git", "-C", str(tmp_path), *arguments], check=True)
    return tmp_path


def write(repository: Path, name: str, text: str = "# as it was\n") -> None:
    path = repository / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def test_the_commit_is_named_and_unchanged(repository: Path) -> None:
    state = json.loads(read_git_state(repository))
    assert len(state["commit"]) == 40
    assert state["changed"] is False


@pytest.mark.parametrize(
    "name",
    ["session.mcap", "runs/20260101-120000.mcap", "own.yaml", "launch/own.yaml",
     "launch/scenes/own.yaml", "launch/scenes/hand.obj", "notebook.py", "tests/test_own.py"],
)  # fmt: skip
def test_new_files_that_no_run_executes_are_no_change(repository: Path, name: str) -> None:
    write(repository, name)
    assert json.loads(read_git_state(repository))["changed"] is False


@pytest.mark.parametrize("name", ["nodes/own/node.py", "messages/own.py", "nodes/own/ a b.glsl"])
def test_a_new_source_file_is_a_change(repository: Path, name: str) -> None:
    write(repository, name)
    assert json.loads(read_git_state(repository))["changed"] is True


@pytest.mark.parametrize(
    ("name", "changed"),
    [("nodes/twin/node.py", True), ("launch/demo.yaml", True), ("docs/index.md", False)],
)
def test_an_edited_file_is_a_change_where_runs_use_it(
    repository: Path, name: str, changed: bool
) -> None:
    write(repository, name, "# another text\n")
    assert json.loads(read_git_state(repository))["changed"] is changed


def test_a_removed_and_a_renamed_source_file_are_changes(repository: Path) -> None:
    (repository / "nodes/twin/node.py").rename(repository / "nodes/twin/moved.py")
    subprocess.run(["git", "-C", str(repository), "add", "-A"], check=True)
    assert json.loads(read_git_state(repository))["changed"] is True


def test_outside_of_git_nothing_is_known(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path.parent))
    monkeypatch.setenv("FLEXSHEET_COMMIT", "abc")
    assert json.loads(read_git_state(tmp_path)) == {"commit": "abc", "changed": None}
