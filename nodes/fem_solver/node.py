"""The soft body: deforms the scene's object where the finger pushes it."""

from __future__ import annotations

import asyncio
import threading
from pathlib import Path

from pydantic import Field

from messages.base import Header
from messages.scene import NonNegative, Positive, Scene
from messages.types import Fingertip, Skin, SoftBody
from nodes.fem_solver import body, cache, precompute
from nodes.fem_solver.contact import Response
from nodes.fem_solver.place import Entry
from nodes.node import Input, Node, NodeParameters, Output


class FemSolverParameters(NodeParameters):
    skin_spacing_m: Positive = Field(
        default=0.003, description="between skin nodes where fingers go; finer is dearer at set-up"
    )
    linear_depth_m: Positive = Field(default=0.006, description="deeper pushes are out of range")
    largest_depth_m: Positive = Field(default=0.010, description="the skin never goes deeper")
    lead_s: NonNegative = Field(default=0.0, description="finger is predicted this far ahead")
    hold_s: NonNegative = Field(default=0.1, description="a lost finger keeps its dent this long")
    relax_s: Positive = Field(default=0.15, description="time constant of springing back after it")
    cache_dir: Path | None = Field(
        default=None, description="of precomputations; null: the user's cache"
    )


class FemSolver(Node):
    """Publishes the skin at rest once it is precomputed, then its displacement per fingertip."""

    parameters: FemSolverParameters
    scene: Input[Scene]
    fingertip: Input[Fingertip]
    skin: Output[Skin]
    soft_body: Output[SoftBody]

    async def setup(self) -> None:
        self._stop = threading.Event()
        self._model: tuple[str, precompute.SoftBodyModel] | None = None
        self._body: body.SceneBody | None = None
        self._forget()
        self.note = "waiting for a scene"

    def _forget(self) -> None:
        self._last: Response | None = None
        self._last_ns = 0
        self._entry: Entry | None = None

    async def close(self) -> None:
        self._stop.set()

    async def on_scene(self, scene: Scene, header: Header) -> None:
        self._body = None
        self._forget()
        try:
            self._body = await asyncio.to_thread(self._build, scene)
        except precompute.Interrupted:
            self.note = "precomputation interrupted"
            return
        except Exception as error:
            self.note = f"no soft body: {error}"
            raise
        self.note = f"soft body ready, {len(self._body.skin.vertices_world_m)} skin nodes"
        self.skin.publish(self._body.skin, source_ns=header.source_ns)

    def _build(self, scene: Scene) -> body.SceneBody:
        """In a thread of its own: takes seconds when nothing is in the cache."""
        spec = body.spec_of(scene, self.parameters.skin_spacing_m)
        if self._model is None or self._model[0] != spec.key():
            path = self.parameters.cache_dir or cache.default_cache_dir()
            self._model = spec.key(), precompute.load_or_compute(spec, path, self._progress)
        return body.scene_body(
            scene,
            spec,
            self._model[1],
            linear_depth_m=self.parameters.linear_depth_m,
            largest_depth_m=self.parameters.largest_depth_m,
        )

    def _progress(self, done: int, total: int, need: precompute.Budget) -> None:
        if self._stop.is_set():
            raise precompute.Interrupted
        self.note = f"precomputing the soft body: {100 * done // total} % ({need.text()})"

    def on_fingertip(self, fingertip: Fingertip, header: Header) -> None:
        if self._body is None:
            return
        if fingertip.valid:
            point = body.position_at(fingertip, self.parameters.lead_s)
            response, self._entry = self._body.respond(point, self._entry)
            self._last, self._last_ns = response, header.source_ns
        elif self._last is None:
            response = self._body.at_rest()
        else:
            response = body.faded(
                self._last,
                (header.source_ns - self._last_ns) * 1e-9,
                hold_s=self.parameters.hold_s,
                relax_s=self.parameters.relax_s,
            )
        self.soft_body.publish(self._body.message(response), source_ns=header.source_ns)
