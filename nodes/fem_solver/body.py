"""A scene's soft body: what to precompute for it, where it stands, its answer in world frame."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from messages.scene import Scene, cylinder_of
from messages.types import Fingertip, Skin, SoftBody
from nodes.fem_solver.contact import (
    LinearSoftBody,
    Push,
    Response,
    SoftBodyMethod,
    approach_normal,
    push_on_cylinder,
)
from nodes.fem_solver.precompute import SoftBodyModel, SoftBodySpec
from nodes.models import rigid
from nodes.models.prediction import path_at

Floats = NDArray[np.float64]

TOUCH_MARGIN_RAD = 0.45
"""The touchable part of the side exceeds the working range's tilt by this much on either side."""
PAD_RATIO = 1.1
"""Half width of the contact patch at the end of the linear range, in finger radii."""


def spec_of(scene: Scene, skin_spacing_m: float) -> SoftBodySpec:
    """What has to be precomputed for this scene's object."""
    body, cylinder = scene.object, cylinder_of(scene)
    free = np.pi - 0.5 * body.support_angle_rad
    return SoftBodySpec(
        radius_m=cylinder.radius_m,
        length_m=cylinder.length_m,
        support_angle_rad=body.support_angle_rad,
        touch_angle_rad=float(min(scene.working_range.tilt_rad + TOUCH_MARGIN_RAD, free)),
        skin_spacing_m=skin_spacing_m,
        poisson_ratio=body.material.poisson_ratio,
    )


def world_from_mesh(scene: Scene) -> Floats:
    """Pose of the mesh: the object's, turned about its axis until the support faces world -z.

    ValueError if the axis points at the user, who then has no side before him to touch.
    """
    pose = scene.object.world_from_object
    world_from_object = rigid.transform_from_rpy(pose.position_m, pose.rpy_rad)
    towards_user = world_from_object[:3, :3].T @ np.array([0.0, 0.0, 1.0])
    if np.hypot(towards_user[1], towards_user[2]) < 0.1:
        raise ValueError(
            f"object.world_from_object.rpy_rad: {pose.rpy_rad} turns the cylinder's axis towards "
            "the user; lay it across (its x axis away from the world's z)"
        )
    turn = float(np.arctan2(-towards_user[1], towards_user[2]))
    return world_from_object @ rigid.transform_from_rpy(np.zeros(3), [turn, 0.0, 0.0])


@dataclass(frozen=True, slots=True)
class SceneBody:
    """The soft body standing in its scene."""

    method: SoftBodyMethod
    spec: SoftBodySpec
    world_from_mesh: Floats
    skin: Skin

    def respond(self, point_world: Floats, held_normal: Floats | None) -> tuple[Response, Floats]:
        """Answer to a fingertip at `point_world` (3,), and the normal (mesh frame) that it pushes
        against, to be handed in as `held_normal` the next time."""
        point = rigid.apply(rigid.inverse(self.world_from_mesh), point_world)
        normal = approach_normal(point, self.spec.radius_m, held_normal)
        return self.method.respond(self._push(point, normal)), normal

    def at_rest(self) -> Response:
        """The untouched body; its stiffness is that of the place nearest to the user."""
        front = np.array([0.0, 0.0, self.spec.radius_m])
        return Response(
            displacement=self.method.at_rest,
            force_n=np.zeros(3),
            stiffness_n_per_m=self.method.stiffness_n_per_m(front),
            force_curve=self.method.force_curve(front),
            push_depth_m=0.0,
            in_range=True,
        )

    def _push(self, point: Floats, normal: Floats) -> Push:
        return push_on_cylinder(
            point, radius_m=self.spec.radius_m, length_m=self.spec.length_m, normal=normal
        )

    def message(self, response: Response) -> SoftBody:
        """The response as it goes on the wire."""
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
            displacement_world_m=np.ascontiguousarray(turned),
        )


def scene_body(
    scene: Scene,
    spec: SoftBodySpec,
    model: SoftBodyModel,
    *,
    linear_depth_m: float,
    largest_depth_m: float,
) -> SceneBody:
    """The soft body of a scene from its precomputed model; ValueError as its parts."""
    pose = world_from_mesh(scene)
    method = LinearSoftBody(
        model.response,
        young_modulus_pa=scene.object.material.young_modulus_pa,
        finger_radius_m=scene.finger.radius_m,
        linear_depth_m=linear_depth_m,
        largest_depth_m=largest_depth_m,
        touch_angle_rad=spec.touch_angle_rad - PAD_RATIO * scene.finger.radius_m / spec.radius_m,
        push_depth_m=scene.working_range.push_depth_m,
    )
    pose_digest = hashlib.sha256(pose.tobytes()).hexdigest()[:8]
    skin = Skin(
        mesh_id=f"{spec.key()[:12]}-{pose_digest}",
        vertices_world_m=rigid.apply(pose, model.response.rest).astype(np.float32),
        triangles=model.triangles,
    )
    return SceneBody(method=method, spec=spec, world_from_mesh=pose, skin=skin)


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
    return path_at(fingertip.ahead_world_m, fingertip.ahead_step_s, lead_s)[0]
