"""Cache computed results on disk, in one file of arrays per result.

Files are written atomically and checked when they are read.  A long computation stores checkpoints
in a folder beside the file, and continues from them after an interruption.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import zipfile
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
import structlog
from numpy.typing import NDArray

Arrays = Mapping[str, NDArray[Any]]
T = TypeVar("T")

DAMAGE = (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile, zlib.error)
"""Exceptions that can occur when a truncated, modified or foreign file is read."""

CACHED_S = 1.0
"""Time after the start in which finished steps count as cached; the estimate excludes them."""
MINUTE_S = 60.0


def default_cache_dir() -> Path:
    """Return the user's cache directory: $XDG_CACHE_HOME/flexsheet, or ~/.cache/flexsheet."""
    root = os.environ.get("XDG_CACHE_HOME")
    return (Path(root) if root else Path.home() / ".cache") / "flexsheet"


def make_digest(value: object) -> str:
    """Return a digest of a JSON value; equal values have equal digests."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:24]


@dataclass(frozen=True, slots=True)
class Specification(Generic[T]):
    """Key of a cached result, and its conversion to arrays and back.

    kind: first part of the file name. depends_on: JSON value of all inputs, including the version
    of the code that computes the result. decode: raises one of `DAMAGE` for invalid arrays.
    """

    kind: str
    depends_on: object
    encode: Callable[[T], Arrays]
    decode: Callable[[dict[str, NDArray[Any]]], T]

    def path(self, cache_dir: Path | None) -> Path:
        """Return the path of the result's file. cache_dir: None for the user's cache."""
        return (
            cache_dir or default_cache_dir()
        ) / f"{self.kind}-{make_digest(self.depends_on)}.npz"

    def checkpoints(self, cache_dir: Path | None) -> CheckpointStore:
        """Return the store for checkpoints of the computation of this result."""
        return CheckpointStore(self.path(cache_dir).with_suffix(".parts"))


def cached(specification: Specification[T], cache_dir: Path | None, compute: Callable[[], T]) -> T:
    """Return the cached result; if there is none, compute and store it, and delete checkpoints.

    Raises OSError if the result cannot be written, and the exceptions of `compute`.
    """
    result = load_cached(specification, cache_dir)
    if result is None:
        result = compute()
        save_cached(specification, cache_dir, result)
        specification.checkpoints(cache_dir).remove()
    return result


def load_cached(specification: Specification[T], cache_dir: Path | None) -> T | None:
    """Return the cached result; None if the file does not exist or is damaged (logged)."""
    path = specification.path(cache_dir)
    content = load_arrays(path)
    if content is None:
        return None
    try:
        return specification.decode(content)
    except DAMAGE as error:
        warn_damaged(path, error)
        return None


def save_cached(specification: Specification[T], cache_dir: Path | None, result: T) -> Path:
    """Store a result and return its file. Raises OSError if the file cannot be written."""
    path = specification.path(cache_dir)
    save_arrays(path, specification.encode(result))
    return path


def encode_fields(result: Any) -> dict[str, NDArray[Any]]:
    """Return the array fields of a dataclass by name."""
    return {one.name: np.asarray(getattr(result, one.name)) for one in fields(result)}


def load_arrays(path: Path) -> dict[str, NDArray[Any]] | None:
    """Return the arrays of a file; None if it does not exist or is damaged (logged)."""
    try:
        # Reading a member of the archive to its end verifies its CRC-32.
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except FileNotFoundError:
        return None
    except DAMAGE as error:
        warn_damaged(path, error)
        return None


def warn_damaged(path: Path, error: Exception) -> None:
    """Log that a file is damaged and that its content is computed again."""
    structlog.get_logger().warning(
        "damaged cache file, its content is computed again", path=str(path), error=repr(error)
    )


def save_arrays(path: Path, arrays: Arrays) -> None:
    """Write arrays to a file atomically.

    Raises OSError if the file cannot be written.
    """
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
    """Delete the temporary files of processes that were killed during a write."""
    import psutil

    for leftover in path.parent.glob(f".{path.stem}.*.tmp"):
        owner = leftover.name.split(".")[-2]
        if owner.isdigit() and not psutil.pid_exists(int(owner)):
            leftover.unlink(missing_ok=True)


@dataclass(frozen=True, slots=True)
class CheckpointStore:
    """Store for finished parts of a computation; each part is one file in a folder."""

    folder: Path

    def load(self, name: str) -> dict[str, NDArray[Any]] | None:
        """Return a stored part of the computation; None if it does not exist or is damaged."""
        return load_arrays(self._path(name))

    def save(self, name: str, arrays: Arrays) -> None:
        """Store a part of the computation. Raises OSError if the file cannot be written."""
        save_arrays(self._path(name), arrays)

    def get(
        self, name: str, compute: Callable[[], dict[str, NDArray[Any]]]
    ) -> dict[str, NDArray[Any]]:
        """Return a stored part, or compute and store it."""
        part = self.load(name)
        if part is None:
            part = compute()
            self.save(name, part)
        return part

    def remove(self) -> None:
        """Delete all parts."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def _path(self, name: str) -> Path:
        return self.folder / f"{name}.npz"


class EtaEstimator:
    """Estimator of a long computation's remaining time from its finished steps."""

    def __init__(self) -> None:
        self._total = self._last = self._cached = 0
        self._start_s = 0.0

    def text(self, done: int, total: int, now_s: float) -> str:
        """Return the progress at the time now_s as text, such as "40 %, about 3 min left".

        If `total` changes, or `done` decreases, a new estimate starts.
        """
        if total != self._total or done < self._last:
            self._total, self._start_s = total, now_s
        if now_s - self._start_s < CACHED_S:
            self._cached = done
        self._last = done
        percent = f"{100 * done // total} %"
        if done in (self._cached, total):
            return percent
        left_s = (now_s - self._start_s) / (done - self._cached) * (total - done)
        if left_s < MINUTE_S:
            return f"{percent}, about {max(1, round(left_s))} s left"
        return f"{percent}, about {round(left_s / MINUTE_S)} min left"
