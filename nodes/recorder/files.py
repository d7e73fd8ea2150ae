"""Names of bag files."""

from __future__ import annotations

from itertools import count
from pathlib import Path


def free_path(path: Path) -> Path:
    """`path`, or with -2, -3, ... before its suffix when there is such a file already.

    A recorder that was restarted goes on beside the bag of its former life.
    """
    if not path.exists():
        return path
    for number in count(2):
        candidate = path.with_name(f"{path.stem}-{number}{path.suffix}")
        if not candidate.exists():
            return candidate
    raise AssertionError("count() does not end")
