"""Compute the errors of a configuration of the system in simulated time, without running nodes.

The finger strokes around the object. The triangulator detects the finger in simulated images, and
planner and arms follow the finger. Images and forces are evaluated with the sheet at rest. The
results do not depend on the load of the computer. All errors are relative to the simulator's ground
truth.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np

from flexsheet.launch.experiments import compliance, stroke
from flexsheet.launch.experiments.force_reference import find_reference_curve
from flexsheet.launch.experiments.node_calibrations import NodeCalibrations
from flexsheet.launch.experiments.offline import Metric, OfflineEvaluator
from flexsheet.launch.experiments.simulated_time import (
    LoopSettings,
    make_soft_body,
    record_in_simulated_time,
)
from flexsheet.launch.experiments.stroke import (
    SampledMotion,
    StrokeRecording,
    compute_sheet_planes,
    object_pose,
    project_presented_point,
    summarize_sizes,
)
from flexsheet.launch.experiments.true_geometry import ArmPair, place_edges
from flexsheet.messages.apparatus import Apparatus
from flexsheet.messages.methods import Methods, SoftBodyChoice, SoftBodyMethod
from flexsheet.messages.scene import Scene
from flexsheet.messages.types import FingerPath, SoftBody
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.cache import default_cache_dir
from flexsheet.nodes.fem_solver.soft_body_factory import load_body as load_scene_body
from flexsheet.nodes.models.motion import SheetMotion
from flexsheet.nodes.models.rigid import apply, inverse
from flexsheet.nodes.models.shapes import Nearest, make_shape
from flexsheet.nodes.planner.compliance import FORCE_JND_FLOOR_N
from flexsheet.nodes.planner.compliance_controller import ComplianceController
from flexsheet.nodes.planner.force_table import choose_force_model
from flexsheet.nodes.planner.hand_bounds import load_or_compute_bounds
from flexsheet.nodes.planner.parameters import PlannerParameters
from flexsheet.nodes.planner.trajectory import SheetTrajectoryPlanner
from flexsheet.nodes.twin.force_history import compute_history_ratios
from flexsheet.nodes.twin.paths import map_to_surface, touchable
from flexsheet.nodes.twin.sheet_pull import solve_sheet
from flexsheet.nodes.twin.sheet_surface import SheetSurface
from flexsheet.nodes.twin.truth import apply_apparatus

STROKE = "system stroke"
TOUCH_M = 0.001
"""The push depth (m) during the stroke, which maintains contact despite drift and tremor."""

STROKED_RATIO = 0.9
"""The stroked fraction of the arc that the finger can touch."""

SAMPLE_S = 0.05
MAX_STEP_RAD = 0.1
"""The maximum phase difference (rad) of the stroke's oscillation between two path points."""

APPROACH_S = 1.0
WARM_UP_S = 0.5
"""The time (s) after the approach in which the sheet settles and errors are not evaluated."""

HOVER_M = 0.03
METRES_PER_PX = 0.0014
"""The resolution of the rendered coordinate images, in metres per pixel.

The error map interpolates between their pixels.
"""

FORCE_STEP_S, FORCE_REST_S = 1.0 / 60.0, 1.5
"""The planner's time step (s) in a push, and the rest (s) before forces are evaluated."""

STAGES = ("fingertip", "planner and arms", "geometry of the arms")
"""The stages whose errors add up to the sheet's error.

The errors are: measured minus true finger; sheet computed from measured joint angles minus measured
finger; true minus computed sheet.
"""


def make_stroke(scene: Scene, seconds: float) -> FingerPath:
    """Return the path of a finger that strokes back and forth around the object.

    The maximum speed is the speed of the scene's working range.
    """
    half_m = 0.5 * STROKED_RATIO * touchable(scene)[1]
    frequency_rad_per_s = scene.working_range.speed_m_per_s / half_m
    times = np.arange(0.0, seconds, min(SAMPLE_S, MAX_STEP_RAD / frequency_rad_per_s))
    arcs = half_m * np.sin(frequency_rad_per_s * times)
    places = np.column_stack([np.zeros_like(arcs), arcs, np.full_like(arcs, -TOUCH_M)])
    first, last = ([*place[:2], HOVER_M] for place in (places[0], places[-1]))
    lift_s = HOVER_M / max(scene.working_range.speed_m_per_s, compliance.PUSH_M_PER_S)
    return FingerPath(
        label=STROKE,
        times_s=np.concatenate([[0.0], APPROACH_S + times, [APPROACH_S + seconds + lift_s]]),
        positions_world_m=map_to_surface(scene, np.vstack([first, places, last])),
        wander_m=stroke.WANDER_M,
        tremor_m=stroke.TREMOR_M,
    )


@dataclass(slots=True)
class ErrorEvaluator:
    """An evaluator of configurations in one scene with one apparatus (true hardware parameters).

    Results of methods that several configurations have in common are computed only once.

    seconds: duration of the stroke.
    seed: random seed of the finger.
    """

    scene: Scene
    apparatus: Apparatus
    calibrations: NodeCalibrations
    seconds: float
    seed: int
    _known: dict[tuple[Any, ...], Any] = field(default_factory=dict)

    def evaluate(self, methods: Methods, planner: Mapping[str, Any]) -> dict[str, Any]:
        """Return mean, 95 % quantile and maximum of each error of a configuration.

        An error is None if the scene does not have the required device or object. The key `budget`
        contains the fraction of the sheet's mean square error that each stage of `STAGES` causes.

        methods: all methods of the configuration.
        planner: values of further planner parameters, by parameter name.
        """
        has_image, has_force = self.scene.projector is not None, self.scene.object.material
        moving = tuple(planner.items())
        drawn = (methods.correction, methods.sheet_shape)
        pressed = (methods.soft_body, methods.compliance)
        return {
            **self._once(moving, lambda: self._stroke(methods, planner)),
            "image_mm": self._once(drawn, lambda: self._image(methods)) if has_image else None,
            "force_percent": self._once(pressed, lambda: self._force(methods))
            if has_force
            else None,
        }

    def _once(self, key: tuple[Any, ...], compute: Callable[[], Any]) -> Any:
        if key not in self._known:
            self._known[key] = compute()
        return self._known[key]

    def _stroke(self, methods: Methods, planner: Mapping[str, Any]) -> dict[str, Any]:
        path = make_stroke(self.scene, self.seconds)
        scene = self.scene.model_copy(update={"methods": methods})
        settings = LoopSettings(
            seed=self.seed, planner=planner, calibrations=self.calibrations, with_images=True
        )
        begin_s = APPROACH_S + WARM_UP_S
        span_s = begin_s, APPROACH_S + self.seconds
        recorded = record_in_simulated_time(scene, self.apparatus, settings, path, span_s)
        times = recorded.finger.times_ns
        errors = split_sheet_error(recorded, np.zeros((len(times), 1)), times)
        off_m = np.linalg.norm(recorded.fingertip.values - recorded.finger.values, axis=1)
        return {
            "sheet_mm": summarize_sizes(1e3 * np.linalg.norm(errors.sum(axis=0), axis=1)),
            "fingertip_mm": summarize_sizes(1e3 * off_m),
            "budget": dict(zip(STAGES, attribute_error(errors).tolist(), strict=True)),
        }

    def _image(self, methods: Methods) -> dict[str, float] | None:
        evaluator = OfflineEvaluator(
            self.scene,
            self.calibrations,
            metres_per_px=METRES_PER_PX,
            correction=methods.correction,
            sheet_shape=methods.sheet_shape,
        )
        maps = evaluator.evaluate(self.apparatus, frozenset({Metric.IMAGE})).image_m or ()
        sizes_mm = [1e3 * np.linalg.norm(one, axis=2).ravel() for one in maps]
        found = np.concatenate(sizes_mm)
        return summarize_sizes(found[np.isfinite(found)])

    def _force(self, methods: Methods) -> dict[str, float] | None:
        """Return the errors (%) of the felt force while the finger rests at several depths.

        The reference is the stored solution of an independent solver. If there is no stored
        solution for the scene, the reference is the force of the configuration's own soft body.
        """
        scene, truth = self.scene, apply_apparatus(self.scene, self.apparatus)
        press = compliance.make_presses(scene)[0]
        body = load_body(scene, methods.soft_body)
        expected = find_reference_curve(scene, *press.place_m)
        arms = ArmPair(scene, self.apparatus)
        chosen = scene.model_copy(update={"methods": methods})
        push = RestingPush(chosen, self.apparatus, self.calibrations, body)
        ratios, errors = compute_history_ratios(self.apparatus), list[float]()
        for hold in press.holds:
            tip = press.surface - hold.depth_m * press.normal
            motion = push.rest_at(tip, press.surface)
            edges = place_edges(motion.world_from_sheet, scene.sheet.width_m * motion.stretch_ratio)
            sheet = solve_sheet(truth, self.apparatus, arms.hold(edges), tip)
            reference = None if expected is None else expected.force(hold.depth_m)
            curve = body.force_curve
            wanted_n = float(np.interp(hold.depth_m, curve[:, 0], curve[:, 1]))
            if reference is not None:
                wanted_n = reference.force_n
            felt_n = ratios * float(sheet.finger_force_n @ press.normal)
            errors += (
                100.0 * np.abs(felt_n - wanted_n) / max(wanted_n, FORCE_JND_FLOOR_N)
            ).tolist()
        return summarize_sizes(np.array(errors))


class RestingPush:
    """A planner of the sheet's motion for a finger that pushes and then rests."""

    def __init__(
        self, scene: Scene, apparatus: Apparatus, calibrations: NodeCalibrations, body: SoftBody
    ) -> None:
        """Make the planner and its compliance controller.

        scene: scene with the methods of the configuration. body: undeformed soft body.
        """
        settings = PlannerParameters()
        mode = settings.choose_compliance(scene)
        model, _ = choose_force_model(scene, calibrations.sheet)
        bounds = load_or_compute_bounds(scene.camera.rate_hz, None)
        self._controller = ComplianceController(
            scene, model, mode, bounds=bounds if mode == "force_curve" else None
        )
        self._controller.update(body, in_contact=False)
        metrics = frozenset({Metric.FINGERTIP})
        offset = OfflineEvaluator(scene, calibrations).evaluate(apparatus, metrics)
        assert offset.fingertip_m is not None
        self._measured_m = offset.fingertip_m[0]
        self._planner = SheetTrajectoryPlanner(scene, settings)

    def rest_at(self, tip: Floats, surface: Floats) -> SheetMotion:
        """Let the finger rest at a point, and return the sheet motion that is then planned.

        If the finger is not in contact yet, it first touches the object at `surface`.

        tip: fingertip (3,), m.
        surface: point (3,) of the object, m.
        """
        if not self._planner.in_contact:
            self._rest(surface)
        self._rest(tip)
        return self._planner.motion

    def _rest(self, tip: Floats) -> None:
        finger = tip + self._measured_m
        for _ in range(round(FORCE_REST_S / FORCE_STEP_S)):
            self._planner.follow_finger(finger, np.zeros(3), self._controller, FORCE_STEP_S, finger)


@cache
def _load_curve(scene_json: str, method: SoftBodyMethod, spacing_m: float) -> SoftBody:
    scene = Scene.model_validate_json(scene_json)
    choice = SoftBodyChoice(method=method, skin_spacing_m=spacing_m)
    rest = load_scene_body(scene, choice, default_cache_dir(), lambda *_: None).at_rest()
    return make_soft_body(rest.force_curve, rest.stiffness_n_per_m)


def load_body(scene: Scene, choice: SoftBodyChoice) -> SoftBody:
    """Return the undeformed soft body of a scene.

    choice: method and spacing of the surface nodes. If a required table has not been computed yet,
    the linear method is used instead, as in the solver node.
    """
    return _load_curve(scene.model_dump_json(), choice.method, choice.skin_spacing_m)


def split_sheet_error(recording: StrokeRecording, offsets_m: Floats, times_ns: Any) -> Floats:
    """Split the sheet's error at n times into the errors of three stages.

    The stages are the measurement of the fingertip, planner and arms, and the geometry of the arms.
    The result (3, n, 3) contains the error vectors (m) in the object's frame. Their sum is the
    total error: the desired contact point minus the contact point of the true sheet. The desired
    contact point is the object's point nearest to the true finger, moved inward by the offset.

    If the object is flat, only the distance between sheet and object is an error. A displacement of
    the sheet within its plane does not change the contact.

    offsets_m: commanded offsets (n, 1).
    """
    world_from_object = object_pose(recording.scene)
    object_from_world = inverse(world_from_object)
    shape = make_shape(dict(recording.scene.object.geometry))

    def find_contact(finger: SampledMotion) -> tuple[Nearest, Floats]:
        foot = shape.closest(apply(object_from_world, finger.interpolate(times_ns)))
        return foot, foot.point - offsets_m * foot.normal

    def present(
        edges: tuple[SampledMotion, SampledMotion], foot: Nearest, surface: SheetSurface | None
    ) -> Floats:
        planes = compute_sheet_planes(edges, world_from_object, times_ns)
        if surface is not None:
            planes = surface.find_tangent_planes(planes, foot.point, world_from_object[1, :3])
        return project_presented_point(foot, planes.points, planes.normals)

    true_foot, wanted = find_contact(recording.finger)
    measured_foot, aimed = find_contact(recording.fingertip)
    whole = wanted - present(recording.true_edges, true_foot, recording.true_surface)
    fingertip = wanted - aimed
    control = aimed - present(recording.measured_edges, measured_foot, recording.surface)
    return np.stack([fingertip, control, whole - fingertip - control])


def attribute_error(parts: Floats) -> Floats:
    """Return how much each of k error components contributes to the mean square error.

    The contributions (k,) are fractions that add up to one. A contribution is negative if the
    component partly cancels other components.

    parts: error components (k, n, d), each with n vectors of d dimensions. Their sum is the total
        error.
    """
    whole = parts.sum(axis=0)
    total = float(np.square(whole).sum())
    if total == 0.0:
        return np.zeros(len(parts))
    return np.asarray(np.einsum("knd,nd->k", parts, whole) / total)
