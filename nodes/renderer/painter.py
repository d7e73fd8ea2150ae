"""One frame from the newest messages: what is believed, drawn, and said about it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from messages.base import Header
from messages.clock import Clock
from messages.types import (
    ArmState,
    Display,
    Eye,
    Fingertip,
    Frame,
    SheetTarget,
    Skin,
    SoftBody,
)
from nodes.node import Input
from nodes.renderer.belief import SheetBelief, finger_tip_at
from nodes.renderer.dent_ahead import DentAhead
from nodes.renderer.lead import Lead
from nodes.renderer.output import believed, both_eyes, drawn_for, which_eye
from nodes.renderer.stage import Stage
from nodes.renderer.stillness import has_moved, is_touched
from nodes.renderer.window import Screen


@dataclass(frozen=True, slots=True)
class Ports:
    """What a frame is drawn from."""

    skin: Input[Skin]
    soft_body: Input[SoftBody]
    fingertip: Input[Fingertip]
    sheet_target: Input[SheetTarget]
    arm_left: Input[ArmState]
    arm_right: Input[ArmState]
    eye: Input[Eye]


class Painter:
    """Draws a scene's frames on a screen; counts them, and those whose light was late."""

    def __init__(
        self,
        stage: Stage,
        screen: Screen,
        ports: Ports,
        lead: Lead,
        clock: Clock,
        *,
        stale_s: float,
    ) -> None:
        self.stage = stage
        self.note = ""
        self.late = self.superseded = 0
        self._screen, self._ports, self._lead, self._clock = screen, ports, lead, clock
        self._stale_s = stale_s
        self._belief = SheetBelief(stale_s=stale_s)
        self._dent = DentAhead()
        self._number = 0
        self._drawn_of: tuple[object, ...] = ()
        self._drawn_arms: tuple[ArmState | None, ArmState | None] = (None, None)
        if ports.soft_body.message is not None and ports.soft_body.header is not None:
            self.answered(ports.soft_body.message, ports.soft_body.header)

    def would_repeat(self, shown: Display) -> bool:
        """Whether a frame would show what the last one did: nobody touches, nothing moves."""
        ports = self._ports
        arms = (ports.arm_left.message, ports.arm_right.message)
        others = (ports.skin.message, ports.eye.message, shown)
        return (
            len(self._drawn_of) == len(others)
            and all(one is other for one, other in zip(self._drawn_of, others, strict=True))
            and not is_touched(ports.fingertip.message, ports.soft_body.message)
            and not any(map(has_moved, self._drawn_arms, arms))
        )

    def paint(self, shown: Display, begun_ns: int, *, with_pixels: bool) -> tuple[Frame, int]:
        """Draw a frame and hand it to the screen; also the exposure (ns) that it goes back to.

        What the frame says of its light is as if no window showed it; see `was_shown`.
        """
        ports, stage = self._ports, self.stage
        self._drawn_of = (ports.skin.message, ports.eye.message, shown)
        self._drawn_arms = (ports.arm_left.message, ports.arm_right.message)
        predicted_to_ns = self._lead.light_ns(begun_ns)
        lead_s = (predicted_to_ns - self._clock.now_ns()) * 1e-9
        source_ns, shaped_for_ns = self._shape(begun_ns, predicted_to_ns)
        tracked = ports.eye.message if ports.eye.age_s() <= self._stale_s else None
        eyes, across, eye_note = believed(stage.scene.eyes, tracked)
        finger_tip = finger_tip_at(ports.fingertip, lead_s, stale_s=self._stale_s)
        sheet = self._belief.update(
            stage,
            ports.arm_left,
            ports.arm_right,
            ports.sheet_target,
            finger_tip,
            lead_s=lead_s,
            eye=eyes.centre_world_m,
        )
        self._number += 1
        pair = both_eyes(eyes, shown.stereo, across)
        which = which_eye(shown.stereo, self._number, shows_both=self._screen.shows_both)
        picture = stage.draw(
            shown,
            sheet,
            stage.look(shown, finger_tip, ports.sheet_target.message),
            read=with_pixels,
            eyes=drawn_for(pair, shown.stereo, which, swap_eyes=shown.swap_eyes),
            drawn=lambda number: self._screen.take(number, stage.canvas.resolved),
        )
        drawn_ns = self._clock.now_ns()
        light_ns = 0
        if not self._screen.is_seen:
            light_ns = self._lead.drawn(begun_ns, drawn_ns)
            self.late += self._lead.is_late(light_ns, predicted_to_ns)
        self.note = "; ".join(filter(None, (self._belief.note, stage.note, eye_note)))
        frame = Frame(
            number=self._number,
            correction=shown.correction,
            stereo=shown.stereo,
            label=shown.label,
            eye=which,
            eyes_world_m=pair,
            world_from_sheet=sheet.world_from_sheet,
            pushed_point_world_m=sheet.foremost_point,
            predicted_to_ns=predicted_to_ns,
            draw_s=(drawn_ns - begun_ns) * 1e-9,
            drawn_ns=drawn_ns,
            light_ns=light_ns,
            late_frames=self.late,
            shaped_for_ns=shaped_for_ns,
            fingertip_world_m=np.zeros((0, 3)) if finger_tip is None else finger_tip[None],
            lost_share=stage.lost_share,
            pixels=() if picture is None else (picture,),
        )
        return frame, source_ns

    def was_shown(self, frame: Frame, swapped_ns: int) -> Frame:
        """The frame with what the window measured; `swapped_ns` 0: a newer one took its place."""
        if not swapped_ns:
            self.superseded += 1
            return frame
        begun_ns = frame.drawn_ns - round(frame.draw_s * 1e9)
        light_ns = self._lead.shown(begun_ns, frame.drawn_ns, swapped_ns)
        self.late += self._lead.is_late(light_ns, frame.predicted_to_ns)
        return frame.model_copy(
            update={"swapped_ns": swapped_ns, "light_ns": light_ns, "late_frames": self.late}
        )

    def answered(self, body: SoftBody, header: Header) -> None:
        """Take in an answer of the solver."""
        self._dent.take(body, header)

    def _shape(self, now_ns: int, light_ns: int) -> tuple[int, int]:
        """Deform the drawn object as the soft body will be; a silent one's is held, however old.

        Returns the exposure (ns) that the picture goes back to, and the instant of the dent.
        """
        ports, stage = self._ports, self.stage
        skin, fresh = ports.skin.message, ports.soft_body.age_s() <= self._stale_s
        if skin is not None and stage.mesh_id != skin.mesh_id:
            stage.follow(skin)
        body, shaped_for_ns = self._dent.at(light_ns if fresh else 0, self._clock.id)
        if body is None or body.mesh_id != stage.mesh_id:
            body, shaped_for_ns = None, 0
        stage.shape(body)
        header = ports.soft_body.header if fresh else ports.fingertip.header
        recent = fresh or ports.fingertip.age_s() <= self._stale_s
        return (header.source_ns if recent and header is not None else now_ns), shaped_for_ns
