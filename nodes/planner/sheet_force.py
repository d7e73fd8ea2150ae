"""Make the force model of a scene's sheet, and benchmark the available force models."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from itertools import product

import numpy as np

from flexsheet.messages.scene import Scene, SheetSpec
from flexsheet.messages.sheet_calibration import SheetCalibration, refuse_other_sheet
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.methods import Family, Trial, clip_range
from flexsheet.nodes.models.sheet.force_models import (
    MembraneSheetModel,
    ScaledSheetModel,
    SheetForce,
    SheetForceModel,
    SheetPosition,
    SheetPush,
    make_model,
)
from flexsheet.nodes.models.sheet.membrane import push_path
from flexsheet.nodes.models.sheet.rubber import Rubber
from flexsheet.nodes.models.sheet.tabulated import TabulatedSheetModel, make_tabulated_model

ReferenceForce = Callable[[SheetSpec, float, float, SheetPosition, float], float]
"""A function that returns the reference force (N) of a push.

Its arguments are the sheet, the stretch ratio, the depth (m), the position and the fingertip radius
(m)."""


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
    mooney = calibration.mooney_ratio
    model = make_model(
        rubber,
        modulus_thickness_n_per_m=float(calibration.modulus_thickness_n_per_m.value),
        slack_width_m=float(calibration.slack_width_m.value),
        cubic_ratio=float(calibration.cubic_ratio.value),
        mooney_ratio=0.0 if mooney is None else float(mooney.value),
    )
    table = calibration.table
    if table is None:
        return model
    return TabulatedSheetModel(
        model, table.stretch_ratios, table.depths_m, table.xs_m, table.ys_m, table.ratios
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


BENCHMARK_DEPTHS_M = (0.002, 0.005, 0.010, 0.020, 0.040)
SLOW_DEPTHS_M = (0.005, 0.020)
"""The push depths at which slow models are benchmarked. These models are benchmarked only at the
mean stretch and at the sheet's centre."""
BENCHMARK_POSITIONS: tuple[tuple[str, float, float], ...] = (
    ("centre", 0.0, 0.0),
    ("off-centre", 0.13, 0.19),
    ("near the clamp", 0.25, 0.0),
    ("near the free edge", 0.0, 0.36),
)
"""The benchmarked positions: name, x as a fraction of the width, and y as a fraction of the height.
"""


MakeTable = Callable[[Scene], TabulatedSheetModel]


def sheet_force_family(reference: ReferenceForce, make_table: MakeTable | None) -> Family:
    """Define the benchmark of the force models over stretch, depth and position.

    reference: function that returns the reference force.
    make_table: function that loads or computes the table; None to omit slow models.
    """
    return Family(
        name="sheet-force",
        unit="%",
        reference="the twin's membrane",
        methods=("scaled", "table", "membrane"),
        trials=partial(_trials, reference, make_table),
        tolerance=lambda scene: 100.0 * scene.tolerances.force_ratio,
    )


def _trials(
    reference: ReferenceForce, make_table: MakeTable | None, scene: Scene
) -> Iterator[Trial]:
    sheet, radius = scene.sheet, scene.finger.radius_m
    rubber = make_rubber(sheet)
    middle = 0.5 * (sheet.min_stretch_ratio + sheet.max_stretch_ratio)
    models: list[SheetForceModel] = [ScaledSheetModel(rubber)]
    if make_table is not None:
        models += [make_table(scene), MembraneSheetModel(rubber)]
    stretches = (1.0, middle, sheet.max_stretch_ratio)
    depths_m = clip_range(scene.working_range.push_depth_m, BENCHMARK_DEPTHS_M)
    for stretch, depth, (label, x, y) in product(stretches, depths_m, BENCHMARK_POSITIONS):
        if label != "centre" and stretch != middle:
            continue
        position = (x * rubber.width_m, y * rubber.height_m)
        reference_n = reference(sheet, stretch, depth, position, radius)
        push = SheetPush(stretch, radius, position)
        for model in models:
            slow = model.name == "membrane"
            if slow and not (stretch == middle and label == "centre" and depth in SLOW_DEPTHS_M):
                continue
            yield Trial(
                method=model.name,
                case={"stretch": stretch, "depth_mm": 1e3 * depth, "position": label},
                run=partial(model.evaluate, push, np.array([depth])),
                error=partial(_error_percent, reference_n=reference_n),
                in_range=not model.invalid_reason(push, depth),
                in_scene=stretch >= sheet.min_stretch_ratio,
            )


def _error_percent(result: SheetForce, *, reference_n: float) -> float:
    return 100.0 * abs(float(result.force_n[0]) / reference_n - 1.0)
