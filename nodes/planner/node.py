"""Compute targets for the sheet from the fingertip and the soft body under the finger."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import scipy

from flexsheet.messages.base import Header
from flexsheet.messages.notes import NoteCode
from flexsheet.messages.scene import Scene
from flexsheet.messages.sheet_calibration import SheetCalibration
from flexsheet.messages.types import (
    ArmLatency,
    Fingertip,
    ParameterChange,
    SheetTarget,
    SoftBody,
)
from flexsheet.nodes.models.interpolation import interpolate_path
from flexsheet.nodes.node import Input, Node, Output
from flexsheet.nodes.planner.compliance_controller import ComplianceController
from flexsheet.nodes.planner.force_table import choose_force_model
from flexsheet.nodes.planner.hand_bounds import load_or_compute_bounds
from flexsheet.nodes.planner.parameters import PlannerParameters
from flexsheet.nodes.planner.self_checks import check_stiffness
from flexsheet.nodes.planner.timing import (
    ActuationDelayEstimator,
    MonotonicTimestampFilter,
    update_horizon_s,
)
from flexsheet.nodes.planner.trajectory import PlannedStep, SheetTrajectoryPlanner

FIRST_HORIZON_S = 0.05
MAX_ACTUATION_DELAY_S = 0.15
"""The maximum actuation delay (s) that is measured and used."""

MAX_FUTURE_S = 0.005
"""The maximum time (s) by which the timestamp of a fingertip message may be in the future."""


def _is_finite(fingertip: Fingertip) -> bool:
    motion = (
        fingertip.position_world_m,
        fingertip.velocity_world_m_per_s,
        fingertip.predicted_path_world_m,
    )
    return all(bool(np.isfinite(values).all()) for values in motion)


class Planner(Node):
    """A node that publishes one sheet target for each fingertip message.

    Equal inputs result in identical messages.
    """

    optional_inputs: ClassVar[frozenset[str]] = frozenset({"soft_body", "arm_latency"})

    watched_inputs: ClassVar[frozenset[str]] = frozenset({"fingertip"})
    ends_with_inputs: ClassVar[bool] = True
    live_parameters: ClassVar[frozenset[str]] = frozenset({"max_age_s"})
    parameters: PlannerParameters
    scene: Input[Scene]
    fingertip: Input[Fingertip]
    soft_body: Input[SoftBody]
    arm_latency: Input[ArmLatency]
    parameter: Input[ParameterChange]
    sheet_target: Output[SheetTarget]

    @classmethod
    def unused_inputs(cls, parameters: PlannerParameters, scene: Scene) -> frozenset[str]:
        no_force = parameters.choose_compliance(scene) == "constant_stretch"
        return frozenset({"soft_body"} if no_force else ())

    async def setup(self) -> None:
        self._trajectory: SheetTrajectoryPlanner | None = None
        self._compliance: ComplianceController | None = None
        self._timestamps = MonotonicTimestampFilter()
        self._writer = ("", 0)
        self._first_step_s = 0.0
        initial_s = self.parameters.actuation_delay_s
        self._actuation = ActuationDelayEstimator(initial_s, max(MAX_ACTUATION_DELAY_S, initial_s))
        fixed_s = self.parameters.prediction_horizon_s
        self._horizon_s = FIRST_HORIZON_S if fixed_s is None else fixed_s
        self._late_count, self._model_text = 0, ""
        self._stopped_oscillations = 0
        path = self.parameters.sheet_calibration
        self._calibration: SheetCalibration | None = None
        if path is not None:
            self._calibration = SheetCalibration.load(path)

    def on_scene(self, scene: Scene, header: Header) -> None:
        # If the new object cannot be presented, the last object's plan must not stay in use.
        self._trajectory = self._compliance = None
        self._trajectory = SheetTrajectoryPlanner(scene, self.parameters)
        model, self._model_text = choose_force_model(
            scene, self._calibration, self.parameters.cache_dir
        )
        measured = None if self._calibration is None else self._calibration.hysteresis_ratio
        mode = self.parameters.choose_compliance(scene)
        bounds = None
        if mode == "force_curve":
            # SciPy imports submodules on first use, which must not delay a sheet target.
            _ = scipy.interpolate
            bounds = load_or_compute_bounds(scene.camera.rate_hz, self.parameters.cache_dir)
        self._compliance = ComplianceController(
            scene,
            model,
            mode,
            hysteresis_ratio=None if measured is None else float(measured.value),
            bounds=bounds,
            delay_s=self._horizon_s,
        )
        self.self_checks = check_stiffness(scene.sheet, self._calibration)
        self._first_step_s = 1.0 / scene.camera.rate_hz
        self._timestamps = MonotonicTimestampFilter()

    def on_soft_body(self, soft_body: SoftBody, header: Header) -> None:
        if self._compliance is not None and self._trajectory is not None:
            self._compliance.update(soft_body, in_contact=self._trajectory.in_contact)
            self._update_note()

    def on_arm_latency(self, arm: ArmLatency, header: Header) -> None:
        self._actuation.on_latency(arm.side, arm.latency_s)

    def _update_note(self) -> None:
        stopped = self._stopped_oscillations
        self.set_notes(
            {
                NoteCode.FORCE_LIMITED: "" if self._compliance is None else self._compliance.note,
                NoteCode.FINGERTIPS_LATE: str(self._late_count) if self._late_count else "",
                NoteCode.OSCILLATIONS_STOPPED: str(stopped) if stopped else "",
                NoteCode.INFO: f"sheet force model: {self._model_text}",
            }
        )

    def on_fingertip(self, fingertip: Fingertip, header: Header) -> None:
        trajectory, compliance = self._trajectory, self._compliance
        if trajectory is None or compliance is None:
            return
        writer = (header.clock_id, header.epoch)
        if writer != self._writer:
            # The triangulator has restarted, possibly with another clock.
            self._writer, self._timestamps = writer, MonotonicTimestampFilter()
        source_ns = header.source_ns
        step_s = self._timestamps.update(source_ns, self._first_step_s)
        if step_s is None:
            self._late_count += 1
            self._update_note()
            return
        age_s = (header.publish_ns - source_ns) * 1e-9
        if not fingertip.valid:
            planned = trajectory.hold("fingertip_invalid", step_s)
        elif not _is_finite(fingertip):
            planned = trajectory.hold("fingertip_not_finite", step_s)
        elif age_s > self.parameters.max_age_s:
            planned = trajectory.hold("fingertip_too_old", step_s)
        elif age_s < -MAX_FUTURE_S:
            planned = trajectory.hold("fingertip_in_future", step_s)
        else:
            step_s += self._adapt_horizon(fingertip, age_s)
            point, velocity = interpolate_path(
                fingertip.predicted_path_world_m, fingertip.prediction_step_s, self._horizon_s
            )
            compliance.set_delay(self._horizon_s, in_contact=trajectory.in_contact)
            planned = trajectory.follow_finger(
                point, velocity, compliance, step_s, fingertip.position_world_m
            )
            if trajectory.watchdog_triggers != self._stopped_oscillations:
                self._stopped_oscillations = trajectory.watchdog_triggers
                self._update_note()
        self._publish(planned, source_ns)

    def _adapt_horizon(self, fingertip: Fingertip, age_s: float) -> float:
        self._actuation.on_fingertip(age_s)
        if self.parameters.prediction_horizon_s is not None:
            return 0.0
        before_s = self._horizon_s
        max_s = (len(fingertip.predicted_path_world_m) - 1) * fingertip.prediction_step_s
        needed_s = age_s + self._actuation.delay_s
        self._horizon_s = update_horizon_s(before_s, needed_s, max_s)
        return self._horizon_s - before_s

    def _publish(self, planned: PlannedStep, source_ns: int) -> None:
        command = planned.command
        valid_at_ns = source_ns + round(self._horizon_s * 1e9)
        self.sheet_target.publish(
            SheetTarget(
                phase=command.phase,
                reason=command.reason,
                valid_at_ns=valid_at_ns,
                world_from_sheet=planned.motion.world_from_sheet,
                twist_world=planned.motion.twist_world,
                stretch_ratio=planned.motion.stretch_ratio,
                trajectory=planned.trajectory,
                contact_world_m=planned.contact_world_m,
                normal_world=planned.normal_world,
                contact_sheet_m=planned.contact_sheet_m,
                push_depth_m=command.push_depth_m,
                normal_offset_m=planned.normal_offset_m,
            ),
            source_ns=source_ns,
        )
