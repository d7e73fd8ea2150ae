"""Make the force model of a scene's sheet."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from flexsheet.messages.scene import SheetSpec
from flexsheet.messages.sheet_calibration import SheetCalibration, refuse_other_sheet
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.sheet.force_models import (
    ScaledSheetModel,
    SheetForceModel,
    SheetPosition,
    make_model,
)
from flexsheet.nodes.models.sheet.membrane import push_path
from flexsheet.nodes.models.sheet.rubber import Rubber
from flexsheet.nodes.models.sheet.tabulated import TabulatedSheetModel, make_tabulated_model


def make_rubber(sheet: SheetSpec) -> Rubber:
    """Convert the sheet of a scene to a model of ideal (neo-Hookean) rubber."""
    return Rubber(sheet.width_m, sheet.height_m, sheet.thickness_m, sheet.young_modulus_pa)


def make_force_model(
    sheet: SheetSpec, calibration: SheetCalibration | None = None
) -> SheetForceModel:
    """Return the force model of a calibrated sheet, or of ideal rubber if there is no calibration.

    Raises CalibrationMismatchError if the calibrated sheet has another size.
    """
    rubber = make_rubber(sheet)
    if calibration is None:
        return ScaledSheetModel(rubber)
    refuse_other_sheet(calibration, sheet)
    return make_model(
        rubber,
        modulus_thickness_n_per_m=float(calibration.modulus_thickness_n_per_m.value),
        slack_width_m=float(calibration.slack_width_m.value),
        cubic_ratio=float(calibration.cubic_ratio.value),
    )


TABLE_DEPTHS_M = np.array([0.002, 0.004, 0.008, 0.015, 0.025, 0.04, 0.05])


def compute_membrane_table(
    rubber: Rubber,
    *,
    stretches: Floats,
    xs_m: Floats,
    ys_m: Floats,
    finger_radius_m: float,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> TabulatedSheetModel:
    """Compute a table of the sheet's force by the finite element method for membranes.

    stretches: n stretch ratios (n,).
    xs_m, ys_m: coordinates of the pushes on the sheet.
    progress: function that receives the number of finished pushes and the total number of pushes.
    """

    def measure(stretch_ratio: float, depths: Floats, position_m: SheetPosition) -> Floats:
        return push_path(
            rubber,
            stretch_ratio=stretch_ratio,
            depths_m=depths,
            position_m=position_m,
            finger_radius_m=finger_radius_m,
        ).forces_n

    return make_tabulated_model(
        ScaledSheetModel(rubber),
        measure,
        stretches=stretches,
        depths_m=TABLE_DEPTHS_M,
        xs_m=xs_m,
        ys_m=ys_m,
        finger_radius_m=finger_radius_m,
        progress=progress,
    )
