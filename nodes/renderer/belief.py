"""Where the renderer believes the sheet and the fingertip to be when the light leaves."""

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

    Poses older than `stale_s` are not used.  `note` says why the last plane is held; empty
    otherwise.
    """

    def __init__(self, *, stale_s: float) -> None:
        self._stale_s = stale_s
        self._sheet: Sheet | None = None
        self.note = ""

    def update(
        self,
        stage: Stage,
        left: Input[ArmState],
        right: Input[ArmState],
        target: Input[SheetTarget],
        finger_tip: Floats | None,
        *,
        lead_s: float,
        eye: Floats,
    ) -> Sheet:
        """The sheet at `lead_s` from now; before any pose was measured, the one at rest.

        finger_tip: (3,) at that instant, or None.  eye: (3,) the point of view.
        """
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
                ahead_s=age_s + lead_s,
                finger_tip=finger_tip,
            )
        if sheet is not None and stage.usable(sheet, eye):
            self._sheet, self.note = sheet, ""
            return sheet
        why = "sheet edge-on or turned away"
        if sheet is None:
            fresh = age_s <= self._stale_s
            why = "the flanges hold no sheet" if fresh else f"arm poses {age_s:.2f} s old"
        self.note = f"{why}: holding the last good sheet plane"
        if self._sheet is None:
            self._sheet = stage.sheet_at_rest()
        return self._sheet


def finger_tip_at(finger: Input[Fingertip], lead_s: float, *, stale_s: float) -> Floats | None:
    """The fingertip (3,) at `lead_s` from now, or None when it is not known."""
    age_s = finger.age_s()
    if finger.message is None or not finger.message.valid or age_s > stale_s:
        return None
    message = finger.message
    return path_at(message.predicted_path_world_m, message.prediction_step_s, age_s + lead_s)[0]
