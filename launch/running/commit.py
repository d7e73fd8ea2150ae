"""Determine the git commit of the running code."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

COMMIT_VARIABLE = "FLEXSHEET_COMMIT"
"""The environment variable that contains the commit if the code is not in a git repository."""

SOFTWARE = Path(__file__).resolve().parents[2]


def read_commit() -> str | None:
    """Return the git commit of the code, or None if it is unknown."""
    try:
        result = subprocess.run(
            # Without this option git refuses a clone that belongs to another user.
            ["git", "-c", "safe.directory=*", "-C", str(SOFTWARE), "rev-parse", "HEAD"],
            capture_output=True,
            text=True,
            timeout=5,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return os.environ.get(COMMIT_VARIABLE)
    return result.stdout.strip()
