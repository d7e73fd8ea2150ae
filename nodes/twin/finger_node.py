"""Simulate the user's finger and the stereo camera.

The parameter `apparatus` contains the true parameters of the simulated hardware. The scene contains
the parameters that the other nodes assume.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import scipy
from pydantic import Field

from flexsheet.messages.apparatus import FingerTruth
from flexsheet.messages.base import Header
from flexsheet.messages.notes import NoteCode
from flexsheet.messages.scene import NonNegative, Scene
from flexsheet.messages.types import FingerPath, StereoPair, TwinArms, TwinFinger
from flexsheet.nodes import NodeRole
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.node import Input, Node, Output
from flexsheet.nodes.twin.clutter import CLUTTER
from flexsheet.nodes.twin.finger import (
    FingerMotion,
    FingerPathError,
    FingerState,
    find_tremor_m,
)
from flexsheet.nodes.twin.hand import CoupledFinger, EdgeTrack, HandImpedance, TrueSheet
from flexsheet.nodes.twin.nail import Nail
from flexsheet.nodes.twin.pixels import TwinCamera
from flexsheet.nodes.twin.rig import make_true_camera
from flexsheet.nodes.twin.sheet_pull import find_clamps
from flexsheet.nodes.twin.sheet_reaction import load_or_compute_reaction
from flexsheet.nodes.twin.truth import SimulatorParameters, apply_apparatus

JITTER_STREAM = 1
"""The second element of the random seed for the jitter of exposure times. It makes the jitter
independent of the image noise."""

REST_WORLD_M = (0.0, 0.0, 0.08)
"""The world position (m) of the finger before the first path."""


class TwinFingerParameters(SimulatorParameters):
    """The parameters of the simulated finger and stereo camera."""

    seed: int = Field(
        default=2006,
        description="random seed of the finger's wander and tremor and of the image noise",
    )
    transfer_s: NonNegative = Field(
        default=0.004, description="duration of the image read-out after the exposure, s"
    )
    clutter: Literal["none", "lab", "crowded"] = Field(
        default="lab",
        description="objects in the images besides the finger. lab: sheet, hand, reflections; "
        "crowded: also a second marker, moving reflections, cables",
    )
    hand: Literal["prescribed", "coupled"] = Field(
        default="prescribed",
        description="prescribed: the finger follows its path regardless of forces. coupled: the "
        "force of the simulated sheet deflects the finger. The apparatus contains the hand's "
        "impedance",
    )
    cache_dir: Path | None = Field(
        default=None,
        description="folder that caches the table of the sheet's force on the finger, which is "
        "used if the parameter `hand` is coupled; null: the user's cache folder is used",
    )


class TwinFingerNode(Node):
    """A node that moves a simulated finger along its path and renders stereo images."""

    role: ClassVar[NodeRole | None] = NodeRole.FINGER_SIMULATOR
    optional_inputs: ClassVar[frozenset[str]] = frozenset({"twin__arms"})
    parameters: TwinFingerParameters
    scene: Input[Scene]
    twin__arms: Input[TwinArms]
    twin__finger_path: Input[FingerPath]
    twin__finger: Output[TwinFinger]
    twin__stereo: Output[StereoPair]

    camera: TwinCamera | None = None
    filming: asyncio.Task[None] | None = None
    motion: FingerMotion
    motion_from_ns = 0
    path_label = ""
    refusal = ""
    missed_frames = 0
    coupled: CoupledFinger | None = None
    preparing: asyncio.Task[None] | None = None
    waiting: FingerPath | None = None

    @cached_property
    def has_scene(self) -> asyncio.Event:
        """Return the event that is set when the first scene arrives."""
        return asyncio.Event()

    @classmethod
    def unused_inputs(cls, parameters: TwinFingerParameters, scene: Scene) -> frozenset[str]:
        return frozenset() if parameters.hand == "coupled" else cls.optional_inputs

    @classmethod
    def replay_refusal(cls, parameters: Any) -> str:
        return "it takes images by its own clock; the bag has the finger's motion as twin/finger"

    async def setup(self) -> None:
        # SciPy imports a submodule on first use, which must not delay an image.
        _ = scipy.special
        if self.parameters.hand == "coupled":
            _ = scipy.interpolate
        self._jitter = np.random.default_rng((self.parameters.seed, JITTER_STREAM))
        self.filming = asyncio.create_task(self._film())

    async def close(self) -> None:
        for task in (self.filming, self.preparing):
            if task is not None:
                task.cancel()
                await asyncio.gather(task, return_exceptions=True)

    def on_scene(self, scene: Scene, header: Header) -> None:
        truth = self.parameters.apparatus
        true_scene = apply_apparatus(scene, truth)
        if self.camera is None:
            rest_m = np.array(REST_WORLD_M)
            self.motion = FingerMotion.of(self._true_finger, rest_m, seed=self.parameters.seed)
            self.motion_from_ns = self.clock.now_ns()
        self.camera = TwinCamera(
            make_true_camera(true_scene.camera),
            finger_radius_m=true_scene.finger.radius_m,
            seed=self.parameters.seed,
            clutter=CLUTTER[self.parameters.clutter],
            nail=None if truth is None else Nail.of(truth.finger),
            skew_s=0.0 if truth is None else truth.camera.skew_s,
        )
        self.max_speed_m_per_s = true_scene.finger.max_speed_m_per_s
        self.period_ns = round(1e9 / true_scene.camera.rate_hz)
        self.exposure_ns = round(1e9 * true_scene.camera.exposure_s)
        self.has_scene.set()
        if self.parameters.hand == "coupled":
            self.coupled, self.edges = None, EdgeTrack()
            self.clamps = find_clamps(true_scene)
            if self.preparing is not None:
                self.preparing.cancel()
            self.preparing = asyncio.create_task(self.call("couple", self._couple, scene))
        else:
            self._follow_waiting()

    async def _couple(self, scene: Scene) -> None:
        given = self.parameters
        reaction = await asyncio.to_thread(
            load_or_compute_reaction, scene, given.apparatus, given.cache_dir
        )
        true_scene = apply_apparatus(scene, given.apparatus)
        sheet = await asyncio.to_thread(TrueSheet, true_scene, given.apparatus, reaction)
        self.coupled = CoupledFinger(HandImpedance.of(given.apparatus), sheet, self._voluntary)
        self.coupled.time_s = self._seconds(self.clock.now_ns())
        self._follow_waiting()

    def _follow_waiting(self) -> None:
        path, self.waiting = self.waiting, None
        if path is None:
            return
        self.refusal = ""
        try:
            self._follow(path)
        except FingerPathError as error:
            self.refusal = f'"{path.label}": {error}'
            self.log.warning("finger path", problem=self.refusal)
        self._update_note()

    def _seconds(self, at_ns: int) -> float:
        return (at_ns - self.started_ns) * 1e-9

    def _voluntary(self, at_s: float) -> tuple[Floats, Floats]:
        """Return the position (3,), m, and velocity (3,), m/s, of the finger's voluntary motion."""
        state = self.motion.at(at_s - self._seconds(self.motion_from_ns))
        return state.position, state.velocity

    def on_twin__arms(self, arms: TwinArms, header: Header) -> None:
        if self.coupled is None:
            return
        at_s = self._seconds(header.source_ns)
        left, right = arms.world_from_flange_left, arms.world_from_flange_right
        self.edges.add(at_s, left @ self.clamps[0], right @ self.clamps[1])
        if self.edges:
            self.coupled.advance(at_s, self.edges)

    def on_twin__finger_path(self, path: FingerPath, header: Header) -> None:
        coupled = self.parameters.hand == "prescribed" or self.coupled is not None
        self.waiting = path
        if self.camera is not None and coupled:
            self._follow_waiting()

    @property
    def _true_finger(self) -> FingerTruth | None:
        apparatus = self.parameters.apparatus
        return None if apparatus is None else apparatus.finger

    def _follow(self, path: FingerPath) -> None:
        """Start to follow a path immediately.

        Raises FingerPathError if the finger cannot follow the path; the current motion then
        continues.
        """
        if problem := path.find_problem():
            raise FingerPathError(f"path: {problem}")
        now_ns = self.clock.now_ns()
        if self.coupled is not None and self.edges:
            self.coupled.advance(self._seconds(now_ns), self.edges)
        self.motion = self.motion.followed_by(
            (now_ns - self.motion_from_ns) * 1e-9,
            times_s=path.times_s,
            points=path.positions_world_m,
            wander_m=path.wander_m,
            tremor_m=find_tremor_m(self._true_finger, path.tremor_m),
            max_speed_m_per_s=self.max_speed_m_per_s,
            joined_by=path.joined_by,
        )
        self.motion_from_ns, self.path_label = now_ns, path.label

    def truth(self, at_ns: int) -> FingerState:
        """Return the true state of the fingertip at the time `at_ns` of this node's clock."""
        state = self.motion.at((at_ns - self.motion_from_ns) * 1e-9)
        if self.coupled is None or not self.edges:
            return state
        ahead = self.coupled.predict(self._seconds(at_ns), self.edges)
        return replace(
            state,
            position=state.position + ahead.deviation_m,
            velocity=state.velocity + ahead.rate_m_per_s,
            force=ahead.force_n,
        )

    def expose(self, middle_ns: int) -> StereoPair:
        """Render the image pair with the timestamp `middle_ns`; publish the true finger position.

        The actual exposure time differs from `middle_ns` by the timestamp error in the parameter
        `apparatus` (true hardware parameters). A scene must have arrived before the call.
        """
        assert self.camera is not None
        exposed_ns = middle_ns + self._stamp_error_ns()
        state = self.truth(middle_ns)
        self.twin__finger.publish(
            TwinFinger(
                path_label=self.path_label,
                path_done=state.path_done,
                path_time_s=state.path_time_s,
                position_world_m=state.position,
                velocity_world_m_per_s=state.velocity,
                force_world_n=state.force,
            ),
            source_ns=middle_ns,
        )
        left, right = self.camera.picture(
            self._track(exposed_ns),
            exposure_s=self.exposure_ns * 1e-9,
            time_s=exposed_ns * 1e-9,
        )
        return StereoPair(
            device=self.camera.camera.device,
            exposure_s=self.exposure_ns * 1e-9,
            dropped_frames=self.missed_frames,
            left=left,
            right=right,
        )

    def _track(self, exposed_ns: int) -> Callable[[float], Floats]:
        """Return the fingertip position (3,), m, as a function of time (s) since mid-exposure."""
        if self.coupled is None:
            return lambda offset_s: self.truth(exposed_ns + round(offset_s * 1e9)).position
        seen = self.truth(exposed_ns)
        return lambda offset_s: seen.position + offset_s * seen.velocity

    def _stamp_error_ns(self) -> int:
        if self.parameters.apparatus is None:
            return 0
        camera = self.parameters.apparatus.camera
        if not camera.exposure_jitter_s:
            return round(1e9 * camera.stamp_offset_s)
        jitter_s = camera.exposure_jitter_s * float(self._jitter.standard_normal())
        return round(1e9 * (camera.stamp_offset_s + jitter_s))

    @property
    def _read_out_s(self) -> float:
        given = self.parameters
        true_s = None if given.apparatus is None else given.apparatus.camera.read_out_s
        return given.transfer_s if true_s is None else true_s

    @property
    def _max_late_ns(self) -> int:
        """Return the maximum delay (ns) at which an exposure can still start.

        If the computer is later, the camera misses an image pair. An exposure may overlap the
        read-out of the previous image pair.
        """
        overlap_ns = self.exposure_ns + round(1e9 * self._read_out_s) - self.period_ns
        return self.exposure_ns + max(0, overlap_ns)

    async def _film(self) -> None:
        """Take images at fixed intervals until the node closes.

        An image pair whose exposure time has already passed counts as missed.
        """
        await self.has_scene.wait()
        start_ns = self.clock.now_ns()
        while True:
            start_ns += self.period_ns
            late_ns = self.clock.now_ns() - start_ns
            if late_ns > self._max_late_ns:
                missed = -(-late_ns // self.period_ns)
                self.missed_frames += missed
                start_ns += missed * self.period_ns
            await self._sleep_until(start_ns)
            await self.call("frame", self._take_frame, start_ns)

    async def _take_frame(self, start_ns: int) -> None:
        """Expose one image pair, and publish it at the end of its read-out."""
        middle_ns = start_ns + self.exposure_ns // 2
        pair = self.expose(middle_ns)
        read_out_ns = start_ns + self.exposure_ns + round(1e9 * self._read_out_s)
        await self._sleep_until(read_out_ns)
        self.twin__stereo.publish(pair, source_ns=middle_ns)
        self._update_note()

    def _update_note(self) -> None:
        info = f'follows the path "{self.path_label}"' if self.path_label else ""
        if self.parameters.hand == "coupled" and self.coupled is None:
            info = "computes the force of the sheet on the finger"
        missed = f"{self.missed_frames} because the computer was busy"
        self.set_notes(
            {
                NoteCode.INFO: info,
                NoteCode.FRAMES_MISSED: missed if self.missed_frames else "",
                NoteCode.FINGER_PATH_REFUSED: self.refusal,
            }
        )

    async def _sleep_until(self, at_ns: int) -> None:
        await asyncio.sleep(max(0.0, (at_ns - self.clock.now_ns()) * 1e-9))
