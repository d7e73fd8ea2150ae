"""Draw the virtual object for the projector, corrected for the sheet's pose and shape."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, ClassVar

from flexsheet.messages.base import Header
from flexsheet.messages.notes import NoteCode
from flexsheet.messages.scene import Scene
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
from flexsheet.nodes import NodeRole, OmissionReason
from flexsheet.nodes.node import Input, Node, Output, periodic
from flexsheet.nodes.renderer import deflection_cache
from flexsheet.nodes.renderer.display_latency import DisplayLatencyEstimator
from flexsheet.nodes.renderer.max_age import MaxAge
from flexsheet.nodes.renderer.parameters import RendererParameters

if TYPE_CHECKING:
    # They import moderngl and glfw, which are installed on the projector's computer only. The other
    # computers import this module to check the launch file.
    from flexsheet.nodes.renderer.frame_renderer import FrameRenderer
    from flexsheet.nodes.renderer.output_window import OutputWindow

IDLE_PERIOD_NS = 1_000_000_000
"""The period (ns) of the frames while nothing moves and no finger is tracked."""

READ_TIME_NS = 2_000_000
"""The minimum time (ns) between the end of one frame and the start of the next frame."""


class Renderer(Node):
    """A node that draws a frame for each soft-body message, at a rate of at most `rate_hz`.

    If there are no recent soft-body messages, fingertip messages trigger frames. If there are no
    recent messages of either type, a timer triggers frames. If there is a window, the node
    publishes each frame after the window has shown it. Otherwise, the node publishes each frame
    after it is drawn.
    """

    role: ClassVar[NodeRole | None] = NodeRole.RENDERER
    optional_inputs: ClassVar[frozenset[str]] = frozenset({"skin", "soft_body"})
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

    @classmethod
    def omission_reason(cls, parameters: Any, scene: Scene) -> OmissionReason | None:
        return OmissionReason.NO_IMAGE if scene.projector is None else None

    @classmethod
    def replay_refusal(cls, parameters: Any) -> str:
        if parameters.output == "window":
            return "it shows its frames in a window; record a run with output: headless instead"
        return ""

    async def setup(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._output = self._new_output()
        self._frame_renderer: FrameRenderer | None = None
        self._shown = Display(correction="two_pass", stereo="side_by_side")
        self._max_age = MaxAge(self.parameters.max_age_s)
        self._due_ns = self._since_pixels = 0
        self._period_ns = int(1e9 / self.parameters.rate_hz)
        self._drawn_ns = 0

    async def close(self) -> None:
        self._output.close()

    def on_scene(self, scene: Scene, header: Header) -> None:
        from flexsheet.nodes.renderer.frame_renderer import FrameRenderer, RendererInputs
        from flexsheet.nodes.renderer.scene_renderer import SceneRenderer

        self._frame_renderer = None
        if scene.projector is None:
            self.set_note(NoteCode.NO_PROJECTOR)
            return
        self._output.open((scene.projector.width_px, scene.projector.height_px))
        given = self.parameters
        if self.display.message is None:
            correction = given.correction or scene.methods.correction
            one_view = given.stereo == "auto" and scene.eyes.interocular_m == 0.0
            stereo = "side_by_side" if given.stereo == "auto" else given.stereo
            self._shown = self._shown.model_copy(
                update={"correction": correction, "stereo": "mono" if one_view else stereo}
            )
        scene_renderer = SceneRenderer(
            scene,
            self._output.context,
            spacing_m=given.spacing_m,
            samples=given.samples,
            basis=deflection_cache.load(scene, given.cache_dir),
            sheet_shape=given.sheet_shape or scene.methods.sheet_shape,
        )
        latency = DisplayLatencyEstimator(
            first_s=given.prediction_horizon_s,
            display_latency_s=given.display_latency_s,
            period_s=self._output.period_s,
        )
        ports = RendererInputs(**{name: self.inputs[name] for name in RendererInputs.__slots__})
        self._frame_renderer = FrameRenderer(
            scene_renderer, self._output, ports, latency, self.clock, max_age=self._max_age
        )

    def on_display(self, display: Display, header: Header) -> None:
        self._shown, self._since_pixels = display, 0

    def on_soft_body(self, soft_body: SoftBody, header: Header) -> None:
        if self._frame_renderer is not None:
            self._frame_renderer.extrapolator.add(soft_body, header)
        self._draw_if_due()

    def on_eye(self, eye: Eye, header: Header) -> None:
        if self._frame_renderer is not None:
            self._frame_renderer.eye_predictor.add(eye, header)

    def on_fingertip(self, fingertip: Fingertip, header: Header) -> None:
        self._max_age.add(header)
        if self.soft_body.age_s() > self._max_age.seconds:
            self._draw_if_due()

    @periodic("rate_hz")
    def refresh(self) -> None:
        """Handle the window's events, and draw a frame if no message has triggered one in time."""
        if not self._output.poll():
            self._reopen()
        if self.clock.now_ns() > self._due_ns + self._period_ns:
            self._draw_if_due()

    def _new_output(self) -> OutputWindow:
        from flexsheet.nodes.renderer.output_window import open_output

        return open_output(self.parameters, self.clock.now_ns, self._was_shown)

    def _was_shown(self, tag: tuple[Frame, int], swapped_ns: int) -> None:
        """Publish the message about a shown frame. Any thread may call this method."""
        self._loop.call_soon_threadsafe(self._publish, *tag, swapped_ns)

    def _reopen(self) -> None:
        """Create the output and all graphics objects again after the OpenGL context was lost."""
        self.log.warning("window", problem=self._output.note)
        self._frame_renderer = None
        self._output.close()
        self._output = self._new_output()
        if self.scene.message is not None and self.scene.header is not None:
            self.on_scene(self.scene.message, self.scene.header)

    def _draw_if_due(self) -> None:
        # Allow drawing up to a quarter of a period early. Otherwise frames would be dropped
        # periodically if the rates of camera and frames are almost equal.
        now_ns = self.clock.now_ns()
        if self._frame_renderer is None or now_ns < self._due_ns - self._period_ns // 4:
            return
        idle_ns = now_ns - self._drawn_ns + self._period_ns // 4
        if idle_ns < IDLE_PERIOD_NS and self._frame_renderer.is_unchanged(self._shown):
            return
        self._drawn_ns = now_ns
        self._draw(self._frame_renderer, now_ns)
        # If drawing takes longer than a period, leave time to read the messages that have arrived.
        earliest_ns = self.clock.now_ns() + READ_TIME_NS
        self._due_ns = max(self._due_ns + self._period_ns, earliest_ns + self._period_ns // 4)

    def _draw(self, frame_renderer: FrameRenderer, begun_ns: int) -> None:
        self._since_pixels += 1
        with_pixels = 0 < self._shown.pixels_every <= self._since_pixels
        frame, source_ns = frame_renderer.render(self._shown, begun_ns, with_pixels=with_pixels)
        if with_pixels:
            self._since_pixels = 0
        self.set_notes({**frame_renderer.notes, NoteCode.WINDOW: self._output.note})
        if self._output.is_seen:
            self._output.show((frame, source_ns), self._shown)
        else:
            self.frame.publish(frame, source_ns=source_ns)

    def _publish(self, frame: Frame, source_ns: int, swapped_ns: int) -> None:
        """Publish the message about a frame.

        source_ns: exposure time of the camera images from which the frame was computed.
        swapped_ns: time at which the window showed the frame; 0 if a newer frame replaced this
            frame.
        """
        if self._frame_renderer is not None:
            frame = self._frame_renderer.on_shown(frame, swapped_ns)
        self.frame.publish(frame, source_ns=source_ns)
