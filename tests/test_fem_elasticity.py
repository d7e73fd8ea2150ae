"""Test the soft body's mesh and stiffness against theory and scikit-fem."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from flexsheet.nodes.fem_solver.elasticity import (
    SolidMeshError,
    degrees_of_freedom,
    quadrature,
    require_support,
    shape_gradients,
)
from flexsheet.nodes.fem_solver.mesh import EDGES, SolidMesh, boundary_faces, cylinder_mesh
from flexsheet.nodes.fem_solver.mesh.solid import number_slabs
from tests.linear_elasticity import solve, stiffness_matrix

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

RADIUS, LENGTH = 0.0353553, 0.12


def cylinder(
    spacing: float,
    *,
    support: float = np.pi / 2,
    contact_nodes: float = 1.5,
    length: float = LENGTH,
) -> SolidMesh:
    return cylinder_mesh(
        radius_m=RADIUS,
        length_m=length,
        support_angle_rad=support,
        touch_angle_rad=contact_nodes,
        skin_spacing_m=spacing,
    )


def box(divisions: tuple[int, int, int], sides: tuple[float, float, float]) -> tuple[Floats, Ints]:
    """Return ten-node tetrahedra of a box: six per brick, along its main diagonal (Kuhn)."""
    shape = tuple(n + 1 for n in divisions)
    grid = np.stack(
        np.meshgrid(
            *(np.linspace(0, s, n) for s, n in zip(sides, shape, strict=True)), indexing="ij"
        ),
        axis=-1,
    ).reshape(-1, 3)
    tetrahedra = []
    for brick in itertools.product(*(range(n) for n in divisions)):
        for steps in itertools.permutations(range(3)):
            corner, path = list(brick), [list(brick)]
            for axis in steps:
                corner[axis] += 1
                path.append(list(corner))
            tetrahedra.append([np.ravel_multi_index(c, shape) for c in path])
    corners = np.array(tetrahedra)
    volume = np.linalg.det(grid[corners[:, 1:]] - grid[corners[:, :1]])
    corners[volume < 0] = corners[volume < 0][:, [0, 2, 1, 3]]
    pairs = np.sort(corners[:, EDGES], axis=2).reshape(-1, 2)
    unique, inverse = np.unique(pairs, axis=0, return_inverse=True)
    nodes = np.concatenate([grid, grid[unique].mean(axis=1)])
    return nodes, np.concatenate([corners, inverse.reshape(-1, 6) + len(grid)], axis=1)


def test_quadrature_is_exact_to_degree_three() -> None:
    points, weights = quadrature()
    assert (weights > 0).all()
    for powers in itertools.product(range(4), repeat=3):
        if sum(powers) <= 3:
            got = float(weights @ np.prod(points ** np.array(powers), axis=1))
            factorials = [float(np.prod(np.arange(1, p + 1))) for p in (*powers, sum(powers) + 3)]
            assert got == pytest.approx(np.prod(factorials[:3]) / factorials[3], rel=1e-13)


def test_gradients_of_a_constant_vanish() -> None:
    points, _ = quadrature()
    assert np.abs(shape_gradients(points).sum(axis=1)).max() < 1e-13


@pytest.mark.parametrize("spacing", [0.008, 0.006, 0.0045])
def test_the_mesh_is_a_sound_solid(spacing: float) -> None:
    mesh = cylinder(spacing)
    corners = mesh.nodes[mesh.elements[:, :4]]
    volume = np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6
    lengths = np.linalg.norm(corners[:, EDGES[:, 0]] - corners[:, EDGES[:, 1]], axis=2)
    # 1 for the regular tetrahedron, 0 for a flat one
    quality = 6 * np.sqrt(2) * volume / np.sqrt((lengths**2).mean(axis=1)) ** 3
    assert quality.min() > 0.2
    surface = mesh.nodes[mesh.skin][mesh.skin_triangles]
    normals = 0.5 * np.cross(surface[:, 1] - surface[:, 0], surface[:, 2] - surface[:, 0])
    assert np.abs(normals.sum(axis=0)).max() < 1e-12  # closed
    enclosed = np.einsum("ij,ij->", normals, surface.mean(axis=1)) / 3
    assert enclosed == pytest.approx(np.pi * RADIUS**2 * LENGTH, rel=0.03)  # and outward
    slab = number_slabs(mesh.nodes, mesh.elements)
    assert np.ptp(slab[mesh.elements], axis=1).max() == 1
    assert (np.diff(slab) >= 0).all()


def test_the_side_is_on_the_cylinder_and_fine_in_front() -> None:
    mesh = cylinder(0.0045)
    contact_nodes = mesh.nodes[mesh.contact_nodes]
    assert np.hypot(contact_nodes[:, 1], contact_nodes[:, 2]) == pytest.approx(RADIUS, rel=1e-12)
    assert np.abs(np.linalg.norm(mesh.contact_normals, axis=1) - 1).max() < 1e-12
    distance, _ = cKDTree(contact_nodes).query(contact_nodes, k=2)
    assert 0.003 < distance[:, 1].mean() < 0.005
    assert np.isin(mesh.contact_nodes, mesh.skin).all()
    assert not mesh.fixed[mesh.contact_nodes].any()


@given(support=st.floats(0.3, 3.0), spacing=st.floats(0.004, 0.008))
@settings(max_examples=15, deadline=None)
def test_exactly_the_strip_at_the_back_is_fixed(support: float, spacing: float) -> None:
    mesh = cylinder(spacing, support=support, contact_nodes=1.2)
    held = mesh.nodes[mesh.fixed]
    angle = np.arctan2(np.abs(held[:, 1]), -held[:, 2])
    # the strip's edges are nodes of the mesh, so that its width does not depend on the spacing
    assert angle.max() == pytest.approx(0.5 * support, abs=1e-6)
    require_support(mesh.nodes, mesh.fixed)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"skin_spacing_m": 0.02}, "skin_spacing_m"),
        ({"skin_spacing_m": float("nan")}, "skin_spacing_m"),
        ({"support_angle_rad": 7.0}, "support_angle_rad"),
        ({"touch_angle_rad": 3.0}, "touch_angle_rad: 3 must be positive and at most"),
    ],
)
def test_a_cylinder_that_cannot_be_meshed_is_rejected(change: dict[str, float], word: str) -> None:
    good = {
        "radius_m": RADIUS,
        "length_m": LENGTH,
        "support_angle_rad": 1.5,
        "touch_angle_rad": 1.5,
        "skin_spacing_m": 0.006,
    }
    with pytest.raises(ValueError, match=word):
        cylinder_mesh(**{**good, **change})


def test_stiffness_equals_that_of_scikit_fem() -> None:
    import skfem
    from skfem.models.elasticity import lame_parameters, linear_elasticity

    mesh = cylinder(0.008)  # with its curved side
    corners = np.unique(mesh.elements[:, :4])
    straight = mesh.nodes.copy()
    straight[mesh.elements[:, 4:]] = mesh.nodes[mesh.elements[:, EDGES]].mean(axis=2)
    tetrahedra = np.searchsorted(corners, mesh.elements[:, :4])
    theirs = skfem.MeshTet2.from_mesh(skfem.MeshTet(straight[corners].T, tetrahedra.T))
    distance, ours = cKDTree(straight).query(theirs.doflocs.T)
    assert distance.max() < 1e-12
    theirs = skfem.MeshTet2(mesh.nodes[ours].T, theirs.t)
    points, weights = quadrature()
    basis = skfem.Basis(
        theirs, skfem.ElementVector(skfem.ElementTetP2()), quadrature=(points.T, weights)
    )
    reference = skfem.asm(linear_elasticity(*lame_parameters(4000.0, 0.45)), basis)
    matrix = stiffness_matrix(
        mesh.nodes, mesh.elements, young_modulus_pa=4000.0, poisson_ratio=0.45
    )
    distance, node = cKDTree(mesh.nodes).query(basis.doflocs.T)
    assert distance.max() < 1e-9
    axis = np.empty(len(node), dtype=np.int64)
    for names in (basis.nodal_dofs, basis.edge_dofs):
        for number, dofs in enumerate(names):
            axis[dofs] = number
    order = 3 * node + axis
    difference = abs(matrix[order][:, order] - reference).max()
    assert difference < 1e-10 * abs(reference).max()


def test_patch_of_curved_elements_carries_constant_strain_exactly() -> None:
    mesh = cylinder(0.008)
    matrix = stiffness_matrix(mesh.nodes, mesh.elements, young_modulus_pa=1.0, poisson_ratio=0.45)
    gradient = np.array([[0.3, 0.1, -0.2], [0.05, -0.4, 0.15], [0.2, -0.1, 0.25]])
    exact = (mesh.nodes @ gradient.T).ravel()
    held = degrees_of_freedom(mesh.skin)
    got = solve(matrix, held, exact[held], np.zeros(matrix.shape[0]))
    assert np.abs(got - exact).max() < 1e-12 * np.abs(exact).max() * len(exact)


def test_a_rigid_motion_costs_nothing() -> None:
    mesh = cylinder(0.008)
    matrix = stiffness_matrix(mesh.nodes, mesh.elements, young_modulus_pa=1.0, poisson_ratio=0.3)
    turn = np.cross([0.1, -0.2, 0.3], mesh.nodes) + np.array([1.0, 2.0, 3.0])
    assert np.abs(matrix @ turn.ravel()).max() < 1e-12


def test_error_falls_with_the_third_power_of_the_element_size() -> None:
    """The boundary values are those of a smooth equilibrium field: the gradient of a harmonic
    potential."""
    errors = []
    for n in (3, 6):
        nodes, elements = box((n, n, n), (1.0, 1.0, 1.0))
        x, y, z = nodes.T
        exact = np.column_stack([np.cos(2 * x) * np.cosh(2 * y), np.sin(2 * x) * np.sinh(2 * y), z])
        matrix = stiffness_matrix(nodes, elements, young_modulus_pa=1.0, poisson_ratio=0.4)
        held = degrees_of_freedom(np.unique(boundary_faces(elements)))
        got = solve(matrix, held, exact.ravel()[held], np.zeros(matrix.shape[0]))
        # the norm that the lumped mass of equal boxes gives; energy is its gradient's
        errors.append(np.sqrt(np.square(got - exact.ravel()).mean()))
    rates = np.log2(np.array(errors[:-1]) / errors[1:])
    assert rates[-1] > 2.7


def test_cantilever_bends_as_a_timoshenko_beam() -> None:
    length, side, modulus, nu = 1.0, 0.1, 1e6, 0.3
    nodes, elements = box((12, 2, 2), (length, side, side))
    matrix = stiffness_matrix(nodes, elements, young_modulus_pa=modulus, poisson_ratio=nu)
    end = np.flatnonzero(np.isclose(nodes[:, 0], length))
    loads = np.zeros(matrix.shape[0])
    loads[3 * end + 2] = 1.0 / len(end)
    root = degrees_of_freedom(np.flatnonzero(nodes[:, 0] == 0))
    got = solve(matrix, root, np.zeros(len(root)), loads).reshape(-1, 3)[end, 2].mean()
    inertia, shear = side**4 / 12, modulus / 2 / (1 + nu)
    theory = length**3 / (3 * modulus * inertia) + length / (5 / 6 * shear * side**2)
    # the clamped root cannot thin out as the beam of the theory does: a little stiffer
    assert 0.98 * theory < got < theory


@pytest.mark.parametrize("nu", [0.5, 0.49999, 1.0, -1.0, float("nan")])
def test_poisson_ratios_that_lose_the_answer_are_rejected(nu: float) -> None:
    nodes, elements = box((1, 1, 1), (1.0, 1.0, 1.0))
    with pytest.raises(ValueError, match="poisson_ratio"):
        stiffness_matrix(nodes, elements, young_modulus_pa=1.0, poisson_ratio=nu)


@pytest.mark.parametrize("modulus", [0.0, -1.0, float("nan"), float("inf")])
def test_stiffness_needs_a_positive_modulus(modulus: float) -> None:
    nodes, elements = box((1, 1, 1), (1.0, 1.0, 1.0))
    with pytest.raises(ValueError, match="young_modulus_pa"):
        stiffness_matrix(nodes, elements, young_modulus_pa=modulus, poisson_ratio=0.3)


def test_quadratic_elements_do_not_lock_near_incompressibility() -> None:
    """A block compressed between its end faces becomes stiffer, but by far less than ten times."""
    nodes, elements = box((3, 3, 3), (1.0, 1.0, 1.0))
    held = degrees_of_freedom(np.flatnonzero((nodes[:, 2] == 0) | np.isclose(nodes[:, 2], 1.0)))
    values = np.where(np.isclose(nodes[held // 3, 2], 1.0) & (held % 3 == 2), -0.01, 0.0)
    forces = []
    for nu in (0.45, 0.4999):
        matrix = stiffness_matrix(nodes, elements, young_modulus_pa=1.0, poisson_ratio=nu)
        moved = solve(matrix, held, values, np.zeros(matrix.shape[0]))
        forces.append(-(matrix @ moved)[held[values < 0]].sum())
    assert 1.0 < forces[1] / forces[0] < 1.5


@pytest.mark.parametrize("how", ["inverted", "flat"])
def test_bad_elements_are_named(how: str) -> None:
    nodes, elements = box((2, 1, 1), (1.0, 1.0, 1.0))
    if how == "inverted":
        elements[7, [0, 1]] = elements[7, [1, 0]]
    else:
        corner = elements[7, 0]
        nodes[corner] = nodes[elements[7, 1:4]].mean(axis=0)
    with pytest.raises(SolidMeshError, match="inverted or flat"):
        stiffness_matrix(nodes, elements, young_modulus_pa=1.0, poisson_ratio=0.3)


def test_a_free_body_is_an_error_not_a_number() -> None:
    nodes, elements = box((2, 2, 2), (1.0, 1.0, 1.0))
    matrix = stiffness_matrix(nodes, elements, young_modulus_pa=1.0, poisson_ratio=0.3)
    loads = np.zeros(matrix.shape[0])
    loads[2] = 1.0
    nothing = np.empty(0, dtype=np.int64)
    with pytest.raises(SolidMeshError, match="free to move"):
        solve(matrix, nothing, np.empty(0), loads)
    line = np.isclose(nodes[:, 0], 0) & np.isclose(nodes[:, 1], 0)
    with pytest.raises(SolidMeshError, match="free to move"):
        require_support(nodes, line)
    with pytest.raises(SolidMeshError, match="0 fixed nodes"):
        require_support(nodes, np.zeros(len(nodes), dtype=bool))
