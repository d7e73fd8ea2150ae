"""Run a planner step by step at the camera's rate, over any object, for tests of the sheet."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.scene import Scene
from flexsheet.nodes.models.rigid import apply, inverse, transform_from_rpy
from flexsheet.nodes.planner.compliance_controller import ComplianceController
from flexsheet.nodes.planner.parameters import PlannerParameters
from flexsheet.nodes.planner.sheet_force import make_force_model
from flexsheet.nodes.planner.trajectory import PlannedStep, SheetTrajectoryPlanner
from tests.scenes import load_values
from tests.twists import twist_between

Floats = NDArray[np.float64]
ROOT = Path(__file__).resolve().parent.parent
STEP_S = 1.0 / 60.0
STILL = np.zeros(3)


def scene_with(
    geometry: Mapping[str, Any],
    position_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
    rpy_rad: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Scene:
    """Return the paper's scene with another object, by default in the world frame."""
    values = load_values()
    values["object"] |= {
        "geometry": dict(geometry),
        "world_from_object": {"position_m": list(position_m), "rpy_rad": list(rpy_rad)},
    }
    return Scene.model_validate(values)


class PlannerHarness:
    """Planner for a scene's object; fingers and results are in the object's frame."""

    def __init__(self, scene: Scene, **parameters: float) -> None:
        self.given = PlannerParameters(**parameters)
        self.plan = SheetTrajectoryPlanner(scene, self.given)
        self.compliance = ComplianceController(scene, make_force_model(scene.sheet), "force_curve")
        pose = scene.object.world_from_object
        self.world_from_object = transform_from_rpy(pose.position_m, pose.rpy_rad)
        self.tilt_rad = scene.working_range.tilt_rad + self.given.tilt_margin_rad
        self.seen: list[PlannedStep] = []
        self.home = self.plan.motion

    def see(self, finger: Floats, velocity: Floats = STILL) -> PlannedStep:
        """Return the next step for a finger (3,) with a velocity (3,)."""
        planned = self.plan.follow_finger(
            apply(self.world_from_object, finger),
            self.world_from_object[:3, :3] @ velocity,
            self.compliance,
            STEP_S,
        )
        self.seen.append(planned)
        return planned

    def lose(self) -> PlannedStep:
        """Return the next step without a finger."""
        planned = self.plan.hold("fingertip_invalid", STEP_S)
        self.seen.append(planned)
        return planned

    def rest(self, finger: Floats, steps: int = 150) -> PlannedStep:
        """Keep the finger at a position for a number of steps."""
        for _ in range(steps):
            planned = self.see(finger)
        return planned

    def follow(self, fingers: Floats) -> list[PlannedStep]:
        """Follow fingers (n, 3), one per step, with velocities from their differences."""
        velocities = np.gradient(fingers, STEP_S, axis=0)
        return [self.see(*one) for one in zip(fingers, velocities, strict=True)]

    def object_from_sheet(self, planned: PlannedStep) -> Floats:
        """Return the planned pose of the sheet, (4, 4)."""
        return np.asarray(inverse(self.world_from_object) @ planned.motion.world_from_sheet)

    def assert_bounded(self) -> None:
        """Assert that all steps were within the parameters' limits of speed, acceleration and
        jerk."""
        sheets = [self.home, self.home, self.home, *(planned.motion for planned in self.seen)]
        rates = np.array(
            [
                [
                    *twist_between(a.world_from_sheet, b.world_from_sheet, STEP_S),
                    (b.stretch_ratio - a.stretch_ratio) / STEP_S,
                ]
                for a, b in pairwise(sheets)
            ]
        )
        given = self.given
        bounds = (
            (given.speed_m_per_s, given.acceleration_m_per_s2, given.jerk_m_per_s3),
            (
                given.turn_rad_per_s,
                given.turn_acceleration_rad_per_s2,
                given.turn_jerk_rad_per_s3,
            ),
            (
                given.stretch_rate_per_s,
                given.stretch_acceleration_per_s2,
                given.stretch_jerk_per_s3,
            ),
        )
        assert np.isfinite(rates).all()
        for part, most in zip((slice(0, 3), slice(3, 6), slice(6, 7)), bounds, strict=True):
            # Speeds are let go of as smoothly as they are taken up: a twentieth may be over.
            for order, (bound, over) in enumerate(
                zip(most, (1.05, 1e-6 + 1, 1e-6 + 1), strict=True)
            ):
                changes = np.diff(rates[:, part], n=order, axis=0) / STEP_S**order
                size = np.linalg.norm(changes, axis=1).max(initial=0.0)
                assert size <= bound * over, (part, order, size, bound)
