"""Verify that the elements reproduce exact solutions on the meshes of all shapes."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from flexsheet.nodes.fem_solver.elasticity import SolidMeshError
from flexsheet.nodes.fem_solver.hyperelastic import NeoHookeanSolid
from flexsheet.nodes.fem_solver.mesh.quality import radius_ratios
from flexsheet.nodes.fem_solver.mesh.solid import EDGES, SolidMesh, boundary_faces
from tests.examples import long_except
from tests.fem_fields import body_loads, dofs_of, equilibrium, lame, surface_loads
from tests.fem_verification import Record, at_most
from tests.linear_elasticity import solve, stiffness_matrix
from tests.scene_solids import SHAPES, scene_solid
from tests.solids import box, distorted

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

MODULUS, NU = 4000.0, 0.45
GRADIENT = np.array([[0.3, 0.1, -0.2], [0.05, -0.4, 0.15], [0.2, -0.1, 0.25]])


def bent_inside(nodes: Floats, elements: Ints) -> tuple[Floats, Ints]:
    """Return a box's mesh with displaced inner corners and curved inner edges."""
    nodes, elements = distorted(nodes, elements)
    inner = np.setdiff1d(elements[:, 4:], boundary_faces(elements))
    size = np.linalg.norm(nodes[elements[:, 0]] - nodes[elements[:, 1]], axis=1).min()
    nodes[inner] += 0.05 * size * np.sin(53.0 * nodes[inner] @ [[2, 1, 3], [1, 3, 2], [3, 2, 1]])
    return nodes, elements


def inner_of(solid: SolidMesh) -> Ints:
    return np.setdiff1d(np.arange(len(solid.nodes)), solid.skin)


def patch_error(nodes: Floats, elements: Ints, nu: float) -> float:
    """Return the relative error of inner nodes under a linear boundary field."""
    matrix = stiffness_matrix(nodes, elements, young_modulus_pa=MODULUS, poisson_ratio=nu)
    exact = (nodes @ GRADIENT.T).ravel()
    held = dofs_of(np.unique(boundary_faces(elements)))
    assert len(held) < len(exact)
    got = solve(matrix, held, exact[held], np.zeros(len(exact)))
    return float(np.abs(got - exact).max() / np.abs(exact).max())


@pytest.mark.parametrize("nu", [0.0, 0.3, 0.499])
def test_patch_of_distorted_tetrahedra(record_property: Record, nu: float) -> None:
    """The hull has a linear displacement, which inner nodes must follow for any element shape.

    Source: patch test, Irons & Razzaque 1972; Zienkiewicz & Taylor, The Finite Element Method, vol.
    1, ch. 10
    """
    nodes, elements = bent_inside(*box((3, 3, 3), (1.0, 1.0, 1.0)))
    error = patch_error(nodes, elements, nu)
    at_most(record_property, f"patch, distorted curved elements, ν = {nu:g}", error, 1e-11)


@pytest.mark.parametrize("shape", long_except(SHAPES, "sphere", "cylinder", "rounded_box"))
def test_patch_of_every_shape(record_property: Record, shape: str) -> None:
    """The patch test uses the solver's meshes with curved skins.

    Source: patch test, Irons & Razzaque 1972
    """
    solid = scene_solid(shape)
    error = patch_error(solid.nodes, solid.elements, NU)
    at_most(record_property, f"patch, mesh of the {shape}", error, 1e-11)


@pytest.mark.parametrize("shape", SHAPES)
def test_a_large_uniform_deformation_of_every_shape(record_property: Record, shape: str) -> None:
    """Inner nodes are in equilibrium under a linear field of any size, and the work of the forces
    gives the closed-form stress.

    Source: P = mu F + (lambda ln J - mu) F^-T, Bonet & Wood, Nonlinear Continuum Mechanics, 2nd
    ed., sec. 6.4.3
    """
    mesh = scene_solid(shape)
    solid = NeoHookeanSolid(mesh.nodes, mesh.elements, young_modulus_pa=MODULUS, poisson_ratio=NU)
    deformation = np.array([[1.6, 0.5, 0.0], [-0.3, 0.7, 0.1], [0.1, 0.0, 1.2]])
    forces = solid.forces(mesh.nodes @ (deformation - np.eye(3)).T)
    lam, mu = lame(MODULUS, NU)
    log = np.log(np.linalg.det(deformation))
    stress = mu * deformation + (lam * log - mu) * np.linalg.inv(deformation).T
    work = np.einsum("ni,nj->ij", forces, mesh.nodes) / solid.volume
    out_of_balance = np.abs(forces[inner_of(mesh)]).max() / np.abs(forces).max()
    error = max(float(out_of_balance), float(np.abs(work - stress).max() / np.abs(stress).max()))
    at_most(record_property, f"large uniform deformation, mesh of the {shape}", error, 1e-11)


@pytest.mark.parametrize("shape", long_except(SHAPES, "sphere", "cylinder", "mesh"))
def test_tractions_of_a_uniform_stress(record_property: Record, shape: str) -> None:
    """The tractions of a uniform stress are given on the curved hull, with three nodes as supports.
    The displacement is the linear field.

    Source: patch test form C (tractions), Taylor, Simo, Zienkiewicz & Chan, Int. J. Numer. Meth.
    Eng. 22, 1986
    """
    mesh = scene_solid(shape)
    nodes, faces = mesh.nodes, boundary_faces(mesh.elements)
    lam, mu = lame(MODULUS, NU)
    strain = 0.5 * (GRADIENT + GRADIENT.T)
    stress = lam * np.trace(strain) * np.eye(3) + 2 * mu * strain
    loads = surface_loads(nodes, faces, lambda _, normals: normals @ stress)
    matrix = stiffness_matrix(nodes, mesh.elements, young_modulus_pa=MODULUS, poisson_ratio=NU)
    exact = (nodes @ strain).ravel()
    held = dofs_of(mesh.skin[[0, len(mesh.skin) // 2, -1]])
    got = solve(matrix, held, exact[held], loads)
    error = float(np.abs(got - exact).max() / np.abs(exact).max())
    at_most(record_property, f"traction patch, mesh of the {shape}", error, 1e-11)


def test_pure_bending_is_exact(record_property: Record) -> None:
    """A bar bent by end couples has a quadratic displacement, which quadratic elements with
    straight edges reproduce exactly.

    Source: Timoshenko & Goodier, Theory of Elasticity, 3rd ed., art. 102
    """
    nodes, elements = distorted(*box((2, 2, 3), (1.0, 1.0, 1.0)))
    nu, curvature = 0.3, 0.2
    x, y, z = (nodes - [0.5, 0.5, 0.0]).T
    exact = curvature * np.column_stack([-0.5 * (z * z + nu * (x * x - y * y)), -nu * x * y, x * z])
    faces = boundary_faces(elements)
    ends = faces[np.isclose(nodes[faces, 2], 0.0).all(1) | np.isclose(nodes[faces, 2], 1.0).all(1)]

    def couple(points: Floats, normals: Floats) -> Floats:
        return MODULUS * curvature * (points[:, :1] - 0.5) * normals

    loads = surface_loads(nodes, ends, couple)
    matrix = stiffness_matrix(nodes, elements, young_modulus_pa=MODULUS, poisson_ratio=nu)
    held = dofs_of(elements[0, :3])
    got = solve(matrix, held, exact.ravel()[held], loads).reshape(-1, 3)
    error = float(np.abs(got - exact).max() / np.abs(exact).max())
    at_most(record_property, "pure bending of a bar, distorted straight elements", error, 1e-10)


def test_a_body_under_its_own_weight_is_exact(record_property: Record) -> None:
    """A bar that hangs by its weight has a quadratic displacement with a body force.

    Source: Timoshenko & Goodier, Theory of Elasticity, 3rd ed., art. 96
    """
    nodes, elements = distorted(*box((2, 2, 3), (1.0, 1.0, 1.0)))
    nu, weight = 0.3, 50.0
    x, y, z = (nodes - [0.5, 0.5, 0.0]).T
    exact = np.column_stack([-nu * x * z, -nu * y * z, 0.5 * (z * z + nu * (x * x + y * y))])
    exact *= weight / MODULUS
    faces = boundary_faces(elements)
    top = faces[np.isclose(nodes[faces, 2], 1.0).all(1)]
    loads = surface_loads(nodes, top, lambda _, normals: weight * normals)
    loads += body_loads(nodes, elements, lambda p: np.broadcast_to([0, 0, -weight], p.shape))
    matrix = stiffness_matrix(nodes, elements, young_modulus_pa=MODULUS, poisson_ratio=nu)
    held = dofs_of(elements[0, :3])
    got = solve(matrix, held, exact.ravel()[held], loads).reshape(-1, 3)
    error = float(np.abs(got - exact).max() / np.abs(exact).max())
    at_most(record_property, "bar hanging by its weight, distorted straight elements", error, 1e-10)


def with_sliver(flatness: float) -> tuple[Floats, Ints]:
    """Return a box whose middle corner is moved towards a face of one of its elements, so that this
    element has the given flatness."""
    nodes, elements = box((2, 2, 2), (1.0, 1.0, 1.0))
    middle = int(np.flatnonzero((nodes == 0.5).all(axis=1))[0])
    mine = elements[(elements[:, :4] == middle).any(axis=1)][0, :4]
    others = mine[mine != middle]
    foot = nodes[others].mean(axis=0)
    nodes[middle] = foot + flatness * (nodes[middle] - foot)
    nodes[elements[:, 4:]] = nodes[elements[:, EDGES]].mean(axis=2)
    return nodes, elements


@pytest.mark.parametrize("flatness", [1e-1, 1e-3, 1e-5])
def test_slivers_carry_the_patch(record_property: Record, flatness: float) -> None:
    """A nearly flat element among good ones reduces the precision only: the error of the patch test
    is rounding over flatness.

    Source: conditioning of a flat tetrahedron's stiffness goes with its inverse height, Shewchuk,
    What is a good linear finite element?, 2002, sec. 3
    """
    nodes, elements = with_sliver(flatness)
    ratio = float(radius_ratios(nodes, elements).min())
    assert 0.0 < ratio < flatness
    what = f"patch with a sliver, radius ratio {ratio:.0e}"
    at_most(record_property, what, patch_error(nodes, elements, NU), 1e-13 / flatness)


def test_large_deformation_with_a_sliver(record_property: Record) -> None:
    """Newton's method converges to the linear field of a stretched hull with a nearly flat element.

    Source: patch test, Irons & Razzaque 1972
    """
    nodes, elements = with_sliver(1e-3)
    solid = NeoHookeanSolid(nodes, elements, young_modulus_pa=MODULUS, poisson_ratio=NU)
    exact = (nodes * [0.5, -0.3, 0.1]).ravel()
    held = dofs_of(np.unique(boundary_faces(elements)))
    got = equilibrium(solid, held, exact[held], np.zeros(len(exact)), steps=2).ravel()
    error = float(np.abs(got - exact).max() / np.abs(exact).max())
    at_most(record_property, "large stretch with a sliver, radius ratio 5e-06", error, 1e-9)


@pytest.mark.parametrize("flatness", [0.0, -1e-3, 1e-9])
def test_flat_and_inverted_elements_are_rejected(flatness: float) -> None:
    """Both material laws reject elements without volume by the same measure."""
    nodes, elements = with_sliver(flatness)
    with pytest.raises(SolidMeshError, match="inverted or flat"):
        stiffness_matrix(nodes, elements, young_modulus_pa=MODULUS, poisson_ratio=NU)
    with pytest.raises(SolidMeshError, match="inverted or flat"):
        NeoHookeanSolid(nodes, elements, young_modulus_pa=MODULUS, poisson_ratio=NU)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_nodes_that_are_not_finite_are_rejected(value: float) -> None:
    """NaN and infinity are rejected."""
    nodes, elements = box((1, 1, 1), (1.0, 1.0, 1.0))
    nodes[3, 1] = value
    with pytest.raises(SolidMeshError, match="not finite"):
        stiffness_matrix(nodes, elements, young_modulus_pa=MODULUS, poisson_ratio=NU)
    with pytest.raises(SolidMeshError, match="not finite"):
        NeoHookeanSolid(nodes, elements, young_modulus_pa=MODULUS, poisson_ratio=NU)
