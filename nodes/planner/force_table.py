"""Keeps the table of a sheet's force from one run to the next: it takes a minute or two to make."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import numpy as np

from messages.methods import SheetForceMethod
from messages.scene import Scene
from nodes.cache import default_cache_dir, load_arrays, save_arrays
from nodes.methods import Progress
from nodes.models.sheet.force_models import LinearSheetModel, ScaledSheetModel, SheetForceModel
from nodes.models.sheet.rubber import Rubber
from nodes.models.sheet.tabulated import TabulatedSheetModel
from nodes.planner.sheet_force import membrane_table, rubber_of

VERSION = 1
"""Of the table's making; another one makes it anew."""

KEPT = ("stretches", "depths_m", "xs_m", "ys_m", "ratios")
"""Fields of `TabulatedSheetModel` that are in the file."""

XS, YS = np.array([0.0, 0.13, 0.25]), np.array([0.0, 0.19, 0.36])
"""Places, over the sheet's width and height."""

LAWS: dict[str, Callable[[Rubber], SheetForceModel]] = {
    "linear": LinearSheetModel,
    "scaled": ScaledSheetModel,
}


def file_of(scene: Scene, cache_dir: Path | None) -> Path:
    """Where the scene's table is kept: the name tells what it is of.  None: the default."""
    told = {
        "version": VERSION,
        "finger_radius_m": scene.finger.radius_m,
        "stretches": [scene.sheet.min_stretch_ratio, scene.sheet.max_stretch_ratio],
        **asdict(rubber_of(scene.sheet)),
    }
    digest = hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()[:24]
    return (cache_dir or default_cache_dir()) / f"sheet-force-{digest}.npz"


def load(scene: Scene, cache_dir: Path | None) -> TabulatedSheetModel | None:
    """The scene's table, or None where it is not kept, or the file is damaged."""
    kept = load_arrays(file_of(scene, cache_dir))
    if kept is None or not kept.keys() >= set(KEPT):
        return None
    stretches, depths_m, xs_m, ys_m, ratios = (kept[name] for name in KEPT)
    base = ScaledSheetModel(rubber_of(scene.sheet))
    return TabulatedSheetModel(base, stretches, depths_m, xs_m, ys_m, ratios)


def load_or_make(
    scene: Scene, cache_dir: Path | None, progress: Progress = lambda done, total: None
) -> TabulatedSheetModel:
    """The scene's table from the cache; else made by the membrane's finite elements, and kept."""
    table = load(scene, cache_dir)
    if table is not None:
        return table
    sheet = scene.sheet
    ends = sorted({sheet.min_stretch_ratio, sheet.max_stretch_ratio})
    table = membrane_table(
        rubber_of(sheet),
        stretches=np.array(ends),
        xs_m=sheet.width_m * XS,
        ys_m=sheet.height_m * YS,
        finger_radius_m=scene.finger.radius_m,
        progress=progress,
    )
    save_arrays(file_of(scene, cache_dir), {name: getattr(table, name) for name in KEPT})
    return table


def law_by(
    scene: Scene, method: SheetForceMethod, cache_dir: Path | None
) -> tuple[SheetForceModel, str]:
    """The scene's ideal sheet by a method, and what to say of it: a table that nobody made yet is
    stood in for by the scaled law."""
    rubber = rubber_of(scene.sheet)
    if method != "table":
        return LAWS[method](rubber), method
    table = load(scene, cache_dir)
    if table is None:
        return ScaledSheetModel(
            rubber
        ), "scaled; there is no table of the sheet's force: run flexsheet prepare"
    return table, method
