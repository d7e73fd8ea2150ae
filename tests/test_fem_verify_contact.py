"""Verify point loads and light contacts on a half-space against Boussinesq and Hertz."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from flexsheet.nodes.fem_solver import newton
from flexsheet.nodes.fem_solver.mesh.solid import boundary_faces
from tests.examples import long_except
from tests.fem_fields import dofs_of
from tests.fem_verification import Record, at_most, between, near
from tests.half_space import half_space
from tests.linear_elasticity import solve, stiffness_matrix

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

E = 4000.0


def boussinesq(points: Floats, force: float, nu: float) -> Floats:
    """Return the displacement (k, 3) of the half-space z <= 0 under a downward force at the
    origin."""
    r2 = points[:, 0] ** 2 + points[:, 1] ** 2
    depth = -points[:, 2]
    rho = np.sqrt(r2 + depth**2)
    scale = force * (1 + nu) / (2 * np.pi * E)
    aside = scale * (depth / rho**3 - (1 - 2 * nu) / (rho * (rho + depth)))
    down = scale * (depth**2 / rho**3 + 2 * (1 - nu) / rho)
    return np.column_stack([aside * points[:, 0], aside * points[:, 1], -down])


@pytest.mark.parametrize("nu", long_except([0.3, 0.45, 0.499], 0.45))
def test_point_load_on_a_half_space(record_property: Record, nu: float) -> None:
    """A quarter of a block has the half-space's displacement on its outer faces. The test measures
    the indentation around the load, and its decrease with the distance.

    Source: Boussinesq 1885; w = (1 - nu^2) F / (pi E r): Johnson, Contact Mechanics, 1985, eqs.
    3.18-3.22
    """
    width, force = 30.0, 1000.0
    nodes, elements = half_space(
        half_width=width, smallest=0.25, fine_radius=1.0, growth=0.5, whole=False
    )
    matrix = stiffness_matrix(nodes, elements, young_modulus_pa=E, poisson_ratio=nu)
    outer = np.isclose(np.abs(nodes), width).any(axis=1)
    away = np.linalg.norm(nodes, axis=1)
    exact = boussinesq(np.where(away[:, None] > 0.0, nodes, 1.0), force, nu)
    glide = np.flatnonzero((nodes[:, :2] == 0.0).ravel())
    held = np.union1d(dofs_of(np.flatnonzero(outer)), 3 * (glide // 2) + glide % 2)
    values = np.where(outer[:, None], exact, 0.0).ravel()
    loads = np.zeros(nodes.size)
    loads[3 * int(np.argmin(away)) + 2] = -0.25 * force
    got = solve(matrix, held, values[held], loads).reshape(-1, 3)
    seen = np.flatnonzero((nodes[:, 2] == 0.0) & (away > 1.5) & (away < 20.0))
    assert len(seen) > 50
    slope, _ = np.polyfit(np.log(away[seen]), np.log(-got[seen, 2]), 1)
    what = f"point load, ν = {nu:g}"
    between(record_property, f"{what}, power of the distance", float(slope), -1.02, -0.98)
    wanted = (1 - nu**2) * force / (np.pi * E)
    error = float(np.abs(-got[seen, 2] * away[seen] / wanted - 1).max())
    at_most(record_property, f"{what}, worst skin node, relative", error, 0.02)
    inside = (away > 2.0) & ~outer
    error = float(
        (np.linalg.norm(got - exact, axis=1) / np.linalg.norm(exact, axis=1))[inside].max()
    )
    at_most(record_property, f"{what}, worst node inside, relative", error, 0.03)


RADIUS, NU = 10.0, 0.3
HALF_WIDTH = 12.0
DEPTHS = (0.2, 0.4)
SHIPPED = (newton.PENALTY_RATIO, newton.ROUNDING_RATIO)
HARD = (10 * newton.PENALTY_RATIO, newton.ROUNDING_RATIO / 10)


@dataclass(frozen=True, slots=True)
class Touch:
    """Results of a light contact: force, radius of the contact by the pressure's second moment, and
    indentation below the finger, absolute and relative to that at the distance `away`."""

    depth: float
    force: float
    patch: float
    sunk: float
    relative: float
    away: float


@cache
def touches(penalty: tuple[float, float]) -> list[Touch]:
    """Press a sphere lightly into a block by Newton's method, with a contact penalty of this
    stiffness."""
    nodes, elements = half_space(
        half_width=HALF_WIDTH, smallest=0.75, fine_radius=1.5, growth=0.9, whole=True
    )
    faces = boundary_faces(elements)
    top = faces[(nodes[faces, 2] == 0.0).all(axis=1)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(newton, "PENALTY_RATIO", penalty[0])
        patch.setattr(newton, "ROUNDING_RATIO", penalty[1])
        body = newton.NeoHookeanBody(
            nodes,
            elements,
            (np.abs(nodes[:, :2]) == HALF_WIDTH).any(axis=1) | (nodes[:, 2] == -HALF_WIDTH),
            top[(np.linalg.norm(nodes[top], axis=2) < 4.0).all(axis=1)],
            young_modulus_pa=E,
            poisson_ratio=NU,
            finger_radius_m=RADIUS,
            tolerance=1e-6,
        )
    surface = np.flatnonzero(nodes[:, 2] == 0.0)
    r = np.linalg.norm(nodes[surface, :2], axis=1)
    ring = (r > 4.0) & (r < 6.0)
    found = []
    centres = [np.array([0.0, 0.0, RADIUS - depth]) for depth in (0.0, *DEPTHS)]
    for depth, state in zip(DEPTHS, list(body.solve_load_steps(centres))[1:], strict=True):
        assert state.reached
        positions = nodes + state.displacement
        push = body.obstacle.forces(positions, state.centre)[surface, 2]
        down = -state.displacement[surface, 2]
        found.append(
            Touch(
                depth=depth,
                force=float(state.force_n[2]),
                patch=float(np.sqrt(2.5 * (push * r**2).sum() / push.sum())),
                sunk=float(down[np.argmin(r)]),
                relative=float(down[np.argmin(r)] - down[ring].mean()),
                away=float(r[ring].mean()),
            )
        )
    return found


def sunk_at(r: float, patch: float, force: float) -> float:
    """Return the displacement of the surface outside the contact by Hertz's theory."""
    pressure = 3 * force / (2 * np.pi * patch**2)
    share = patch / r
    bend = (2 * patch**2 - r**2) * np.arcsin(share) + r * patch * np.sqrt(1 - share**2)
    return float((1 - NU**2) / E * pressure / (2 * patch) * bend)


@pytest.mark.long
@pytest.mark.parametrize(
    ("penalty", "name", "off"),
    [pytest.param(HARD, "hard", 0.04, marks=pytest.mark.long), (SHIPPED, "own", 0.1)],
)
def test_light_pushes_follow_hertz(
    record_property: Record, penalty: tuple[float, float], name: str, off: float
) -> None:
    """The test compares the radius of the contact and the indentation for a given force, and the
    exponent 3/2. The indentation is relative to the skin some radii away, which is independent of
    the block's boundaries. With a penalty ten times as stiff as the solver's, the result is nearly
    Hertz's; with the solver's, the contact is wider by the penetration.

    Source: Hertz 1882; Johnson, Contact Mechanics, 1985, eqs. 3.42, 4.22-4.24
    """
    modulus = E / (1 - NU**2)
    found = touches(penalty)
    for contact_nodes in found:
        what = f"Hertz, depth {contact_nodes.depth / RADIUS:g} R, {name} bed"
        patch = (0.75 * contact_nodes.force * RADIUS / modulus) ** (1 / 3)
        near(
            record_property,
            f"{what}, patch radius / R",
            contact_nodes.patch / RADIUS,
            patch / RADIUS,
            off,
        )
        wanted = patch**2 / RADIUS - sunk_at(contact_nodes.away, patch, contact_nodes.force)
        near(
            record_property,
            f"{what}, sinking / R",
            contact_nodes.relative / RADIUS,
            wanted / RADIUS,
            off,
        )
    sunk = [
        contact_nodes.relative
        + sunk_at(contact_nodes.away, contact_nodes.patch, contact_nodes.force)
        for contact_nodes in found
    ]
    power = np.log(found[1].force / found[0].force) / np.log(sunk[1] / sunk[0])
    between(record_property, f"Hertz, power of force, {name} bed", float(power), 1.45, 1.55)


@pytest.mark.long
def test_what_the_bed_costs_is_known(record_property: Record) -> None:
    """With the solver's penalty, the skin penetrates the finger by less than a hundredth of its
    radius. For a light contact this is significant, and reduces the force at the same depth.

    Source: the bed's own law, nodes/fem_solver/newton.py, against the bed ten times as hard
    """
    for own, hard in zip(touches(SHIPPED), touches(HARD), strict=True):
        what = f"own bed at depth {own.depth / RADIUS:g} R"
        entered = (own.depth - own.sunk) / RADIUS
        between(record_property, f"{what}, skin inside the finger / R", entered, 0.0, 0.01)
        between(
            record_property, f"{what}, force over hard bed's", own.force / hard.force, 0.85, 1.0
        )
