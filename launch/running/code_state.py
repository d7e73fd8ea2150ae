"""Determine the git commit of the running code, and whether files have changed since the commit."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path

COMMIT_VARIABLE = "FLEXSHEET_COMMIT"
SOURCE_PATHS = ("messages", "nodes", "launch", "flexsheet", "pyproject.toml")
"""The paths in the repository that contain all code of flexsheet."""

SOURCE_SUFFIXES = {".py", ".glsl", ".css", ".js"}
"""The suffixes of files that count as changes of the code although git does not track them.

Other files, such as new scenes and meshes, affect a run only if a launch file names them.
"""

UNTRACKED = "??"


def read_git_state(directory: Path) -> str:
    """Return a JSON text with the git commit of the code, and whether files have changed.

    The keys of the JSON object are `commit` and `changed`. If the code is not in a git repository,
    `changed` is null. The value of `commit` is then taken from the environment variable that
    COMMIT_VARIABLE names, or is null.

    directory: root of the repository.
    """
    listed = _git(
        directory, "status", "--porcelain", "-z", "--untracked-files=all", "--", *SOURCE_PATHS
    )
    state = {
        "commit": _git(directory, "rev-parse", "HEAD") or os.environ.get(COMMIT_VARIABLE) or None,
        "changed": None if listed is None else _has_changed_sources(listed),
    }
    return json.dumps(state)


def _has_changed_sources(listed: str) -> bool:
    """Return whether sources have changed, given the output of `git status --porcelain -z`."""
    entries = [entry for entry in listed.split("\0") if entry]
    return any(
        not entry.startswith(UNTRACKED) or Path(entry).suffix in SOURCE_SUFFIXES
        for entry in entries
    )


def _git(directory: Path, *arguments: str) -> str | None:
    """Run git in a directory and return its output, or None if git fails or is not installed."""
    try:
        result = subprocess.run(
            # Without this option git refuses a clone that belongs to another user.
            ["git", "-c", "safe.directory=*", "-C", str(directory), *arguments],
            capture_output=True,
            text=True,
            timeout=5,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return result.stdout.strip("\n")
