"""Decides where the sheet shall be: from the fingertip to the sheet's target."""

from __future__ import annotations

import numpy as np

from flexsheet.messages.base import Header
from flexsheet.messages.methods import SheetForceMethod, chosen
from flexsheet.messages.scene import Scene
from flexsheet.messages.sheet_calibration import SheetCalibration, load_sheet_calibration
from flexsheet.messages.types import Fingertip, SheetTarget, SoftBody
from flexsheet.nodes.models.prediction import path_at
from flexsheet.nodes.node import Input, Node, Output
from flexsheet.nodes.planner.force_table import law_by
from flexsheet.nodes.planner.lead import next_lead_s
from flexsheet.nodes.planner.motion import Plan, Planned
from flexsheet.nodes.planner.order import Order
from flexsheet.nodes.planner.parameters import PlannerParameters
from flexsheet.nodes.planner.sheet_force import law_for
from flexsheet.nodes.planner.yielding import Yielding

FIRST_LEAD_S = 0.05
CLOCK_SLACK_S = 0.005
"""A fingertip from further in the future than this is no measurement."""


def _is_finite(fingertip: Fingertip) -> bool:
    motion = (
        fingertip.position_world_m,
        fingertip.velocity_world_m_per_s,
        fingertip.predicted_path_world_m,
    )
    return all(bool(np.isfinite(values).all()) for values in motion)


class Planner(Node):
    """Publishes one sheet target per fingertip; the same inputs give the same bytes."""

    parameters: PlannerParameters
    scene: Input[Scene]
    fingertip: Input[Fingertip]
    soft_body: Input[SoftBody]
    sheet_target: Output[SheetTarget]

    async def setup(self) -> None:
        self._plan: Plan | None = None
        self._yielding: Yielding | None = None
        self._order = Order()
        self._writer = ("", 0)
        self._first_step_s = 0.0
        given = self.parameters
        self._lead_s = FIRST_LEAD_S if given.lead_s is None else given.lead_s
        self._late, self._law = 0, ""
        path = given.sheet_calibration
        self._calibration: SheetCalibration | None = None
        if path is not None:
            self._calibration = load_sheet_calibration(path)

    def on_scene(self, scene: Scene, header: Header) -> None:
        # An object that cannot be presented must not leave the last one's plan in force.
        self._plan = self._yielding = None
        self._plan = Plan(scene, self.parameters.settings())
        if self._calibration is None:
            method: SheetForceMethod = chosen(
                self.parameters.sheet_force, scene.methods.sheet_force, "scaled"
            )
            law, self._law = law_by(scene, method, self.parameters.cache_dir)
        else:
            law, self._law = law_for(scene.sheet, self._calibration), "as calibrated"
        self._yielding = Yielding(scene, law, self.parameters.presents)
        self._first_step_s = 1.0 / scene.camera.rate_hz
        self._order = Order()

    def on_soft_body(self, soft_body: SoftBody, header: Header) -> None:
        if self._yielding is not None and self._plan is not None:
            self._yielding.take(soft_body, touching=self._plan.touching)
            self._tell()

    def _tell(self) -> None:
        late = f"{self._late} fingertips came out of order and were left out" if self._late else ""
        presented = self._yielding.note if self._yielding is not None else ""
        law = f"sheet's force: {self._law}"
        self.note = "; ".join(filter(None, (presented, late, law)))

    def on_fingertip(self, fingertip: Fingertip, header: Header) -> None:
        plan, yielding = self._plan, self._yielding
        if plan is None or yielding is None:
            return
        writer = (header.clock_id, header.epoch)
        if writer != self._writer:
            # The triangulator was started anew, and its times with it.
            self._writer, self._order = writer, Order()
        source_ns = header.source_ns
        step_s = self._order.step_s(source_ns, self._first_step_s)
        if step_s is None:
            self._late += 1
            self._tell()
            return
        age_s = (header.publish_ns - source_ns) * 1e-9
        if not fingertip.valid:
            planned = plan.hold(f"fingertip: {fingertip.reason}", step_s)
        elif not _is_finite(fingertip):
            planned = plan.hold("fingertip: numbers that are not finite", step_s)
        elif not -CLOCK_SLACK_S <= age_s <= self.parameters.oldest_s:
            planned = plan.hold(f"fingertip is {age_s * 1e3:.0f} ms old", step_s)
        else:
            if self.parameters.lead_s is None:
                before_s = self._lead_s
                furthest_s = (
                    len(fingertip.predicted_path_world_m) - 1
                ) * fingertip.prediction_step_s
                self._lead_s = next_lead_s(before_s, age_s + self.parameters.arrival_s, furthest_s)
                step_s += self._lead_s - before_s
            point, velocity = path_at(
                fingertip.predicted_path_world_m, fingertip.prediction_step_s, self._lead_s
            )
            planned = plan.follow_finger(point, velocity, yielding, step_s)
        self._publish(planned, source_ns)

    def _publish(self, planned: Planned, source_ns: int) -> None:
        shown = planned.presentation
        self.sheet_target.publish(
            SheetTarget(
                phase=shown.phase,
                reason=shown.reason,
                valid_at_ns=source_ns + round(self._lead_s * 1e9),
                world_from_sheet=planned.motion.world_from_sheet,
                twist_world=planned.motion.twist_world,
                stretch_ratio=planned.motion.stretch_ratio,
                contact_world_m=planned.contact_world_m,
                normal_world=planned.normal_world,
                contact_sheet_m=planned.contact_sheet_m,
                push_depth_m=shown.push_depth_m,
                retreat_m=planned.retreat_m,
            ),
            source_ns=source_ns,
        )
