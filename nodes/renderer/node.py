"""Draws the virtual object for the projector, corrected for where the sheet is."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field

from messages.base import Header
from messages.scene import NonNegative, Positive, Scene
from messages.types import (
    ArmState,
    Correction,
    Display,
    Fingertip,
    Frame,
    SheetTarget,
    Skin,
    SoftBody,
    StereoMode,
)
from nodes.node import Input, Node, NodeParameters, Output, periodic
from nodes.renderer import dent_cache
from nodes.renderer.belief import SheetBelief
from nodes.renderer.gl import SAMPLES, headless_context
from nodes.renderer.stage import Stage


class RendererParameters(NodeParameters):
    rate_hz: Positive = Field(default=30.0, description="most frames a second")
    lead_s: NonNegative = Field(
        default=0.016, description="from the start of drawing to the middle of the light"
    )
    stale_s: Positive = Field(
        default=0.1, description="older poses, fingertips and soft bodies are not used"
    )
    spacing_m: Positive = Field(default=0.0025, description="between vertices of the drawn surface")
    samples: int = Field(
        default=SAMPLES,
        ge=0,
        le=16,
        description="of a pixel; fewer draw faster without a GPU",
    )
    correction: Correction = Field(default="two_pass", description="until a display message")
    cache_dir: Path | None = Field(
        default=None, description="of the sheet's dent shapes; null: the user's cache"
    )
    stereo: StereoMode = Field(default="side_by_side", description="until a display message")


class Renderer(Node):
    """Draws as soon as the soft body has answered to a new fingertip, at most at `rate_hz`.

    Without a solver the fingertip itself gives the beat, without a finger the timer.  The sheet is
    taken from the measured flange poses, moved on by the target's twist to when the light leaves.
    """

    parameters: RendererParameters
    scene: Input[Scene]
    skin: Input[Skin]
    soft_body: Input[SoftBody]
    fingertip: Input[Fingertip]
    sheet_target: Input[SheetTarget]
    arm_left: Input[ArmState]
    arm_right: Input[ArmState]
    display: Input[Display]
    frame: Output[Frame]

    async def setup(self) -> None:
        self._context = headless_context()
        self._stage: Stage | None = None
        self._belief = self._new_belief()
        self._shown = Display(correction=self.parameters.correction, stereo=self.parameters.stereo)
        self._due_ns = 0
        self._number = self._since_pixels = self._late = 0
        self._period_ns = int(1e9 / self.parameters.rate_hz)

    async def close(self) -> None:
        self._context.release()

    def on_scene(self, scene: Scene, header: Header) -> None:
        if self._stage is not None:
            self._stage.release()
        self._stage, self._belief = None, self._new_belief()
        spacing_m, samples = self.parameters.spacing_m, self.parameters.samples
        dents = dent_cache.load(scene, self.parameters.cache_dir)
        self._stage = Stage(scene, self._context, spacing_m=spacing_m, samples=samples, dents=dents)

    def on_display(self, display: Display, header: Header) -> None:
        self._shown, self._since_pixels = display, 0

    def on_soft_body(self, soft_body: SoftBody, header: Header) -> None:
        self._draw_if_due()

    def on_fingertip(self, fingertip: Fingertip, header: Header) -> None:
        if self.soft_body.age_s() > self.parameters.stale_s:
            self._draw_if_due()

    @periodic("rate_hz")
    def refresh(self) -> None:
        """Keep the picture alive when nothing new comes."""
        if self.clock.now_ns() > self._due_ns + self._period_ns:
            self._draw_if_due()

    def _draw_if_due(self) -> None:
        # A quarter of a period early is in time: else a 60 Hz camera beats against 30 Hz.
        now_ns = self.clock.now_ns()
        if self._stage is None or now_ns < self._due_ns - self._period_ns // 4:
            return
        self._draw(self._stage, now_ns)
        # Where drawing is slower than the rate, what has come meanwhile is read before the next.
        rest_until_ns = self.clock.now_ns() + self._period_ns // 2
        self._due_ns = max(self._due_ns + self._period_ns, rest_until_ns)

    def _draw(self, stage: Stage, start_ns: int) -> None:
        shown, predicted_to_ns = self._shown, start_ns + int(self.parameters.lead_s * 1e9)
        source_ns = self._shape_object(stage, start_ns)
        sheet = self._belief.update(
            stage, self.arm_left, self.arm_right, self.sheet_target, self.fingertip
        )
        self.note = "; ".join(filter(None, (self._belief.note, stage.note)))
        self._since_pixels += 1
        with_pixels = 0 < shown.pixels_every <= self._since_pixels
        look = stage.look(shown, self.fingertip.message, self.sheet_target.message)
        picture = stage.draw(shown, sheet, look, read=with_pixels)
        if with_pixels:
            self._since_pixels = 0
        end_ns = self.clock.now_ns()
        self._number += 1
        self._late += end_ns > predicted_to_ns
        frame = Frame(
            number=self._number,
            correction=shown.correction,
            stereo=shown.stereo,
            label=shown.label,
            eyes_world_m=stage.eyes(shown),
            world_from_sheet=sheet.world_from_sheet,
            pushed_point_world_m=sheet.foremost_point,
            predicted_to_ns=predicted_to_ns,
            draw_s=(end_ns - start_ns) * 1e-9,
            late_frames=self._late,
            pixels=() if picture is None else (picture,),
        )
        self.frame.publish(frame, source_ns=source_ns)

    def _shape_object(self, stage: Stage, now_ns: int) -> int:
        """Deform the drawn object as the newest soft body says, however old that is.

        Returns the exposure (ns) that the picture goes back to.
        """
        skin, body, stale_s = self.skin.message, self.soft_body.message, self.parameters.stale_s
        if skin is not None and stage.mesh_id != skin.mesh_id:
            stage.follow(skin)
        stage.shape(body if body is not None and body.mesh_id == stage.mesh_id else None)
        used = self.soft_body if self.soft_body.age_s() <= stale_s else self.fingertip
        recent = used.header is not None and used.age_s() <= stale_s
        return used.header.source_ns if recent and used.header is not None else now_ns

    def _new_belief(self) -> SheetBelief:
        return SheetBelief(stale_s=self.parameters.stale_s, lead_s=self.parameters.lead_s)
