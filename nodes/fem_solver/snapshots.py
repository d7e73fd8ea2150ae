"""Define and solve the snapshots from which the nonlinear table of a soft body is built.

A snapshot is the solution for pushes at one surface point (sample point) to several depths, for a
neo-Hookean material. It is computed for a Young's modulus of 1 Pa, because the modulus only scales
the forces. A job contains all inputs of a snapshot as arrays, so another process or computer can
solve it.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.scene import Cylinder, StripSupport
from flexsheet.nodes.arrays import Bools, Floats, Ints, Singles
from flexsheet.nodes.fem_solver.mesh.cylinder import Focus, cylinder_mesh
from flexsheet.nodes.fem_solver.mesh.from_scene import MeshSpec, build_mesh, min_extent_m
from flexsheet.nodes.fem_solver.mesh.grading import FinePoint
from flexsheet.nodes.fem_solver.mesh.solid import SAME_M, SolidMesh, nodes_in_planes, skin_faces

DEPTHS_M = (0.0015, 0.003, 0.005, 0.0075, 0.010, 0.0125, 0.015, 0.0175, 0.020, 0.0225)
SPACING_RATIO = 0.35
"""The distance between skin nodes near the push, in finger radii."""
NEAR_RATIO = 1.5
"""The distance from the pushed point, in finger radii, within which the mesh is fine."""
STATIONS = (0.0, 0.4, 0.7, 0.9)
"""The positions of the sample points along a cylinder, as fractions of its half length."""
ANGLE_STEP_RAD, RIM_RAD = 0.42, 0.25
"""The angle between sample points around a cylinder, and the angle between the outermost sample
point and the edge of the touchable skin."""
APART_RATIO, RIM_RATIO = 2.2, 0.9
"""The distance between sample points, and their minimum distance from skin that cannot be touched,
in finger radii. They apply to shapes other than cylinders."""
TOLERANCE, MAX_STEP_RATIO, MIN_STEP_FRACTION = 1e-3, 1.0, 0.25
"""The settings of Newton's method for snapshots: the tolerance, and the maximum and minimum load
step. The force differs by at most 0.04 % from that with the stricter settings of a reference
solution, but the computation time is halved."""
MIN_VOLUME_RATIO = 0.2
"""The minimum ratio of deformed to undeformed volume of any element. A push ends at this ratio.
Below this ratio, the solution at the next depth would not converge."""
COARSE_DEPTHS_M = (0.0025, 0.005, 0.010)
COARSE_COUNT = 9
"""The push depths and the number of sample points of a coarse table."""
FINE_DEPTHS_M = (0.0007, 0.0015, 0.003, 0.005, 0.010)
FINE_RATIO, FINE_NEAR_RATIO, FINE_GROWTH = 0.5, 0.4, 0.7
"""The parameters of the fine mesh that corrects the forces. The first is the ratio of its skin
spacing to the skin spacing of a snapshot. The second is the radius of the fine region, in finger
radii. The third is the growth of the element size per distance (m/m). `FINE_DEPTHS_M` contains the
push depths.
"""
LATTICE_GROWTH = 0.5
"""The increase of the element size per distance (m/m) from the pushed point, in meshes of bisected
lattices. Their elements are up to half as large as required."""
MAX_ELEMENT_RATIO = 0.35
"""The maximum element size in meshes of bisected lattices, as a fraction of the body's minimum
extent."""
SAME_RATIO = 1e-6


@dataclass(frozen=True, slots=True)
class SamplePoint:
    """A surface point (3,), m, and its outward normal (3,), in the mesh frame."""

    point: Floats
    normal: Floats


@dataclass(frozen=True, slots=True)
class SnapshotJob:
    """The inputs for computing a snapshot: the solutions of pushes at one point to several depths.

    nodes (n, 3): positions of the n nodes, m.
    elements (e, 10): node indices.
    fixed (n,): whether each node is fixed.
    faces (f, 6): six-node triangles that the finger can touch.
    sample: surface point at which the finger pushes.
    depths_m: push depths.
    mirror_axes: normals of the planes of symmetry, 0 for the plane x = 0 and 1 for y = 0. Only one
        side of these planes is meshed. The planes contain the pushed point.
    """

    nodes: Floats
    elements: Ints
    fixed: Bools
    faces: Ints
    sample: SamplePoint
    poisson_ratio: float
    finger_radius_m: float
    depths_m: tuple[float, ...]
    mirror_axes: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class Snapshot:
    """The solution of a snapshot job.

    rest (s, 3): undeformed positions of the s skin nodes, m. faces (f, 6): six-node triangles of
    the skin. depths_m (k,): push depths. moved (k, s, 3): displacement (m) of the s skin nodes at
    these k depths. force_n (k, 3): force on the finger for a Young's modulus of 1 Pa. reached:
    number of converged depths. At depths for which no solution converged, the entries repeat the
    last converged solution.
    """

    rest: Floats
    faces: Ints
    depths_m: Floats
    moved: Singles
    force_n: Floats
    reached: int


def solve_snapshot(job: SnapshotJob) -> Snapshot:
    """Compute the snapshot that a job describes.

    Raises SolidMeshError if an element is inverted, and ValueError if the material is invalid.
    """
    from flexsheet.nodes.fem_solver.newton import NeoHookeanBody  # scipy is slow to import

    body = NeoHookeanBody(
        job.nodes,
        job.elements,
        job.fixed,
        job.faces,
        young_modulus_pa=1.0,
        poisson_ratio=job.poisson_ratio,
        finger_radius_m=job.finger_radius_m,
        tolerance=TOLERANCE,
        min_step_fraction=MIN_STEP_FRACTION,
        max_step_ratio=MAX_STEP_RATIO,
        factor_dtype=np.float32,
        mirror_axes=job.mirror_axes,
        finger_axis=job.sample.normal,
    )
    faces = skin_faces(job.nodes, job.elements, job.mirror_axes)
    skin = np.unique(faces)
    path = [
        job.sample.point + (job.finger_radius_m - d) * job.sample.normal for d in (0, *job.depths_m)
    ]
    states = []
    for state in body.solve_load_steps(path):
        states.append(state)
        if state.min_volume_ratio < MIN_VOLUME_RATIO:
            break
    states = states[1:]
    states += [replace(states[-1], reached=False)] * (len(job.depths_m) - len(states))
    snapshot = Snapshot(
        rest=job.nodes[skin],
        faces=np.searchsorted(skin, faces),
        depths_m=np.array(job.depths_m),
        moved=np.array([state.displacement[skin] for state in states], dtype=np.float32),
        force_n=np.array([state.force_n for state in states]),
        reached=sum(state.reached for state in states),
    )
    for axis in job.mirror_axes:
        snapshot = _unfold_snapshot(snapshot, job.sample, axis)
    return snapshot


def _unfold_snapshot(snapshot: Snapshot, sample: SamplePoint, axis: int) -> Snapshot:
    """Return the snapshot of a whole body, given the snapshot of one half of this body.

    axis: axis that is perpendicular to the plane of symmetry between the halves.
    """
    signs = np.ones(3)
    signs[axis] = -1.0
    image, _ = reflect_snapshot(snapshot, sample, signs)
    others = np.flatnonzero(~nodes_in_planes(snapshot.rest, (axis,))[:, axis])
    number = np.arange(len(snapshot.rest))
    number[others] = len(number) + np.arange(len(others))
    return replace(
        snapshot,
        rest=np.concatenate([snapshot.rest, image.rest[others]]),
        faces=np.concatenate([snapshot.faces, number[image.faces]]),
        moved=np.concatenate([snapshot.moved, image.moved[:, others]], axis=1),
        force_n=snapshot.force_n + image.force_n,
    )


def find_mirror_planes(mesh: SolidMesh) -> list[Floats]:
    """Find the mirror symmetries of a body and its support about the planes x = 0 and y = 0.

    Return one vector (3,) for each symmetry, with -1 for mirrored coordinates and 1 for other
    coordinates. The first vector is the identity (1, 1, 1).
    """
    from scipy.spatial import cKDTree

    # Inner nodes of a symmetric body may be asymmetric: compare touchable and fixed nodes only.
    some = np.union1d(mesh.contact_nodes, np.flatnonzero(mesh.fixed))
    points, is_fixed = mesh.nodes[some], mesh.fixed[some]
    tree, same = cKDTree(points), SAME_RATIO * float(np.ptp(points, axis=0).max())
    free = [np.ones(3)]
    for axis in (0, 1):
        signs = np.ones(3)
        signs[axis] = -1.0
        distances, partner = tree.query(points * signs)
        if distances.max() < same and np.array_equal(is_fixed[partner], is_fixed):
            free += [one * signs for one in free]
    return free


def choose_sample_points(
    spec: MeshSpec, mesh: SolidMesh, mirrors: list[Floats], radius_m: float
) -> list[SamplePoint]:
    """Choose sample points that, with their mirror images, cover the touchable skin.

    mirrors: vectors (3,) of signs, one for each mirror symmetry of the body. radius_m: radius of
    the finger.
    """
    if isinstance(spec.geometry, Cylinder):
        return _choose_cylinder_points(spec.geometry, spec.touch_angle_rad, mirrors)
    points, normals = mesh.nodes[mesh.contact_nodes], mesh.contact_normals
    chosen = np.ones(len(points), dtype=bool)
    for axis in (0, 1):
        if any(signs[axis] < 0.0 for signs in mirrors):
            chosen &= points[:, axis] >= -1e-9
    others = np.setdiff1d(mesh.skin, mesh.contact_nodes)
    if len(others):
        from scipy.spatial import cKDTree

        rim, _ = cKDTree(mesh.nodes[others]).query(points)
        inner = chosen & (rim > RIM_RATIO * radius_m)
        chosen = inner if inner.any() else chosen
    points, normals = points[chosen], normals[chosen]
    # Repeatedly add the point that is farthest from all chosen points (farthest point sampling).
    numbers = [int((points @ np.array(spec.towards_user)).argmax())]
    distances = np.linalg.norm(points - points[numbers[0]], axis=1)
    while distances.max() > APART_RATIO * radius_m:
        numbers.append(int(distances.argmax()))
        distances = np.minimum(distances, np.linalg.norm(points - points[numbers[-1]], axis=1))
    return [SamplePoint(points[number], normals[number]) for number in numbers]


def order_by_spread(
    samples: list[SamplePoint], mirrors: list[Floats], towards_user: Floats
) -> list[SamplePoint]:
    """Order sample points so that the first points cover the skin as evenly as possible.

    The first point is nearest to the centre of the side that faces the user. Each next point is
    farthest from all previous points and their mirror images (farthest point sampling). mirrors:
    vectors (3,) of signs, one for each mirror symmetry. towards_user (3,): unit vector.
    """
    points = np.array([sample.point for sample in samples])
    images = points[:, None] * np.array(mirrors)
    aside = np.linalg.norm(points - np.outer(points @ towards_user, towards_user), axis=1)
    order = [int((points @ towards_user - aside).argmax())]
    distances = np.full(len(samples), np.inf)
    while len(order) < len(samples):
        to_images = np.linalg.norm(points[:, None] - images[order[-1]], axis=2).min(axis=1)
        distances = np.minimum(distances, to_images)
        distances[order] = -1.0
        order.append(int(distances.argmax()))
    return [samples[number] for number in order]


def _choose_cylinder_points(
    cylinder: Cylinder, touch_rad: float, mirrors: list[Floats]
) -> list[SamplePoint]:
    last = max(touch_rad - RIM_RAD, 0.5 * touch_rad)
    angles = np.linspace(0.0, last, int(np.ceil(last / ANGLE_STEP_RAD)) + 1)
    x = 0.5 * cylinder.length_m * np.array(STATIONS)
    if not any(signs[0] < 0.0 for signs in mirrors):
        x = np.append(-x[:0:-1], x)
    if not any(signs[1] < 0.0 for signs in mirrors):
        angles = np.append(-angles[:0:-1], angles)
    samples = []
    for station, angle in itertools.product(x, angles):
        normal = np.array([0.0, np.sin(angle), np.cos(angle)])
        samples.append(SamplePoint(cylinder.radius_m * normal + [station, 0.0, 0.0], normal))
    return samples


def make_snapshot_job(
    spec: MeshSpec,
    mesh: SolidMesh,
    sample: SamplePoint,
    *,
    poisson_ratio: float,
    finger_radius_m: float,
    spacing_m: float | None = None,
    depths_m: tuple[float, ...] | None = None,
) -> SnapshotJob:
    """Return the inputs for computing pushes at one surface point to several depths.

    If the shape permits it, a new mesh is made that is fine near this point and coarse elsewhere.
    Otherwise, `mesh` is used.

    spacing_m: node spacing on the skin of the new mesh; None means the default for tables.
    depths_m: push depths; None means `DEPTHS_M`.
    """
    spacing_m = spacing_m or _spacing_m(spec, finger_radius_m)
    focused = _make_focused_mesh(spec, sample, spacing_m, NEAR_RATIO * finger_radius_m, None)
    return make_job_on_mesh(
        mesh if focused is None else focused,
        sample,
        poisson_ratio=poisson_ratio,
        finger_radius_m=finger_radius_m,
        depths_m=DEPTHS_M if depths_m is None else depths_m,
        mirror_axes=() if focused is None else _mirror_axes(spec, sample),
    )


def make_fine_job(
    spec: MeshSpec, sample: SamplePoint, *, poisson_ratio: float, finger_radius_m: float
) -> SnapshotJob:
    """Return the inputs for computing pushes at one surface point with an especially fine mesh.

    The forces on this mesh correct the forces of the nonlinear table. The shape must permit a mesh
    that is fine only near one point (`has_focused_meshes`).
    """
    spacing_m = FINE_RATIO * _spacing_m(spec, finger_radius_m)
    near_m = FINE_NEAR_RATIO * finger_radius_m
    mesh = _make_focused_mesh(spec, sample, spacing_m, near_m, FINE_GROWTH)
    assert mesh is not None
    return make_job_on_mesh(
        mesh,
        sample,
        poisson_ratio=poisson_ratio,
        finger_radius_m=finger_radius_m,
        depths_m=FINE_DEPTHS_M,
        mirror_axes=_mirror_axes(spec, sample),
    )


def solve_push(spec: MeshSpec, mesh: SolidMesh, sample: SamplePoint, **given: Any) -> Snapshot:
    """Make the job of a push with the arguments of `make_snapshot_job`, and solve it."""
    return solve_snapshot(make_snapshot_job(spec, mesh, sample, **given))


def solve_fine_push(spec: MeshSpec, sample: SamplePoint, **given: Any) -> Snapshot:
    """Make the job of a push with the arguments of `make_fine_job`, and solve it."""
    return solve_snapshot(make_fine_job(spec, sample, **given))


def _spacing_m(spec: MeshSpec, finger_radius_m: float) -> float:
    return min(SPACING_RATIO * finger_radius_m, spec.skin_spacing_m)


def has_focused_meshes(spec: MeshSpec) -> bool:
    """Return whether a body can have a mesh that is fine near one point and coarse elsewhere.

    Cylinders permit such meshes only if a strip supports them. All other shapes permit them.
    """
    return not isinstance(spec.geometry, Cylinder) or isinstance(spec.support, StripSupport)


def _make_focused_mesh(
    spec: MeshSpec, sample: SamplePoint, spacing_m: float, near_m: float, growth: float | None
) -> SolidMesh | None:
    """Return a mesh that is fine near a sample point.

    Return None if the shape does not support such meshes. spacing_m: skin spacing near the point.
    near_m: distance from the point within which the mesh has this spacing. growth: increase of the
    element size per distance (m/m); if it is None, the default is used.
    """
    if not has_focused_meshes(spec):
        return None
    geometry, support = spec.geometry, spec.support
    if not (isinstance(geometry, Cylinder) and isinstance(support, StripSupport)):
        x, y, z = (float(value) for value in sample.point)
        fine_point = FinePoint(
            (x, y, z), near_m, growth or LATTICE_GROWTH, MAX_ELEMENT_RATIO * min_extent_m(spec)
        )
        return build_mesh(
            spec, replace(spec.grading, skin_spacing_m=spacing_m, fine_point=fine_point)
        )
    return cylinder_mesh(
        radius_m=geometry.radius_m,
        length_m=geometry.length_m,
        support_angle_rad=support.angle_rad,
        touch_angle_rad=np.pi - 0.5 * support.angle_rad,
        skin_spacing_m=spacing_m,
        focus=Focus(
            x_m=float(sample.point[0]),
            angle_rad=float(np.arctan2(sample.normal[1], sample.normal[2])),
            near_m=near_m,
            growth=growth,
        ),
        mirror_axes=_mirror_axes(spec, sample),
    )


def _mirror_axes(spec: MeshSpec, sample: SamplePoint) -> tuple[int, ...]:
    """Return the normals of the planes of symmetry of a cylinder that contain the pushed point.

    The result contains 0 for the plane x = 0, and 1 for the plane y = 0. For other shapes, it is
    empty.
    """
    if not isinstance(spec.geometry, Cylinder):
        return ()
    return tuple(
        axis for axis in (0, 1) if max(abs(sample.point[axis]), abs(sample.normal[axis])) < SAME_M
    )


def make_job_on_mesh(
    mesh: SolidMesh,
    sample: SamplePoint,
    *,
    poisson_ratio: float,
    finger_radius_m: float,
    depths_m: tuple[float, ...],
    mirror_axes: tuple[int, ...] = (),
) -> SnapshotJob:
    """Return the inputs for computing pushes at one surface point with a given mesh.

    depths_m: push depths.
    mirror_axes: normals of the planes of symmetry, 0 for the plane x = 0 and 1 for y = 0. The mesh
        must be on only one side of these planes.
    """
    return SnapshotJob(
        nodes=mesh.nodes,
        elements=mesh.elements,
        fixed=mesh.fixed,
        faces=mesh.contact_nodes[mesh.contact_faces],
        sample=sample,
        poisson_ratio=poisson_ratio,
        finger_radius_m=finger_radius_m,
        depths_m=depths_m,
        mirror_axes=mirror_axes,
    )


def reflect_snapshot(
    snapshot: Snapshot, sample: SamplePoint, signs: Floats
) -> tuple[Snapshot, SamplePoint]:
    """Return the mirror images of a snapshot and of its sample point.

    signs (3,): -1 for mirrored coordinates, and 1 for other coordinates.
    """
    faces = snapshot.faces
    if signs.prod() < 0.0:
        faces = faces[:, [0, 2, 1, 5, 4, 3]]
    image = replace(
        snapshot,
        rest=snapshot.rest * signs,
        faces=faces,
        moved=snapshot.moved * signs.astype(np.float32),
        force_n=snapshot.force_n * signs,
    )
    return image, SamplePoint(sample.point * signs, sample.normal * signs)


def decode_snapshot(content: dict[str, NDArray[Any]]) -> Snapshot:
    """Make a snapshot from the arrays of a cache file, whose keys are the field names."""
    return Snapshot(reached=int(content.pop("reached")), **content)
