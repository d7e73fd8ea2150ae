"""Predict the sheet's pose and the fingertip at the display time of a frame."""

from __future__ import annotations

from flexsheet.messages.types import ArmState, Fingertip, SheetTarget
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.interpolation import interpolate_path
from flexsheet.nodes.models.rigid import pose_matrix
from flexsheet.nodes.node import Input
from flexsheet.nodes.renderer.max_age import MaxAge
from flexsheet.nodes.renderer.scene_renderer import SceneRenderer
from flexsheet.nodes.renderer.sheet import SheetPose, estimate_sheet


class SheetPosePredictor:
    """A predictor of the sheet's pose from the measured flange poses of the arms.

    If no valid pose of the sheet is newer than `max_age`, the predictor returns the last valid
    pose. In this case, the attribute `note` contains the reason. Otherwise, `note` is empty.
    """

    def __init__(self, max_age: MaxAge) -> None:
        self._max_age = max_age
        self._sheet: SheetPose | None = None
        self.note = ""

    def update(
        self,
        scene_renderer: SceneRenderer,
        left: Input[ArmState],
        right: Input[ArmState],
        target: Input[SheetTarget],
        finger_tip: Floats | None,
        *,
        horizon_s: float,
        eye: Floats,
    ) -> SheetPose:
        """Return the sheet's pose predicted for the time `horizon_s` after the current time.

        Before the first valid pose, return the sheet at rest. finger_tip (3,): position of the
        fingertip at this time, world frame, m; None if it is unknown. eye (3,): midpoint of the
        eyes, world frame, m.
        """
        sheet, age_s = None, max(left.age_s(), right.age_s())
        if (
            left.message is not None
            and right.message is not None
            and age_s <= self._max_age.seconds
        ):
            arms = scene_renderer.scene.arms
            moving = target.message is not None and target.age_s() <= self._max_age.seconds
            sheet = estimate_sheet(
                left.message.world_from_flange @ pose_matrix(arms.left.flange_from_edge),
                right.message.world_from_flange @ pose_matrix(arms.right.flange_from_edge),
                height_m=scene_renderer.scene.sheet.height_m,
                twist_world=target.message.twist_world
                if moving and target.message is not None
                else None,
                ahead_s=age_s + horizon_s,
                finger_tip=finger_tip,
            )
        if sheet is not None and scene_renderer.usable(sheet, eye):
            self._sheet, self.note = sheet, ""
            return sheet
        why = "the sheet is edge-on to the eyes or the projector, or faces away"
        if sheet is None:
            fresh = age_s <= self._max_age.seconds
            why = "implausible flange poses" if fresh else f"the arm poses are {age_s:.2f} s old"
        self.note = why
        if self._sheet is None:
            self._sheet = scene_renderer.sheet_at_rest()
        return self._sheet


def predict_fingertip(
    finger: Input[Fingertip], horizon_s: float, *, max_age_s: float
) -> Floats | None:
    """Return the predicted fingertip position (3,), world frame, m, `horizon_s` after now.

    Return None if the fingertip message is invalid or older than `max_age_s`.
    """
    age_s = finger.age_s()
    if finger.message is None or not finger.message.valid or age_s > max_age_s:
        return None
    message = finger.message
    return interpolate_path(
        message.predicted_path_world_m, message.prediction_step_s, age_s + horizon_s
    )[0]
