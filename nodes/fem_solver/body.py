"""Build the soft body of a scene, and compute its response to the finger in the world frame."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace

import numpy as np

from flexsheet.messages.scene import Scene, require_material
from flexsheet.messages.types import Fingertip, Skin, SoftBody
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.fem_solver.closest_contact import ContactAnchor, locate
from flexsheet.nodes.fem_solver.contact import LinearSoftBody, Response, SoftBodyMethod
from flexsheet.nodes.fem_solver.mesh.from_scene import MeshSpec, mesh_spec, world_from_mesh
from flexsheet.nodes.fem_solver.precompute import SoftBodyModel, SoftBodySpec
from flexsheet.nodes.fem_solver.precompute_table import TableSpec
from flexsheet.nodes.fem_solver.snapshots import has_focused_meshes
from flexsheet.nodes.fem_solver.table import Table, TableSoftBody
from flexsheet.nodes.models import rigid
from flexsheet.nodes.models.interpolation import interpolate_path
from flexsheet.nodes.models.shapes import Shape, make_shape

COARSE_TABLE = "coarse_table"
"""The name of the method that uses the coarse nonlinear table. This table is computed from only a
few snapshots (precomputed pushes)."""
LINEAR_DEPTH_M = 0.006
"""The push depth up to which the linear method is valid. The stiffness is evaluated at this depth.
"""
MAX_DEPTH_M = 0.010
"""The push depth at which the displacement of the linear method stops growing."""
ERROR_DEPTHS_M = (0.0005, 0.001, 0.0015, 0.002, 0.003, 0.005)
_LINEAR_ERRORS = (1.13, 0.76, 0.59, 0.46, 0.32, 0.26)
FORCE_ERROR_RATIOS = {
    "linear": (_LINEAR_ERRORS, _LINEAR_ERRORS),
    COARSE_TABLE: ((0.18, 0.10, 0.10, 0.10, 0.10, 0.10), (1.13, 0.76, 0.59, 0.46, 0.22, 0.22)),
    "nonlinear_table": ((0.17, 0.07, 0.03, 0.03, 0.03, 0.03), (1.13, 0.76, 0.15, 0.15, 0.15, 0.15)),
}
"""The estimated relative errors of each method's contact force at the depths `ERROR_DEPTHS_M`.

The first row applies to bodies with meshes that are fine near the push, for which the forces of a
table are corrected. The second row applies to cylinders without a strip support, whose tables use
the linear response at small depths. The errors are valid for 95 % of the touchable nodes, for the
finger of the demo and a skin spacing of 4.5 mm. The first row was measured on the demo's cylinder
by `python -m benchmarks.soft_body --table`. The second row is derived from the first row and was
not measured.
"""
FAR_M = 10.0
"""The distance (m) of a distant user from an object."""

TRACE_TOLERANCE_M, MAX_TRACE_STEPS = 1e-6, 200
"""The distance from the surface at which `find_front` stops, and its maximum number of steps."""

NOTED_DEPTHS_M = (0.001, 0.005)
"""The push depths (m) for which the node's status states the estimated force error."""


def state_force_error_ratio(method: str, mesh: MeshSpec, depth_m: float) -> float:
    """Return the estimated relative error of a method's contact force at a push depth."""
    corrected, uncorrected = FORCE_ERROR_RATIOS[method]
    errors = corrected if has_focused_meshes(mesh) else uncorrected
    return float(np.interp(depth_m, ERROR_DEPTHS_M, errors))


def make_soft_body_spec(scene: Scene, skin_spacing_m: float) -> SoftBodySpec:
    """Return the inputs of the precomputation for the object of a scene.

    skin_spacing_m: distance between skin nodes. Raises ValueError if the skin spacing exceeds the
    radius of the fingertip, or if the axis of a cylinder points to the user.
    """
    if skin_spacing_m > scene.finger.radius_m:
        raise ValueError(
            f"skin_spacing_m: {skin_spacing_m:g} is more than finger.radius_m "
            f"({scene.finger.radius_m:g}), and the force would be far too large; reduce "
            "skin_spacing_m to the radius or less"
        )
    return SoftBodySpec(mesh_spec(scene, skin_spacing_m), require_material(scene).poisson_ratio)


def make_table_spec(scene: Scene, spec: SoftBodySpec, *, coarse: bool = False) -> TableSpec:
    """Return the inputs from which a soft body's table of nonlinear push responses is computed."""
    return TableSpec(spec, scene.finger.radius_m, coarse)


@dataclass(frozen=True, slots=True)
class SceneBody:
    """The soft body of a scene, at its pose in the world.

    method: method that computes the response. shape: surface of the body. spec: inputs of the
    precomputation. skin: skin mesh. front (3,): surface point nearest to the user, m, mesh frame
    (see `find_front`). world_from_mesh (4, 4): pose of the mesh frame in the world. rest (s, 3):
    undeformed positions of the s skin nodes, m, mesh frame.
    """

    method: SoftBodyMethod
    spec: SoftBodySpec
    shape: Shape
    front: Floats
    world_from_mesh: Floats
    rest: Floats
    skin: Skin

    def respond(
        self, point_world: Floats, anchor: ContactAnchor | None
    ) -> tuple[Response, ContactAnchor | None]:
        """Return the response to a fingertip at `point_world` (3,), m, and the new contact anchor.

        anchor: contact anchor (pushed surface point) that the previous call returned; None before
        the first call. Raises ValueError if a coordinate of the point is not finite.
        """
        point = rigid.apply(rigid.inverse(self.world_from_mesh), point_world)
        query, new_anchor = locate(self.shape, point, anchor)
        return self.method.respond(query), new_anchor

    def at_rest(self) -> Response:
        """Return the response of the body while the finger does not touch it.

        Displacement and force are zero. Stiffness and force curve belong to the front of the
        object.
        """
        return Response(
            displacement=self.method.at_rest,
            force_n=np.zeros(3),
            stiffness_n_per_m=self.method.stiffness_n_per_m(self.front),
            force_curve=self.method.force_curve(self.front),
            push_depth_m=0.0,
            in_range=True,
        )

    def force_error_ratio(self, depth_m: float) -> float:
        """Return the estimated relative error of the contact force at a push depth."""
        return state_force_error_ratio(self.method.name, self.spec.mesh, depth_m)

    def message(self, response: Response, *, horizon_s: float = 0.0) -> SoftBody:
        """Return the message with a response of this soft body, with vectors in the world frame.

        horizon_s: time from the camera exposure to the predicted fingertip position.
        """
        rotation = self.world_from_mesh[:3, :3]
        rotated = response.displacement @ rotation.T.astype(np.float32)
        return SoftBody(
            mesh_id=self.skin.mesh_id,
            method=self.method.name,
            in_range=response.in_range,
            push_depth_m=response.push_depth_m,
            force_world_n=rotation @ response.force_n,
            stiffness_n_per_m=response.stiffness_n_per_m,
            force_curve=response.force_curve,
            prediction_horizon_s=horizon_s,
            force_error_ratio=self.force_error_ratio(response.push_depth_m),
            displacement_world_m=np.ascontiguousarray(rotated),
        )


def find_front(shape: Shape, rest: Floats, towards_user: Floats) -> Floats:
    """Return the surface point (3,) that is nearest to the user, m, mesh frame.

    For a distant user, this point can be on the edge of the touchable surface, as for a tilted
    plane. The result is then the point that the user sees in the direction of the origin.

    rest (s, 3): positions of the skin nodes, m. towards_user (3,): unit vector.
    """
    middle = 0.5 * (rest.min(axis=0) + rest.max(axis=0))
    if not shape.closest(FAR_M * towards_user).on_edge:
        return shape.closest(middle + 2.0 * np.ptp(rest, axis=0).max() * towards_user).point
    point = FAR_M * towards_user
    for _ in range(MAX_TRACE_STEPS):
        # No surface is nearer than the nearest point, so a step of this length cannot pass it.
        step_m = float(np.linalg.norm(point - shape.closest(point).point))
        if step_m < TRACE_TOLERANCE_M:
            break
        point = point - step_m * towards_user
    return shape.closest(point).point


def build_scene_body(scene: Scene, spec: SoftBodySpec, model: SoftBodyModel) -> SceneBody:
    """Build the soft body of a scene from its precomputed model, with the linear method.

    Raises ValueError if the axis of a cylinder points to the user.
    """
    pose = world_from_mesh(scene)
    shape = make_shape(dict(scene.object.geometry))
    rest = model.response.rest
    method = LinearSoftBody(
        model.response,
        shape,
        rest[model.bounds],
        young_modulus_pa=require_material(scene).young_modulus_pa,
        finger_radius_m=scene.finger.radius_m,
        linear_depth_m=LINEAR_DEPTH_M,
        max_depth_m=MAX_DEPTH_M,
        push_depth_m=scene.working_range.push_depth_m,
    )
    pose_digest = hashlib.sha256(pose.tobytes()).hexdigest()[:8]
    skin = Skin(
        mesh_id=f"{spec.key()[:12]}-{pose_digest}",
        vertices_world_m=rigid.apply(pose, rest).astype(np.float32),
        triangles=model.triangles,
    )
    return SceneBody(
        method=method,
        spec=spec,
        shape=shape,
        front=find_front(shape, rest, np.array(spec.mesh.towards_user)),
        world_from_mesh=pose,
        rest=rest,
        skin=skin,
    )


def attach_table(
    body: SceneBody, scene: Scene, model: SoftBodyModel, table: Table, *, coarse: bool = False
) -> SceneBody:
    """Return a copy of the body that computes its responses from a precomputed nonlinear table.

    coarse: whether the table is a coarse table, which is computed from only a few pushes.
    """
    method = TableSoftBody(
        model.response,
        model.response.rest[model.bounds],
        table,
        name=COARSE_TABLE if coarse else "nonlinear_table",
        young_modulus_pa=require_material(scene).young_modulus_pa,
        finger_radius_m=scene.finger.radius_m,
        push_depth_m=scene.working_range.push_depth_m,
        linear_depth_m=LINEAR_DEPTH_M,
    )
    return replace(body, method=method)


def fade_response(response: Response, lost_s: float, *, hold_s: float, relax_s: float) -> Response:
    """Return the response at the time `lost_s` after the last measurement of the finger.

    response: last response before the finger was lost. The response is unchanged for the time
    `hold_s`, and then decays with the time constant `relax_s`.
    """
    if lost_s <= hold_s:
        return response
    left = float(np.exp(-(lost_s - hold_s) / relax_s))
    return replace(
        response,
        displacement=response.displacement * np.float32(left),
        force_n=response.force_n * left,
        push_depth_m=response.push_depth_m * left,
    )


def predict_position(fingertip: Fingertip, horizon_s: float) -> Floats:
    """Return the fingertip position (3,), m, world frame, `horizon_s` after the exposure."""
    return interpolate_path(
        fingertip.predicted_path_world_m, fingertip.prediction_step_s, horizon_s
    )[0]
