"""Test meshes of every shape: validity, accuracy, resolution under fingers, and supports."""

from __future__ import annotations

import itertools
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from flexsheet.launch.objects.meshes import read_mesh
from flexsheet.messages.scene import Mesh, Scene
from flexsheet.nodes.fem_solver.elasticity import (
    jacobians,
    quadrature,
    shape_gradients,
)
from flexsheet.nodes.fem_solver.mesh.bisection import CELL, bisect, make_lattice
from flexsheet.nodes.fem_solver.mesh.cylinder import Focus, cylinder_mesh
from flexsheet.nodes.fem_solver.mesh.fitted import _find_pinches, _remove_pinches, hull_faces
from flexsheet.nodes.fem_solver.mesh.from_scene import (
    MeshSpec,
    build_mesh,
    estimate_node_count,
    mesh_spec,
    world_from_mesh,
)
from flexsheet.nodes.fem_solver.mesh.quality import (
    MIN_JACOBIAN_RATIO,
    MIN_RADIUS_RATIO,
    min_jacobian_ratios,
    radius_ratios,
    signed_volumes,
)
from flexsheet.nodes.fem_solver.mesh.smoothing import _distortion
from flexsheet.nodes.fem_solver.mesh.solid import (
    SAME_M,
    SUBTRIANGLES,
    SolidMesh,
    UnfitMeshError,
    add_midside_nodes,
    boundary_faces,
    number_slabs,
    orient_tetrahedra,
)
from flexsheet.nodes.fem_solver.mesh.supports import require_fixation
from flexsheet.nodes.models.shapes import make_shape
from tests.examples import examples, long_except
from tests.scenes import load_values
from tests.shared import compute_once

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

LIVER = Path(__file__).resolve().parent.parent.parent / "shared" / "data" / "mesh" / "liver.obj"
EGG_AXES_M = [0.035, 0.03, 0.025]
STRIP = {"kind": "strip", "angle_rad": 1.5}

SPHERE = {"shape": "sphere", "radius_m": 0.03}
ELLIPSOID = {"shape": "ellipsoid", "semi_axes_m": [0.045, 0.03, 0.02]}
BOX = {"shape": "rounded_box", "size_m": [0.08, 0.06, 0.04], "edge_radius_m": 0.008}
PLANE = {"shape": "plane", "width_m": 0.08, "height_m": 0.06}
CYLINDER = {"shape": "cylinder", "radius_m": 0.0353553, "length_m": 0.12}


def egg_mesh() -> dict[str, Any]:
    """Return the triangle mesh of an ellipsoid."""
    ball = trimesh.creation.icosphere(subdivisions=3)
    vertices = np.ascontiguousarray(ball.vertices * EGG_AXES_M, dtype=np.float64)
    return {
        "shape": "mesh",
        "vertices_m": vertices,
        "triangles": np.ascontiguousarray(ball.faces, dtype=np.int32),
        "smoothing_m": 0.006,
        "origin": "made",
    }


EGG = egg_mesh()
SHAPES = {
    "sphere": SPHERE,
    "ellipsoid": ELLIPSOID,
    "rounded_box": BOX,
    "plane": PLANE,
    "cylinder": CYLINDER,
    "mesh": EGG,
}
SPACING, FINER = 0.006, 0.004
CLOSED = ("sphere", "ellipsoid", "rounded_box", "mesh")


def scene(geometry: dict[str, Any], **changes: Any) -> Scene:
    """Return the scene of the paper with another object."""
    content = load_values()
    body = content["object"]
    body.update({"geometry": geometry, "support": STRIP, **changes})
    return Scene.model_validate(content)


def rotated_pose(rpy_rad: list[float]) -> dict[str, Any]:
    return {"position_m": [0.0, 0.0, 0.0], "rpy_rad": rpy_rad}


@cache
def mesh(name: str, spacing: float = SPACING) -> SolidMesh:
    return compute_once(
        f"mesh-{name}-{spacing}", lambda: build_mesh(mesh_spec(scene(SHAPES[name]), spacing))
    )


def solid_volume(solid: SolidMesh) -> float:
    """Return the volume of the curved elements."""
    points, weights = quadrature()
    jacobian = np.einsum("qak,eai->eqik", shape_gradients(points), solid.nodes[solid.elements])
    return float((np.linalg.det(jacobian) * weights).sum())


def hull_area(solid: SolidMesh, faces: Ints) -> float:
    """Integrate over curved six-node faces by a rule of degree 4 (Dunavant, 1985)."""
    total = 0.0
    for a, weight in (
        (0.445948490915965, 0.223381589678011),
        (0.091576213509771, 0.109951743655322),
    ):
        for lone in range(3):
            L = np.full(3, a)
            L[lone] = 1.0 - 2.0 * a
            slopes = np.empty((6, 3))
            for i in range(3):
                slopes[i] = np.eye(3)[i] * (4.0 * L[i] - 1.0)
                j = (i + 1) % 3
                slopes[3 + i] = 4.0 * (np.eye(3)[i] * L[j] + np.eye(3)[j] * L[i])
            along = np.einsum("fax,ai->fix", solid.nodes[faces], slopes)
            cross = np.cross(along[:, 1] - along[:, 0], along[:, 2] - along[:, 0])
            total += 0.5 * weight * float(np.linalg.norm(cross, axis=1).sum())
    return total


def expected(geometry: dict[str, Any]) -> tuple[float, float]:
    """Return the volume (m^3) and the area (m^2) of an object in closed form, or of a triangle
    mesh.
    """
    match geometry["shape"]:
        case "sphere":
            r = geometry["radius_m"]
            return 4 / 3 * np.pi * r**3, 4 * np.pi * r**2
        case "ellipsoid":
            a, b, c = geometry["semi_axes_m"]
            ball = trimesh.creation.icosphere(subdivisions=6)
            ball.apply_scale([a, b, c])
            return 4 / 3 * np.pi * a * b * c, ball.area
        case "rounded_box":
            r = geometry["edge_radius_m"]
            core = np.array(geometry["size_m"]) - 2 * r
            pairs = core[0] * core[1] + core[1] * core[2] + core[2] * core[0]
            # Steiner's formula for the parallel body of a box
            volume = core.prod() + 2 * r * pairs + np.pi * r**2 * core.sum() + 4 / 3 * np.pi * r**3
            return volume, 2 * pairs + 2 * np.pi * r * core.sum() + 4 * np.pi * r**2
        case "cylinder":
            r, length = geometry["radius_m"], geometry["length_m"]
            return np.pi * r**2 * length, 2 * np.pi * r * (length + r)
        case "plane":
            x, y, z = geometry["width_m"] + 0.2, geometry["height_m"] + 0.2, 0.1
            return x * y * z, 2 * (x * y + y * z + z * x)
        case _ if geometry is EGG:
            # the smooth surface is the ellipsoid that the triangles were cut from
            return expected({"shape": "ellipsoid", "semi_axes_m": EGG_AXES_M})
        case _:
            surface = trimesh.Trimesh(geometry["vertices_m"], geometry["triangles"])
            return surface.volume, surface.area


def require_sound(solid: SolidMesh) -> None:
    """Assert that the elements are valid, the hull is closed, and the parts of the mesh agree."""
    assert radius_ratios(solid.nodes, solid.elements).min() > MIN_RADIUS_RATIO
    assert np.degrees(min_dihedral_rad(solid.nodes, solid.elements).min()) > 8
    assert min_jacobian_ratios(solid.nodes, solid.elements).min() > 0.99 * MIN_JACOBIAN_RATIO
    faces = boundary_faces(solid.elements)
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    unique, uses = np.unique(edges, axis=0, return_counts=True)
    assert (uses == 2).all()
    assert len(np.unique(faces[:, :3])) - len(unique) + len(faces) == 2
    assert len(np.unique(solid.elements)) == len(solid.nodes)
    slab = number_slabs(solid.nodes, solid.elements)
    assert np.ptp(slab[solid.elements], axis=1).max() <= 1
    assert (np.diff(slab) >= 0).all()
    assert (np.unique(faces) == solid.skin).all()
    assert (np.diff(solid.contact_nodes) > 0).all()
    assert np.isin(solid.contact_nodes, solid.skin).all()
    assert not solid.fixed[solid.contact_nodes].any()
    assert (np.unique(solid.contact_faces) == np.arange(len(solid.contact_nodes))).all()
    assert np.abs(np.linalg.norm(solid.contact_normals, axis=1) - 1).max() < 1e-9
    require_fixation("", solid.nodes, solid.fixed)


def min_dihedral_rad(points: Floats, tetrahedra: Ints) -> Floats:
    """Return the smallest angle between two faces of each straight tetrahedron (e,)."""
    corners = points[tetrahedra[:, :4]]
    normals = []
    for i in range(4):
        a, b, c = (corners[:, j] for j in range(4) if j != i)
        normal = np.cross(b - a, c - a)
        inwards = ((corners[:, i] - a) * normal).sum(axis=1, keepdims=True) > 0.0
        normal = np.where(inwards, -normal, normal)
        normals.append(normal / np.linalg.norm(normal, axis=1, keepdims=True))
    cosines = [-(a * b).sum(axis=1) for a, b in itertools.combinations(normals, 2)]
    smallest: Floats = np.arccos(np.clip(np.max(cosines, axis=0), -1.0, 1.0))
    return smallest


@pytest.mark.parametrize("name", SHAPES)
def test_every_shape_becomes_a_sound_solid(name: str) -> None:
    require_sound(mesh(name))


@pytest.mark.parametrize(
    ("name", "volume_error", "area_error"),
    [
        ("sphere", 3e-3, 2e-3),
        ("ellipsoid", 3e-3, 2e-3),
        # curvature jumps within elements where faces become edges
        ("rounded_box", 1.5e-2, 2e-2),
        ("plane", 1e-12, 1e-12),
        ("cylinder", 5e-4, 5e-4),
        ("mesh", 3e-3, 2e-3),
    ],
)
def test_volume_and_area_are_the_shapes(name: str, volume_error: float, area_error: float) -> None:
    solid = mesh(name)
    volume, area = expected(SHAPES[name])
    assert solid_volume(solid) == pytest.approx(volume, rel=volume_error)
    assert hull_area(solid, boundary_faces(solid.elements)) == pytest.approx(area, rel=area_error)


@pytest.mark.parametrize("name", long_except(["sphere", "ellipsoid"], "sphere"))
def test_volume_converges_with_curved_elements(name: str) -> None:
    volume, _ = expected(SHAPES[name])
    coarse, fine = (abs(solid_volume(mesh(name, h)) / volume - 1) for h in (0.007, FINER))
    # straight ones would gain the square of 7/4, three
    assert fine < coarse / 4


@pytest.mark.parametrize("name", CLOSED)
def test_skin_nodes_lie_on_the_surface_and_normals_are_its(name: str) -> None:
    solid = mesh(name)
    found = make_shape(dict(scene(SHAPES[name]).object.geometry)).closest(solid.nodes[solid.skin])
    corners = np.isin(solid.skin, solid.elements[:, :4])
    assert np.abs(found.height_m[corners]).max() < 1e-6
    assert np.abs(found.height_m).max() < 1e-6
    normals = found.normal[np.searchsorted(solid.skin, solid.contact_nodes)]
    assert np.abs(normals - solid.contact_normals).max() < 1e-9


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("spacing", long_except([SPACING, FINER], SPACING))
def test_the_skin_is_as_fine_as_asked_where_fingers_go(name: str, spacing: float) -> None:
    solid = mesh(name, spacing)
    faces = solid.contact_nodes[solid.contact_faces]
    area = hull_area(solid, faces)
    assert np.sqrt(area / len(solid.contact_nodes)) <= spacing
    corners = solid.nodes[faces[:, SUBTRIANGLES].reshape(-1, 3)]
    neighbours = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    assert np.quantile(neighbours, 0.5) <= 1.1 * spacing
    assert neighbours.max() <= 2.0 * spacing


@pytest.mark.parametrize("name", long_except(SHAPES, "sphere", "cylinder"))
def test_behind_and_below_the_mesh_is_coarser(name: str) -> None:
    solid = mesh(name, 0.0035)
    front = solid.contact_nodes[solid.contact_faces]
    hull = boundary_faces(solid.elements)
    behind = hull[~np.isin(hull, solid.contact_nodes).any(axis=1)]
    coarser = hull_area(solid, behind) / len(behind) / (hull_area(solid, front) / len(front))
    assert coarser > 1.3
    at_front = np.isin(solid.elements[:, :4], front).any(axis=1)
    inside = ~np.isin(solid.elements[:, :4], solid.skin).any(axis=1)
    size = signed_volumes(solid.nodes, solid.elements)
    assert size[inside].max() > 1.5 * np.median(size[at_front])


@pytest.mark.parametrize("name", ["sphere", "ellipsoid", "rounded_box", "plane"])
@pytest.mark.parametrize("axis", [0, 1])
def test_symmetric_shapes_have_symmetric_meshes(name: str, axis: int) -> None:
    solid = mesh(name)
    mirrored = solid.nodes.copy()
    mirrored[:, axis] *= -1
    distance, other = cKDTree(solid.nodes).query(mirrored)
    assert distance.max() < 1e-8
    assert (solid.fixed[other] == solid.fixed).all()
    elements = {tuple(row) for row in np.sort(solid.elements, axis=1)}
    assert elements == {tuple(row) for row in np.sort(other[solid.elements], axis=1)}


@pytest.mark.parametrize("angle_rad", [0.1, 1.2])
def test_about_a_focus_a_cylinders_mesh_leans_to_no_side(angle_rad: float) -> None:
    """Compare nodes with their mirror images. An asymmetric mesh would push the finger sideways."""
    radius_m, near_m = CYLINDER["radius_m"], 0.011
    mesh = cylinder_mesh(
        radius_m=radius_m,
        length_m=CYLINDER["length_m"],
        support_angle_rad=1.5,
        touch_angle_rad=2.0,
        skin_spacing_m=0.003,
        focus=Focus(0.004, angle_rad, near_m),
    )
    across = np.array([0.0, np.cos(angle_rad), -np.sin(angle_rad)])
    out = np.array([0.0, np.sin(angle_rad), np.cos(angle_rad)])
    local = np.column_stack([mesh.nodes[:, 0] - 0.004, mesh.nodes @ across, mesh.nodes @ out])
    near = np.linalg.norm(local - [0.0, 0.0, radius_m], axis=1) < near_m
    assert near.sum() > 80
    # a middle of an edge stands for the edge
    for signs in ([-1.0, 1.0, 1.0], [1.0, -1.0, 1.0]):
        away, _ = cKDTree(local).query(local[near] * signs)
        assert away.max() < 1e-9
    whole = np.pi * radius_m**2 * CYLINDER["length_m"]
    points, weights = quadrature()
    _, determinants = jacobians(mesh.nodes, mesh.elements, shape_gradients(points))
    assert (determinants * weights).sum() == pytest.approx(whole, rel=1e-3)
    assert min_jacobian_ratios(mesh.nodes, mesh.elements).min() > MIN_JACOBIAN_RATIO


@pytest.mark.parametrize("x_m", [-0.5 * SAME_M, 0.0, 0.5 * SAME_M])
def test_a_mesh_begins_in_the_plane_of_its_focus_despite_rounding(x_m: float) -> None:
    mesh = cylinder_mesh(
        radius_m=CYLINDER["radius_m"],
        length_m=CYLINDER["length_m"],
        support_angle_rad=1.5,
        touch_angle_rad=2.0,
        skin_spacing_m=0.003,
        focus=Focus(x_m, 0.3, 0.011),
        mirror_axes=(0,),
    )
    stations = np.unique(mesh.nodes[:, 0].round(9))
    assert (stations[0], stations[-1]) == pytest.approx((0.0, 0.5 * CYLINDER["length_m"]))
    assert np.diff(stations).max() < 0.25 * CYLINDER["radius_m"]


@pytest.mark.parametrize("name", long_except(SHAPES, "sphere", "cylinder", "mesh"))
def test_the_same_scene_gives_the_same_mesh(name: str) -> None:
    first, again = mesh(name), build_mesh(mesh_spec(scene(SHAPES[name]), SPACING))
    for part in ("nodes", "elements", "fixed", "skin", "contact_nodes", "contact_faces"):
        assert (getattr(first, part) == getattr(again, part)).all(), part


def test_a_key_covers_all_inputs_of_a_mesh() -> None:
    moved = dict(EGG, vertices_m=EGG["vertices_m"] * 1.0001)
    range_changed = scene(SPHERE).model_copy(
        update={"working_range": scene(SPHERE).working_range.model_copy(update={"tilt_rad": 0.9})}
    )
    base = {"kind": "base", "height_m": 0.01}
    different = [
        mesh_spec(scene(SPHERE), 0.004),
        mesh_spec(scene(SPHERE), 0.005),
        mesh_spec(scene(ELLIPSOID), 0.004),
        mesh_spec(scene(EGG), 0.004),
        mesh_spec(scene(moved), 0.004),
        mesh_spec(range_changed, 0.004),
        mesh_spec(scene(SPHERE, support=base), 0.004),
        mesh_spec(scene(SPHERE, support=base | {"down_world": [0, -1, 0]}), 0.004),
        mesh_spec(scene(SPHERE, world_from_object=rotated_pose([0.5, 0.0, 0.0])), 0.004),
    ]
    assert len({spec.key() for spec in different}) == len(different)
    same = [
        (scene(EGG), scene(EGG | {"origin": "elsewhere"})),
        (scene(SPHERE), scene(SPHERE, world_from_object=rotated_pose([0.0, 0.0, 0.0]))),
        (scene(SPHERE), scene(SPHERE, material={"young_modulus_pa": 100.0, "poisson_ratio": 0.1})),
    ]
    for one, other in same:
        assert mesh_spec(one, 0.004).key() == mesh_spec(other, 0.004).key()


@given(
    sizes=st.tuples(*[st.floats(0.03, 0.09)] * 3),
    rounding=st.floats(0.05, 1.0),
    spacing=st.floats(0.0045, 0.007),
    rpy=st.tuples(*[st.floats(-3.0, 3.0)] * 3),
    shape=st.sampled_from(["sphere", "ellipsoid", "rounded_box"]),
)
@examples(6)
def test_any_measures_and_any_side_to_the_user_give_a_sound_mesh(
    sizes: tuple[float, float, float],
    rounding: float,
    spacing: float,
    rpy: tuple[float, float, float],
    shape: str,
) -> None:
    geometry: dict[str, Any] = {
        "sphere": {"radius_m": sizes[0] / 2},
        "ellipsoid": {"semi_axes_m": [size / 2 for size in sizes]},
        "rounded_box": {"size_m": list(sizes), "edge_radius_m": rounding * 0.4999 * min(sizes)},
    }[shape]
    one = scene({"shape": shape, **geometry}, world_from_object=rotated_pose(list(rpy)))
    solid = build_mesh(mesh_spec(one, spacing))
    require_sound(solid)
    towards_user = world_from_mesh(one)[:3, :3].T @ [0.0, 0.0, 1.0]
    angles = np.arccos(np.clip(solid.contact_normals @ towards_user, -1, 1))
    assert angles.max() < one.working_range.tilt_rad + 0.45 + 1e-6


@pytest.mark.long
@pytest.mark.skipif(not LIVER.exists(), reason=f"{LIVER} is not there")
def test_a_liver_is_meshed() -> None:
    geometry = dict(read_mesh(LIVER, 0.01, None))
    solid = build_mesh(mesh_spec(scene(geometry), 0.0035))
    require_sound(solid)
    volume, area = expected(geometry)
    # its rims are thinner than any element
    assert solid_volume(solid) == pytest.approx(volume, rel=0.04)
    assert hull_area(solid, boundary_faces(solid.elements)) == pytest.approx(area, rel=0.08)


@pytest.mark.parametrize("name", long_except(SHAPES, "sphere", "cylinder"))
def test_the_number_of_nodes_is_foreseen(name: str) -> None:
    for spacing in (SPACING, FINER):
        spec = mesh_spec(scene(SHAPES[name]), spacing)
        nodes = estimate_node_count(spec, make_shape(dict(spec.geometry)))
        assert 0.4 < nodes / len(mesh(name, spacing).nodes) < 2.5


@pytest.mark.parametrize("name", long_except(sorted(set(SHAPES) - {"plane"}), "sphere"))
def test_a_base_holds_the_lowest_skin(name: str) -> None:
    support = {"kind": "base", "height_m": 0.012, "down_world": [0.0, -2.0, 0.0]}
    one = scene(SHAPES[name], support=support)
    solid = build_mesh(mesh_spec(one, SPACING))
    world = solid.nodes[solid.skin] @ world_from_mesh(one)[:3, :3].T
    low = world[:, 1] <= world[:, 1].min() + 0.012 + 1e-9
    assert (low == solid.fixed[solid.skin]).all()
    assert not solid.fixed[np.setdiff1d(np.arange(len(solid.nodes)), solid.skin)].any()
    require_sound(solid)


@pytest.mark.parametrize("name", long_except(["sphere", "cylinder", "mesh"], "sphere", "cylinder"))
def test_patches_hold_the_skin_within(name: str) -> None:
    # turned about x: a cylinder's mesh frame is turned back, the patches turn with the object
    place = rotated_pose([0.4, 0.0, 0.0])
    boxed = build_mesh(
        mesh_spec(
            scene(
                SHAPES[name],
                support={"kind": "box_patch", "min_m": [-1, -1, -1], "max_m": [1, 1, -0.015]},
                world_from_object=place,
            ),
            SPACING,
        )
    )
    balled = build_mesh(
        mesh_spec(
            scene(
                SHAPES[name],
                support={"kind": "sphere_patch", "centre_m": [0, 0, -0.03], "radius_m": 0.02},
                world_from_object=place,
            ),
            SPACING,
        )
    )
    back = -0.4 if name == "cylinder" else 0.0
    rotation = np.array(
        [[1, 0, 0], [0, np.cos(back), -np.sin(back)], [0, np.sin(back), np.cos(back)]]
    )
    for solid, inside in (
        (boxed, lambda x: x[:, 2] <= -0.015 + 1e-9),
        (balled, lambda x: np.linalg.norm(x - [0, 0, -0.03], axis=1) <= 0.02 + 1e-9),
    ):
        points = solid.nodes[solid.skin] @ rotation.T
        assert (inside(points) == solid.fixed[solid.skin]).all()
        require_sound(solid)


@pytest.mark.parametrize("name", CLOSED)
def test_a_strip_holds_what_faces_away(name: str) -> None:
    solid = mesh(name)
    normals = make_shape(dict(scene(SHAPES[name]).object.geometry)).closest(solid.nodes).normal
    angle = np.arccos(np.clip(-normals[:, 2], -1, 1))[solid.skin]
    assert (solid.fixed[solid.skin] == (angle <= 0.75 + 1e-9)).all()


@pytest.mark.parametrize(
    ("geometry", "changes", "spacing", "words"),
    [
        (SPHERE, {}, 0.02, "skin_spacing_m: 0.02"),
        (SPHERE, {}, float("nan"), "skin_spacing_m"),
        (SPHERE, {}, 0.0, "skin_spacing_m"),
        (CYLINDER, {}, 0.012, "skin_spacing_m: 0.012 .* the radius of a cylinder"),
        (SPHERE, {}, 0.0003, "GiB"),
        (ELLIPSOID | {"semi_axes_m": [0.05, 0.05, 0.004]}, {}, 0.003, "minimum extent"),
        (BOX | {"size_m": [0.1, 0.1, 0.004], "edge_radius_m": 0.001}, {}, 0.003, "minimum extent"),
        (PLANE | {"width_m": 0.005}, {}, 0.003, "minimum extent"),
        (PLANE, {"world_from_object": rotated_pose([np.pi, 0, 0])}, 0.005, "faces away"),
        (
            CYLINDER,
            {"world_from_object": rotated_pose([0, np.pi / 2, 0])},
            0.005,
            "towards the user",
        ),
        (SPHERE, {"support": {"kind": "strip", "angle_rad": 6.5}}, 0.005, "support.angle_rad"),
        (CYLINDER, {"support": {"kind": "strip", "angle_rad": 6.5}}, 0.005, r"support\.angle_rad"),
        (SPHERE, {"support": {"kind": "strip", "angle_rad": 0.01}}, 0.005, "object.support"),
        (SPHERE, {"support": {"kind": "base", "height_m": 1.0}}, 0.005, "object.support fixes it"),
        (
            SPHERE,
            {"support": {"kind": "sphere_patch", "centre_m": [1, 0, 0], "radius_m": 0.1}},
            0.005,
            "sphere_patch fixes 0",
        ),
        (
            EGG | {"vertices_m": EGG["vertices_m"] * [1.0, 1.0, 0.2]},
            {},
            0.003,
            "minimum extent",
        ),
    ],
)
def test_what_cannot_be_meshed_is_rejected_with_the_reason(
    geometry: dict[str, Any], changes: dict[str, Any], spacing: float, words: str
) -> None:
    with pytest.raises(ValueError, match=words):
        build_mesh(mesh_spec(scene(geometry, **changes), spacing))


def test_supports_of_a_scene_are_checked() -> None:
    with pytest.raises(ValueError, match="down_world"):
        scene(SPHERE, support={"kind": "base", "height_m": 0.01, "down_world": [0, 0, 0]})
    with pytest.raises(ValueError, match="must be below"):
        scene(SPHERE, support={"kind": "box_patch", "min_m": [0, 0, 0], "max_m": [1, 0, 1]})


def test_a_scene_with_a_mesh_and_patches_survives_the_wire() -> None:
    one = scene(EGG, support={"kind": "box_patch", "min_m": [-1, -1, -1], "max_m": [1, 1, 0]})
    back = Scene.model_validate(one.model_dump())
    assert isinstance(back.object.geometry, Mesh)
    assert mesh_spec(one, 0.005).key() == mesh_spec(back, 0.005).key()


# the lattice


def conforming(tetrahedra: Ints) -> bool:
    faces = np.sort(
        tetrahedra[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]].reshape(-1, 3), axis=1
    )
    return bool(np.unique(faces, axis=0, return_counts=True)[1].max() == 2)


def test_a_lattice_fills_its_box_with_outward_diagonals() -> None:
    vertices, tetrahedra = make_lattice((2, 1, 3))
    assert len(vertices) == 5 * 3 * 7
    assert np.abs(signed_volumes(vertices.astype(float), tetrahedra)).sum() == pytest.approx(
        48 * CELL**3
    )
    assert conforming(tetrahedra)
    on_hull = (np.abs(vertices) == CELL * np.array([2, 1, 3])).any(axis=1)
    hull = hull_faces(tetrahedra)
    assert on_hull[hull].all()
    per_element = np.zeros(len(tetrahedra), dtype=int)
    for number, element in enumerate(np.sort(tetrahedra, axis=1)):
        faces = [np.delete(element, i) for i in range(4)]
        per_element[number] = sum((hull == face).all(axis=1).any() for face in faces)
    assert per_element.max() == 1


@given(
    places=st.lists(st.tuples(*[st.floats(-1, 1)] * 3), min_size=1, max_size=4),
    depth=st.integers(1, 4),
)
@examples(8)
def test_bisection_conforms_with_three_shapes_only(
    places: list[tuple[float, float, float]], depth: int
) -> None:
    targets = np.array(places) * CELL

    def too_large(vertices: Ints, tetrahedra: Ints) -> NDArray[np.bool_]:
        corners = vertices[tetrahedra]
        away = np.linalg.norm(corners.mean(axis=1)[:, None] - targets, axis=2).min(axis=1)
        size = np.ptp(corners, axis=1).max(axis=1)
        return np.asarray((away < 2 * size) & (size > CELL / 2**depth))

    vertices, tetrahedra = bisect(*make_lattice((1, 1, 1)), too_large)
    volume = signed_volumes(vertices.astype(float), tetrahedra)
    assert np.abs(volume).sum() == pytest.approx((2 * CELL) ** 3, rel=1e-12)
    assert conforming(tetrahedra)
    ratios = np.abs(radius_ratios(vertices.astype(float), tetrahedra))
    assert len(np.unique(ratios.round(6))) <= 3
    assert ratios.min() > 0.4


def test_bisection_beyond_the_unit_is_rejected() -> None:
    with pytest.raises(UnfitMeshError, match="far too small"):
        bisect(*make_lattice((1, 1, 1)), lambda v, t: (v[t] == 0).all(axis=2).any(axis=1))


def test_a_core_shrinks_at_pinches_until_nothing_is_left() -> None:
    by_edge = np.array([[0, 1, 2, 3], [0, 1, 4, 5]])
    depth = -np.arange(1.0, 7.0)
    core = np.array([False, False, True, False, True, False])
    # the core's higher vertex gives way to the pinch
    assert _remove_pinches(by_edge, core, depth).tolist() == [[0, 1, 4, 5]]
    with pytest.raises(UnfitMeshError, match="too thin"):
        _remove_pinches(by_edge, np.zeros(6, dtype=bool), depth)


def test_pinches_are_found() -> None:
    by_edge = np.array([[0, 1, 2, 3], [0, 1, 4, 5]])
    assert _find_pinches(hull_faces(by_edge)).tolist() == [0, 1]
    by_vertex = np.array([[0, 1, 2, 3], [0, 4, 5, 6]])
    assert _find_pinches(hull_faces(by_vertex)).tolist() == [0]
    assert len(_find_pinches(hull_faces(np.array([[0, 1, 2, 3], [0, 1, 2, 4]])))) == 0


# quality


def test_ratios_of_known_tetrahedra() -> None:
    regular = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    cells = orient_tetrahedra(regular, np.array([[0, 1, 2, 3]]))
    assert radius_ratios(regular, cells) == pytest.approx([1.0])
    assert np.degrees(min_dihedral_rad(regular, cells)) == pytest.approx([70.52878])
    assert radius_ratios(regular, cells[:, [1, 0, 2, 3]]) == pytest.approx([-1.0])
    sliver = np.array([[0.0, 0, 0], [1, 1, 1e-6], [1, 0, 0], [0, 1, 0]])
    assert abs(radius_ratios(sliver, np.array([[0, 1, 2, 3]]))[0]) < 1e-5


@given(seed=st.integers(0, 10_000), bend=st.floats(0.0, 0.6))
@settings(max_examples=40, deadline=None)
def test_the_least_jacobian_is_a_bound(seed: int, bend: float) -> None:
    rng = np.random.default_rng(seed)
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    nodes, elements = add_midside_nodes(corners, np.array([[0, 1, 2, 3]]))
    assert min_jacobian_ratios(nodes, elements) == pytest.approx([1.0])
    nodes[4:] += bend * rng.uniform(-0.5, 0.5, (6, 3))
    samples = np.array(
        [p for p in itertools.product(np.linspace(0, 1, 9), repeat=3) if sum(p) <= 1]
    )
    jacobian = np.einsum("qak,ai->qik", shape_gradients(samples), nodes[elements[0]])
    sampled = np.linalg.det(jacobian).min() / (6 * signed_volumes(nodes, elements)[0])
    bound = min_jacobian_ratios(nodes, elements)[0]
    assert bound <= sampled + 1e-9
    # and no worse than the distance between Bernstein's coefficients and the cubic
    assert bound >= sampled - 4.0 * bend


def test_the_shape_measures_slope_is_its_derivative() -> None:
    rng = np.random.default_rng(1)
    vertices, tetrahedra = make_lattice((1, 1, 1))
    points = vertices / CELL + rng.uniform(-0.1, 0.1, vertices.shape)
    cells = orient_tetrahedra(points, tetrahedra)
    _, gradient = _distortion(points, cells)
    direction = rng.normal(size=points.shape)
    step = 1e-6
    ahead, behind = (_distortion(points + s * step * direction, cells)[0] for s in (1, -1))
    assert (gradient * direction).sum() == pytest.approx((ahead - behind) / (2 * step), rel=1e-6)
    points[0] = -points[0]
    assert _distortion(points, cells)[0] == np.inf


def test_a_spec_is_all_that_a_mesh_needs() -> None:
    assert isinstance(mesh_spec(scene(SPHERE), 0.005), MeshSpec)
    one, other = scene(CYLINDER), scene(CYLINDER, world_from_object=rotated_pose([1.0, 0.0, 0.0]))
    strip = [mesh_spec(each, 0.006) for each in (one, other)]
    assert strip[0].rotation_rad == 0.0
    assert strip[1].rotation_rad == pytest.approx(-1.0)
    # the side towards the user is up in both
    assert world_from_mesh(other)[:3, :3] @ [0, 0, 1] == pytest.approx([0, 0, 1])
