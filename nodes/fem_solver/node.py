"""Provide the node that computes how the finger deforms the virtual object of the scene."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from functools import partial
from threading import Event
from typing import Any, ClassVar, TypeVar

from flexsheet.messages.base import Header
from flexsheet.messages.scene import Scene
from flexsheet.messages.types import Fingertip, ParameterChange, Skin, SoftBody
from flexsheet.nodes import OmissionReason, cache
from flexsheet.nodes.cache import EtaEstimator
from flexsheet.nodes.fem_solver import body, precompute
from flexsheet.nodes.fem_solver.closest_contact import ContactAnchor
from flexsheet.nodes.fem_solver.contact import Response
from flexsheet.nodes.fem_solver.deadline_fallback import DeadlineFallback
from flexsheet.nodes.fem_solver.parameters import FemSolverParameters
from flexsheet.nodes.fem_solver.soft_body_factory import (
    FACTORY_PARAMETERS,
    SKIN_SPACING_M,
    SoftBodyFactory,
    choose_method,
)
from flexsheet.nodes.models.interpolation import smoothstep
from flexsheet.nodes.node import Input, Node, Output

T = TypeVar("T")

POLL_S = 0.05
TABLE_NOTE = "; the nonlinear table is being computed"
BLEND_S = 5.0
"""The duration of the gradual transition between the responses of two methods, in seconds."""


class FemSolver(Node):
    """A node that publishes the skin of the object and the displacement that the finger causes.

    The undeformed skin (surface) is published once for each scene, and its displacement once for
    each fingertip message.
    """

    live_parameters: ClassVar[frozenset[str]] = frozenset(
        {"prediction_horizon_s", "hold_s", "relax_s"}
    )
    on_demand: ClassVar[bool] = True
    parameters: FemSolverParameters
    scene: Input[Scene]
    fingertip: Input[Fingertip]
    parameter: Input[ParameterChange]
    skin: Output[Skin]
    soft_body: Output[SoftBody]

    @classmethod
    def omission_reason(cls, parameters: Any, scene: Scene) -> OmissionReason | None:
        return OmissionReason.RIGID_OBJECT if scene.object.material is None else None

    async def setup(self) -> None:
        self._stop = Event()
        self._bodies: dict[str, body.SceneBody] = {}
        folder = self.parameters.cache_dir or cache.default_cache_dir()
        self._factory = SoftBodyFactory(
            SKIN_SPACING_M, folder, **self.parameters.model_dump(include=FACTORY_PARAMETERS)
        )
        self._table_task: asyncio.Task[None] | None = None
        self._eta = EtaEstimator()
        self._replaced: list[tuple[body.SceneBody, int]] = []
        self._fallback: DeadlineFallback
        self._set_bodies([])
        self._reset_contact()
        self.note = "waits for the scene"

    def _reset_contact(self) -> None:
        self._last: Response | None = None
        self._last_ns = 0
        self._anchor: ContactAnchor | None = None

    def _set_bodies(self, bodies: list[body.SceneBody]) -> None:
        """Set the soft bodies that compute responses, and start a gradual transition to them.

        bodies: one body per method, the best one first; empty if there is no scene yet.
        """
        if bodies and self._bodies:
            self._replaced.append((self._bodies[self._fallback.name], self.clock.now_ns()))
        else:
            self._replaced = []
        self._bodies = {one.method.name: one for one in bodies}
        if bodies:
            self._fallback = DeadlineFallback(list(self._bodies), self.parameters.step_budget_s)
            self.note = f"soft body by {self._describe(bodies[0])}"

    def _describe(self, current: body.SceneBody) -> str:
        nodes = len(current.skin.vertices_world_m)
        bodies = (current, *(old for old, _ in self._replaced))
        errors = " and ".join(
            f"{max(100.0 * one.force_error_ratio(depth_m) for one in bodies):.0f} % at "
            f"{1e3 * depth_m:g} mm"
            for depth_m in body.NOTED_DEPTHS_M
        )
        return (
            f"{current.method.name}, force error up to {errors} depth relative to the "
            "reference, "
            f"{nodes} skin nodes"
        )

    async def close(self) -> None:
        self._stop.set()
        await self._stop_table_task()

    async def _stop_table_task(self) -> None:
        if self._table_task is not None:
            self._stop.set()
            await self._table_task
            self._table_task, self._stop = None, Event()

    async def on_scene(self, scene: Scene, header: Header) -> None:
        self._set_bodies([])
        self._reset_contact()
        await self._stop_table_task()
        if scene.object.material is None:
            self.note = "no soft body: the object is rigid"
            return
        p, factory = self.parameters, self._factory
        method, factory.skin_spacing_m = choose_method(
            scene, p.method, p.skin_spacing_m, compute_table=p.compute_table
        )
        try:
            bodies = await run_unless_superseded(
                partial(factory.bodies, scene, method),
                self._progress,
                partial(self.is_superseded, "scene"),
            )
        except precompute.Interrupted:
            self.note = "precomputation interrupted"
            return
        except Exception as error:
            self.note = f"no soft body: {error}"
            raise
        self._set_bodies(bodies)
        self.note += factory.pending_note(scene, method, bodies)
        self.skin.publish(bodies[0].skin, source_ns=header.source_ns)
        if method == "nonlinear_table" and not p.friction_ratio and len(bodies) == 1:
            self.note += TABLE_NOTE
            self._table_task = asyncio.create_task(self._build_table(scene, bodies[0]))

    async def _build_table(self, scene: Scene, linear: body.SceneBody) -> None:
        """Compute the nonlinear table in the background, and use it when it is finished.

        Until then, responses come from the linear method, or from a coarse table as soon as it
        exists.
        """
        loop = asyncio.get_running_loop()
        stop = self._stop
        self.log.info(
            "computes the nonlinear table of the soft body in the background, which takes minutes; "
            "the graph works meanwhile, and `flexsheet status` shows the progress"
        )

        async def adopt(quick: body.SceneBody) -> None:
            if not stop.is_set():
                self._set_bodies([quick, linear])
                self.note += TABLE_NOTE

        def on_quick(quick: body.SceneBody) -> None:
            asyncio.run_coroutine_threadsafe(adopt(quick), loop).result()

        try:
            best = await asyncio.to_thread(
                self._factory.build_table,
                scene,
                linear,
                partial(self._progress, stop),
                on_quick,
            )
        except precompute.Interrupted:
            self.note = "the nonlinear table was interrupted; the next start continues it"
        except Exception as error:
            self.report_error("nonlinear_table", error)
        else:
            self._set_bodies([best, linear])

    def _progress(self, stop: Event, done: int, total: int, need: str) -> None:
        if stop.is_set() or self._stop.is_set():
            raise precompute.Interrupted
        eta = self._eta.text(done, total, self.clock.now_ns() * 1e-9)
        now = [self._describe(one) for one in self._bodies.values()]
        until_then = f"; the graph works until then with {now[0]}" if now else ""
        self.note = f"precomputing the soft body: {eta} ({need}){until_then}"

    def on_fingertip(self, fingertip: Fingertip, header: Header) -> None:
        if not self._bodies:
            return
        current = self._bodies[self._fallback.name]
        self._end_transitions()
        if fingertip.valid:
            start_ns = self.clock.now_ns()
            point = body.predict_position(fingertip, self.parameters.prediction_horizon_s)
            anchor = self._anchor
            response, self._anchor = current.respond(point, anchor)
            if self._fallback.record((self.clock.now_ns() - start_ns) * 1e-9):
                late = f", {current.method.name} was late" if self._fallback.is_fallback else ""
                chosen = self._bodies[self._fallback.name]
                self._replaced.append((current, self.clock.now_ns()))
                self.note = f"soft body by {self._describe(chosen)}{late}"
            response = self._blend_in(response, lambda old: old.respond(point, anchor)[0])
            self._last, self._last_ns = response, header.source_ns
        elif self._last is None:
            response = self._blend_in(current.at_rest(), body.SceneBody.at_rest)
        else:
            response = body.fade_response(
                self._last,
                (header.source_ns - self._last_ns) * 1e-9,
                hold_s=self.parameters.hold_s,
                relax_s=self.parameters.relax_s,
            )
        message = current.message(
            response,
            horizon_s=self.parameters.prediction_horizon_s,
            replaced=[old for old, _ in self._replaced],
        )
        self.soft_body.publish(message, source_ns=header.source_ns)

    def _end_transitions(self) -> None:
        """Remove previous soft bodies whose transition to the present soft body has ended.

        During a transition, the responses of both soft bodies are blended.
        """
        if not self._replaced:
            return
        begin_ns = self.clock.now_ns() - round(1e9 * BLEND_S)
        self._replaced = [one for one in self._replaced if one[1] > begin_ns]
        builds_table = self._table_task is not None and not self._table_task.done()
        if not (self._replaced or builds_table or self._fallback.is_fallback):
            self.note = f"soft body by {self._describe(self._bodies[self._fallback.name])}"

    def _blend_in(
        self, response: Response, respond: Callable[[body.SceneBody], Response]
    ) -> Response:
        """Return the response of the current body, blended with those of recently replaced bodies.

        When a more accurate body replaces another one, the response changes gradually within
        BLEND_S.

        response: response of the current body.
        respond: function that returns the response of another body to the same finger position.
        """
        if not self._replaced:
            return response
        now_ns = self.clock.now_ns()
        fractions = [min((now_ns - at_ns) / 1e9 / BLEND_S, 1.0) for _, at_ns in self._replaced]
        shown, *newer = [respond(replaced) for replaced, _ in self._replaced]
        for fraction, one in zip(fractions, [*newer, response], strict=True):
            shown = body.blend_responses(shown, one, smoothstep(fraction))
        return shown


async def run_unless_superseded(
    compute: Callable[[Callable[..., None]], T],
    progress: Callable[..., None],
    is_superseded: Callable[[], bool],
) -> T:
    """Run a function in a thread, and return its result unless a newer request arrives.

    compute: function that is run. Its argument is a callback with which it reports progress.
    progress: function that receives the reports of progress. Its first argument is an event that is
        set when the computation should stop.
    is_superseded: function that returns whether a newer request has arrived.

    Raises Interrupted if a newer request arrives. The thread then ends later, and its errors are
    ignored.
    """
    stop = Event()
    task = asyncio.create_task(asyncio.to_thread(compute, partial(progress, stop)))
    try:
        while not task.done():
            await asyncio.wait({task}, timeout=POLL_S)
            if not task.done() and is_superseded():
                raise precompute.Interrupted
        return task.result()
    finally:
        stop.set()
        task.add_done_callback(lambda ended: ended.cancelled() or ended.exception())
