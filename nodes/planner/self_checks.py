"""Compare the stiffness of the sheet in the scene with its calibration."""

from __future__ import annotations

from flexsheet.messages.scene import SheetSpec
from flexsheet.messages.sheet_calibration import SheetCalibration
from flexsheet.messages.types import SelfCheck

MAX_STIFFNESS_RATIO = 0.05
"""The maximum relative difference between the stiffness in the scene and the calibrated stiffness.
It equals three standard deviations of a calibrated stiffness."""


def check_stiffness(
    sheet: SheetSpec, calibration: SheetCalibration | None
) -> tuple[SelfCheck, ...]:
    """Check whether the sheet's stiffness in the scene agrees with the calibration.

    The stiffness is Young's modulus times thickness, N/m. The rendered forces depend on the
    calibration. The sag and the limits of the edge force depend on the scene.

    Returns one check, or () if there is no calibration.
    """
    if calibration is None:
        return ()
    expected = sheet.young_modulus_pa * sheet.thickness_m
    measured = calibration.modulus_thickness_n_per_m
    threshold = MAX_STIFFNESS_RATIO * expected + 2.0 * measured.standard_deviation
    return (
        SelfCheck(
            cause="sheet_stiffness",
            unit="N/m",
            value=measured.value,
            expected=expected,
            threshold=threshold,
            suspected=abs(measured.value - expected) > threshold,
        ),
    )
