"""Draws the virtual object for the projector, corrected for where the sheet is."""

from __future__ import annotations

import asyncio

from messages.base import Header
from messages.methods import chosen
from messages.scene import Scene
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
from nodes.cache import load_cached
from nodes.node import Input, Node, Output, periodic
from nodes.renderer import deflection_cache
from nodes.renderer.lead import Lead
from nodes.renderer.painter import Painter, Ports
from nodes.renderer.parameters import RendererParameters
from nodes.renderer.stage import Stage
from nodes.renderer.window import Screen, open_screen


class Renderer(Node):
    """Draws as soon as the soft body has answered to a new fingertip, at most at `rate_hz`.

    Without a solver the fingertip itself gives the beat, without a finger the timer.  A frame is
    published when it was drawn, or with a window when that showed it.
    """

    parameters: RendererParameters
    scene: Input[Scene]
    skin: Input[Skin]
    soft_body: Input[SoftBody]
    fingertip: Input[Fingertip]
    sheet_target: Input[SheetTarget]
    arm_left: Input[ArmState]
    arm_right: Input[ArmState]
    eye: Input[Eye]
    display: Input[Display]
    frame: Output[Frame]

    async def setup(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._screen = self._new_screen()
        self._painter: Painter | None = None
        self._shown = Display(correction="two_pass", stereo=self.parameters.stereo)
        self._due_ns = self._since_pixels = 0
        self._period_ns = int(1e9 / self.parameters.rate_hz)
        self._still_ns, self._drawn_ns = int(1e9 / self.parameters.still_rate_hz), 0

    async def close(self) -> None:
        self._screen.close()

    def on_scene(self, scene: Scene, header: Header) -> None:
        if self._painter is not None:
            self._painter.stage.release()
            self._painter = None
        self._screen.open((scene.projector.width_px, scene.projector.height_px))
        given = self.parameters
        if self.display.message is None:
            correction = chosen(given.correction, scene.methods.correction, "two_pass")
            self._shown = self._shown.model_copy(update={"correction": correction})
        stage = Stage(
            scene,
            self._screen.context,
            spacing_m=given.spacing_m,
            samples=given.samples,
            dents=load_cached(deflection_cache.shapes_cache(scene), given.cache_dir),
            sheet_shape=chosen(given.sheet_shape, scene.methods.sheet_shape, "dents"),
        )
        lead = Lead(first_s=given.lead_s, light_s=given.light_s, period_s=self._screen.period_s)
        ports = Ports(**{name: self.inputs[name] for name in Ports.__slots__})
        self._painter = Painter(stage, self._screen, ports, lead, self.clock, stale_s=given.stale_s)

    def on_display(self, display: Display, header: Header) -> None:
        self._shown, self._since_pixels = display, 0

    def on_soft_body(self, soft_body: SoftBody, header: Header) -> None:
        if self._painter is not None:
            self._painter.answered(soft_body, header)
        self._draw_if_due()

    def on_fingertip(self, fingertip: Fingertip, header: Header) -> None:
        if self.soft_body.age_s() > self.parameters.stale_s:
            self._draw_if_due()

    @periodic("rate_hz")
    def refresh(self) -> None:
        """See to the window, and keep the picture alive when nothing new comes."""
        if not self._screen.poll():
            self._open_anew()
        if self.clock.now_ns() > self._due_ns + self._period_ns:
            self._draw_if_due()

    def _new_screen(self) -> Screen:
        return open_screen(self.parameters, self.clock.now_ns, self._was_shown)

    def _was_shown(self, tag: tuple[Frame, int], swapped_ns: int) -> None:
        """Called by the window's thread, too."""
        self._loop.call_soon_threadsafe(self._publish, *tag, swapped_ns)

    def _open_anew(self) -> None:
        """A lost context takes all that was drawn with along: begin again from the scene."""
        self.log.warning("window", problem=self._screen.note)
        self._painter = None
        self._screen.close()
        self._screen = self._new_screen()
        if self.scene.message is not None and self.scene.header is not None:
            self.on_scene(self.scene.message, self.scene.header)

    def _draw_if_due(self) -> None:
        # A quarter of a period early is in time: else a 60 Hz camera beats against 30 Hz.
        now_ns = self.clock.now_ns()
        if self._painter is None or now_ns < self._due_ns - self._period_ns // 4:
            return
        rested_ns = now_ns - self._drawn_ns + self._period_ns // 4
        if rested_ns < self._still_ns and self._painter.would_repeat(self._shown):
            return
        self._drawn_ns = now_ns
        self._draw(self._painter, now_ns)
        # Where drawing is slower than the rate, what has come meanwhile is read before the next.
        rest_until_ns = self.clock.now_ns() + self._period_ns // 2
        self._due_ns = max(self._due_ns + self._period_ns, rest_until_ns)

    def _draw(self, painter: Painter, begun_ns: int) -> None:
        self._since_pixels += 1
        with_pixels = 0 < self._shown.pixels_every <= self._since_pixels
        frame, source_ns = painter.paint(self._shown, begun_ns, with_pixels=with_pixels)
        if with_pixels:
            self._since_pixels = 0
        self.note = "; ".join(filter(None, (painter.note, self._screen.note)))
        if self._screen.is_seen:
            self._screen.show((frame, source_ns), self._shown)
        else:
            self.frame.publish(frame, source_ns=source_ns)

    def _publish(self, frame: Frame, source_ns: int, swapped_ns: int) -> None:
        """A frame that the window showed, or passed over for a newer one."""
        if self._painter is not None:
            frame = self._painter.was_shown(frame, swapped_ns)
        self.frame.publish(frame, source_ns=source_ns)
