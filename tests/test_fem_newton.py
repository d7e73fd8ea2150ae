"""Test Newton's method for a pushed body: equilibrium, smoothness, and no inverted elements."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from flexsheet.nodes.fem_solver.mesh.solid import boundary_faces
from flexsheet.nodes.fem_solver.newton import (
    EquilibriumState,
    FingerObstacle,
    NeoHookeanBody,
    NewtonNotConvergedError,
)
from flexsheet.nodes.fem_solver.snapshots import SamplePoint, SnapshotJob, solve_snapshot
from tests.solids import box

Floats = NDArray[np.float64]

MODULUS, NU, FINGER = 4000.0, 0.45, 0.007
SIDE, HEIGHT = 0.03, 0.012


def pad(
    divisions: tuple[int, int, int] = (5, 5, 2),
    factor_dtype: type[np.float32 | np.float64] = np.float64,
) -> NeoHookeanBody:
    """Return a block of 30 x 30 x 12 mm, fixed at its bottom, with its top at z = 0."""
    nodes, elements = box(divisions, (SIDE, SIDE, HEIGHT))
    nodes = nodes - [0.5 * SIDE, 0.5 * SIDE, HEIGHT]
    faces = boundary_faces(elements)
    return NeoHookeanBody(
        nodes,
        elements,
        np.isclose(nodes[:, 2], -HEIGHT),
        faces[np.isclose(nodes[faces, 2], 0.0).all(axis=1)],
        young_modulus_pa=MODULUS,
        poisson_ratio=NU,
        finger_radius_m=FINGER,
        factor_dtype=factor_dtype,
    )


def centre(depth: float, x: float = 0.0012, y: float = 0.0007) -> Floats:
    return np.array([x, y, FINGER - depth])


def press(body: NeoHookeanBody, *centres: Floats) -> list[EquilibriumState]:
    return list(body.solve_load_steps(centres))


@pytest.fixture(scope="module")
def body() -> NeoHookeanBody:
    return pad()


@pytest.fixture(scope="module")
def pressed(body: NeoHookeanBody) -> EquilibriumState:
    return press(body, centre(0.0), centre(0.004))[-1]


def test_the_body_is_in_balance_with_the_finger(
    body: NeoHookeanBody, pressed: EquilibriumState
) -> None:
    assert pressed.reached
    inner = body.solid.forces(pressed.displacement)
    outer = body.obstacle.forces(body.solid.nodes + pressed.displacement, pressed.centre)
    free = ~body.fixed
    assert np.abs((inner + outer)[free]).max() < 1e-7 * np.abs(outer).max()
    # what the finger pushes, the ground takes
    assert inner[body.fixed].sum(axis=0) == pytest.approx(pressed.force_n * [1, 1, 1], rel=1e-5)
    assert not pressed.displacement[body.fixed].any()
    assert pressed.force_n[2] > 0.0
    assert 0.3 < pressed.min_volume_ratio < 1.0


def test_no_point_of_the_skin_is_inside_the_finger(
    body: NeoHookeanBody, pressed: EquilibriumState
) -> None:
    _, depth, _, _ = body.obstacle.inside(body.solid.nodes + pressed.displacement, pressed.centre)
    assert len(depth) > 10
    assert 0.0 < depth.max() < 0.02 * FINGER


def test_the_force_is_the_energys_derivative_along_the_finger(body: NeoHookeanBody) -> None:
    """Compare the force with the derivative of the minimum energy by the position of the finger."""
    step = 1e-5
    states = press(body, centre(0.0), centre(0.003 - step), centre(0.003), centre(0.003 + step))

    def energy(state: EquilibriumState) -> float:
        positions = body.solid.nodes + state.displacement
        return body.solid.energy(state.displacement) + body.obstacle.energy(positions, state.centre)

    slope = (energy(states[3]) - energy(states[1])) / (2 * step)
    assert states[2].force_n[2] == pytest.approx(slope, rel=1e-4)


def test_the_shaft_of_a_capsule_presses_like_a_cylinder() -> None:
    nodes, elements = box((3, 3, 2), (SIDE, SIDE, HEIGHT))
    faces = boundary_faces(elements)
    given: dict[str, Any] = {"modulus_pa": MODULUS, "radius_m": FINGER}
    axis = np.array([0.6, 0.0, 0.8])
    capsule = FingerObstacle(nodes, elements, faces, axis=axis, **given)
    sphere = FingerObstacle(nodes, elements, faces, **given)
    # The whole shaft is inside the block, and the tip is below it.
    tip = np.array([0.45 * SIDE, 0.5 * SIDE, -0.5 * FINGER])
    inner, depth, normals, away = capsule.inside(nodes, tip)
    along = (capsule.points(nodes)[inner] - tip) @ axis
    shaft = along > FINGER
    assert shaft.sum() > 10
    assert np.abs(normals[shaft] @ axis).max() < 1e-12
    assert depth + away == pytest.approx(FINGER)
    assert len(sphere.inside(nodes, tip)[0]) < len(inner)

    direction = np.random.default_rng(0).normal(size=nodes.shape)
    step = 1e-8 * direction
    change = capsule.energy(nodes + step, tip) - capsule.energy(nodes - step, tip)
    forces = capsule.forces(nodes, tip)
    assert change == pytest.approx(2.0 * (forces * step).sum(), rel=1e-4)
    matrices = np.zeros((len(elements), 30, 30))
    capsule.add_tangents(matrices, nodes, tip, geometric_stiffness_weight=1.0)
    local = direction[elements].reshape(len(elements), 30, 1)
    curvature = float((local.transpose(0, 2, 1) @ matrices @ local).sum())
    bent = capsule.forces(nodes + step, tip) - capsule.forces(nodes - step, tip)
    assert curvature == pytest.approx((bent * direction).sum() / 2e-8, rel=1e-4)


def test_without_friction_the_result_is_independent_of_the_path(
    body: NeoHookeanBody, pressed: EquilibriumState
) -> None:
    aside = press(body, centre(0.0, x=-0.004), centre(0.003, x=-0.004, y=0.003), centre(0.004))[-1]
    deeper = press(body, centre(0.0), centre(0.006), centre(0.004))[-1]
    for other in (aside, deeper):
        assert np.abs(other.displacement - pressed.displacement).max() < 1e-7
        assert other.force_n == pytest.approx(pressed.force_n, abs=1e-5 * pressed.force_n[2])


def test_the_answer_is_smooth_in_the_fingers_position(body: NeoHookeanBody) -> None:
    """The contact energy is twice differentiable, so small steps cause small changes."""
    step = 4e-5
    places = [centre(0.003, x=-0.0004 + step * i) for i in range(13)]
    states = press(body, centre(0.0, x=-0.0004), *places)[1:]
    forces = np.array([state.force_n for state in states])
    moves = np.diff([state.displacement for state in states], axis=0)
    assert np.linalg.norm(moves, axis=2).max() < 2.0 * step
    assert np.abs(np.diff(forces[:, 2])).max() < 0.01 * forces[:, 2].mean()
    assert np.abs(np.diff(forces[:, 2], 2)).max() < 0.002 * forces[:, 2].mean()


def test_factors_of_single_precision_lead_to_the_same_balance(
    body: NeoHookeanBody, pressed: EquilibriumState
) -> None:
    """The precision of the factors affects only the search direction."""
    coarse = pad(factor_dtype=np.float32)
    quick = press(coarse, centre(0.0), pressed.centre)[-1]
    assert quick.reached
    largest = np.abs(pressed.displacement).max()
    assert np.abs(quick.displacement - pressed.displacement).max() < 1e-6 * largest
    assert np.allclose(quick.force_n, pressed.force_n, rtol=1e-6, atol=1e-9)
    stiffness = body.solid.tangents(pressed.displacement)
    factors = body._order.factor(stiffness.astype(np.float32))
    assert {pivot.dtype for pivot in factors.diagonal} == {np.dtype(np.float32)}


def test_where_newton_does_not_settle_the_push_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    """Beyond the last converged depth, the last result is repeated and marked as not reached."""
    body = pad(divisions=(4, 4, 2))
    job = SnapshotJob(
        nodes=body.solid.nodes,
        elements=body.solid.elements,
        fixed=body.fixed,
        faces=body.obstacle._faces,
        sample=SamplePoint(centre(FINGER), np.array([0.0, 0.0, 1.0])),
        poisson_ratio=NU,
        finger_radius_m=FINGER,
        depths_m=(0.001, 0.002, 0.003, 0.004),
    )
    solve_equilibrium = NeoHookeanBody.solve_equilibrium

    def never_deeper(
        body: NeoHookeanBody, displacement: Floats, to: Floats, *rest: Any, **also: Any
    ) -> Any:
        if to[2] < FINGER - 0.0022:
            raise NewtonNotConvergedError("not settled")
        return solve_equilibrium(body, displacement, to, *rest, **also)

    monkeypatch.setattr(NeoHookeanBody, "solve_equilibrium", never_deeper)
    answer = solve_snapshot(job)
    assert answer.reached == 2
    assert answer.force_n[1] @ job.sample.normal > 0.0
    for held in (2, 3):
        assert np.array_equal(answer.moved[held], answer.moved[2])
    # it went as far as a quarter of a step leads, and no farther
    assert np.linalg.norm(answer.moved[2] - answer.moved[1], axis=1).max() < 0.0003


def test_a_finger_in_the_air_moves_nothing(body: NeoHookeanBody) -> None:
    state = press(body, centre(-0.01), centre(-1e-6))[-1]
    assert not state.displacement.any()
    assert not state.force_n.any()


def test_obstacle_tangent_is_the_derivative_of_its_forces() -> None:
    nodes, elements = box((1, 1, 1), (0.01, 0.01, 0.01))
    faces = boundary_faces(elements)
    obstacle = FingerObstacle(nodes, elements, faces, modulus_pa=MODULUS, radius_m=FINGER)
    there = np.array([0.003, 0.006, 0.0166])
    way = np.random.default_rng(5).normal(size=nodes.shape)
    matrices = np.zeros((len(elements), 30, 30))
    obstacle.add_tangents(matrices, nodes, there, geometric_stiffness_weight=1.0)
    dofs = (3 * elements[:, :, None] + np.arange(3)).reshape(-1, 30)
    forces_change = np.zeros(nodes.size)
    np.add.at(forces_change, dofs, np.einsum("eij,ej->ei", matrices, way.ravel()[dofs]))
    step = 1e-9
    ahead = obstacle.forces(nodes + step * way, there)
    behind = obstacle.forces(nodes - step * way, there)
    change = (ahead - behind).ravel() / (2 * step)
    assert len(obstacle.inside(nodes, there)[0]) > 3
    assert np.abs(forces_change - change).max() < 1e-5 * np.abs(change).max()
