"""The law of a scene's sheet, and the sheet-force method family."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from itertools import product

import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.scene import Scene, SheetSpec
from flexsheet.messages.sheet_calibration import SheetCalibration, refuse_other_sheet
from flexsheet.nodes.methods import Family, Trial, clip_range
from flexsheet.nodes.models.sheet.force_models import (
    LinearSheetModel,
    MembraneSheetModel,
    Place,
    ScaledSheetModel,
    SheetForce,
    SheetForceModel,
    make_model,
)
from flexsheet.nodes.models.sheet.membrane import push_path
from flexsheet.nodes.models.sheet.rubber import Rubber
from flexsheet.nodes.models.sheet.tabulated import TabulatedSheetModel, make_tabulated_model

Floats = NDArray[np.float64]

Judge = Callable[[SheetSpec, float, float, Place, float], float]
"""The true force (N) at a stretch ratio, a depth (m), a place and a fingertip radius."""


def rubber_of(sheet: SheetSpec) -> Rubber:
    """The scene's sheet as ideal (neo-Hookean) rubber."""
    return Rubber(sheet.width_m, sheet.height_m, sheet.thickness_m, sheet.young_modulus_pa)


def law_for(sheet: SheetSpec, calibration: SheetCalibration | None = None) -> SheetForceModel:
    """The law to plan with: as calibrated, else the scaled law of the scene's sheet.

    CalibrationMismatchError for a calibration of a sheet of other sizes.
    """
    rubber = rubber_of(sheet)
    if calibration is None:
        return ScaledSheetModel(rubber)
    refuse_other_sheet(calibration, sheet)
    mooney = calibration.mooney_share
    law = make_model(
        rubber,
        modulus_thickness_n_per_m=float(calibration.modulus_thickness_n_per_m.value),
        slack_width_m=float(calibration.slack_width_m.value),
        cubic_ratio=float(calibration.cubic_ratio.value),
        mooney_share=0.0 if mooney is None else float(mooney.value),
    )
    table = calibration.table
    if table is None:
        return law
    return TabulatedSheetModel(
        law, table.stretch_ratios, table.depths_m, table.xs_m, table.ys_m, table.ratios
    )


TABLE_DEPTHS_M = np.array([0.002, 0.004, 0.008, 0.015, 0.025, 0.04, 0.05])


def membrane_table(
    rubber: Rubber,
    *,
    stretches: Floats,
    xs_m: Floats,
    ys_m: Floats,
    finger_radius_m: float,
    depths_m: Floats = TABLE_DEPTHS_M,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> TabulatedSheetModel:
    """The table that the membrane's finite elements give: a push for each stretch and place."""

    def measure(stretch_ratio: float, depths: Floats, place_m: Place) -> Floats:
        return push_path(
            rubber,
            stretch_ratio=stretch_ratio,
            depths_m=depths,
            place_m=place_m,
            finger_radius_m=finger_radius_m,
        ).forces_n

    return make_tabulated_model(
        ScaledSheetModel(rubber),
        measure,
        stretches=stretches,
        depths_m=depths_m,
        xs_m=xs_m,
        ys_m=ys_m,
        finger_radius_m=finger_radius_m,
        progress=progress,
    )


CHART_DEPTHS_M = (0.002, 0.005, 0.010, 0.020, 0.040)
SLOW_DEPTHS_M = (0.005, 0.020)
"""The slow one is charted at these only, at the middle of stretch and sheet."""
CHART_PLACES: tuple[tuple[str, float, float], ...] = (
    ("centre", 0.0, 0.0),
    ("off-centre", 0.13, 0.19),
    ("near the clamp", 0.25, 0.0),
    ("near the free edge", 0.0, 0.36),
)
"""Names, and x over the width, y over the height."""


TableOf = Callable[[Scene], TabulatedSheetModel]


def sheet_force_family(judge: Judge, table_of: TableOf | None) -> Family:
    """Every law at the scene's stretches, slack and at the arms' limit, over depths and places.

    table_of: makes the table, or has it; None: without the laws that take minutes.
    """
    return Family(
        name="sheet-force",
        unit="%",
        reference="the twin's membrane",
        methods=("linear", "scaled", "table", "membrane"),
        trials=partial(_trials, judge, table_of),
        tolerance=lambda scene: 100.0 * scene.tolerances.force_ratio,
    )


def _trials(judge: Judge, table_of: TableOf | None, scene: Scene) -> Iterator[Trial]:
    sheet, radius = scene.sheet, scene.finger.radius_m
    rubber = rubber_of(sheet)
    middle = 0.5 * (sheet.min_stretch_ratio + sheet.max_stretch_ratio)
    laws: list[SheetForceModel] = [LinearSheetModel(rubber), ScaledSheetModel(rubber)]
    if table_of is not None:
        laws += [table_of(scene), MembraneSheetModel(rubber)]
    stretches = (1.0, middle, sheet.max_stretch_ratio)
    depths_m = clip_range(scene.working_range.push_depth_m, CHART_DEPTHS_M)
    for stretch, depth, (where, x, y) in product(stretches, depths_m, CHART_PLACES):
        if where != "centre" and stretch != middle:
            continue
        place = (x * rubber.width_m, y * rubber.height_m)
        true_n = judge(sheet, stretch, depth, place, radius)
        for law in laws:
            slow = law.name == "membrane"
            if slow and not (stretch == middle and where == "centre" and depth in SLOW_DEPTHS_M):
                continue
            yield Trial(
                method=law.name,
                case={"stretch": stretch, "depth_mm": 1e3 * depth, "place": where},
                run=partial(
                    law.evaluate,
                    stretch,
                    np.array([depth]),
                    place_m=place,
                    finger_radius_m=radius,
                ),
                error=partial(_error_percent, true_n=true_n),
                in_range=not law.invalid_reason(
                    stretch, depth, place_m=place, finger_radius_m=radius
                ),
                in_scene=stretch >= sheet.min_stretch_ratio,
            )


def _error_percent(pressed: SheetForce, *, true_n: float) -> float:
    return 100.0 * abs(float(pressed.force_n[0]) / true_n - 1.0)
