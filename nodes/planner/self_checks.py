"""Compare the stiffness of the sheet in the scene with its calibration."""

from __future__ import annotations

from flexsheet.messages.scene import SheetSpec
from flexsheet.messages.sheet_calibration import SheetCalibration
from flexsheet.messages.types import SelfCheck

MAX_STIFFNESS_RATIO = 0.05
"""Accepted relative difference of the stiffness: three standard deviations of a calibration."""


def check_stiffness(
    sheet: SheetSpec, calibration: SheetCalibration | None
) -> tuple[SelfCheck, ...]:
    """Return the check of Young's modulus times thickness, or () without a calibration.

    A difference matters because rendered forces follow from the calibration, but the limits of the
    edge force and the sag from the scene.
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
