"""Deform the scene's object where the finger pushes it: the soft body's node."""

from __future__ import annotations

import asyncio
from functools import partial
from threading import Event

from flexsheet.messages.base import Header
from flexsheet.messages.scene import Scene
from flexsheet.messages.types import Fingertip, Skin, SoftBody
from flexsheet.nodes import cache
from flexsheet.nodes.cache import EtaEstimator
from flexsheet.nodes.fem_solver import body, precompute
from flexsheet.nodes.fem_solver.closest_contact import ContactAnchor
from flexsheet.nodes.fem_solver.contact import Response
from flexsheet.nodes.fem_solver.deadline_fallback import DeadlineFallback
from flexsheet.nodes.fem_solver.interruption import run_unless_superseded
from flexsheet.nodes.fem_solver.parameters import FemSolverParameters
from flexsheet.nodes.fem_solver.soft_body_factory import (
    FACTORY_PARAMETERS,
    SKIN_SPACING_M,
    SoftBodyFactory,
    choose_method,
)
from flexsheet.nodes.node import Input, Node, Output


class FemSolver(Node):
    """Publish the skin at rest once it is precomputed, then its displacement for each fingertip."""

    parameters: FemSolverParameters
    scene: Input[Scene]
    fingertip: Input[Fingertip]
    skin: Output[Skin]
    soft_body: Output[SoftBody]

    async def setup(self) -> None:
        self._stop = Event()
        folder = self.parameters.cache_dir or cache.default_cache_dir()
        self._maker = SoftBodyFactory(
            SKIN_SPACING_M, folder, **self.parameters.model_dump(include=FACTORY_PARAMETERS)
        )
        self._making: asyncio.Task[None] | None = None
        self._remaining = EtaEstimator()
        self._use([])
        self._forget()
        self.note = "waiting for a scene"

    def _forget(self) -> None:
        self._last: Response | None = None
        self._last_ns = 0
        self._entry: ContactAnchor | None = None

    def _use(self, bodies: list[body.SceneBody]) -> None:
        """Answer with these bodies from now on, the best first; with none before a scene."""
        self._bodies = {one.method.name: one for one in bodies}
        if bodies:
            self._pace = DeadlineFallback(list(self._bodies), self.parameters.step_budget_s)
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
        method, maker.skin_spacing_m = choose_method(scene, p.method, p.skin_spacing_m)
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
        self.note += maker.pending_note(scene, method, bodies)
        self.skin.publish(bodies[0].skin, source_ns=header.source_ns)
        if method == "nonlinear_table" and not p.friction_ratio and len(bodies) == 1:
            self._making = asyncio.create_task(self._make_table(scene, bodies[0]))

    async def _make_table(self, scene: Scene, linear: body.SceneBody) -> None:
        """Compute the nonlinear table while the linear method answers."""
        try:
            progress = partial(self._progress, self._stop)
            best = await asyncio.to_thread(self._maker.build_table, scene, linear, progress)
        except precompute.Interrupted:
            self.note = "nonlinear table interrupted; the next start continues it"
        except Exception as error:
            self.report_error("nonlinear_table", error)
        else:
            self._use([best, linear])

    def _progress(self, stop: Event, done: int, total: int, need: precompute.WorkBudget) -> None:
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
            point = body.predict_position(fingertip, self.parameters.prediction_horizon_s)
            response, self._entry = current.respond(point, self._entry)
            self._last, self._last_ns = response, header.source_ns
            if self._pace.record((self.clock.now_ns() - begun_ns) * 1e-9):
                late = f", {current.method.name} was late" if self._pace.is_fallback else ""
                self.note = f"soft body by {self._pace.name}{late}"
        elif self._last is None:
            response = current.at_rest()
        else:
            response = body.fade_response(
                self._last,
                (header.source_ns - self._last_ns) * 1e-9,
                hold_s=self.parameters.hold_s,
                relax_s=self.parameters.relax_s,
            )
        answer = current.message(response, horizon_s=self.parameters.prediction_horizon_s)
        self.soft_body.publish(answer, source_ns=header.source_ns)
