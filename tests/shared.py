"""Share expensive results between all processes of a test run."""

from __future__ import annotations

import fcntl
import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

T = TypeVar("T")

FOLDER_VARIABLE = "FLEXSHEET_TESTS_SHARED"
"""Environment variable: the folder of this run's results.  `tests/conftest.py` sets it."""


def compute_once(name: str, compute: Callable[[], T]) -> T:
    """Return the result of `compute`, which only one process of the test run executes.

    name: name of the result. Each name must belong to one computation.
    """
    folder = os.environ.get(FOLDER_VARIABLE)
    if folder is None:
        return compute()
    path = Path(folder, f"{name}.pickle")
    with Path(folder, f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if path.exists():
            result: T = pickle.loads(path.read_bytes())
            return result
        result = compute()
        path.write_bytes(pickle.dumps(result))
        return result
