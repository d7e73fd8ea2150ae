"""Load precomputed push solutions that the package contains for some scenes.

From these solutions (snapshots), the coarse nonlinear table of a scene is computed without delay.
The files are in the folder `pushes`. The command `python -m benchmarks.ship_tables` writes them.
The file name contains a key that depends on all inputs of the solutions. Therefore an outdated file
is not used.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexsheet.nodes.cache import Specification, load_arrays
from flexsheet.nodes.fem_solver.snapshots import Snapshot
from flexsheet.nodes.fem_solver.table import Table

KEYS = ("rest", "faces", "depths_m", "moved", "scale_m", "force_n", "reached")
FOLDER = Path(__file__).with_name("pushes")
LEVELS = 32767
"""The number of quantization steps between zero and the largest displacement at a depth."""


def shipped_path(entry: Specification[Table]) -> Path:
    """Return the path of the file with precomputed push solutions for a table.

    The package contains this file only for some tables.
    """
    return FOLDER / entry.path(FOLDER).name


def load_shipped(path: Path) -> dict[str, Snapshot]:
    """Load push solutions (snapshots) from a file, as a dict with their names as keys.

    Returns an empty dict if the file does not exist.
    """
    content = load_arrays(path)
    if content is None:
        return {}
    names = sorted({name.partition("/")[0] for name in content})
    return {name: _decode({key: content[f"{name}/{key}"] for key in KEYS}) for name in names}


def _decode(arrays: Mapping[str, NDArray[Any]]) -> Snapshot:
    return Snapshot(
        rest=arrays["rest"].astype(np.float64),
        faces=arrays["faces"].astype(np.int64),
        depths_m=arrays["depths_m"],
        moved=arrays["moved"] * arrays["scale_m"][:, None, None].astype(np.float32),
        force_n=arrays["force_n"],
        reached=int(arrays["reached"]),
    )


def save_shipped(path: Path, snapshots: Mapping[str, Snapshot]) -> None:
    """Write push solutions (snapshots) to a compressed file, with displacements rounded to 16 bits.

    snapshots: solutions, with their names as keys.
    """
    arrays: dict[str, NDArray[Any]] = {}
    for name, one in snapshots.items():
        scale_m = np.abs(one.moved).max(axis=(1, 2), initial=1e-9) / LEVELS
        encoded = {
            "rest": one.rest.astype(np.float32),
            "faces": one.faces.astype(np.uint16),
            "depths_m": one.depths_m,
            "moved": np.round(one.moved / scale_m[:, None, None]).astype(np.int16),
            "scale_m": scale_m,
            "force_n": one.force_n,
            "reached": np.array(one.reached),
        }
        arrays |= {f"{name}/{key}": encoded[key] for key in KEYS}
    path.parent.mkdir(exist_ok=True)
    np.savez_compressed(path, allow_pickle=False, **arrays)
