"""A scene's soft body: what to precompute for it, where it stands, its answer in world frame."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from messages.scene import Scene
from messages.types import Fingertip, Skin, SoftBody
from nodes.fem_solver.contact import LinearSoftBody, Response, SoftBodyMethod
from nodes.fem_solver.mesh import mesh_spec, world_from_mesh
from nodes.fem_solver.place import Entry, locate, locate_stuck, slipped
from nodes.fem_solver.precompute import SoftBodyModel, SoftBodySpec
from nodes.fem_solver.precompute_table import TableSpec
from nodes.fem_solver.table import Table, TableSoftBody
from nodes.models import rigid
from nodes.models.prediction import path_at
from nodes.models.shapes import Shape, make_shape

Floats = NDArray[np.float64]


def spec_of(scene: Scene, skin_spacing_m: float, *, sticking: bool = False) -> SoftBodySpec:
    """What has to be precomputed for this scene's object.

    ValueError as `mesh_spec`, and for a skin coarser than the fingertip, which would resist far too
    much: twice where it is 1.7 times as coarse, seven times where it is 7 times.
    """
    if skin_spacing_m > scene.finger.radius_m:
        raise ValueError(
            f"skin_spacing_m: {skin_spacing_m:g} is more than finger.radius_m "
            f"({scene.finger.radius_m:g}): a skin so coarse would answer so small a fingertip with "
            "far too much force; lower skin_spacing_m to that or less"
        )
    mesh = mesh_spec(scene, skin_spacing_m)
    return SoftBodySpec(mesh, scene.object.material.poisson_ratio, sticking)


def table_spec_of(scene: Scene, spec: SoftBodySpec) -> TableSpec:
    """What the nonlinear table of this body depends on."""
    return TableSpec(spec, scene.finger.radius_m)


def front_of(shape: Shape, spec: SoftBodySpec, rest: Floats) -> Floats:
    """The surface point (3,) nearest to a user far off; rest (s, 3): skin nodes."""
    middle = 0.5 * (rest.min(axis=0) + rest.max(axis=0))
    away = 2.0 * float(np.ptp(rest, axis=0).max())
    return shape.closest(middle + away * np.array(spec.mesh.towards_user)).point


@dataclass(frozen=True, slots=True)
class SceneBody:
    """The soft body standing in its scene.

    front (3,): the surface point nearest to the user, rest (s, 3): skin nodes, mesh frame.
    linear_depth_m: to which the linear method is good, and at which the stiffness is told.
    friction_ratio: of what the finger can pull along the skin to what it presses; 0: it slides.
    """

    method: SoftBodyMethod
    spec: SoftBodySpec
    shape: Shape
    front: Floats
    world_from_mesh: Floats
    rest: Floats
    skin: Skin
    linear_depth_m: float
    friction_ratio: float

    def respond(self, point_world: Floats, held: Entry | None) -> tuple[Response, Entry | None]:
        """Answer to a fingertip at `point_world` (3,), and where it is in the body, to be handed in
        as `held` the next time.  ValueError for a point that is not finite."""
        point = rigid.apply(rigid.inverse(self.world_from_mesh), point_world)
        if self.friction_ratio == 0.0:
            push, entry = locate(self.shape, point, held)
            return self.method.respond(push), entry
        push, entry = locate_stuck(self.shape, point, held)
        response = self.method.respond(push)
        if entry is None or push.drag_m is None:
            return response, entry
        pressing = float(response.force_n @ push.normal)
        aside = float(np.linalg.norm(response.force_n - pressing * push.normal))
        most = self.friction_ratio * max(pressing, 0.0)
        if aside > most:
            # the skin pulls back in proportion to the drag: so much of it is held
            share = most / aside
            entry = slipped(self.shape, entry, push.drag_m, share)
            response = self.method.respond(replace(push, drag_m=share * push.drag_m))
        return response, entry

    def at_rest(self) -> Response:
        """The untouched body; its stiffness is that of the place nearest to the user."""
        return Response(
            displacement=self.method.at_rest,
            force_n=np.zeros(3),
            stiffness_n_per_m=self.method.stiffness_n_per_m(self.front),
            force_curve=self.method.force_curve(self.front),
            push_depth_m=0.0,
            in_range=True,
        )

    def message(self, response: Response, *, lead_s: float = 0.0) -> SoftBody:
        """The response as it goes on the wire, to a finger `lead_s` after its exposure."""
        rotation = self.world_from_mesh[:3, :3]
        turned = response.displacement @ rotation.T.astype(np.float32)
        return SoftBody(
            mesh_id=self.skin.mesh_id,
            method=self.method.name,
            in_range=response.in_range,
            push_depth_m=response.push_depth_m,
            force_world_n=rotation @ response.force_n,
            stiffness_n_per_m=response.stiffness_n_per_m,
            force_curve=response.force_curve,
            lead_s=lead_s,
            displacement_world_m=np.ascontiguousarray(turned),
        )


def scene_body(
    scene: Scene,
    spec: SoftBodySpec,
    model: SoftBodyModel,
    *,
    linear_depth_m: float,
    largest_depth_m: float,
    friction_ratio: float = 0.0,
) -> SceneBody:
    """The soft body of a scene from its precomputed model; ValueError as its parts."""
    pose = world_from_mesh(scene)
    shape = make_shape(dict(scene.object.geometry))
    rest = model.response.rest
    method = LinearSoftBody(
        model.response,
        shape,
        rest[model.bounds],
        young_modulus_pa=scene.object.material.young_modulus_pa,
        finger_radius_m=scene.finger.radius_m,
        linear_depth_m=linear_depth_m,
        largest_depth_m=largest_depth_m,
        push_depth_m=scene.working_range.push_depth_m,
        drag=model.drag,
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
        front=front_of(shape, spec, rest),
        world_from_mesh=pose,
        rest=rest,
        skin=skin,
        linear_depth_m=linear_depth_m,
        friction_ratio=friction_ratio,
    )


def with_table(body: SceneBody, scene: Scene, model: SoftBodyModel, table: Table) -> SceneBody:
    """The same body, answered for by its nonlinear table."""
    method = TableSoftBody(
        model.response,
        model.response.rest[model.bounds],
        table,
        young_modulus_pa=scene.object.material.young_modulus_pa,
        finger_radius_m=scene.finger.radius_m,
        push_depth_m=scene.working_range.push_depth_m,
        linear_depth_m=body.linear_depth_m,
    )
    return replace(body, method=method)


def faded(response: Response, lost_s: float, *, hold_s: float, relax_s: float) -> Response:
    """A response after the finger has been lost for `lost_s`: held, then it springs back."""
    if lost_s <= hold_s:
        return response
    left = float(np.exp(-(lost_s - hold_s) / relax_s))
    return replace(
        response,
        displacement=response.displacement * np.float32(left),
        force_n=response.force_n * left,
        push_depth_m=response.push_depth_m * left,
    )


def position_at(fingertip: Fingertip, lead_s: float) -> Floats:
    """Where the fingertip is expected `lead_s` after its exposure, m, world."""
    return path_at(fingertip.predicted_path_world_m, fingertip.prediction_step_s, lead_s)[0]
