"""Test the cylinder's mesh and the element stiffness against theory."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from flexsheet.nodes.fem_solver.elasticity import (
    degrees_of_freedom,
    quadrature,
    shape_gradients,
)
from flexsheet.nodes.fem_solver.mesh.cylinder import cylinder_mesh
from flexsheet.nodes.fem_solver.mesh.solid import SolidMesh, boundary_faces
from tests.linear_elasticity import solve, stiffness_matrix
from tests.solids import box

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


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"skin_spacing_m": 0.02}, "skin_spacing_m"),
        ({"skin_spacing_m": float("nan")}, "skin_spacing_m"),
        ({"support_angle_rad": 7.0}, r"support\.angle_rad"),
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


def test_a_rigid_motion_costs_nothing() -> None:
    mesh = cylinder(0.008)
    matrix = stiffness_matrix(mesh.nodes, mesh.elements, young_modulus_pa=1.0, poisson_ratio=0.3)
    turn = np.cross([0.1, -0.2, 0.3], mesh.nodes) + np.array([1.0, 2.0, 3.0])
    assert np.abs(matrix @ turn.ravel()).max() < 1e-12


def test_error_falls_with_the_third_power_of_the_element_size() -> None:
    """Prescribe the gradient of a harmonic potential, which is an equilibrium field, at the
    boundary.
    """
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
