"""Find the commit of the running code, and whether its sources were changed since."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path

COMMIT_VARIABLE = "FLEXSHEET_COMMIT"
SOURCE_PATHS = ("messages", "nodes", "launch", "flexsheet", "pyproject.toml")
"""Paths of the repository that contain all code that a run executes."""

SOURCE_SUFFIXES = {".py", ".glsl", ".css", ".js"}
"""Suffixes of new files that change a run.

A new launch file, scene or mesh affects a run only if a launch file names it."""

UNTRACKED = "??"


def read_git_state(directory: Path) -> str:
    """Return the commit of the code and whether its sources were changed since, as JSON.

    directory: root of the repository. commit: outside of git the value of COMMIT_VARIABLE, else
    null. changed: null outside of git.
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
    """Evaluate the output of `git status --porcelain -z`: entries of two letters and a path."""
    entries = [entry for entry in listed.split("\0") if entry]
    return any(
        not entry.startswith(UNTRACKED) or Path(entry).suffix in SOURCE_SUFFIXES
        for entry in entries
    )


def _git(directory: Path, *arguments: str) -> str | None:
    """Return what git prints, None where it fails or is missing."""
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
