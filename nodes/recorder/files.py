"""Bag files: their names, what each begins with, and room for them."""

from __future__ import annotations

import mimetypes
from collections.abc import Iterable, Mapping
from contextlib import suppress
from itertools import count
from pathlib import Path

from flexsheet.messages.bag import BagError, BagWriter
from flexsheet.messages.files import free_bytes

__all__ = ["free_bytes", "free_path", "open_bag"]


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


def open_bag(
    path: Path, recording: Mapping[str, str], *, compress: bool, attach: Iterable[Path]
) -> BagWriter:
    """A new bag at a free path, with the files to attach in it; raises BagError, OSError."""
    bag = BagWriter(free_path(path), {"recording": recording}, compress=compress)
    try:
        for file in attach:
            media_type = mimetypes.guess_type(file.name)[0] or "application/octet-stream"
            bag.add_attachment(file.name, file.read_bytes(), media_type)
    except BaseException:
        with suppress(BagError):
            bag.close()
        raise
    return bag
