"""Evaluate the errors of an apparatus without running the nodes.

An apparatus is a set of true parameters of the simulated hardware. The nodes' methods use the
parameters of the scene, and the simulator's models use the parameters of the apparatus. The errors
of fingertip, sheet, image and felt force are computed at rest. The errors of fingertip and sheet
can also be computed for a constant speed of the finger, at which wrong exposure times cause errors.

Only the force model of the rubber depends on time: it simulates a push in and out. Therefore servo
lag, delays, frame rate, tremor and backlash have no effect. An experiment with running nodes
measures these effects. Images have no noise. Separate models of camera, arms, membrane and eye
compute the reference values. These models share no code with the nodes.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from typing import Any

import numpy as np

from flexsheet.launch.calibration.projector import project_points
from flexsheet.launch.experiments import ExperimentError
from flexsheet.launch.experiments.node_calibrations import NodeCalibrations
from flexsheet.launch.experiments.stroke import project_presented_point
from flexsheet.launch.experiments.true_geometry import ArmPair, place_edges
from flexsheet.messages.apparatus import Apparatus
from flexsheet.messages.methods import Correction, SheetShapeMethod
from flexsheet.messages.scene import Scene, require_projector
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.rigid import apply, inverse, pose_matrix, transform
from flexsheet.nodes.models.shapes import make_shape
from flexsheet.nodes.models.shapes.triangles import intersect_rays
from flexsheet.nodes.models.sheet.force_models import SheetPush
from flexsheet.nodes.models.sheet.tension import compute_sag_m
from flexsheet.nodes.planner.sheet_force import make_force_model, make_rubber
from flexsheet.nodes.renderer import deflection_cache
from flexsheet.nodes.renderer.benchmarks import draw_coordinate_ramps
from flexsheet.nodes.renderer.gl import headless_context
from flexsheet.nodes.renderer.scene_renderer import SceneRenderer
from flexsheet.nodes.renderer.sheet import SheetPose, estimate_sheet
from flexsheet.nodes.triangulator.triangulation import StereoGeometry, measure
from flexsheet.nodes.twin import rig
from flexsheet.nodes.twin.error_map import error_map
from flexsheet.nodes.twin.eye import HALF_WINDOW_M, TrueProjector, eye_rays, first_hits, seen
from flexsheet.nodes.twin.force_history import compute_history_ratios
from flexsheet.nodes.twin.membrane import CELLS, NotConvergedError, solve_path
from flexsheet.nodes.twin.nail import Nail
from flexsheet.nodes.twin.paths import map_to_surface, touchable
from flexsheet.nodes.twin.sheet_pull import solve_sheet, true_rubber
from flexsheet.nodes.twin.sheet_surface import SheetPlanes, SheetSurface
from flexsheet.nodes.twin.true_object import TrueBody
from flexsheet.nodes.twin.truth import apply_apparatus

METRES_PER_PX = 0.0007
"""The image resolution in Furukawa et al. 2007, in metres per pixel."""

STROKE_RATIOS = (0.0, 0.5, 1.0)
"""The evaluated finger positions on the object.

They are fractions of the upper half of the arc that the finger can touch.
"""

MAX_FORCE_DEPTHS_M = (0.004, 0.016)
"""The maximum depths (m) of the two pushes whose forces are compared.

The depths are limited to half and to all of the push depth of the scene.
"""

MIN_FORCE_N = 0.1
"""The minimum denominator of relative force errors, in newtons.

People do not feel relative errors of smaller forces.
"""

MAX_IMAGE_DEPTH_M = 0.03
RENDERER_SPACING_M = 0.0025
UNIT_COVARIANCE_PX2 = np.eye(2)


class Metric(StrEnum):
    """The types of errors that are evaluated.

    Each value is the key of the error in the results, and ends in the error's unit.
    """

    SHEET = "sheet_mm"
    IMAGE = "image_mm"
    FORCE = "force_percent"
    FINGERTIP = "fingertip_mm"


ALL_METRICS = frozenset(Metric)
MOVING_METRICS = frozenset({Metric.SHEET, Metric.FINGERTIP})
"""The errors that can be evaluated while the finger moves."""


CROSS_RATIOS, CROSS_ASIDES_M = (-1.0, -0.5, 0.0, 0.5, 1.0), (-0.03, 0.0, 0.03)
"""The positions of the crosses that are drawn on the object to measure the visual error.

The first tuple contains fractions of the arc that the finger can touch. The second tuple contains
distances (m) to the right.
"""


@dataclass(frozen=True, slots=True)
class Evaluation:
    """The errors with given true hardware parameters; a field is None if it was not evaluated.

    fingertip_m: (n, 3), measured minus true fingertip position at n contact points.
    sheet_m: (n, 3), point of the object under the true finger minus the contact point of the sheet.
    image_m: one map (rows, columns, 2) of image errors per simulated case; NaN if the object is not
        visible at a pixel.
    felt_n, expected_n: (k,), k forces of the true sheet, and the forces that the planner's model of
        the sheet predicts for the same pushes.
    """

    fingertip_m: Floats | None = None
    sheet_m: Floats | None = None
    image_m: tuple[Floats, ...] | None = None
    felt_n: Floats | None = None
    expected_n: Floats | None = None

    def figures(self) -> dict[str, float | None]:
        """Return the error of each metric, by the name of the metric.

        The image error is a root mean square in mm. The force error is a mean absolute relative
        error in percent. The errors of sheet and fingertip are mean lengths in mm.
        """
        return {
            Metric.SHEET: _mean_length_mm(self.sheet_m),
            Metric.IMAGE: None if self.image_m is None else _rms_mm(self.image_m),
            Metric.FORCE: self._force_percent(1.0),
            Metric.FINGERTIP: _mean_length_mm(self.fingertip_m),
        }

    def change_from(self, other: Evaluation) -> dict[str, float | None]:
        """Return the change of each metric from another evaluation of the same simulated cases.

        The errors of both evaluations are subtracted for each contact point, pixel and push. The
        differences are then averaged, so errors that both evaluations have in common cancel. The
        method `figures` states the unit of each metric.
        """
        image = None
        if self.image_m is not None and other.image_m is not None:
            pairs = zip(self.image_m, other.image_m, strict=True)
            image = _rms_mm(tuple(one - before for one, before in pairs))
        ratio: Floats | float = 1.0
        if other.felt_n is not None and other.expected_n is not None:
            ratio = other.felt_n / np.maximum(other.expected_n, MIN_FORCE_N)
        return {
            Metric.SHEET: _mean_length_mm(_difference(self.sheet_m, other.sheet_m)),
            Metric.IMAGE: image,
            Metric.FORCE: self._force_percent(ratio),
            Metric.FINGERTIP: _mean_length_mm(_difference(self.fingertip_m, other.fingertip_m)),
        }

    def _force_percent(self, reference_ratio: Floats | float) -> float | None:
        if self.felt_n is None or self.expected_n is None:
            return None
        expected_n = np.maximum(self.expected_n, MIN_FORCE_N)
        return 100.0 * float(np.abs(self.felt_n / expected_n - reference_ratio).mean())


def _difference(one: Floats | None, other: Floats | None) -> Floats | None:
    return None if one is None or other is None else one - other


def _mean_length_mm(vectors_m: Floats | None) -> float | None:
    if vectors_m is None:
        return None
    return 1e3 * float(np.linalg.norm(vectors_m, axis=1).mean())


def _rms_mm(maps_m: tuple[Floats, ...]) -> float | None:
    """Return the root mean square (mm) of error maps (m), or None if no point is visible."""
    squares = np.concatenate([np.sum(one**2, axis=2).ravel() for one in maps_m])
    squares = squares[np.isfinite(squares)]
    return 1e3 * float(np.sqrt(squares.mean())) if len(squares) else None


@dataclass(frozen=True, slots=True)
class CrossErrors:
    """The errors of crosses that are drawn at expected contact points, as the eyes see them.

    All positions are projected from an eye onto the screen plane.

    places_m (n, 2): expected contact points of the n crosses, seen from the midpoint between the
        true eyes.
    errors_m (n, 2, 2): positions (x, y) at which the left and the right eye see the cross, minus
        the positions of the actual contact.
    """

    places_m: Floats
    errors_m: Floats

    def figures(self) -> dict[str, float]:
        """Return the errors (mm) of the drawn crosses as statistics over all crosses.

        The mean and the maximum are computed from the average of both eyes. The result also
        contains the mean error of each eye and the mean error of the horizontal disparity.
        """
        left, right = np.moveaxis(1e3 * self.errors_m, 1, 0)
        both = np.linalg.norm(0.5 * (left + right), axis=1)
        return {
            "mean_mm": float(both.mean()),
            "max_mm": float(both.max()),
            "left_mm": float(np.linalg.norm(left, axis=1).mean()),
            "right_mm": float(np.linalg.norm(right, axis=1).mean()),
            "disparity_mm": float(np.abs(right[:, 0] - left[:, 0]).mean()),
        }


@dataclass(frozen=True, slots=True)
class Contact:
    """A sheet that touches the object: pose of the sheet (4, 4), and touched surface point (3,).

    The point is on the undeformed object.
    """

    world_from_sheet: Floats
    point: Floats

    @property
    def normal(self) -> Floats:
        return np.asarray(self.world_from_sheet[:3, 2])


class OfflineEvaluator:
    """A model that computes the display errors in one scene without running the nodes.

    The errors are computed for given sets of true hardware parameters (apparatuses).

    metres_per_px: resolution of the images.
    cells: number of mesh intervals per side of the true sheet.
    correction, sheet_shape: methods of the renderer.
    """

    def __init__(
        self,
        scene: Scene,
        calibrations: NodeCalibrations | None = None,
        *,
        metres_per_px: float = METRES_PER_PX,
        cells: int = CELLS,
        correction: Correction = "two_pass",
        sheet_shape: SheetShapeMethod = "reduced_order",
    ) -> None:
        self._metres_per_px, self._cells = metres_per_px, cells
        self._correction, self._sheet_shape = correction, sheet_shape
        given = calibrations or NodeCalibrations()
        self._scene = scene
        self._geometry = StereoGeometry.of(scene.camera, given.stereo)
        self._force_model = make_force_model(scene.sheet, given.sheet)
        self._stamp_offset_s = given.stamp_offset_s
        self._marker_from_pad = given.find_marker_offset_m(scene)
        self._shape = make_shape(dict(scene.object.geometry))
        self._world_from_object = pose_matrix(scene.object.world_from_object)
        low, high = scene.sheet.min_stretch_ratio, scene.sheet.max_stretch_ratio
        self._stretch_ratio = 0.5 * (low + high)
        half_m = 0.5 * touchable(scene)[1]
        self._places_m = [ratio * half_m for ratio in STROKE_RATIOS]

    @cached_property
    def _renderer(self) -> SceneRenderer:
        return SceneRenderer(
            self._scene,
            headless_context(),
            spacing_m=RENDERER_SPACING_M,
            basis=deflection_cache.load_or_compute(self._scene, None),
            sheet_shape=self._sheet_shape,
        )

    def evaluate(
        self,
        apparatus: Apparatus,
        metrics: frozenset[Metric] = ALL_METRICS,
        speed_m_per_s: float = 0.0,
    ) -> Evaluation:
        """Evaluate the given metrics with an apparatus (true parameters of the simulated hardware).

        speed_m_per_s: speed of the finger along the object. The speed affects only the errors of
        fingertip and sheet.

        Raises ExperimentError if the equations of the sheet or the arms have no solution.
        """
        try:
            return self._evaluate(apparatus, metrics, speed_m_per_s)
        except (NotConvergedError, ValueError) as error:
            raise ExperimentError(f"apparatus {apparatus.origin}: {error}") from error

    def _evaluate(
        self, apparatus: Apparatus, metrics: frozenset[Metric], speed_m_per_s: float
    ) -> Evaluation:
        scene = apply_apparatus(self._scene, apparatus)
        contacts = [self._touch(place_m) for place_m in self._places_m]
        moving_errors = self._measure_fingertips(scene, apparatus, contacts, speed_m_per_s)
        resting = self._measure_fingertips(scene, apparatus, contacts[:1])[0]
        arms = ArmPair(self._scene, apparatus)
        sheet = image = felt = expected = None
        if Metric.SHEET in metrics:
            surface = SheetSurface.of(self._scene, apparatus)
            sheet = np.array(
                [
                    self._sheet_error(arms, surface, *pair)
                    for pair in zip(contacts, moving_errors, strict=True)
                ]
            )
        if Metric.FORCE in metrics:
            felt, expected = self._compare_forces(scene, apparatus, arms, resting)
        if Metric.IMAGE in metrics:
            image = self._compare_images(scene, apparatus, arms, resting)
        fingertip = moving_errors if Metric.FINGERTIP in metrics else None
        return Evaluation(fingertip, sheet, image, felt, expected)

    def _touch(self, around_m: float, aside_m: float = 0.0) -> Contact:
        """Return the contact after the sheet has rolled over the object without slip.

        The sheet starts in contact with the front of the object.

        around_m: arc length around the object from the front to the new contact point.
        aside_m: distance that the contact point moves to the right.
        """
        place = np.array([aside_m, around_m, 0.0])
        point, above = map_to_surface(self._scene, place + np.outer([0.0, 1e-3], [0, 0, 1]))
        return self._lay_sheet(point, (above - point) / 1e-3, place)

    @staticmethod
    def _lay_sheet(point: Floats, normal: Floats, on_sheet_m: Floats) -> Contact:
        """Place a sheet tangent to the object at a surface point, and return the contact.

        point: surface point (3,) in the world.
        normal: unit normal (3,) of the sheet.
        on_sheet_m: coordinates (3,) of the contact point in the sheet's frame.
        """
        x_axis = np.array([1.0, 0.0, 0.0]) - normal * normal[0]
        x_axis /= np.linalg.norm(x_axis)
        rotation = np.column_stack([x_axis, np.cross(normal, x_axis), normal])
        return Contact(transform(rotation, point - rotation @ on_sheet_m), point)

    def _measure_fingertips(
        self,
        scene: Scene,
        apparatus: Apparatus,
        contacts: list[Contact],
        speed_m_per_s: float = 0.0,
    ) -> Floats:
        """Return the measured minus the true fingertip positions (n, 3), in m, for n contacts.

        Pixels are computed with the true camera, and triangulated with the nodes' calibration. The
        finger strokes upwards at the given speed. Therefore wrong timestamps and different exposure
        times of both cameras also cause errors.
        """
        camera = rig.make_true_camera(scene.camera)
        left_from_world = inverse(pose_matrix(camera.world_from_left))
        offset_m = Nail.of(apparatus.finger).marker_offset_m
        errors = []
        for contact in contacts:
            velocity = speed_m_per_s * contact.world_from_sheet[:3, 1]
            late_s = apparatus.camera.stamp_offset_s - self._stamp_offset_s
            times_s = late_s + np.array([0.0, apparatus.camera.skew_s])
            markers = contact.point + offset_m + times_s[:, None] * velocity
            pixels = rig.stereo_pixels(camera, left_from_world, markers)
            found = measure(self._geometry, *pixels, covariance=UNIT_COVARIANCE_PX2)
            if found is None:
                raise ExperimentError(
                    f"apparatus {apparatus.origin}: the fingertip at {contact.point} m cannot be "
                    "triangulated; check the camera offsets in the apparatus"
                )
            errors.append(found.point_world - self._marker_from_pad - contact.point)
        return np.array(errors)

    def _edges(self, contact: Contact) -> tuple[Floats, Floats]:
        """Return the poses (4, 4) of the clamped edges that bring the sheet into contact.

        The edges compensate the sag of the sheet, so its centre touches the contact plane.
        """
        sheet = self._scene.sheet
        distance_m = sheet.width_m * self._stretch_ratio
        sag_m = compute_sag_m(
            make_rubber(sheet),
            contact.normal,
            density_kg_per_m3=sheet.density_kg_per_m3,
            edge_distance_m=distance_m,
            across=0.5,
        )
        pose = contact.world_from_sheet.copy()
        pose[:3, 3] -= sag_m * contact.normal
        return place_edges(pose, distance_m)

    def _sheet_error(
        self, arms: ArmPair, surface: SheetSurface, contact: Contact, tip_error: Floats
    ) -> Floats:
        """Return the error (3,) of the sheet's contact point, in m, in the world frame.

        The error is the vector from the contact point of the sheet to the object point under the
        true finger. The error occurs because the arms move the sheet to the measured finger, and
        because the true hardware deviates from the scene.

        tip_error: measured minus true fingertip (3,).
        """
        object_from_world = inverse(self._world_from_object)
        foot = self._shape.closest(apply(object_from_world, contact.point + tip_error))
        believed = apply(self._world_from_object, foot.point)
        normal = self._world_from_object[:3, :3] @ foot.normal
        before = contact.world_from_sheet
        rolled_m = before[:3, :3].T @ (believed - before[:3, 3])
        rolled_m[2] = 0.0
        laid = self._lay_sheet(believed, normal, rolled_m)
        left, right = arms.hold(self._edges(laid))
        planes = surface.find_tangent_planes(
            SheetPlanes.through(left, right), contact.point[None], np.array([0.0, 1.0, 0.0])
        )
        true_foot = self._shape.closest(apply(object_from_world, contact.point)[None])
        presented = project_presented_point(
            true_foot,
            apply(object_from_world, planes.points),
            planes.normals @ self._world_from_object[:3, :3],
        )
        error = (true_foot.point - presented)[0]
        return np.asarray(self._world_from_object[:3, :3] @ error)

    def _compare_forces(
        self, scene: Scene, apparatus: Apparatus, arms: ArmPair, tip_error: Floats
    ) -> tuple[Floats, Floats]:
        """Return k felt forces (N), and the k forces (N) that the planner's model predicts.

        Each push gives two forces, one in loading and one in unloading.
        """
        contact = self._touch(0.0)
        left, right = arms.hold(self._edges(contact))
        most_m = self._scene.working_range.push_depth_m
        history_ratios = compute_history_ratios(apparatus)
        depths_m = [
            min(depth_m, limit_m)
            for depth_m, limit_m in zip(MAX_FORCE_DEPTHS_M, (0.5 * most_m, most_m), strict=True)
        ]
        path = solve_path(
            true_rubber(scene.sheet, apparatus),
            left,
            right,
            finger_tips=[contact.point - depth_m * contact.normal for depth_m in depths_m],
            finger_radius_m=scene.finger.radius_m,
            friction_coefficient=apparatus.sheet.friction_coefficient,
            cells=self._cells,
        )
        felt: list[float] = []
        expected: list[float] = []
        for depth_m, pushed in zip(depths_m, path, strict=True):
            felt.extend((history_ratios * (pushed.finger_force_n @ contact.normal)).tolist())
            believed_m = depth_m - float(tip_error @ contact.normal)
            model = self._force_model.evaluate(
                SheetPush(self._stretch_ratio, self._scene.finger.radius_m),
                np.array([max(believed_m, 1e-4)]),
            )
            expected.extend([float(model.force_n[0])] * len(history_ratios))
        return np.array(felt), np.array(expected)

    def _compare_images(
        self, scene: Scene, apparatus: Apparatus, arms: ArmPair, tip_error: Floats
    ) -> tuple[Floats, ...]:
        tilted, upright = self._touch(self._places_m[-1]), self._touch(0.0)
        depth_m = min(MAX_IMAGE_DEPTH_M, self._scene.working_range.push_depth_m)
        tip = upright.point - depth_m * upright.normal
        return (
            self._map_errors(scene, apparatus, arms, contact=tilted, tip=None, tip_error=tip_error),
            self._map_errors(scene, apparatus, arms, contact=upright, tip=tip, tip_error=tip_error),
        )

    def _map_errors(
        self,
        scene: Scene,
        apparatus: Apparatus,
        arms: ArmPair,
        *,
        contact: Contact,
        tip: Floats | None,
        tip_error: Floats,
    ) -> Floats:
        edges = self._edges(contact)
        believed = self._estimate_sheet(edges, None if tip is None else tip + tip_error)
        ramps = draw_coordinate_ramps(self._renderer, self._correction, believed)
        sheet = solve_sheet(scene, apparatus, arms.hold(edges), tip, cells=self._cells)
        eye = scene.eyes.centre_world_m
        x, y = (
            seen(one, sheet, scene, eye=eye, metres_per_px=self._metres_per_px) for one in ramps
        )
        errors = error_map(x, y, self._metres_per_px).errors_m
        return self._correct_parallax(errors, eye)

    def _estimate_sheet(self, edges: tuple[Floats, Floats], finger_tip: Floats | None) -> SheetPose:
        """Return the pose of the sheet that the renderer computes from the poses of resting edges.

        edges: poses (4, 4) of the left and the right clamped edge.
        finger_tip: position (3,), m; None if no finger touches the sheet.
        """
        height_m = self._scene.sheet.height_m
        sheet = estimate_sheet(*edges, height_m=height_m, finger_tip=finger_tip)
        assert sheet is not None
        return sheet

    def compare_crosses(self, apparatus: Apparatus) -> CrossErrors:
        """Compute the errors between projected crosses and the actual contact points.

        Each cross marks an expected contact point of the object, and is projected onto the sheet
        for each eye. The finger then moves to the expected contact point, and the sheet follows the
        measured finger. An error is the vector from the actual contact point to the cross, as seen
        by the eye. Raises ExperimentError if a contact point cannot be computed, or if all crosses
        miss the sheet.
        """
        scene = apply_apparatus(self._scene, apparatus)
        arms = ArmPair(self._scene, apparatus)
        surface = SheetSurface.of(self._scene, apparatus)
        contacts = [
            self._touch(ratio * self._places_m[-1], aside_m)
            for ratio in CROSS_RATIOS
            for aside_m in CROSS_ASIDES_M
        ]
        tip_errors = self._measure_fingertips(scene, apparatus, contacts)
        touched = np.array(
            [
                contact.point - self._sheet_error(arms, surface, contact, error)
                for contact, error in zip(contacts, tip_errors, strict=True)
            ]
        )
        targets = np.array([contact.point for contact in contacts])
        edges = self._edges(self._touch(0.0))
        mesh = self._renderer.sheet_mesh(self._estimate_sheet(edges, None))
        corners = mesh.vertices[mesh.triangles].astype(np.float64)
        sheet = solve_sheet(scene, apparatus, arms.hold(edges))
        lamp = TrueProjector(
            require_projector(scene), sheet.positions.reshape(-1, 3), sheet.triangles()
        )
        errors = []
        for side in (-0.5, 0.5):
            believed_eye, eye = (
                one.eyes.centre_world_m + side * one.eyes.interocular_m * np.eye(3)[0]
                for one in (self._scene, scene)
            )
            triangles, weights = intersect_rays(believed_eye, targets - believed_eye, corners)
            drawn = np.einsum("nk,nki->ni", weights, corners[triangles])
            lit, lands = lamp.intersect_surface(
                project_points(require_projector(self._scene), np.nan_to_num(drawn))
            )
            lit[~lands | np.isnan(drawn[:, 0])] = np.nan
            errors.append(_on_screen(eye, lit) - _on_screen(eye, touched))
        found = np.stack(errors, axis=1)
        seen_by_both = np.isfinite(found).all(axis=(1, 2))
        if not seen_by_both.any():
            raise ExperimentError(
                f"apparatus {apparatus.origin}: none of the projected crosses is on the sheet; "
                "check the poses of projector and eyes"
            )
        places = _on_screen(scene.eyes.centre_world_m, targets)
        return CrossErrors(places[seen_by_both], found[seen_by_both])

    def _correct_parallax(self, errors_m: Floats, eye: Floats) -> Floats:
        """Convert image errors (rows, columns, 2), in m, to the true eye position.

        The given errors are displacements from the correct image for the scene's eye position. The
        results are displacements from the correct image for the true eye position `eye` (3,).
        """
        believed_eye = self._scene.eyes.centre_world_m
        if np.array_equal(eye, believed_eye):
            return errors_m
        shifts = self._parallax(eye)
        size = len(errors_m)
        at = (np.arange(size) + 0.5 * (1 - size)) * self._metres_per_px
        x, y = np.meshgrid(at, -at)
        drawn = np.stack([x, y], axis=-1) - errors_m
        known = np.isfinite(drawn).all(axis=2)
        column = np.rint(drawn[known][:, 0] / self._metres_per_px + 0.5 * (size - 1)).astype(int)
        row = np.rint(0.5 * (size - 1) - drawn[known][:, 1] / self._metres_per_px).astype(int)
        inside = (column >= 0) & (column < size) & (row >= 0) & (row < size)
        found = np.full((len(row), 2), np.nan)
        found[inside] = shifts[row[inside], column[inside]]
        corrected = errors_m.copy()
        corrected[known] -= found
        return corrected

    def _parallax(self, eye: Floats) -> Floats:
        """Return the shift (rows, columns, 2), in m, of each pixel's object point on the screen.

        The shift results from moving the eye from the scene's position to `eye`. It is NaN if the
        ray of a pixel misses the object.
        """
        on_screen, points = self._object_points
        to_screen = eye[2] / (eye[2] - points[..., 2:])
        return np.asarray(eye[:2] + (points[..., :2] - eye[:2]) * to_screen - on_screen)

    @cached_property
    def _object_points(self) -> tuple[Floats, Floats]:
        """Return the points at which the ray of each pixel meets the screen plane and the object.

        The rays start at the scene's eye position. The first array (rows, columns, 2) contains
        points on the screen plane, m. The second array (rows, columns, 3) contains points on the
        object, m. These values are NaN if the ray misses the object.
        """
        size = round(2.0 * HALF_WINDOW_M / self._metres_per_px)
        rays = eye_rays(
            self._scene.eyes.centre_world_m,
            metres_per_px=self._metres_per_px,
            size=size,
            box=(0, 0, size, size),
            samples=1,
        )
        body = TrueBody(self._scene).at_rest()
        hits = first_hits(rays, body.vertices, body.triangles)
        hit = hits.triangle >= 0
        directions = rays.directions()
        points = np.full((size, size, 3), np.nan)
        points[hit] = rays.origin + directions[hit] / hits.inverse_range[hit][:, None]
        return (rays.origin + directions)[..., :2], points


def _on_screen(eye: Floats, points: Floats) -> Floats:
    """Project n points (n, 3) from an eye (3,) onto the screen plane z = 0.

    Returns the coordinates (x, y) on the screen plane, (n, 2), m.
    """
    to_screen = eye[2] / (eye[2] - points[:, 2:])
    return np.asarray(eye[:2] + (points[:, :2] - eye[:2]) * to_screen)


def exceeded_tolerances(scene: Scene, figures: dict[str, Any]) -> list[str]:
    """Return the names of the metrics whose errors exceed the scene's tolerances.

    figures: error of each metric.
    """
    limits = metric_tolerances(scene)
    return [
        metric.value
        for metric, limit in limits.items()
        if figures.get(metric) is not None and figures[metric] > limit
    ]


def metric_tolerances(scene: Scene) -> dict[Metric, float]:
    """Return the scene's tolerance of each metric, in the unit of the metric."""
    given = scene.tolerances
    return {
        Metric.SHEET: 1e3 * given.sheet_position_m,
        Metric.IMAGE: 1e3 * given.image_m,
        Metric.FORCE: 100.0 * given.force_ratio,
        Metric.FINGERTIP: 1e3 * given.fingertip_m,
    }
