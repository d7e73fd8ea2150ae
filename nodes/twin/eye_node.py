"""Simulate the images at the user's eye, from which experiments compute image errors.

Experiments label the frames that they evaluate. The parameter `apparatus` contains the true
parameters of the simulated hardware. The scene contains the parameters that the other nodes assume.
"""

from __future__ import annotations

import asyncio
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from flexsheet.messages.base import Header
from flexsheet.messages.notes import NoteCode
from flexsheet.messages.scene import Positive, Scene
from flexsheet.messages.types import (
    Display,
    Eye,
    Frame,
    Skin,
    SoftBody,
    TwinArms,
    TwinEye,
    TwinFinger,
    Viewpoint,
)
from flexsheet.nodes import OmissionReason
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.node import Input, Node, Output
from flexsheet.nodes.twin.eye import METRES_PER_PX, EyeCamera, EyeSituation
from flexsheet.nodes.twin.truth import SimulatorParameters, apply_apparatus, find_display_delay_s
from flexsheet.nodes.twin.viewer import HeadSway

Key = tuple[str, ...]
"""The label, correction method and eye of a frame. They identify a rendering job."""

Job = tuple[EyeSituation, Floats, Frame, Header]

MAX_QUEUE = 32
"""The maximum number of frames that wait to be rendered."""

MIN_INTERVAL_NS = 5_000_000_000
"""The minimum time (ns) between two rendered frames with the same key."""

MAX_EYE_AGE_S = 0.1
"""The maximum age (s) of the tracked eye position. If the position is older, the eyes of the scene
are used."""


class TwinEyeParameters(SimulatorParameters):
    """The parameters of the simulated eye."""

    metres_per_px: Positive = Field(
        default=METRES_PER_PX, description="size of a pixel on the screen plane, m"
    )
    viewpoint: Viewpoint = Field(
        default="centre",
        description="position of the measuring camera for mono frames: left or right eye, or the "
        "centre between both eyes",
    )
    seed: int = Field(default=2026, description="random seed of the simulated head motion")


class TwinEyeNode(Node):
    """A node that simulates the image that the user's eye sees of a displayed frame.

    Only frames with a label are simulated. An experiment labels the frames that it evaluates. An
    image takes about a second to render. Therefore the node renders one frame per label, correction
    method and eye, and ignores further frames. The frame must contain its pixels, drawn for one
    viewpoint only. If it was drawn for one eye, the viewpoint is the position of this eye.
    Otherwise the viewpoint in the parameters is used.

    The sheet is rendered as it is when the projector shows the frame, a few milliseconds after the
    frame arrives. The finger position is taken from the latest exposure. The deformation is the
    latest result of the soft-body solver.
    """

    on_demand: ClassVar[bool] = True
    optional_inputs: ClassVar[frozenset[str]] = frozenset({"skin", "soft_body"})
    parameters: TwinEyeParameters
    scene: Input[Scene]
    frame: Input[Frame]
    display: Input[Display]
    eye: Input[Eye]
    twin__arms: Input[TwinArms]
    twin__finger: Input[TwinFinger]
    soft_body: Input[SoftBody]
    skin: Input[Skin]
    twin__eye: Output[TwinEye]

    @classmethod
    def omission_reason(cls, parameters: Any, scene: Scene) -> OmissionReason | None:
        return OmissionReason.NO_IMAGE if scene.projector is None else None

    async def setup(self) -> None:
        self._camera = EyeCamera()
        self._worker = ThreadPoolExecutor(1, thread_name_prefix=self.name)
        given = self.parameters
        self._jobs: dict[Key, Job] = {}
        self._rendered_ns: dict[Key, int] = {}
        self._before_light: tuple[Frame, Header] | None = None
        self._task: asyncio.Task[None] | None = None
        self._scenes: tuple[Scene, Scene] | None = None
        truth = given.apparatus
        self._sway = None if truth is None else HeadSway.drawn(truth.eyes, given.seed)

    async def close(self) -> None:
        self._jobs.clear()
        if self._task is not None:
            await asyncio.gather(self._task, return_exceptions=True)
        self._worker.shutdown()

    async def settle(self) -> None:
        if self._task is not None:
            await self._task

    def on_frame(self, frame: Frame, header: Header) -> None:
        key, now_ns = (frame.label, frame.correction, frame.eye), self.clock.now_ns()
        if not frame.pixels or not frame.label or key in self._jobs:
            return
        if key in self._rendered_ns and now_ns - self._rendered_ns[key] < MIN_INTERVAL_NS:
            return
        if self.scene.message is None or self.twin__arms.message is None:
            self.set_note(NoteCode.WAITING_FOR_SCENE)
        elif frame.stereo != "mono" and frame.eye == "both":
            text = f'"{frame.label}" has two views ({frame.stereo})'
            self.set_note(NoteCode.FRAME_NOT_RENDERED, text)
        elif len(self._jobs) >= MAX_QUEUE:
            self._rendered_ns[key] = now_ns
            text = f'frame "{frame.label}" is not rendered, because {MAX_QUEUE} frames are waiting'
            self.report_error("on_frame", OverflowError(f"{text}; use fewer labels at a time"))
        elif self._before_light is None:
            self._before_light = (frame, header)

    def on_twin__arms(self, arms: TwinArms, header: Header) -> None:
        scene = self.scene.message
        if self._before_light is None or scene is None:
            return
        frame, frame_header = self._before_light
        late_s = find_display_delay_s(frame, self.parameters.apparatus)
        light_ns = frame.predicted_to_ns + round(1e9 * late_s)
        if header.clock_id == frame_header.clock_id and header.source_ns < light_ns:
            return
        self._before_light = None
        true_scene = self._true_scene(scene)
        situation = self._collect_situation(true_scene, arms)
        eye = self._true_eye(true_scene, light_ns * 1e-9, self._viewpoint(frame))
        key = (frame.label, frame.correction, frame.eye)
        self._jobs[key] = (situation, eye, frame, frame_header)
        if self._task is None or self._task.done():
            self._task = asyncio.get_running_loop().create_task(self._picture_all())

    def _true_scene(self, scene: Scene) -> Scene:
        """Return the scene with the true parameters of the devices; the result is cached."""
        if self._scenes is None or self._scenes[0] is not scene:
            self._scenes = scene, apply_apparatus(scene, self.parameters.apparatus)
        return self._scenes[1]

    def _collect_situation(self, true_scene: Scene, arms: TwinArms) -> EyeSituation:
        finger, display = self.twin__finger.message, self.display.message
        skin, body = self.skin.message, self.soft_body.message
        # A deformation of another mesh is ignored.
        moved = body if skin is not None and body and body.mesh_id == skin.mesh_id else None
        return EyeSituation(
            scene=true_scene,
            apparatus=self.parameters.apparatus,
            arms=arms,
            finger_tip=None if finger is None else finger.position_world_m,
            skin=None if moved is None else skin,
            displacement=None if moved is None else moved.displacement_world_m,
            flat=display is not None and display.shading == "flat",
            metres_per_px=self.parameters.metres_per_px,
        )

    def _viewpoint(self, frame: Frame) -> Viewpoint:
        return self.parameters.viewpoint if frame.eye == "both" else frame.eye

    def _true_eye(self, true_scene: Scene, at_s: float, viewpoint: Viewpoint) -> Floats:
        """Return the true world position (3,), m, of the simulated eye at the time `at_s`.

        viewpoint: left eye, right eye, or the midpoint of both.

        The position is the tracked position of the eyes plus the tracking error in the parameter
        `apparatus`. If no eyes are tracked, it is the position in the true scene. The simulated
        head motion is added.
        """
        given = self.parameters
        tracked = self.eye.message if self.eye.age_s() <= MAX_EYE_AGE_S else None
        centre, right = true_scene.eyes.centre_world_m, np.array([1.0, 0.0, 0.0])
        if tracked is not None and tracked.valid:
            centre = tracked.centre_world_m
            right = tracked.right_world / np.linalg.norm(tracked.right_world)
            if given.apparatus is not None:
                centre = centre + np.array(given.apparatus.eyes.centre_offset_m)
        if self._sway is not None:
            centre = centre + self._sway.at(at_s)
        if viewpoint == "centre":
            return centre
        aside_m = 0.5 * true_scene.eyes.interocular_m
        return np.asarray(centre + (aside_m if viewpoint == "right" else -aside_m) * right)

    async def _picture_all(self) -> None:
        while self._jobs:
            key, job = next(iter(self._jobs.items()))
            await self.call("picture", self._picture, *job)
            self._jobs.pop(key, None)
            self._rendered_ns[key] = self.clock.now_ns()

    async def _picture(
        self, situation: EyeSituation, eye: Floats, frame: Frame, header: Header
    ) -> None:
        job = partial(self._camera.take, frame.pixels[0], situation, eye=eye)
        seen, expected = await asyncio.get_running_loop().run_in_executor(self._worker, job)
        picture = TwinEye(
            label=frame.label,
            correction=frame.correction,
            viewpoint=self._viewpoint(frame),
            metres_per_px=self.parameters.metres_per_px,
            seen=seen,
            expected=expected,
        )
        self.set_note(NoteCode.INFO, f'rendered the frame "{frame.label}"')
        self.twin__eye.publish(picture, source_ns=header.source_ns)
