"""The soft body: deforms the scene's object where the finger pushes it."""

from __future__ import annotations

import asyncio
from functools import partial
from pathlib import Path
from threading import Event
from typing import Literal

from pydantic import Field

from messages.base import Header
from messages.scene import NonNegative, Positive, Scene
from messages.types import Fingertip, Skin, SoftBody
from nodes import cache
from nodes.fem_solver import body, precompute
from nodes.fem_solver.contact import Response
from nodes.fem_solver.interruption import run_unless_superseded
from nodes.fem_solver.making import GIVEN, SKIN_SPACING_M, Maker, MethodChoice, asked
from nodes.fem_solver.pace import Pace
from nodes.fem_solver.place import Entry
from nodes.fem_solver.remaining import Remaining
from nodes.node import Input, Node, NodeParameters, Output


class FemSolverParameters(NodeParameters):
    method: MethodChoice = Field(
        default="auto",
        description="auto: the scene's, else the nonlinear table if it is in the cache, else "
        "linear; nonlinear_table makes it, in minutes, in the background, if it is not there",
    )
    skin_spacing_m: Positive | Literal["auto"] = Field(
        default="auto",
        description="between skin nodes where fingers go; auto: the scene's, else 0.003",
    )
    linear_depth_m: Positive = Field(default=0.006, description="deeper pushes are out of range")
    largest_depth_m: Positive = Field(default=0.010, description="the skin never goes deeper")
    friction_ratio: NonNegative = Field(
        default=0.0,
        description="the finger sticks until it pulls along the skin by more than this share of "
        "its pressure, then slips; 0: it slides; above 0 the linear method answers",
    )
    step_budget_s: Positive = Field(
        default=0.004, description="answers later than this, five running, change the method"
    )
    workers: int = Field(default=0, ge=0, description="processes that make a table; 0: one a core")
    scheduler: str | None = Field(
        default=None,
        description="a dask.distributed one, as tcp://host:8786, whose workers make the table",
    )
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
        self._stop = Event()
        folder = self.parameters.cache_dir or cache.default_cache_dir()
        self._maker = Maker(SKIN_SPACING_M, folder, **self.parameters.model_dump(include=GIVEN))
        self._making: asyncio.Task[None] | None = None
        self._remaining = Remaining()
        self._use([])
        self._forget()
        self.note = "waiting for a scene"

    def _forget(self) -> None:
        self._last: Response | None = None
        self._last_ns = 0
        self._entry: Entry | None = None

    def _use(self, bodies: list[body.SceneBody]) -> None:
        """Answer by these from now on, the best first; by none before a scene."""
        self._bodies = {one.method.name: one for one in bodies}
        if bodies:
            self._pace = Pace(list(self._bodies), self.parameters.step_budget_s)
            nodes = len(bodies[0].skin.vertices_world_m)
            self.note = f"soft body ready, {self._pace.name}, {nodes} skin nodes"

    async def close(self) -> None:
        self._stop.set()
        await self._end_making()

    async def _end_making(self) -> None:
        if self._making is not None:
            self._stop.set()
            await self._making
            self._making, self._stop = None, Event()

    async def on_scene(self, scene: Scene, header: Header) -> None:
        self._use([])
        self._forget()
        await self._end_making()
        p, maker = self.parameters, self._maker
        method, maker.skin_spacing_m = asked(scene, p.method, p.skin_spacing_m)
        try:
            make, newer = partial(maker.bodies, scene, method), partial(self.is_superseded, "scene")
            bodies = await run_unless_superseded(make, self._progress, newer)
        except precompute.Interrupted:
            self.note = "precomputation interrupted"
            return
        except Exception as error:
            self.note = f"no soft body: {error}"
            raise
        self._use(bodies)
        self.note += maker.lacking(scene, method, bodies)
        self.skin.publish(bodies[0].skin, source_ns=header.source_ns)
        if method == "nonlinear_table" and not p.friction_ratio and len(bodies) == 1:
            self._making = asyncio.create_task(self._make_table(scene, bodies[0]))

    async def _make_table(self, scene: Scene, linear: body.SceneBody) -> None:
        """While the linear method answers, make what answers better."""
        try:
            progress = partial(self._progress, self._stop)
            best = await asyncio.to_thread(self._maker.tabulated, scene, linear, progress)
        except precompute.Interrupted:
            self.note = "making of the nonlinear table interrupted; it goes on from there next time"
        except Exception as error:
            self.report_error("nonlinear_table", error)
        else:
            self._use([best, linear])

    def _progress(self, stop: Event, done: int, total: int, need: precompute.Need) -> None:
        if stop.is_set() or self._stop.is_set():
            raise precompute.Interrupted
        far = self._remaining.text(done, total, self.clock.now_ns() * 1e-9)
        self.note = f"precomputing the soft body: {far} ({need.text()})"

    def on_fingertip(self, fingertip: Fingertip, header: Header) -> None:
        if not self._bodies:
            return
        current = self._bodies[self._pace.name]
        if fingertip.valid:
            begun_ns = self.clock.now_ns()
            point = body.position_at(fingertip, self.parameters.lead_s)
            response, self._entry = current.respond(point, self._entry)
            self._last, self._last_ns = response, header.source_ns
            if self._pace.took((self.clock.now_ns() - begun_ns) * 1e-9):
                late = f", {current.method.name} was late" if self._pace.dropped else ""
                self.note = f"soft body by {self._pace.name}{late}"
        elif self._last is None:
            response = current.at_rest()
        else:
            p, since_s = self.parameters, (header.source_ns - self._last_ns) * 1e-9
            response = body.faded(self._last, since_s, hold_s=p.hold_s, relax_s=p.relax_s)
        answer = current.message(response, lead_s=self.parameters.lead_s)
        self.soft_body.publish(answer, source_ns=header.source_ns)
