"""Arrays kept on disk: a file is whole or absent, and is read only if every checksum in it holds.

What takes long is kept part by part while it is computed, in a folder beside the final file, so
that an interrupted computation goes on where it stopped.
"""

from __future__ import annotations

import os
import shutil
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import structlog
from numpy.typing import NDArray

Arrays = Mapping[str, NDArray[Any]]

DAMAGE = (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile, zlib.error)
"""What reading a file that is cut, changed or of another kind may raise."""


def default_cache_dir() -> Path:
    """$XDG_CACHE_HOME/flexsheet, or ~/.cache/flexsheet."""
    root = os.environ.get("XDG_CACHE_HOME")
    return (Path(root) if root else Path.home() / ".cache") / "flexsheet"


def load_arrays(path: Path) -> dict[str, NDArray[Any]] | None:
    """The arrays of a file; None if there is none, or (logged) it is damaged."""
    try:
        # reading a member of the archive to its end verifies its CRC-32
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except FileNotFoundError:
        return None
    except DAMAGE as error:
        say_damaged(path, error)
        return None


def say_damaged(path: Path, error: Exception) -> None:
    """Log that a file is of no use; what it held is computed anew."""
    structlog.get_logger().warning(
        "damaged cache file is computed anew", path=str(path), error=repr(error)
    )


def save_arrays(path: Path, arrays: Arrays) -> None:
    """Keep arrays; a reader sees the whole file or none.  OSError if it cannot be written."""
    path.parent.mkdir(parents=True, exist_ok=True)
    _remove_leftovers(path)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as file:
            np.savez(file, allow_pickle=False, **arrays)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def _remove_leftovers(path: Path) -> None:
    """Delete temporary files of processes that are gone (killed while they wrote)."""
    import psutil

    for leftover in path.parent.glob(f".{path.stem}.*.tmp"):
        owner = leftover.name.split(".")[-2]
        if owner.isdigit() and not psutil.pid_exists(int(owner)):
            leftover.unlink(missing_ok=True)


@dataclass(frozen=True, slots=True)
class Parts:
    """The parts of an unfinished computation, in a folder of their own."""

    folder: Path

    def load(self, name: str) -> dict[str, NDArray[Any]] | None:
        """A part kept before; None as `load_arrays`."""
        return load_arrays(self._path(name))

    def save(self, name: str, arrays: Arrays) -> None:
        """Keep a part.  OSError as `save_arrays`."""
        save_arrays(self._path(name), arrays)

    def remove(self) -> None:
        """Delete all parts, once the whole is kept."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def _path(self, name: str) -> Path:
        return self.folder / f"{name}.npz"
