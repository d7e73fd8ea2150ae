"""Compare the stiffness of the sheet in the scene with its calibration and with measured forces."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from flexsheet.messages.scene import Scene, SheetSpec
from flexsheet.messages.sheet_calibration import SheetCalibration
from flexsheet.messages.types import Force, SelfCheck
from flexsheet.nodes.models.residuals import ResidualMonitor
from flexsheet.nodes.models.sheet.force_models import SheetForceModel, SheetPush

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


MAX_FORCE_RATIO = 0.12
"""The maximum relative error of the predicted force. Hysteresis of the rubber contributes 5 %, and
the sheet model 3 %. A depth error of 0.3 mm contributes 3 to 6 %, and the gauge 1 %."""

MIN_INDENTATION_M = 0.005
"""The minimum indentation (m) for a comparison of forces. The relative errors at smaller depths are
too large."""

MIN_FORCE_N = 0.2
"""The minimum force (N) for a comparison. The relative errors of smaller forces are too large."""

QUIET_S, QUIET_M = 0.15, 0.0005
"""The criterion for a push at rest: within QUIET_S before and after the measurement, the
indentation changes by at most QUIET_M."""


@dataclass(frozen=True, slots=True)
class PlannedPush:
    """The planned push for the time `valid_at_ns`.

    position_m: (x, y) of the contact on the sheet.
    """

    valid_at_ns: int
    stretch_ratio: float
    indentation_m: float
    position_m: tuple[float, float]


class MeasuredForceCheck:
    """A comparison of measured finger forces with the forces that the sheet's model predicts.

    The ratio of measured to predicted force estimates the true product of modulus and thickness,
    divided by the assumed product.
    """

    def __init__(self, scene: Scene, model: SheetForceModel) -> None:
        self._model, self._radius_m = model, scene.finger.radius_m
        self._expected = scene.sheet.young_modulus_pa * scene.sheet.thickness_m
        self._pushes: deque[PlannedPush] = deque(maxlen=256)
        self._waiting: deque[tuple[int, float]] = deque(maxlen=64)
        self._monitor = ResidualMonitor(1, threshold=MAX_FORCE_RATIO)

    def add_push(self, push: PlannedPush) -> None:
        """Store a planned push, and compare measured forces with the forces of the sheet model.

        A force is compared when all pushes within QUIET_S of its measurement are known. It is
        ignored if the depth changes during this time.
        """
        self._pushes.append(push)
        limit_ns = push.valid_at_ns - round(1e9 * QUIET_S)
        while self._waiting and self._waiting[0][0] <= limit_ns:
            self._compare(*self._waiting.popleft())

    def add_force(self, force: Force, at_ns: int) -> None:
        """Store a force, measured at `at_ns`, if it is valid and along the sheet's normal."""
        if force.valid and force.axis == "sheet_normal":
            self._waiting.append((at_ns, force.force_n))

    def _compare(self, at_ns: int, force_n: float) -> None:
        window_ns = 1e9 * QUIET_S
        near = [one for one in self._pushes if abs(one.valid_at_ns - at_ns) <= window_ns]
        if not near:
            return
        depths = [one.indentation_m for one in near]
        if min(depths) < MIN_INDENTATION_M or max(depths) - min(depths) > QUIET_M:
            return
        push = min(near, key=lambda one: abs(one.valid_at_ns - at_ns))
        conditions = SheetPush(push.stretch_ratio, self._radius_m, push.position_m)
        if self._model.invalid_reason(conditions, push.indentation_m):
            return
        pressed = self._model.evaluate(conditions, np.array([push.indentation_m]))
        predicted_n = float(pressed.force_n[0])
        if predicted_n > MIN_FORCE_N:
            self._monitor.add(np.array([force_n / predicted_n - 1.0]), at_ns)

    @property
    def result(self) -> tuple[SelfCheck, ...]:
        """Return the result of the self-check, or () if too few forces have been compared."""
        if not self._monitor.has_data:
            return ()
        return (
            SelfCheck(
                cause="sheet_stiffness",
                subject="measured force",
                unit="N/m",
                value=self._expected * (1.0 + float(self._monitor.mean[0])),
                expected=self._expected,
                threshold=self._expected * MAX_FORCE_RATIO,
                suspected=self._monitor.suspected,
            ),
        )
