"""Draw frames for the projector from the newest messages, and make a message about each frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flexsheet.messages.clock import Clock
from flexsheet.messages.notes import NoteCode
from flexsheet.messages.types import (
    ArmState,
    Display,
    Eye,
    Fingertip,
    Frame,
    SheetTarget,
    Skin,
    SoftBody,
)
from flexsheet.nodes.node import Input
from flexsheet.nodes.renderer.display_latency import DisplayLatencyEstimator
from flexsheet.nodes.renderer.eye_predictor import EyePredictor
from flexsheet.nodes.renderer.max_age import MaxAge
from flexsheet.nodes.renderer.output import both_eyes, select_drawn_eyes, select_eyes, which_eye
from flexsheet.nodes.renderer.output_window import OutputWindow
from flexsheet.nodes.renderer.scene_renderer import SceneRenderer
from flexsheet.nodes.renderer.sheet_pose_predictor import SheetPosePredictor, predict_fingertip
from flexsheet.nodes.renderer.skin_extrapolator import SkinExtrapolator

VISIBLE_CHANGE_M = 1e-4
"""The displacement (m) of the sheet that makes a new frame necessary. It is about a fifth of a
pixel."""

FLANGE_TO_SHEET_M = 0.15
"""The maximum distance (m) between a point on the sheet's edge and the flange of the arm that holds
the edge."""


@dataclass(frozen=True, slots=True)
class RendererInputs:
    """The inputs of the renderer node. Their newest messages determine the next frame."""

    skin: Input[Skin]
    soft_body: Input[SoftBody]
    fingertip: Input[Fingertip]
    sheet_target: Input[SheetTarget]
    arm_left: Input[ArmState]
    arm_right: Input[ArmState]
    eye: Input[Eye]


class FrameRenderer:
    """A renderer of the frames of a scene, which counts frames that were late or never shown."""

    def __init__(
        self,
        scene_renderer: SceneRenderer,
        screen: OutputWindow,
        ports: RendererInputs,
        latency: DisplayLatencyEstimator,
        clock: Clock,
        *,
        max_age: MaxAge,
    ) -> None:
        self.scene_renderer = scene_renderer
        self.notes: dict[NoteCode, str] = {}
        self.late = self.superseded = 0
        self._output, self._ports, self._latency, self._clock = screen, ports, latency, clock
        self._max_age = max_age
        self._sheet_predictor = SheetPosePredictor(max_age)
        self.eye_predictor = EyePredictor(max_age)
        self.extrapolator = SkinExtrapolator()
        self._number = 0
        self._drawn_of: tuple[object, ...] = ()
        self._drawn_arms: tuple[ArmState | None, ArmState | None] = (None, None)
        if ports.soft_body.message is not None and ports.soft_body.header is not None:
            self.extrapolator.add(ports.soft_body.message, ports.soft_body.header)

    def is_unchanged(self, shown: Display) -> bool:
        """Return whether a new frame would equal the last frame because no input has changed."""
        ports = self._ports
        arms = (ports.arm_left.message, ports.arm_right.message)
        others = (ports.skin.message, ports.eye.message, shown)
        return (
            len(self._drawn_of) == len(others)
            and all(one is other for one, other in zip(self._drawn_of, others, strict=True))
            and not is_touched(ports.fingertip.message, ports.soft_body.message)
            and not any(map(has_moved, self._drawn_arms, arms))
        )

    def render(self, shown: Display, begun_ns: int, *, with_pixels: bool) -> tuple[Frame, int]:
        """Draw a frame. Return its message, and the exposure time of the camera images behind it.

        begun_ns: start of drawing.
        with_pixels: whether the message contains the image.

        The exposure time is a timestamp (ns). If there is a window, the method `on_shown` later
        adds the display time to the message.
        """
        ports, scene_renderer = self._ports, self.scene_renderer
        self._drawn_of = (ports.skin.message, ports.eye.message, shown)
        self._drawn_arms = (ports.arm_left.message, ports.arm_right.message)
        predicted_to_ns = self._latency.predict_light_ns(begun_ns)
        horizon_s = (predicted_to_ns - self._clock.now_ns()) * 1e-9
        source_ns, shaped_for_ns = self._shape(begun_ns, predicted_to_ns)
        tracked = self.eye_predictor.predict(ports.eye, horizon_s)
        eyes, across, eye_note = select_eyes(scene_renderer.scene.eyes, tracked)
        finger_tip = predict_fingertip(ports.fingertip, horizon_s, max_age_s=self._max_age.seconds)
        sheet = self._sheet_predictor.update(
            scene_renderer,
            ports.arm_left,
            ports.arm_right,
            ports.sheet_target,
            finger_tip,
            horizon_s=horizon_s,
            eye=eyes.centre_world_m,
        )
        self._number += 1
        pair = both_eyes(eyes, shown.stereo, across)
        which = which_eye(shown.stereo, self._number, shows_both=self._output.shows_both)
        image = scene_renderer.draw(
            shown,
            sheet,
            scene_renderer.draw_style(shown, finger_tip, ports.sheet_target.message),
            read=with_pixels,
            eyes=select_drawn_eyes(pair, shown.stereo, which, swap_eyes=shown.swap_eyes),
            drawn=lambda number: self._output.store(number, scene_renderer.canvas.resolved),
        )
        drawn_ns = self._clock.now_ns()
        light_ns = 0
        if not self._output.is_seen:
            light_ns = self._latency.record_drawn(begun_ns, drawn_ns)
            self.late += self._latency.is_late(light_ns, predicted_to_ns)
        self.notes = {
            NoteCode.SHEET_POSE_OLD: self._sheet_predictor.note,
            NoteCode.SHEET_SHAPE_INACCURATE: scene_renderer.note,
            NoteCode.EYES_OF_SCENE: eye_note,
        }
        frame = Frame(
            number=self._number,
            correction=shown.correction,
            stereo=shown.stereo,
            label=shown.label,
            pattern=shown.pattern,
            eye=which,
            eyes_world_m=pair,
            world_from_sheet=sheet.world_from_sheet,
            pushed_point_world_m=sheet.contact_point,
            predicted_to_ns=predicted_to_ns,
            draw_s=(drawn_ns - begun_ns) * 1e-9,
            drawn_ns=drawn_ns,
            light_ns=light_ns,
            late_frames=self.late,
            shaped_for_ns=shaped_for_ns,
            fingertip_world_m=np.zeros((0, 3)) if finger_tip is None else finger_tip[None],
            occluded_fraction=scene_renderer.occluded_fraction,
            pixels=() if image is None else (image,),
        )
        return frame, source_ns

    def on_shown(self, frame: Frame, swapped_ns: int) -> Frame:
        """Add the measured display times to the message of a frame, and return the message.

        swapped_ns: time of the buffer swap that showed the frame; 0 if the frame was never shown,
            because a newer frame replaced it.
        """
        if not swapped_ns:
            self.superseded += 1
            return frame
        begun_ns = frame.drawn_ns - round(frame.draw_s * 1e9)
        light_ns = self._latency.record_shown(begun_ns, frame.drawn_ns, swapped_ns)
        self.late += self._latency.is_late(light_ns, frame.predicted_to_ns)
        return frame.model_copy(
            update={"swapped_ns": swapped_ns, "light_ns": light_ns, "late_frames": self.late}
        )

    def _shape(self, now_ns: int, light_ns: int) -> tuple[int, int]:
        """Deform the drawn object as predicted for the display time `light_ns`.

        If the soft-body solver's last response is too old, its deformation is not extrapolated.
        Returns two times (ns): the exposure time of the camera image from which the deformation was
        computed, and the time for which the deformation was predicted.
        """
        ports, scene_renderer = self._ports, self.scene_renderer
        skin, fresh = ports.skin.message, ports.soft_body.age_s() <= self._max_age.seconds
        if skin is not None and scene_renderer.mesh_id != skin.mesh_id:
            scene_renderer.set_skin(skin)
        body, shaped_for_ns = self.extrapolator.extrapolate(
            light_ns if fresh else 0, self._clock.id
        )
        if body is None or body.mesh_id != scene_renderer.mesh_id:
            body, shaped_for_ns = None, 0
        scene_renderer.deform(body)
        header = ports.soft_body.header if fresh else ports.fingertip.header
        recent = fresh or ports.fingertip.age_s() <= self._max_age.seconds
        return (header.source_ns if recent and header is not None else now_ns), shaped_for_ns


def is_touched(fingertip: Fingertip | None, soft_body: SoftBody | None) -> bool:
    """Return whether the object is deformed, or may be touched because a finger is tracked."""
    if fingertip is not None and fingertip.valid:
        return True
    return soft_body is not None and bool(soft_body.displacement_world_m.any())


def has_moved(before: ArmState | None, now: ArmState | None) -> bool:
    """Return whether an arm moved its edge of the sheet by more than `VISIBLE_CHANGE_M`."""
    if before is None or now is None:
        return before is not now
    change = np.abs(now.world_from_flange - before.world_from_flange)
    shift_m = change[:3, 3].max() + FLANGE_TO_SHEET_M * change[:3, :3].max()
    return bool(shift_m > VISIBLE_CHANGE_M)
