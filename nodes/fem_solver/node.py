"""Provide the node that computes how the finger deforms the virtual object of the scene."""

from __future__ import annotations

import asyncio
from typing import Any, ClassVar

from flexsheet.messages.base import Header
from flexsheet.messages.notes import NoteCode
from flexsheet.messages.scene import Scene
from flexsheet.messages.types import Fingertip, ParameterChange, Skin, SoftBody
from flexsheet.nodes import OmissionReason, cache
from flexsheet.nodes.fem_solver import body
from flexsheet.nodes.fem_solver.closest_contact import ContactAnchor
from flexsheet.nodes.fem_solver.contact import Response
from flexsheet.nodes.fem_solver.parameters import FemSolverParameters
from flexsheet.nodes.fem_solver.soft_body_factory import choose_method, load_body
from flexsheet.nodes.node import Input, Node, Output


class FemSolver(Node):
    """A node that publishes the skin of the object and the displacement that the finger causes.

    The undeformed skin (surface) is published once for each scene, and its displacement once for
    each fingertip message. The launcher computes the tables of a scene before it starts the node.
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
        self._reset()
        self.set_note(NoteCode.WAITING_FOR_SCENE)

    def _reset(self) -> None:
        self._body: body.SceneBody | None = None
        self._last: Response | None = None
        self._last_ns = 0
        self._anchor: ContactAnchor | None = None

    async def on_scene(self, scene: Scene, header: Header) -> None:
        self._reset()
        if scene.object.material is None:
            self.set_note(NoteCode.INFO, "no soft body: the object is rigid")
            return
        p = self.parameters
        choice = choose_method(scene, p.method, p.skin_spacing_m)
        folder = p.cache_dir or cache.default_cache_dir()
        try:
            built = await asyncio.to_thread(load_body, scene, choice, folder, self._progress)
        except Exception as error:
            self.set_note(NoteCode.SOFT_BODY_FAILED, str(error))
            raise
        self._body = built
        self.set_note(NoteCode.INFO, describe(built))
        if choice.method == "nonlinear_table" and built.method.name == "linear":
            detail = f"{describe(built)}; {cache.advise_precompute(scene)}"
            self.set_note(NoteCode.SOFT_BODY_TABLE_MISSING, detail)
        self.skin.publish(built.skin, source_ns=header.source_ns)

    def _progress(self, done: int, total: int, need: str) -> None:
        percent = 100 * done // total
        self.set_note(NoteCode.SOFT_BODY_COMPUTING, f"{percent} % ({need})")

    def on_fingertip(self, fingertip: Fingertip, header: Header) -> None:
        if self._body is None:
            return
        p = self.parameters
        if fingertip.valid:
            point = body.predict_position(fingertip, p.prediction_horizon_s)
            response, self._anchor = self._body.respond(point, self._anchor)
            self._last, self._last_ns = response, header.source_ns
        elif self._last is None:
            response = self._body.at_rest()
        else:
            lost_s = (header.source_ns - self._last_ns) * 1e-9
            response = body.fade_response(self._last, lost_s, hold_s=p.hold_s, relax_s=p.relax_s)
        message = self._body.message(response, horizon_s=p.prediction_horizon_s)
        self.soft_body.publish(message, source_ns=header.source_ns)


def describe(current: body.SceneBody) -> str:
    """Return a text with the method of a soft body and its estimated force errors."""
    errors = " and ".join(
        f"{100.0 * current.force_error_ratio(depth_m):.0f} % at {1e3 * depth_m:g} mm"
        for depth_m in body.NOTED_DEPTHS_M
    )
    return (
        f"soft body by {current.method.name}, force error up to {errors} depth "
        f"relative to the reference, {len(current.rest)} skin nodes"
    )
