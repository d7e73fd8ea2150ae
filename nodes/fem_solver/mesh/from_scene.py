"""Specify the mesh of a scene's virtual object, estimate the required resources, and build the
mesh.

The skin is the surface of the object. Its spacing is the distance between neighbouring skin nodes.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, replace

import numpy as np

from flexsheet.messages.scene import (
    BaseSupport,
    Cylinder,
    Geometry,
    Mesh,
    Plane,
    Scene,
    StripSupport,
    Support,
    require_support,
)
from flexsheet.nodes.arrays import Bools, Floats, Ints
from flexsheet.nodes.fem_solver.mesh.cylinder import cylinder_mesh
from flexsheet.nodes.fem_solver.mesh.fitted import fit_mesh, limit_sizes_by_curvature
from flexsheet.nodes.fem_solver.mesh.grading import Grading
from flexsheet.nodes.fem_solver.mesh.mapped import distance_to_rectangle, mesh_by_map, mesh_slab
from flexsheet.nodes.fem_solver.mesh.quality import signed_volumes
from flexsheet.nodes.fem_solver.mesh.solid import (
    SolidMesh,
    UnfitMeshError,
    boundary_faces,
    make_solid_mesh,
    restrict_touchable,
)
from flexsheet.nodes.fem_solver.mesh.supports import require_fixation, select_fixed
from flexsheet.nodes.models import rigid
from flexsheet.nodes.models.shapes import GEOMETRIES, Shape, make_shape
from flexsheet.nodes.models.shapes.triangles import volume_m3

Vector = tuple[float, float, float]

VERSION = 1
"""The version of the meshing code. Increase it when the mesh for the same specification changes."""
TOUCH_MARGIN_RAD = 0.45
"""The angle by which touchable skin extends beyond the maximum sheet tilt of the working range."""
SLAB_DEPTHS = 2.0
"""The depth of the slab that represents a half-space, divided by the scene's maximum push depth."""
MIN_THICKNESS_SPACINGS = 4.0
"""The minimum thickness of the object, in skin spacings. This thickness corresponds to two
elements."""
MAX_NODES = 250_000
BYTES_PER_NODE = 6000
"""The measured maximum memory (bytes) that meshing needs per node."""
SAMPLES = 16
"""The number of samples along each side of the bounding box for the estimate of the node count."""
INNER_FACTOR, SKIN_FACTOR = 2.5, 5.0
CYLINDER_FACTOR, MESH_FACTOR = 0.6, 1.3
"""Measured factors that correct the estimated numbers of nodes: `INNER_FACTOR` inside the object,
and `SKIN_FACTOR` on its skin. The sum of both numbers is then multiplied by `CYLINDER_FACTOR` if
the object is a cylinder, or by `MESH_FACTOR` if it is a mesh file."""
MAX_LOST_FRACTION = 0.1
"""The maximum fraction of an object's volume that the mesh is allowed to omit."""


@dataclass(frozen=True, slots=True)
class MeshSpec:
    """The inputs that determine a mesh.

    touch_angle_rad: maximum angle between the normal of touchable skin and the direction to the
    user. skin_spacing_m: distance between skin nodes. towards_user: unit vector to the user, mesh
    frame. down: downward direction in the object frame, used if the support is a base.
    rotation_rad: rotation of the mesh frame of a cylinder about the object's x axis. slab_depth_m:
    depth of the slab that represents a half-space.
    """

    geometry: Geometry
    support: Support
    touch_angle_rad: float
    skin_spacing_m: float
    towards_user: Vector
    down: Vector
    rotation_rad: float
    slab_depth_m: float

    def key(self) -> str:
        """Return a digest that identifies the mesh."""
        digest = hashlib.sha256(f"mesh {VERSION}".encode())
        for part in (self.geometry, self.support):
            for name, value in sorted(dict(part).items()):
                if name != "origin":
                    digest.update(name.encode())
                    array = isinstance(value, np.ndarray)
                    digest.update(value.tobytes() if array else json.dumps(value).encode())
        numbers = (self.touch_angle_rad, self.skin_spacing_m, self.rotation_rad, self.slab_depth_m)
        digest.update(json.dumps([numbers, self.towards_user, self.down]).encode())
        return digest.hexdigest()[:24]

    @property
    def grading(self) -> Grading:
        return Grading(self.skin_spacing_m, self.touch_angle_rad, self.towards_user)


def mesh_spec(scene: Scene, skin_spacing_m: float) -> MeshSpec:
    """Return the specification of the mesh of a scene.

    skin_spacing_m: distance between skin nodes. Raises ValueError if the axis of a cylinder points
    to the user.
    """
    body = scene.object
    object_from_world = rigid.inverse(_world_from_object(scene))[:3, :3]
    mesh_from_world = rigid.inverse(world_from_mesh(scene))[:3, :3]
    cylinder, support = isinstance(body.geometry, Cylinder), require_support(scene)
    touch_angle = scene.working_range.tilt_rad + TOUCH_MARGIN_RAD
    if cylinder and isinstance(support, StripSupport):
        touch_angle = min(touch_angle, np.pi - 0.5 * support.angle_rad)
    down = support.down_world if isinstance(support, BaseSupport) else (0.0, 0.0, 0.0)
    return MeshSpec(
        geometry=body.geometry,
        support=support,
        touch_angle_rad=float(touch_angle),
        skin_spacing_m=skin_spacing_m,
        towards_user=_rounded(mesh_from_world @ np.array([0.0, 0.0, 1.0])),
        down=_rounded(object_from_world @ np.array(down)),
        rotation_rad=_cylinder_rotation_rad(scene) if cylinder else 0.0,
        slab_depth_m=SLAB_DEPTHS * scene.working_range.push_depth_m
        if isinstance(body.geometry, Plane)
        else 0.0,
    )


def world_from_mesh(scene: Scene) -> Floats:
    """Return the pose (4, 4) of the mesh frame in the world.

    The mesh frame is the object frame. For a cylinder, it is also rotated about the cylinder's axis
    so that z points to the user. Raises ValueError if the axis of a cylinder points to the user,
    because its side cannot be touched.
    """
    world_from_object = _world_from_object(scene)
    if not isinstance(scene.object.geometry, Cylinder):
        return world_from_object
    rotation = rigid.transform_from_rpy(np.zeros(3), [_cylinder_rotation_rad(scene), 0.0, 0.0])
    return np.asarray(world_from_object @ rotation)


def _world_from_object(scene: Scene) -> Floats:
    return rigid.pose_matrix(scene.object.world_from_object)


def _cylinder_rotation_rad(scene: Scene) -> float:
    towards_user = _world_from_object(scene)[:3, :3].T @ np.array([0.0, 0.0, 1.0])
    if np.hypot(towards_user[1], towards_user[2]) < 0.1:
        raise ValueError(
            f"object.world_from_object.rpy_rad: {scene.object.world_from_object.rpy_rad} points "
            "the cylinder's axis towards the user; rotate its x axis away from the world's z"
        )
    return float(np.arctan2(-towards_user[1], towards_user[2]))


def _rounded(vector: Floats) -> Vector:
    """Round a vector, so that small numerical differences do not change the digest of a mesh."""
    # Adding zero converts -0.0 to 0.0.
    x, y, z = (float(value) + 0.0 for value in np.round(vector, 12))
    return x, y, z


def estimate_node_count(spec: MeshSpec, shape: Shape) -> int:
    """Estimate the number of nodes of the mesh of a shape, within a factor of two.

    Nodes are half an element size apart. Therefore the number of inner nodes is about the integral
    of (2 / element size)^3 over the volume. The number of skin nodes is about the integral of (2 /
    element size)^2 over the surface. Measured factors such as `INNER_FACTOR` correct both numbers.
    The estimate takes at most a second. Raises UnfitMeshError if the skin spacing does not fit the
    object or requires more than `MAX_NODES` nodes.
    """
    low, high = _box(spec)
    spacing, thickness = spec.skin_spacing_m, float((high - low).min())
    if isinstance(spec.geometry, Plane):
        thickness = min(thickness, spec.geometry.width_m, spec.geometry.height_m)
    if isinstance(spec.geometry, Cylinder):
        thickness = min(spec.geometry.radius_m, spec.geometry.length_m)
    if not 0.0 < spacing <= thickness / MIN_THICKNESS_SPACINGS * (1.0 + 1e-9):
        raise UnfitMeshError(
            f"skin_spacing_m: {spacing:g} must be positive and at most a quarter of the object's "
            f"minimum extent ({thickness:g} m, the radius of a cylinder); change skin_spacing_m"
        )
    steps = (np.arange(SAMPLES) + 0.5) / SAMPLES
    grid = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    points = low + grid * (high - low)
    if isinstance(spec.geometry, Plane):
        depth = distance_to_rectangle(points, spec.geometry)
        normals = np.broadcast_to(np.array(spec.towards_user), points.shape)
        bend = np.zeros(len(points))
    else:
        found = shape.closest(points)
        depth, normals = -found.height_m, found.normal
        bend = np.sqrt(np.square(found.shape_operator).sum(axis=(1, 2)))
    sizes = spec.grading.sizes(points, normals, depth)
    on_skin = spec.grading.sizes(points, normals, 0.0 * depth)
    if isinstance(spec.geometry, Mesh):
        on_skin = limit_sizes_by_curvature(on_skin, bend, spec.grading)
    weight = float((high - low).prod()) / len(points)
    shell = float((high - low).max()) / SAMPLES
    inner = weight * np.sum((2.0 / sizes[depth > 0.0]) ** 3)
    skin = weight / shell * np.sum((2.0 / on_skin[(depth > 0.0) & (depth <= shell)]) ** 2)
    usual = {"cylinder": CYLINDER_FACTOR, "mesh": MESH_FACTOR}.get(spec.geometry.shape, 1.0)
    nodes = int(usual * (INNER_FACTOR * inner + SKIN_FACTOR * skin)) + 100
    if nodes > MAX_NODES:
        raise UnfitMeshError(
            f"skin_spacing_m: {spacing:g} requires about {nodes} nodes "
            f"({nodes * BYTES_PER_NODE / 2**30:.1f} GiB of memory), but the maximum is "
            f"{MAX_NODES}; "
            "increase skin_spacing_m"
        )
    return nodes


def min_extent_m(spec: MeshSpec) -> float:
    """Return the minimum extent (m) of the bounding box of the meshed volume."""
    low, high = _box(spec)
    return float((high - low).min())


def _box(spec: MeshSpec) -> tuple[Floats, Floats]:
    """Return the lower and the upper corner (3,), m, of the bounding box of the meshed volume."""
    low, high = GEOMETRIES[spec.geometry.shape].bounds_m(spec.geometry)
    margin = spec.slab_depth_m
    return low - margin, high + np.array([margin, margin, 0.0])


def build_mesh(spec: MeshSpec, grading: Grading | None = None) -> SolidMesh:
    """Build the mesh that a specification describes, in the mesh frame (`world_from_mesh`).

    grading: element sizes; None means the element sizes in the specification. For a cylinder, the
        argument is ignored.

    Raises UnfitMeshError if the skin spacing does not fit the object or requires more than
    `MAX_NODES` nodes. It is also raised if the object is too thin for the elements, or if the
    support fixes too few nodes or all touchable skin.
    """
    geometry, grading = spec.geometry, grading or spec.grading
    shape = make_shape(dict(geometry))
    estimate_node_count(spec, shape)
    if isinstance(geometry, Cylinder):
        return _cylinder(geometry, spec)
    if isinstance(geometry, Plane):
        nodes, elements = mesh_slab(geometry, spec.slab_depth_m, grading)
        normals = _slab_normals(nodes)
        half = 0.5 * np.array([geometry.width_m, geometry.height_m]) + 1e-9
        touchable = (normals[:, 2] > 0.0) & (np.abs(nodes[:, :2]) <= half).all(axis=1)
    else:
        cuboid_map = GEOMETRIES[geometry.shape].cuboid_map
        if cuboid_map is not None:
            nodes, elements = mesh_by_map(cuboid_map(geometry, shape), shape, grading)
        else:
            nodes, elements = fit_mesh(shape, *_box(spec), grading)
        if isinstance(geometry, Mesh):
            _require_volume(geometry, nodes, elements, spec)
        skin = np.unique(boundary_faces(elements))
        normals = np.zeros_like(nodes)
        normals[skin] = shape.closest(nodes[skin]).normal
        touchable = np.ones(len(nodes), dtype=bool)
    touchable &= grading.touchable(normals)
    skin = np.unique(boundary_faces(elements))
    fixed = np.zeros(len(nodes), dtype=bool)
    fixed[skin] = _select_fixed(spec, nodes[skin], normals[skin])
    mesh = make_solid_mesh(nodes, elements, touchable=touchable, fixed=fixed, normals=normals)
    if isinstance(geometry, Plane):
        _require_fixed_back(spec, fixed[skin], normals[skin])
    return mesh


def _cylinder(cylinder: Cylinder, spec: MeshSpec) -> SolidMesh:
    """Build the mesh of a cylinder.

    If the support is a strip, the mesh has nodes on its edges, and the strip is fixed. Any other
    support fixes the skin nodes inside its region.
    """
    strip = isinstance(spec.support, StripSupport)
    mesh = cylinder_mesh(
        radius_m=cylinder.radius_m,
        length_m=cylinder.length_m,
        support_angle_rad=spec.support.angle_rad
        if isinstance(spec.support, StripSupport)
        else 2.0 * (np.pi - spec.touch_angle_rad),
        touch_angle_rad=spec.touch_angle_rad,
        skin_spacing_m=spec.skin_spacing_m,
    )
    points = mesh.nodes[mesh.skin]
    if strip:
        require_fixation(spec.support.kind, points, mesh.fixed[mesh.skin])
        return mesh
    normals = np.column_stack([np.zeros(len(points)), points[:, 1:] / cylinder.radius_m])
    fixed = np.zeros(len(mesh.nodes), dtype=bool)
    fixed[mesh.skin] = _select_fixed(spec, points, normals)
    return restrict_touchable(replace(mesh, fixed=fixed), np.ones(len(mesh.nodes), dtype=bool))


def _select_fixed(spec: MeshSpec, points: Floats, normals: Floats) -> Bools:
    """Return whether the support fixes each skin point (n, 3), m, mesh frame.

    normals (n, 3): outward unit normals at the points, mesh frame.
    """
    object_from_mesh = rigid.transform_from_rpy(np.zeros(3), [spec.rotation_rad, 0.0, 0.0])[:3, :3]
    return select_fixed(
        spec.support,
        points @ object_from_mesh.T,
        normals @ object_from_mesh.T,
        towards_user=object_from_mesh @ np.array(spec.towards_user),
        down=np.array(spec.down),
    )


def _require_fixed_back(spec: MeshSpec, fixed: Bools, normals: Floats) -> None:
    """Raise UnfitMeshError unless the whole back of the slab that represents a half-space is fixed.

    A slab with a partly fixed back bends, and is therefore far softer than a half-space.
    """
    back = normals[:, 2] < 0.0
    if not fixed[back].all():
        raise UnfitMeshError(
            f"object.support: the support of the kind {spec.support.kind} fixes "
            f"{fixed[back].sum()} of {back.sum()} nodes at the back of the plane's slab, which "
            "represents a half-space; set support to {kind: strip, angle_rad: 1.0}"
        )


def _slab_normals(nodes: Floats) -> Floats:
    """Return a unit vector (n, 3) for each node of a slab.

    The vector is the outward normal at nodes of the top and the bottom, and +x at other nodes.
    """
    normals = np.zeros_like(nodes)
    normals[:, 0] = 1.0
    low, high = nodes[:, 2].min(), nodes[:, 2].max()
    near = 1e-9 * (high - low)
    normals[nodes[:, 2] > high - near] = [0.0, 0.0, 1.0]
    normals[nodes[:, 2] < low + near] = [0.0, 0.0, -1.0]
    return normals


def _require_volume(mesh: Mesh, nodes: Floats, elements: Ints, spec: MeshSpec) -> None:
    """Raise UnfitMeshError if the mesh omits more than `MAX_LOST_FRACTION` of the object."""
    required_m3 = volume_m3(mesh.vertices_m, mesh.triangles.astype(np.int64))
    lost_fraction = 1.0 - float(signed_volumes(nodes, elements).sum()) / required_m3
    if lost_fraction > MAX_LOST_FRACTION:
        raise UnfitMeshError(
            f"skin_spacing_m: {100 * lost_fraction:.0f} % of the object is too thin for elements "
            f"of {2.0 * spec.skin_spacing_m:g} m; reduce skin_spacing_m"
        )
