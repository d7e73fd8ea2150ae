"""Verify that Newton's method marks failed pushes and never returns inverted elements."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray

from flexsheet.nodes.fem_solver.hyperelastic import NeoHookeanSolid
from flexsheet.nodes.fem_solver.mesh.quality import min_jacobian_ratios
from flexsheet.nodes.fem_solver.mesh.solid import boundary_faces
from flexsheet.nodes.fem_solver.newton import (
    EquilibriumState,
    NeoHookeanBody,
    winding_number,
)
from tests.examples import long_except
from tests.fem_verification import Record, at_most, between
from tests.solids import box

Floats = NDArray[np.float64]

FINGER, SIDE, HEIGHT = 0.007, 0.03, 0.012


def pad(*, nu: float = 0.45, finger: float = FINGER, sides: bool = False) -> NeoHookeanBody:
    """Return a coarse block of 30 x 30 x 12 mm, fixed at its bottom, with its top at z = 0."""
    nodes, elements = box((4, 4, 2), (SIDE, SIDE, HEIGHT))
    nodes = nodes - [0.5 * SIDE, 0.5 * SIDE, HEIGHT]
    faces = boundary_faces(elements)
    ground = np.isclose(nodes[:, 2], -HEIGHT)
    free = ~ground[faces].all(axis=1)
    top = np.isclose(nodes[faces, 2], 0.0).all(axis=1)
    return NeoHookeanBody(
        nodes,
        elements,
        ground,
        faces[free if sides else top],
        young_modulus_pa=4000.0,
        poisson_ratio=nu,
        finger_radius_m=finger,
    )


def pressed(body: NeoHookeanBody, *places: tuple[float, float, float]) -> list[EquilibriumState]:
    return list(body.solve_load_steps([np.array(place) for place in places]))


def require_sound(body: NeoHookeanBody, states: list[EquilibriumState]) -> None:
    """Assert finite results without inversion, and no converged result after the first failure."""
    for state in states:
        assert np.isfinite(state.displacement).all()
        assert np.isfinite(state.force_n).all()
        bound = min_jacobian_ratios(
            body.solid.nodes + state.displacement, body.solid.elements
        ).min()
        assert bound > 0.0
        assert state.min_volume_ratio > 0.0
    assert all(a.reached or not b.reached for a, b in itertools.pairwise(states))


@pytest.mark.parametrize("nu", long_except([0.3, 0.45, 0.499], 0.45))
def test_a_push_too_deep_is_flagged_and_sound(record_property: Record, nu: float) -> None:
    """The depth increases until the mesh fails: the last result remains, flagged, and no element is
    inverted anywhere, not only at quadrature points.

    Source: Jacobians bounded by Bernstein coefficients, Johnen, Remacle & Geuzaine, J. Comput.
    Phys. 233, 2013
    """
    body = pad(nu=nu)
    places = [(0.001, 0.0007, FINGER - depth) for depth in (0.0, 0.004, 0.0115, 0.03)]
    states = pressed(body, *places)
    require_sound(body, states)
    assert states[1].reached
    assert not states[-1].reached
    assert np.linalg.norm(states[-1].displacement, axis=1).max() < 2 * HEIGHT
    depth = FINGER - float(states[-1].centre[2])
    what = f"12 mm block, coarse mesh, ν = {nu:g}, depth reached"
    between(record_property, f"{what} / thickness", depth / HEIGHT, 0.5, 1.0)
    forces = [float(state.force_n[2]) for state in states]
    assert all(a <= b for a, b in itertools.pairwise(forces))


def test_a_finger_faster_than_a_frame_does_not_slip_through() -> None:
    """Move the finger from above to below the block in one step."""
    body = pad()
    states = pressed(body, (0.001, 0.0007, FINGER), (0.001, 0.0007, FINGER - 0.03))
    require_sound(body, states)
    assert not states[-1].reached
    assert states[-1].force_n[2] > 0.3
    assert FINGER - states[-1].centre[2] > 0.006


def test_a_finger_that_begins_inside_is_flagged() -> None:
    """Start with the finger inside the body, where no path leads."""
    state = pressed(pad(), (0.001, 0.0007, -0.006))[0]
    assert not state.reached
    assert not state.displacement.any()


def test_a_finger_smaller_than_the_elements_is_felt(record_property: Record) -> None:
    """A tip of 1 mm on elements of 7.5 mm touches between their nodes; unresolvable results are
    flagged."""
    body = pad(finger=0.001)
    states = pressed(body, (0.001, 0.0007, 0.001), (0.001, 0.0007, 0.0), (0.001, 0.0007, -0.003))
    require_sound(body, states)
    assert states[1].reached
    assert states[1].force_n[2] > 0.0
    _, depth, _, _ = body.obstacle.inside(
        body.solid.nodes + states[1].displacement, states[1].centre
    )
    at_most(
        record_property,
        "tip of 1 mm, elements of 7.5 mm, skin inside / R",
        depth.max() / 1e-3,
        0.15,
    )


def test_a_finger_on_the_edge_slides_off_soundly() -> None:
    """Push at an edge of the block, so that half of the contact is beside the top face."""
    body = pad(sides=True)
    states = pressed(body, (0.015, 0.0007, 0.0071), (0.015, 0.0007, 0.003))
    require_sound(body, states)
    assert states[-1].reached
    assert states[-1].force_n[0] > 0.0


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_finger_without_a_position_is_an_error(value: float) -> None:
    """Pass a position that is not finite as the first and as the second position."""
    with pytest.raises(ValueError, match="not finite"):
        pressed(pad(), (value, 0.0, 0.0))
    with pytest.raises(ValueError, match="not finite"):
        pressed(pad(), (0.0, 0.0, FINGER), (0.0, value, 0.0))


def test_a_turned_corner_is_seen_though_quadrature_sees_nothing() -> None:
    """The middle node of an edge is moved nearly to its end. The corner there is inverted, although
    all quadrature points have a positive volume and the energy is finite."""
    nodes, elements = box((1, 1, 1), (1.0, 1.0, 1.0))
    solid = NeoHookeanSolid(nodes, elements, young_modulus_pa=1.0, poisson_ratio=0.3)
    moved = np.zeros_like(nodes)
    first, second, middle = elements[0, [0, 1, 4]]
    moved[middle] = 0.3 * (nodes[first] - nodes[second])
    assert np.isfinite(solid.energy(moved))
    assert solid.deformation(moved)[1].min() > 0.0
    assert min_jacobian_ratios(nodes + moved, elements).min() < 0.0
    assert solid.min_volume_ratio(moved) < 0.0


@pytest.mark.parametrize(("place", "times"), [((0.4, 0.5, 0.6), 1.0), ((1.2, 0.5, 0.5), 0.0)])
def test_winding_number_detects_inside(place: tuple[float, float, float], times: float) -> None:
    """The winding number is one inside and zero outside."""
    nodes, elements = box((2, 2, 2), (1.0, 1.0, 1.0))
    hull = boundary_faces(elements)[:, :3]
    assert winding_number(nodes[hull] - place) == pytest.approx(times, abs=1e-12)
