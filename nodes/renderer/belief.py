"""Where the renderer believes the sheet to be when the light leaves."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from messages.types import ArmState, Fingertip, SheetTarget
from nodes.models.prediction import path_at
from nodes.node import Input
from nodes.renderer.sheet import Sheet, sheet_between
from nodes.renderer.stage import Stage, transform_of

Floats = NDArray[np.float64]


class SheetBelief:
    """The sheet from the measured flange poses; the last good one while those are no good.

    Poses older than `stale_s` are not used.  `lead_s` is how far ahead the light leaves.  `note`
    says why the last plane is held; empty otherwise.
    """

    def __init__(self, *, stale_s: float, lead_s: float) -> None:
        self._stale_s, self._lead_s = stale_s, lead_s
        self._sheet: Sheet | None = None
        self.note = ""

    def update(
        self,
        stage: Stage,
        left: Input[ArmState],
        right: Input[ArmState],
        target: Input[SheetTarget],
        finger: Input[Fingertip],
    ) -> Sheet:
        """The sheet at `lead_s` from now; before any pose was measured, the one at rest."""
        sheet, age_s = None, max(left.age_s(), right.age_s())
        if left.message is not None and right.message is not None and age_s <= self._stale_s:
            arms = stage.scene.arms
            moving = target.message is not None and target.age_s() <= self._stale_s
            sheet = sheet_between(
                left.message.world_from_flange @ transform_of(arms.left.flange_from_edge),
                right.message.world_from_flange @ transform_of(arms.right.flange_from_edge),
                height_m=stage.scene.sheet.height_m,
                twist_world=target.message.twist_world
                if moving and target.message is not None
                else np.zeros(6),
                ahead_s=age_s + self._lead_s,
                finger_tip=self._finger_tip(finger),
            )
        if sheet is not None and stage.usable(sheet):
            self._sheet, self.note = sheet, ""
            return sheet
        why = f"arm poses {age_s:.2f} s old" if sheet is None else "sheet edge-on or turned away"
        self.note = f"{why}: holding the last good sheet plane"
        if self._sheet is None:
            self._sheet = stage.sheet_at_rest()
        return self._sheet

    def _finger_tip(self, finger: Input[Fingertip]) -> Floats | None:
        """The fingertip when the light leaves, or None when it is not known."""
        age_s = finger.age_s()
        if finger.message is None or not finger.message.valid or age_s > self._stale_s:
            return None
        message, lead_s = finger.message, age_s + self._lead_s
        return path_at(message.ahead_world_m, message.ahead_step_s, lead_s)[0]
