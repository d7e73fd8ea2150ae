"""Test smooth meshes: errors against exact surfaces, continuity, and rejected meshes."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from numpy.typing import NDArray

from flexsheet.launch.objects.meshes import read_mesh
from flexsheet.nodes.models.shapes import (
    EllipsoidShape,
    MeshError,
    SmoothMeshShape,
    make_shape,
    principal_curvatures,
)
from flexsheet.nodes.models.shapes.smooth_mesh import EDGE, MAX_CURVATURE_RATIO, default_smoothing_m
from flexsheet.nodes.models.shapes.triangles import (
    check_mesh,
    count_intersections,
    dihedrals_rad,
    half_edges,
    nearest_in_triangles,
    refine_facets,
    triangle_normals,
    vertex_normals,
    volume_m3,
)
from tests.facets import Facets

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]

LIVER = Path(__file__).resolve().parent.parent.parent / "shared" / "data" / "mesh" / "liver.obj"
AXES = (0.05, 0.03, 0.02)
RADIUS = 0.03
TOWARDS_USER = np.array([0.0, 0.0, 1.0])


def meshed_ellipsoid(axes: tuple[float, float, float], subdivisions: int) -> tuple[Floats, Indices]:
    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=1.0)
    return np.array(ball.vertices) * axes, np.array(ball.faces, dtype=np.int64)


def cube(side_m: float = 0.04) -> tuple[Floats, Indices]:
    box = trimesh.creation.box((side_m, side_m, side_m))
    return np.array(box.vertices, dtype=np.float64), np.array(box.faces, dtype=np.int64)


@cache
def smooth_ellipsoid(axes: tuple[float, float, float], subdivisions: int) -> SmoothMeshShape:
    vertices, triangles = meshed_ellipsoid(axes, subdivisions)
    return SmoothMeshShape(vertices, triangles, default_smoothing_m(vertices, triangles))


@cache
def smooth_cube() -> SmoothMeshShape:
    return SmoothMeshShape(*cube(), 0.008)


@cache
def liver() -> SmoothMeshShape:
    if not LIVER.is_file():
        pytest.skip(f"the real mesh is not there: {LIVER}")
    mesh = read_mesh(LIVER, 0.01, None)
    shape = make_shape(dict(mesh))
    assert isinstance(shape, SmoothMeshShape)
    return shape


def degrees_between(one: Floats, other: Floats) -> Floats:
    return np.degrees(2.0 * np.arcsin(np.minimum(0.5 * np.linalg.norm(one - other, axis=-1), 1.0)))


def around(axes: tuple[float, float, float], count: int = 600) -> Floats:
    directions = np.random.default_rng(0).normal(size=(count, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True) * np.array(axes) * 1.05


@pytest.mark.parametrize(
    ("axes", "subdivisions", "most_deg", "most_m", "most_curvature"),
    [
        ((RADIUS,) * 3, 2, 0.15, 3e-5, 0.05),
        ((RADIUS,) * 3, 3, 0.02, 3e-6, 0.02),
        pytest.param((RADIUS,) * 3, 4, 0.003, 2e-7, 0.005, marks=pytest.mark.long),
        (AXES, 3, 2.0, 1e-4, 0.2),
        pytest.param(AXES, 4, 0.4, 2e-5, 0.1, marks=pytest.mark.long),
    ],
)
def test_the_error_against_a_known_surface_is_bounded(
    axes: tuple[float, float, float],
    subdivisions: int,
    most_deg: float,
    most_m: float,
    most_curvature: float,
) -> None:
    queries = around(axes)
    known = EllipsoidShape(axes).closest(queries)
    found = smooth_ellipsoid(axes, subdivisions).closest(queries)
    assert degrees_between(found.normal, known.normal).max() < most_deg
    assert np.abs(found.height_m - known.height_m).max() < most_m
    assert not found.on_edge.any()
    assert not found.undecided.any()
    curvatures, wanted = (
        principal_curvatures(one.shape_operator, one.normal)[0] for one in (found, known)
    )
    assert np.abs(curvatures - wanted).max() < most_curvature * wanted.max()


def test_facets_and_vertex_normals_are_far_worse() -> None:
    vertices, triangles = meshed_ellipsoid(AXES, 4)
    queries = around(AXES)
    known = EllipsoidShape(AXES).closest(queries).normal
    triangle, weights = Facets(vertices, triangles).nearest(queries)
    facet = triangle_normals(vertices, triangles)[triangle]
    blend = (weights[:, None] @ vertex_normals(vertices, triangles)[triangles[triangle]])[:, 0]
    blend /= np.linalg.norm(blend, axis=1, keepdims=True)
    smooth = smooth_ellipsoid(AXES, 4).closest(queries).normal
    worst = [degrees_between(one, known).max() for one in (smooth, blend, facet)]
    assert worst[0] < worst[1] / 3 < worst[2] / 9


@settings(max_examples=40, deadline=None)
@given(
    one=npst.arrays(np.float64, 3, elements=st.floats(-0.1, 0.1)),
    other=npst.arrays(np.float64, 3, elements=st.floats(-0.1, 0.1)),
)
def test_distance_and_nearest_point_agree(one: Floats, other: Floats) -> None:
    shape = smooth_ellipsoid(AXES, 3)
    found = shape.closest(np.stack([one, other]))
    sure = ~found.undecided
    back = found.point + found.height_m[:, None] * found.normal
    assert np.allclose(back[sure], np.stack([one, other])[sure], atol=3e-6)
    assert np.abs(shape.signed_distance(found.point))[sure] == pytest.approx(0.0, abs=1e-8)
    rise = abs(float(np.diff(found.height_m)[0]))
    assert rise <= np.linalg.norm(one - other) + 1e-6


@pytest.mark.parametrize("shape", [lambda: smooth_ellipsoid(AXES, 3), smooth_cube], ids=["e", "c"])
def test_gradient_and_curvature_by_differences(shape: object) -> None:
    assert callable(shape)
    solid: SmoothMeshShape = shape()
    queries = np.random.default_rng(1).uniform(-0.04, 0.04, (150, 3))
    found = solid.closest(queries)
    keep = ~found.undecided & (found.height_m > 1e-3)
    assert keep.sum() > 30
    rises = [
        solid.signed_distance(queries[keep] + one) - solid.signed_distance(queries[keep] - one)
        for one in 1e-6 * np.eye(3)
    ]
    assert np.allclose(np.stack(rises, axis=1) / 2e-6, found.normal[keep], atol=1e-3)
    point, normal = found.point[keep], found.normal[keep]
    along = np.cross(normal, [0.3, 0.5, 0.8])
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    ahead, behind = (
        solid.closest(point + way * along, previous=point).normal for way in (1e-6, -1e-6)
    )
    bend = (found.shape_operator[keep] @ along[:, :, None])[:, :, 0]
    assert np.allclose((ahead - behind) / 2e-6, bend, atol=5e-3 * np.abs(bend).max() + 0.5)


def walk(shape: SmoothMeshShape, start: Floats, step_m: float, steps: int) -> tuple[Floats, Floats]:
    """Return normals (steps, 3) along a geodesic of the surface, and whether each point is on an
    edge.
    """
    here = shape.closest(start)
    point, normal = here.point, here.normal
    heading = np.cross(normal, [0.36, 0.48, 0.8])
    normals, edges = np.empty((steps, 3)), np.empty(steps, dtype=bool)
    for i in range(steps):
        heading = heading - normal * (normal @ heading)
        heading /= np.linalg.norm(heading)
        found = shape.closest(point + step_m * heading, previous=point)
        point, normal = found.point, found.normal
        normals[i], edges[i] = normal, bool(found.on_edge)
    return normals, edges


def worst_turn(normals: Floats, edges: Floats, step_m: float) -> float:
    """Return the maximum second derivative (1/m^2) of the normal by arc length, without edges."""
    second = np.linalg.norm(np.diff(normals, 2, axis=0), axis=1) / step_m**2
    off = ~(edges[2:] | edges[1:-1] | edges[:-2])
    return float(second[off].max())


@pytest.mark.parametrize("step_m", [2e-4, 5e-5])
def test_the_normals_acceleration_is_bounded_on_a_real_mesh(step_m: float) -> None:
    shape = liver()
    bound = 60.0 / shape.smoothing_m**2
    for start in ([0.02, 0.04, 0.0], [-0.03, 0.05, 0.03], [-0.02, 0.0, 0.0]):
        normals, edges = walk(shape, np.array(start), step_m, int(0.025 / step_m))
        # On facets this grows as the step shrinks: 800 and 3300 over the square at these steps.
        assert worst_turn(normals, edges, step_m) < bound
        assert edges.mean() < 0.3
        turned = np.linalg.norm(np.diff(normals, axis=0), axis=1) / step_m
        off = ~(edges[1:] | edges[:-1])
        assert turned[off].max() < 1.1 * EDGE * MAX_CURVATURE_RATIO / shape.smoothing_m


def test_the_real_mesh_is_followed_closely() -> None:
    shape = liver()
    assert 0.002 < shape.smoothing_m < 0.006
    assert shape.deviation_m() < 0.2 * shape.smoothing_m
    vertices, triangles = liver_arrays()
    centres = vertices[triangles].mean(axis=1)
    found = shape.closest(centres)
    assert found.on_edge.mean() < 0.05
    assert np.quantile(np.abs(found.height_m), 0.99) < 0.00025
    # From the smooth surface back to the facets: nowhere does it bulge away from the mesh.
    triangle, weights = Facets(vertices, triangles).nearest(found.point[::9])
    foot = (weights[:, None] @ vertices[triangles[triangle]])[:, 0]
    assert np.linalg.norm(foot - found.point[::9], axis=1).max() < 0.001


def liver_arrays() -> tuple[Floats, Indices]:
    mesh = read_mesh(LIVER, 0.01, None)
    return mesh.vertices_m, mesh.triangles.astype(np.int64)


def test_a_nearest_point_is_the_nearest_of_all() -> None:
    shape = smooth_ellipsoid((0.05, 0.05, 0.012), 4)
    known = EllipsoidShape((0.05, 0.05, 0.012))
    inside = np.random.default_rng(3).uniform(-1.0, 1.0, (300, 3)) * [0.03, 0.03, 0.008]
    found = shape.closest(inside)
    assert np.abs(found.height_m - known.closest(inside).height_m).max() < 5e-5


def test_a_nearest_point_of_the_real_mesh_is_that_of_its_facets() -> None:
    shape, rng = liver(), np.random.default_rng(2)
    base = shape.closest(rng.uniform(-0.05, 0.05, (300, 3)))
    queries = base.point + rng.uniform(-0.015, 0.02, (300, 1)) * base.normal
    vertices, triangles = liver_arrays()
    triangle, weights = Facets(vertices, triangles).nearest(queries)
    foot = (weights[:, None] @ vertices[triangles[triangle]])[:, 0]
    distance = np.linalg.norm(queries - foot, axis=1)
    off = np.abs(np.abs(shape.closest(queries).height_m) - distance)
    assert np.quantile(off, 0.98) < 0.0004
    assert off.max() < 0.002


def test_the_earlier_point_decides_between_two_sides() -> None:
    shape = smooth_ellipsoid((0.05, 0.05, 0.012), 4)
    middle = np.array([0.002, 0.001, 0.0])
    assert bool(shape.closest(np.zeros(3)).undecided)
    for side in (1.0, -1.0):
        before = shape.closest(np.array([0.002, 0.001, 0.02 * side])).point
        for depth in np.linspace(0.02, -0.002, 80):
            found = shape.closest(middle + side * depth * TOWARDS_USER, previous=before)
            assert side * found.normal[2] > 0.9
            assert np.linalg.norm(found.point - before) < 5e-4
            before = found.point
        assert side * shape.closest(middle - side * 0.002 * TOWARDS_USER).normal[2] < 0.0


def test_a_cubes_edges_are_rounded_and_flagged_its_faces_flat() -> None:
    shape = smooth_cube()
    face = shape.closest(np.array([[0.03, 0.0, 0.0], [0.03, 0.008, -0.007], [0.018, 0.002, 0.0]]))
    assert np.allclose(face.normal, [1.0, 0.0, 0.0], atol=1e-9)
    assert np.allclose(face.height_m, [0.01, 0.01, -0.002], atol=1e-9)
    assert not face.on_edge.any()
    over_edge = np.array([[0.03, 0.0, 0.03], [0.03, 0.03, 0.03]])
    edge = shape.closest(over_edge)
    assert edge.on_edge.all()
    assert np.allclose(edge.normal, over_edge / np.linalg.norm(over_edge, axis=1, keepdims=True))
    assert shape.deviation_m() < 0.2 * shape.smoothing_m
    # Around the edge the normal turns from face to face without a jump.
    angle = np.linspace(0.0, np.pi / 2, 2000)
    arc = np.stack([0.015 + 0.012 * np.cos(angle), 0 * angle, 0.015 + 0.012 * np.sin(angle)], 1)
    turned = degrees_between(
        *(shape.closest(arc).normal[part] for part in (slice(1, None), slice(-1)))
    )
    assert turned.max() < 0.5


def test_far_near_and_bad_queries() -> None:
    shape = smooth_ellipsoid(AXES, 3)
    far = shape.closest(np.array([3e5, -4e5, 5e5]))
    assert np.linalg.norm(far.point) < 0.06
    for query in (np.array([np.nan, 0.0, 0.0]), np.array([0.0, np.inf, 0.0])):
        with pytest.raises(ValueError, match="NaN"):
            shape.closest(query)
    assert shape.closest(np.zeros((0, 3))).shape_operator.shape == (0, 3, 3)
    vertex = meshed_ellipsoid(AXES, 3)[0][7]
    assert abs(float(shape.closest(vertex).height_m)) < shape.deviation_m() + 1e-9
    # A point found before that is nowhere near the surface does not harm.
    lost = shape.closest(np.array([0.06, 0.0, 0.0]), previous=np.array([0.5, 0.5, 0.5]))
    assert np.allclose(lost.point, shape.closest(np.array([0.06, 0.0, 0.0])).point, atol=1e-6)


@pytest.mark.parametrize("make", [lambda: smooth_ellipsoid(AXES, 3), smooth_cube, liver])
def test_single_and_batch_queries_agree(make: Callable[[], SmoothMeshShape]) -> None:
    """The queries include distant points, points near edges and points inside the mesh."""
    shape = make()
    rng = np.random.default_rng(4)
    begun = shape.closest(rng.uniform(-0.05, 0.05, (120, 3)))
    queries = begun.point + rng.uniform(-0.01, 0.01, (120, 1)) * begun.normal
    before = shape.closest(queries + rng.normal(0.0, 1e-3, (120, 3))).point
    many = shape.closest(queries, previous=before)
    apart = []
    for i in range(len(queries)):
        one = shape.closest(queries[i], previous=before[i])
        apart.append(float(np.linalg.norm(one.point - many.point[i])))
        if apart[-1] < 1e-7:
            assert one.normal == pytest.approx(many.normal[i], abs=1e-5)
            bound = 1e-3 * (1.0 + np.abs(many.shape_operator[i]).max())
            assert np.abs(one.shape_operator - many.shape_operator[i]).max() < bound
    # At a centre of curvature rounding decides which way a descent goes.
    assert np.mean(np.array(apart) < 1e-7) >= 0.99


def test_a_mesh_that_is_convex_hardly_rises() -> None:
    shape = smooth_ellipsoid(AXES, 4)
    found = shape.closest(around(AXES, 50))
    rises = [
        shape.rise_m(point, normal, 0.03)
        for point, normal in zip(found.point, found.normal, strict=True)
    ]
    assert max(rises) < 2e-5


def test_what_is_no_solids_surface_is_rejected() -> None:
    vertices, triangles = cube()
    with pytest.raises(MeshError, match="a closed surface needs at least 4"):
        SmoothMeshShape(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64), 0.01)
    with pytest.raises(MeshError, match="not closed: 3 edges"):
        check_mesh(vertices, triangles[1:])
    flipped = triangles.copy()
    flipped[0] = flipped[0, ::-1]
    with pytest.raises(MeshError, match="winding is inconsistent along 3 of 18"):
        check_mesh(vertices, flipped)
    with pytest.raises(MeshError, match="inside out"):
        check_mesh(vertices, triangles[:, ::-1])
    with pytest.raises(MeshError, match="more than two triangles"):
        check_mesh(vertices, np.concatenate([triangles, triangles]))
    with pytest.raises(MeshError, match="NaN"):
        check_mesh(np.where(vertices == vertices[0], np.nan, vertices), triangles)
    with pytest.raises(MeshError, match=r"outside 0\.\.7"):
        check_mesh(vertices, triangles + 1)
    collapsed = vertices.copy()
    collapsed[1] = collapsed[0]
    with pytest.raises(MeshError, match="degenerate"):
        check_mesh(collapsed, triangles)
    with pytest.raises(ValueError, match="smoothing_m"):
        SmoothMeshShape(vertices, triangles, 0.0)
    with pytest.raises(MeshError, match="expected vertices"):
        check_mesh(np.zeros((4, 2)), triangles)


def test_parts_that_touch_in_one_vertex_are_rejected() -> None:
    vertices, triangles = cube()
    other = vertices + 0.04
    shared = int(np.flatnonzero((vertices == 0.02).all(axis=1))[0])
    twin = int(
        np.flatnonzero(np.allclose(other, 0.02, atol=1e-12) | (other == 0.02).all(axis=1))[0]
    )
    moved = np.where(triangles == twin, shared, triangles + len(vertices))
    with pytest.raises(MeshError, match="touch in 1 single vertices"):
        check_mesh(np.concatenate([vertices, other]), np.concatenate([triangles, moved]))


def test_a_fold_is_rejected() -> None:
    # A thin blade whose two sides meet at two degrees.
    vertices = np.array([[0, 0, 0], [0.1, 0, 0], [0.05, 0.05, 0], [0.05, 0.05, 0.0005]])
    triangles = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    with pytest.raises(MeshError, match="are folded"):
        check_mesh(vertices, triangles)


def test_triangles_that_cut_through_one_another_are_counted() -> None:
    vertices, triangles = cube()
    assert count_intersections(vertices, triangles) == 0
    both = np.concatenate([vertices, vertices + np.array([0.011, 0.012, 0.013])])
    assert count_intersections(both, np.concatenate([triangles, triangles + 8])) > 4
    ball = meshed_ellipsoid(AXES, 3)
    assert count_intersections(*ball) == 0


def test_refinement_keeps_the_surface() -> None:
    vertices, triangles = cube()
    fine_vertices, fine = refine_facets(vertices, triangles, 0.007)
    check_mesh(fine_vertices, fine)
    run = half_edges(fine)
    assert (
        np.linalg.norm(fine_vertices[run[:, 0]] - fine_vertices[run[:, 1]], axis=1).max() <= 0.007
    )
    assert volume_m3(fine_vertices, fine) == pytest.approx(0.04**3)
    assert np.isclose(np.abs(fine_vertices).max(axis=1), 0.02).all()
    assert np.isclose(np.degrees(dihedrals_rad(vertices, triangles)[1]).max(), 90.0)
    with pytest.raises(MeshError, match="increase the permitted edge length"):
        refine_facets(vertices, triangles, 1e-5)


@settings(max_examples=60, deadline=None)
@given(npst.arrays(np.float64, (4, 3), elements=st.floats(-1.0, 1.0)))
def test_no_point_of_a_triangle_is_nearer(places: Floats) -> None:
    corners, query = places[:3], places[3]
    area = np.linalg.norm(np.cross(corners[1] - corners[0], corners[2] - corners[0]))
    if area < 1e-3:
        return
    weights = nearest_in_triangles(query[None], corners[None])[0]
    assert weights.min() >= -1e-12
    assert weights.sum() == pytest.approx(1.0)
    found = np.linalg.norm(weights @ corners - query)
    grid = np.random.default_rng(0).dirichlet([0.5, 0.5, 0.5], 300)
    assert found <= np.linalg.norm(grid @ corners - query, axis=1).min() + 1e-9
