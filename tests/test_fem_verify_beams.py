"""Verify cantilevers and Cook's membrane against elasticity theory and published values."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import ellipk, ellipkinc

from flexsheet.nodes.fem_solver.hyperelastic import NeoHookeanSolid
from flexsheet.nodes.fem_solver.mesh.solid import boundary_faces
from tests.examples import long_except
from tests.fem_fields import dofs_of, equilibrium, lame, relative_errors, surface_loads
from tests.fem_verification import Record, at_most, between, near
from tests.linear_elasticity import solve, stiffness_matrix
from tests.solids import box, bricks

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

LENGTH, HALF = 8.0, 1.0
E, NU, FORCE = 1000.0, 0.3, 1.0


def faces_where(nodes: Floats, elements: Ints, there: NDArray[np.bool_]) -> Ints:
    faces = boundary_faces(elements)
    return faces[there[faces].all(axis=1)]


def plane_cantilever(points: Floats) -> Floats:
    """Return the displacement (k, 3) in plane strain under the end shear `FORCE` per width, along
    x."""
    x, y = points[:, 0], points[:, 1]
    e, nu = E / (1 - NU**2), NU / (1 - NU)
    inertia = 2 * HALF**3 / 3
    u = -FORCE * y / (6 * e * inertia) * ((6 * LENGTH - 3 * x) * x + (2 + nu) * (y**2 - HALF**2))
    v = (
        FORCE
        / (6 * e * inertia)
        * (3 * nu * y**2 * (LENGTH - x) + (4 + 5 * nu) * HALF**2 * x + (3 * LENGTH - x) * x**2)
    )
    return np.column_stack([u, v, np.zeros(len(points))])


def plane_cantilever_slope(points: Floats) -> Floats:
    """Return the gradient (k, 3, 3) of `plane_cantilever`."""
    x, y = points[:, 0], points[:, 1]
    e, nu = E / (1 - NU**2), NU / (1 - NU)
    f = FORCE / (6 * e * 2 * HALF**3 / 3)
    slope = np.zeros((len(points), 3, 3))
    slope[:, 0, 0] = -f * y * (6 * LENGTH - 6 * x)
    slope[:, 0, 1] = -f * ((6 * LENGTH - 3 * x) * x + (2 + nu) * (3 * y**2 - HALF**2))
    slope[:, 1, 0] = f * (-3 * nu * y**2 + (4 + 5 * nu) * HALF**2 + 6 * LENGTH * x - 3 * x**2)
    slope[:, 1, 1] = f * 6 * nu * y * (LENGTH - x)
    return slope


def test_plane_cantilever_with_end_shear(record_property: Record) -> None:
    """A beam in plane strain has the theoretical displacement at its root and parabolic shear at
    its end. The cubic displacement is approximated by quadratic elements.

    Source: Timoshenko & Goodier, Theory of Elasticity, 3rd ed., art. 21; in this form Augarde &
    Deeks, Finite Elem. Anal. Des. 44, 2008, eqs. 1-5
    """
    nodes, elements = bricks(
        np.linspace(0, LENGTH, 13), np.linspace(-HALF, HALF, 5), np.linspace(0, 0.5, 2)
    )
    end = faces_where(nodes, elements, np.isclose(nodes[:, 0], LENGTH))

    def shear(points: Floats, _: Floats) -> Floats:
        pull = np.zeros_like(points)
        pull[:, 1] = 0.75 * FORCE / HALF**3 * (HALF**2 - points[:, 1] ** 2)
        return pull

    loads = surface_loads(nodes, end, shear)
    exact = plane_cantilever(nodes)
    root = dofs_of(np.flatnonzero(nodes[:, 0] == 0.0))
    held = np.union1d(root, 3 * np.arange(len(nodes)) + 2)
    matrix = stiffness_matrix(nodes, elements, young_modulus_pa=E, poisson_ratio=NU)
    got = solve(matrix, held, exact.ravel()[held], loads).reshape(-1, 3)
    tip = np.flatnonzero(np.isclose(nodes[:, 0], LENGTH) & np.isclose(nodes[:, 1], 0.0))
    ratio = float(got[tip, 1].mean() / exact[tip, 1].mean())
    near(record_property, "plane cantilever L/h = 4, tip over the exact one", ratio, 1.0, 1e-3)
    l2, energy = relative_errors(
        (nodes, elements), got, plane_cantilever, plane_cantilever_slope, lame(E, NU)
    )
    at_most(record_property, "plane cantilever, displacement error in L2", l2, 1e-3)
    at_most(record_property, "plane cantilever, error in energy norm", energy, 0.02)


def test_slender_cantilever_with_end_shear(record_property: Record) -> None:
    """A square bar in space is clamped at its root, with shear on its end. The clamp prevents
    lateral contraction, which beam theory neglects, so that the bar is slightly stiffer.

    Source: Timoshenko beam, P L^3 / (3 E I) + P L / (k G A), with k = 10 (1 + nu) / (12 + 11 nu):
    Cowper, J. Appl. Mech. 33, 1966
    """
    length, side, nu = 10.0, 1.0, 0.3
    nodes, elements = box((20, 2, 2), (length, side, side))
    end = faces_where(nodes, elements, np.isclose(nodes[:, 0], length))
    loads = surface_loads(nodes, end, lambda p, _: np.broadcast_to([0, 0, FORCE], p.shape))
    root = dofs_of(np.flatnonzero(nodes[:, 0] == 0.0))
    matrix = stiffness_matrix(nodes, elements, young_modulus_pa=E, poisson_ratio=nu)
    got = solve(matrix, root, np.zeros(len(root)), loads).reshape(-1, 3)
    tip = got[np.isclose(nodes[:, 0], length), 2].mean()
    shear = 10 * (1 + nu) / (12 + 11 * nu) * E / (2 * (1 + nu)) * side**2
    theory = FORCE * (length**3 / (3 * E * side**4 / 12) + length / shear)
    what = "clamped bar L/h = 10, tip over Timoshenko's"
    between(record_property, what, float(tip / theory), 0.985, 1.0)


def elastica(load: float) -> tuple[float, float]:
    """Return the tip (across, along) of a cantilever of unit length under the end load `load` E I.

    With p the modulus of the elliptic integrals and phi their amplitude at the root, K(p) - F(phi,
    p) = sqrt(load), sin phi = 1 / (p sqrt 2).
    """
    from scipy.optimize import brentq
    from scipy.special import ellipe, ellipeinc

    def excess(p: float) -> float:
        phi = np.arcsin(1 / (p * np.sqrt(2)))
        return float(ellipk(p * p) - ellipkinc(phi, p * p) - np.sqrt(load))

    p = brentq(excess, np.sqrt(0.5) + 1e-12, 1 - 1e-12)
    phi = np.arcsin(1 / (p * np.sqrt(2)))
    across = 1 - 2 / np.sqrt(load) * (ellipe(p * p) - ellipeinc(phi, p * p))
    return float(across), float(1 - np.sqrt(2 / load) * np.sqrt(2 * p * p - 1))


@pytest.mark.parametrize(("load", "across", "along"), [(2.0, 0.49346, 0.16064)])
def test_cantilever_bent_far(
    record_property: Record, load: float, across: float, along: float
) -> None:
    """A slender neo-Hookean bar is bent by half its length. It stretches slightly, unlike the
    elastica.

    Source: elastica, Bisshopp & Drucker, Quart. Appl. Math. 3, 1945; the tip's places as tabulated
    by Mattiasson, Int. J. Numer. Meth. Eng. 17, 1981
    """
    assert elastica(load) == pytest.approx((across, along), abs=1e-5)
    length, side = 40.0, 1.0
    nodes, elements = box((40, 1, 1), (length, side, side))
    solid = NeoHookeanSolid(nodes, elements, young_modulus_pa=E, poisson_ratio=0.0)
    end = faces_where(nodes, elements, np.isclose(nodes[:, 0], length))
    force = load * E * side**4 / 12 / length**2
    loads = surface_loads(nodes, end, lambda p, _: np.broadcast_to([0, 0, force], p.shape))
    root = dofs_of(np.flatnonzero(nodes[:, 0] == 0.0))
    got = equilibrium(solid, root, np.zeros(len(root)), loads, steps=8)
    tip = got[np.isclose(nodes[:, 0], length)].mean(axis=0) / length
    near(record_property, f"elastica, P L²/EI = {load:g}, across / L", float(tip[2]), across, 0.002)
    near(record_property, f"elastica, P L²/EI = {load:g}, along / L", float(-tip[0]), along, 0.002)


def cook(divisions: int) -> tuple[Floats, Ints]:
    """Return Cook's tapered panel as a slab of one layer: 48 wide, 44 high at the root, 16 at the
    end."""
    nodes, elements = box((divisions, divisions, 1), (1.0, 1.0, 1.0))
    s, t, z = nodes.T
    thick = 48.0 / divisions
    return np.column_stack([48 * s, 44 * s + t * (44 - 28 * s), thick * z]), elements


def cook_supports(nodes: Floats) -> Ints:
    """Return the supports: clamped root, no displacement across the panel (plane strain)."""
    root = dofs_of(np.flatnonzero(nodes[:, 0] == 0.0))
    return np.union1d(root, 3 * np.arange(len(nodes)) + 2)


def cook_loads(nodes: Floats, elements: Ints, force: float) -> Floats:
    """Return the loads of a uniform shear on the end, `force` per unit of thickness."""
    end = faces_where(nodes, elements, np.isclose(nodes[:, 0], 48.0))
    return surface_loads(nodes, end, lambda p, _: np.broadcast_to([0, force / 16, 0], p.shape))


def height(nodes: Floats, displacement: Floats, y: float) -> float:
    """Return the rise of the end at the height y."""
    there = np.isclose(nodes[:, 0], 48.0) & np.isclose(nodes[:, 1], y)
    return float(displacement[there, 1].mean())


def cook_tip(divisions: int, e: float, nu: float) -> float:
    """Return the linear rise at the middle of the end under unit force."""
    nodes, elements = cook(divisions)
    matrix = stiffness_matrix(nodes, elements, young_modulus_pa=e, poisson_ratio=nu)
    held = cook_supports(nodes)
    loads = cook_loads(nodes, elements, 1.0)
    got = solve(matrix, held, np.zeros(len(held)), loads).reshape(-1, 3)
    return height(nodes, got, 52.0)


@cache
def cook_mixed_tip(nu: float) -> float:
    """Return the rise by scikit-fem in the plane, with Taylor-Hood elements, which do not lock;
    shear modulus 3/8."""
    import skfem
    from scipy.sparse import bmat
    from skfem.helpers import ddot, div, sym_grad

    mesh = skfem.MeshTri.init_tensor(np.linspace(0, 1, 41), np.linspace(0, 1, 41))
    s, t = mesh.p
    mesh = skfem.MeshTri(np.array([48 * s, 44 * s + t * (44 - 28 * s)]), mesh.t)
    mesh = mesh.with_boundaries({"root": lambda x: x[0] < 1e-6, "end": lambda x: x[0] > 48 - 1e-6})
    motion = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementTriP2()), intorder=4)
    pressure = motion.with_element(skfem.ElementTriP1())
    mu = 0.375
    lam = 2 * mu * nu / (1 - 2 * nu)

    @skfem.BilinearForm
    def shear(u: Any, v: Any, _: Any) -> Any:
        return 2 * mu * ddot(sym_grad(u), sym_grad(v))

    @skfem.BilinearForm
    def volume(u: Any, q: Any, _: Any) -> Any:
        return div(u) * q

    @skfem.BilinearForm
    def bulk(p: Any, q: Any, _: Any) -> Any:
        return p * q / lam

    @skfem.LinearForm
    def end(v: Any, _: Any) -> Any:
        return v[1] / 16

    b = volume.assemble(motion, pressure)
    matrix = bmat([[shear.assemble(motion), b.T], [b, -bulk.assemble(pressure)]], "csr")
    facets = skfem.FacetBasis(mesh, motion.elem, facets="end")
    right = np.concatenate([end.assemble(facets), np.zeros(pressure.N)])
    held = motion.get_dofs("root").all()
    found = skfem.solve(*skfem.condense(matrix, right, D=held))
    middle = np.flatnonzero(np.isclose(motion.doflocs, [[48.0], [52.0]]).all(axis=0))
    return float(found[middle[1]])


def test_cooks_membrane(record_property: Record) -> None:
    """The published value for plane stress is that of plane strain with E (1 + 2 nu) / (1 + nu)^2
    and nu / (1 + nu).

    Source: Cook, J. Struct. Div. ASCE 100, 1974; converged value 23.96 (E = 1, nu = 1/3, plane
    stress): Cook, Malkus & Plesha, Concepts and Applications of FEA, 3rd ed., 1989, sec. 6.13
    """
    nu = 1.0 / 3.0
    tip = cook_tip(10, (1 + 2 * nu) / (1 + nu) ** 2, nu / (1 + nu))
    near(record_property, "Cook's membrane, compressible, 10 × 10 × 6 elements", tip, 23.96, 0.005)


def test_cooks_membrane_nearly_incompressible(record_property: Record) -> None:
    """At nu = 0.4999, displacement elements lock: they are too stiff, and converge from below.
    scikit-fem with a pressure field does not lock, and confirms the published value.

    Source: 16.4326 (lambda = 7500, mu = 0.375, Richardson-extrapolated), Krysl, FinEALE's example
    Cook_3D_strain_T10
    """
    published, nu = 16.4326, 0.4999
    tips = [cook_tip(divisions, 0.75 * (1 + nu), nu) for divisions in (4, 8, 12)]
    assert tips[0] < tips[1] < tips[2] < published
    for divisions, tip, low in zip((4, 8, 12), tips, (0.72, 0.92, 0.96), strict=True):
        what = (
            f"Cook's membrane, ν = 0.4999, {divisions} × {divisions} × 6 elements, over published"
        )
        between(record_property, what, tip / published, low, 1.0)
    what = "Cook's membrane, ν = 0.4999, scikit-fem with a pressure field, 40 × 40"
    near(record_property, what, cook_mixed_tip(nu), published, 0.005)


@pytest.mark.parametrize(
    ("nu", "low"),
    long_except([(0.3, 0.99), (0.45, 0.985), (0.49, 0.97), (0.499, 0.965)], (0.499, 0.965)),
)
def test_locking_grows_towards_incompressibility(
    record_property: Record, nu: float, low: float
) -> None:
    """The bending stiffness for nu towards 0.5 is compared with scikit-fem's mixed elements on the
    same mesh, which do not lock.

    Source: Taylor & Hood, Comput. Fluids 1, 1973, by scikit-fem
    """
    tip = cook_tip(12, 0.75 * (1 + nu), nu)
    what = f"Cook's membrane, 12 × 12 × 6 elements, over mixed ones, ν = {nu:g}"
    between(record_property, what, tip / cook_mixed_tip(nu), low, 1.0)


@pytest.mark.long
def test_cooks_membrane_at_large_strain(record_property: Record) -> None:
    """A neo-Hookean panel with nu = 0.4999, whose corner rises by 40 % of the end's height, locks
    like the linear one.

    Source: rise of the upper corner 6.9083 (E = 240.565, nu = 0.4999, load 100; 128 x 128 mesh):
    Elguedj, Bazilevs, Calo & Hughes, Comput. Methods Appl. Mech. Eng. 197, 2008
    """
    tips = []
    for divisions in (4, 6):
        nodes, elements = cook(divisions)
        solid = NeoHookeanSolid(nodes, elements, young_modulus_pa=240.565, poisson_ratio=0.4999)
        held = cook_supports(nodes)
        loads = cook_loads(nodes, elements, 100.0)
        got = equilibrium(solid, held, np.zeros(len(held)), loads, steps=10)
        tips.append(height(nodes, got, 60.0) / 6.9083)
    what = "Cook's membrane, large strain, ν = 0.4999, over published, elements"
    between(record_property, f"{what} 4 × 4 × 6", tips[0], 0.7, 0.8)
    between(record_property, f"{what} 6 × 6 × 6", tips[1], 0.84, 1.0)
