"""Compute and cache the force table of a scene's sheet, which takes 1 to 2 minutes.

The table contains the sheet's force on the finger by stretch, depth and position. The folder
`tables` of the package contains the table for the sheet of the shipped scenes. Its file is named by
the key of the cache, so an outdated table is not used. The command `python -m
benchmarks.ship_tables` writes it.
"""

from __future__ import annotations

from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.scene import Scene
from flexsheet.messages.sheet_calibration import SheetCalibration
from flexsheet.nodes.cache import Specification, advise_precompute, cached, load_cached
from flexsheet.nodes.methods import Progress
from flexsheet.nodes.models.sheet.force_models import (
    ScaledSheetModel,
    SheetForceModel,
)
from flexsheet.nodes.models.sheet.tabulated import TabulatedSheetModel
from flexsheet.nodes.planner.sheet_force import (
    compute_membrane_table,
    make_force_model,
    make_rubber,
)

VERSION = 1
"""The version of the computation. A cached table of another version is computed again."""

FIELDS = ("stretches", "depths_m", "xs_m", "ys_m", "ratios")
"""The fields of `TabulatedSheetModel` that the cache file contains."""

FOLDER = Path(__file__).with_name("tables")
XS, YS = np.array([0.0, 0.13, 0.25]), np.array([0.0, 0.19, 0.36])
"""The grid of push positions in the table, as fractions of the sheet's width and height."""


def make_table_cache(scene: Scene) -> Specification[TabulatedSheetModel]:
    """Define the key and the format of the cache file for a scene's force table."""
    rubber = make_rubber(scene.sheet)
    depends_on = {
        "version": VERSION,
        "finger_radius_m": scene.finger.radius_m,
        "stretches": [scene.sheet.min_stretch_ratio, scene.sheet.max_stretch_ratio],
        **asdict(rubber),
    }

    def decode(content: dict[str, NDArray[Any]]) -> TabulatedSheetModel:
        stretches, depths_m, xs_m, ys_m, ratios = (content[name] for name in FIELDS)
        return TabulatedSheetModel(
            ScaledSheetModel(rubber), stretches, depths_m, xs_m, ys_m, ratios
        )

    return Specification(
        "sheet-force",
        depends_on,
        lambda table: {name: getattr(table, name) for name in FIELDS},
        decode,
    )


def load_or_compute(
    scene: Scene, cache_dir: Path | None, progress: Progress = lambda done, total: None
) -> TabulatedSheetModel:
    """Return the force table of a scene from the cache.

    A table that is not in the cache is copied from the package, or computed, and stored.
    """
    entry = make_table_cache(scene)
    shipped = load_cached(entry, FOLDER)
    compute = partial(compute_table, scene, progress)
    return cached(entry, cache_dir, compute if shipped is None else lambda: shipped)


def compute_table(
    scene: Scene, progress: Progress = lambda done, total: None
) -> TabulatedSheetModel:
    """Compute the force table of a scene."""
    sheet = scene.sheet
    ends = sorted({sheet.min_stretch_ratio, sheet.max_stretch_ratio})
    return compute_membrane_table(
        make_rubber(sheet),
        stretches=np.array(ends),
        xs_m=sheet.width_m * XS,
        ys_m=sheet.height_m * YS,
        finger_radius_m=scene.finger.radius_m,
        progress=progress,
    )


def choose_force_model(
    scene: Scene, calibration: SheetCalibration | None, cache_dir: Path | None = None
) -> tuple[SheetForceModel, str]:
    """Return the force model that the planner uses for a scene, and a note for the operator.

    calibration: calibration of the sheet, which replaces the computed table; None: not calibrated.

    If neither the cache nor the package contains the table, a `ScaledSheetModel` is returned.
    """
    if calibration is not None:
        return make_force_model(scene.sheet, calibration), "calibrated"
    entry = make_table_cache(scene)
    table = load_cached(entry, cache_dir) or load_cached(entry, FOLDER)
    if table is not None:
        return table, "table"
    note = f"scaled; the table of the sheet's force is missing; {advise_precompute(scene)}"
    return ScaledSheetModel(make_rubber(scene.sheet)), note
