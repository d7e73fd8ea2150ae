"""Cache computed results on disk, one file of arrays for each result.

Files are written atomically and checked when they are read. A long computation stores checkpoints
in a folder beside the file. After an interruption, it continues from these checkpoints.
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
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import numpy as np
import structlog
from numpy.typing import NDArray

if TYPE_CHECKING:
    from flexsheet.messages.scene import Scene

Arrays = Mapping[str, NDArray[Any]]
T = TypeVar("T")

DAMAGE = (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile, zlib.error)
"""The exceptions that can occur when a damaged file, or a file of another program, is read."""

CACHED_S = 1.0
"""The time (s) from the start of a computation in which finished steps count as loaded from the
cache. The estimate of the remaining time ignores these steps."""
MINUTE_S = 60.0


def default_cache_dir() -> Path:
    """Return the user's cache directory: $XDG_CACHE_HOME/flexsheet, or ~/.cache/flexsheet."""
    root = os.environ.get("XDG_CACHE_HOME")
    return (Path(root) if root else Path.home() / ".cache") / "flexsheet"


def advise_precompute(scene: Scene) -> str:
    """Return a text that tells the user how to compute the missing tables of a scene."""
    return f'with the file of the scene "{scene.name}" as SCENE, run flexsheet precompute SCENE'


def make_digest(value: object) -> str:
    """Return a hash of a JSON value, as 24 hexadecimal digits."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:24]


@dataclass(frozen=True, slots=True)
class Specification(Generic[T]):
    """The key of a cached result, and the functions that convert the result to arrays and back.

    kind: first part of the file name.
    depends_on: JSON value of all inputs, including the version of the code that computes the
        result.
    decode: function from arrays to the result. It raises one of the exceptions in `DAMAGE` if the
        arrays are invalid.
    """

    kind: str
    depends_on: object
    encode: Callable[[T], Arrays]
    decode: Callable[[dict[str, NDArray[Any]]], T]

    def path(self, cache_dir: Path | None) -> Path:
        """Return the path of the file that stores the result.

        cache_dir: folder of the cache; None means the cache of the user.
        """
        return (
            cache_dir or default_cache_dir()
        ) / f"{self.kind}-{make_digest(self.depends_on)}.npz"

    def checkpoints(self, cache_dir: Path | None) -> CheckpointStore:
        """Return the store in which an interrupted computation saves its intermediate results.

        cache_dir: folder of the cache; None means the cache of the user.
        """
        return CheckpointStore(self.path(cache_dir).with_suffix(".parts"))


def cached(specification: Specification[T], cache_dir: Path | None, compute: Callable[[], T]) -> T:
    """Return the cached result, or compute and store the result if the cache does not contain it.

    After a computation, the checkpoints are deleted. Raises OSError if the result cannot be
    written, and the exceptions that `compute` raises.
    """
    result = load_cached(specification, cache_dir)
    if result is None:
        result = compute()
        save_cached(specification, cache_dir, result)
        specification.checkpoints(cache_dir).remove()
    return result


def load_cached(specification: Specification[T], cache_dir: Path | None) -> T | None:
    """Return the cached result, or None if the file does not exist or is damaged.

    A damaged file is logged.
    """
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
    """Store a result, and return the path of its file.

    Raises OSError if the file cannot be written.
    """
    path = specification.path(cache_dir)
    save_arrays(path, specification.encode(result))
    return path


def encode_fields(result: Any) -> dict[str, NDArray[Any]]:
    """Return the array fields of a dataclass instance as a dict with the field names as keys."""
    return {one.name: np.asarray(getattr(result, one.name)) for one in fields(result)}


def load_arrays(path: Path) -> dict[str, NDArray[Any]] | None:
    """Return the arrays of a file as a dict with their names as keys.

    Returns None if the file does not exist or is damaged. A damaged file is logged.
    """
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
    """Log a warning that a file is damaged and that its content is computed again."""
    structlog.get_logger().warning(
        "damaged cache file, its content is computed again", path=str(path), error=repr(error)
    )


def save_arrays(path: Path, arrays: Arrays) -> None:
    """Write arrays to a file atomically, so that other processes never read an incomplete file.

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
    """Delete the temporary files of processes that ended while they were writing the file."""
    import psutil

    for leftover in path.parent.glob(f".{path.stem}.*.tmp"):
        owner = leftover.name.split(".")[-2]
        if owner.isdigit() and not psutil.pid_exists(int(owner)):
            leftover.unlink(missing_ok=True)


@dataclass(frozen=True, slots=True)
class CheckpointStore:
    """A store for the finished parts of a computation. Each part is one file in a folder."""

    folder: Path

    def load(self, name: str) -> dict[str, NDArray[Any]] | None:
        """Return the arrays of a stored part, or None if the part does not exist or is damaged."""
        return load_arrays(self._path(name))

    def save(self, name: str, arrays: Arrays) -> None:
        """Store the arrays of a part. Raises OSError if the file cannot be written."""
        save_arrays(self._path(name), arrays)

    def get(
        self, name: str, compute: Callable[[], dict[str, NDArray[Any]]]
    ) -> dict[str, NDArray[Any]]:
        """Return the arrays of a stored part. If the part is not stored, compute and store it."""
        part = self.load(name)
        if part is None:
            part = compute()
            self.save(name, part)
        return part

    def remove(self) -> None:
        """Delete all stored parts of the computation."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def _path(self, name: str) -> Path:
        return self.folder / f"{name}.npz"


class EtaEstimator:
    """An estimator of the remaining time of a long computation.

    The estimate uses the number of finished steps.
    """

    def __init__(self) -> None:
        self._total = self._last = self._cached = 0
        self._start_s = 0.0

    def text(self, done: int, total: int, now_s: float) -> str:
        """Return the progress as text, such as "40 %, about 3 min left".

        done, total: numbers of steps.
        now_s: current time, s.

        If `total` changes or `done` decreases, a new estimate starts.
        """
        if total != self._total or done < self._last:
            self._total, self._start_s = total, now_s
        if now_s - self._start_s < CACHED_S:
            self._cached = done
        self._last = done
        percent = f"{100 * done // max(total, 1)} %"
        if done in (self._cached, total):
            return percent
        left_s = (now_s - self._start_s) / (done - self._cached) * (total - done)
        if left_s < MINUTE_S:
            return f"{percent}, about {max(1, round(left_s))} s left"
        return f"{percent}, about {round(left_s / MINUTE_S)} min left"
