"""Control the stretch and the normal offset of the sheet for the soft body under the finger."""

from __future__ import annotations

import numpy as np

from flexsheet.messages.methods import ComplianceMode
from flexsheet.messages.scene import Scene
from flexsheet.messages.types import SoftBody
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.hand_loop import OffsetBoundsTable
from flexsheet.nodes.models.sheet.force_models import SheetForceModel, SheetPosition, SheetPush
from flexsheet.nodes.planner.compliance import (
    FORCE_JND_FLOOR_N,
    Compliance,
    ObjectCurve,
    StretchLimits,
    choose_stretch,
    fit_compliance,
    make_stretch_limits,
)
from flexsheet.nodes.planner.hysteresis import HysteresisCorrection

EQUAL_RATIO = 0.02
"""The relative difference below which two force curves count as equal. Users notice only
differences that are at least seven times as large."""

FIRST_DELAY_S = 0.06
"""The initial value of the delay between the measurement of a depth and the motion of the sheet."""

DELAY_HYSTERESIS_S = 0.03
"""The minimum decrease (s) of the measured delay after which new bounds on the offset's slope are
computed."""

COMPARED_FRACTIONS = np.array([0.04, 0.1, 0.25, 0.5, 1.0])
"""The depths at which force curves are compared, as fractions of the maximum depth."""


class ComplianceController:
    """A controller of the sheet's stretch and normal offset for the object under the finger.

    mode: "force_curve" renders the object's force as a function of depth. "stiffness" matches only
        the object's stiffness at small depths, by the stretch (Furukawa et al. 2007).
        "constant_stretch" uses the minimum stretch.
    hysteresis_ratio: fraction of the loading energy that the rubber loses in a cycle. None means
        that the value in the scene is used.
    bounds: limits of the derivative of the offset with respect to the finger's depth. Within these
        limits, the control loop with the user's hand is stable. None means that the hand is
        ignored.
    delay_s: time from the measurement of a depth until the sheet has moved.
    bandwidth_rad_per_s: bandwidth of the depth filter; None if there are no bounds.
    """

    def __init__(
        self,
        scene: Scene,
        model: SheetForceModel,
        mode: ComplianceMode,
        *,
        hysteresis_ratio: float | None = None,
        bounds: OffsetBoundsTable | None = None,
        delay_s: float = FIRST_DELAY_S,
    ) -> None:
        self.stretch_ratio = scene.sheet.min_stretch_ratio
        self.note = ""
        self._scene, self._model, self._mode = scene, model, mode
        ratio = scene.sheet.hysteresis_ratio if hysteresis_ratio is None else hysteresis_ratio
        self._hysteresis = HysteresisCorrection(ratio) if ratio else None
        self._bounds, self.delay_s, self._bounded_delay_s = bounds, delay_s, delay_s
        self._limits = self._make_limits()
        self.bandwidth_rad_per_s: float | None = (
            None if bounds is None else float(bounds.bandwidths_rad_per_s[0])
        )
        self._curve: ObjectCurve | None = None
        self._compared_m = scene.working_range.push_depth_m * COMPARED_FRACTIONS
        self._fitted_n: Floats | None = None
        self._compliance: Compliance | None = None

    def update(self, soft_body: SoftBody, *, in_contact: bool) -> None:
        """Choose the sheet's stretch and normal offset to match the force of the soft body.

        The stretch remains constant during contact, because users would feel the motion of the
        edges. If the force curve is invalid, the method raises UnfitCurveError, and the last values
        remain valid.
        """
        if self._mode == "constant_stretch":
            return
        if self._mode == "stiffness":
            if soft_body.stiffness_n_per_m > 0.0:
                self.stretch_ratio, self.note = choose_stretch(
                    soft_body.stiffness_n_per_m, self._scene.sheet
                )
            return
        rows = soft_body.force_curve
        if len(rows) == 0:
            return
        forces_n = np.interp(self._compared_m, rows[:, 0], rows[:, 1])
        if self._fitted_n is not None:
            differences_n = np.abs(forces_n - self._fitted_n)
            if (differences_n < EQUAL_RATIO * np.maximum(self._fitted_n, FORCE_JND_FLOOR_N)).all():
                return
        self._fit(ObjectCurve.from_rows(rows), in_contact=in_contact)
        self._fitted_n = forces_n

    def set_delay(self, delay_s: float, *, in_contact: bool) -> None:
        """Set the delay from the measurement of a depth to the motion of the sheet.

        The stability bounds of the sheet's offset depend on this delay. If the bounds change, the
        stretch and the offset are computed again from the object's force curve. While the finger
        touches the sheet, the bounds are not changed.
        """
        self.delay_s = delay_s
        if self._bounds is None or in_contact:
            return
        if self._bounded_delay_s - DELAY_HYSTERESIS_S <= delay_s <= self._bounded_delay_s:
            return
        before = self._bounds.at_delay(self._bounded_delay_s)
        self._bounded_delay_s = delay_s
        if np.array_equal(before.max_advances, self._bounds.at_delay(delay_s).max_advances):
            return
        self._limits = self._make_limits()
        if self._curve is not None:
            self._fit(self._curve, in_contact=False)

    def _make_limits(self) -> StretchLimits:
        bounds = None if self._bounds is None else self._bounds.at_delay(self._bounded_delay_s)
        return make_stretch_limits(self._scene.sheet, self._model, bounds)

    def _fit(self, curve: ObjectCurve, *, in_contact: bool) -> None:
        self._curve = curve
        kept = in_contact and self._compliance is not None
        fitted = fit_compliance(
            curve,
            self._model,
            self._limits,
            self._scene,
            stretch_ratio=self.stretch_ratio if kept else None,
        )
        self._compliance = fitted
        self.stretch_ratio = fitted.stretch_ratio
        hand_note = ""
        if self._bounds is not None:
            self.bandwidth_rad_per_s, suffices = fitted.choose_bandwidth_rad_per_s()
            if not suffices:
                hand_note = (
                    "a hand of low damping can oscillate with this object, because the sheet "
                    f"follows after {1e3 * self.delay_s:.0f} ms; reduce the delay or use a stiffer "
                    "object"
                )
        self.note = "; ".join(filter(None, (fitted.note, self._range_note(fitted), hand_note)))

    def _range_note(self, fitted: Compliance) -> str:
        """Return why the force model is invalid for the deepest push, or "" if it is valid."""
        max_depth_m = self._scene.working_range.push_depth_m
        push = SheetPush(fitted.stretch_ratio, fitted.finger_radius_m)
        reason = self._model.invalid_reason(push, float(fitted.indentation_m(max_depth_m)))
        if not reason:
            return ""
        model = f"the sheet force model {self._model.name}"
        return f"{model} is not valid here: {reason}"

    def normal_offset(self, depth_m: float, position_m: SheetPosition) -> tuple[float, float]:
        """Return the sheet's normal offset (m), and its derivative with respect to the depth.

        depth_m: depth of the finger in the object.
        position_m: (x, y) of the contact on the sheet.

        If the offset is positive, the sheet is behind the object's tangent plane. If the hysteresis
        is corrected, the result also depends on the depths of earlier calls.
        """
        force_ratio = 1.0 if self._hysteresis is None else self._hysteresis.update(depth_m)
        if self._compliance is None or depth_m <= 0.0:
            return 0.0, 0.0
        offset_m = float(self._compliance.normal_offset_m(depth_m, position_m))
        per_depth = self._compliance.offset_per_depth(depth_m, position_m)
        if force_ratio == 1.0 or depth_m >= self._compliance.max_depth_m:
            return offset_m, per_depth
        indented_m = depth_m - offset_m
        scale = force_ratio ** (-1.0 / self._force_exponent(indented_m, position_m))
        return depth_m - scale * indented_m, 1.0 - scale * (1.0 - per_depth)

    def _force_exponent(self, indentation_m: float, position_m: SheetPosition) -> float:
        if indentation_m <= 0.0:
            return 1.0
        push = SheetPush(self.stretch_ratio, self._scene.finger.radius_m, position_m)
        depths = np.array([0.95, 1.05]) * indentation_m
        below, above = self._model.evaluate(push, depths).force_n
        if below <= 0.0:
            return 1.0
        return max(float(np.log(above / below) / np.log(1.05 / 0.95)), 0.5)
