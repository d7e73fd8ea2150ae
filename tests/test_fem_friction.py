"""Test a sticking finger that drags the skin, and slips above the friction limit."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray

from flexsheet.nodes.cache import load_cached, save_cached
from flexsheet.nodes.fem_solver.closest_contact import (
    ContactAnchor,
    ContactQuery,
    locate_sticking,
    slide_anchor,
)
from flexsheet.nodes.fem_solver.contact import LinearSoftBody
from flexsheet.nodes.fem_solver.elasticity import degrees_of_freedom
from flexsheet.nodes.fem_solver.mesh.from_scene import build_mesh
from flexsheet.nodes.fem_solver.precompute import (
    SoftBodyModel,
    compute,
    make_tangents,
    response_cache,
)
from flexsheet.nodes.models.shapes import CylinderShape
from tests.linear_elasticity import solve, stiffness_matrix
from tests.soft_bodies import cylinder_spec

Floats = NDArray[np.float64]

RADIUS, LENGTH, FINGER, MODULUS = 0.02, 0.06, 0.007, 4000.0
SPEC = cylinder_spec(RADIUS, LENGTH, touch_angle_rad=1.2, skin_spacing_m=0.005, sticking=True)
SHAPE = CylinderShape(RADIUS, LENGTH)
UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def model() -> SoftBodyModel:
    return compute(SPEC, lambda done, total, need: None)


@pytest.fixture(scope="module")
def body(model: SoftBodyModel) -> LinearSoftBody:
    return LinearSoftBody(
        model.response,
        SHAPE,
        model.response.rest[model.bounds],
        young_modulus_pa=MODULUS,
        finger_radius_m=FINGER,
        linear_depth_m=0.006,
        max_depth_m=0.010,
        drag=model.drag,
    )


def push(
    depth: float, drag: tuple[float, float, float] = (0.0, 0.0, 0.0), x: float = 0.0
) -> ContactQuery:
    return ContactQuery(RADIUS * UP + [x, 0.0, 0.0], UP, depth, 0.0, np.array(drag))


def test_each_column_is_the_solution_under_its_load(model: SoftBodyModel) -> None:
    mesh = build_mesh(SPEC.mesh)
    assert model.drag is not None
    matrix = stiffness_matrix(mesh.nodes, mesh.elements, young_modulus_pa=1.0, poisson_ratio=0.45)
    held = degrees_of_freedom(np.flatnonzero(mesh.fixed))
    for node, which in ((0, 0), (len(mesh.contact_nodes) // 2, 1)):
        loads = np.zeros(matrix.shape[0])
        loads[degrees_of_freedom(mesh.contact_nodes[[node]])] = model.drag.tangents[node, which]
        wanted = solve(matrix, held, np.zeros(len(held)), loads).reshape(-1, 3)
        got = model.drag.influence[2 * node + which].reshape(-1, 3)
        assert np.abs(got - wanted[mesh.skin]).max() < 1e-6 * np.abs(wanted).max()
        along = np.einsum("mi,mpi->mp", wanted[mesh.contact_nodes], model.drag.tangents).ravel()
        assert model.drag.compliance[2 * node + which] == pytest.approx(along, rel=1e-7)


def test_tangents_are_at_right_angles() -> None:
    normals = np.random.default_rng(2).normal(size=(50, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    frames = np.concatenate([normals[:, None], make_tangents(normals)], axis=1)
    assert frames @ frames.transpose(0, 2, 1) == pytest.approx(np.tile(np.eye(3), (50, 1, 1)))


def test_a_sticking_finger_drags_the_skin_beneath_it(
    body: LinearSoftBody, model: SoftBodyModel
) -> None:
    straight, aside = body.respond(push(0.004)), body.respond(push(0.004, (0.002, 0.0, 0.0)))
    below = np.linalg.norm(model.response.rest - RADIUS * UP, axis=1) < 0.003
    dragged = (aside.displacement - straight.displacement)[below, 0]
    assert dragged.mean() == pytest.approx(0.002, rel=0.15)
    # the skin pulls it back
    assert aside.force_n[0] < -0.1 * straight.force_n[2]
    assert aside.force_n[2] == pytest.approx(straight.force_n[2], rel=0.1)
    assert np.abs(straight.force_n[:2]).max() < 0.05 * straight.force_n[2]


def test_the_friction_force_is_proportional_to_the_drag(body: LinearSoftBody) -> None:
    straight = body.respond(push(0.004)).force_n
    once = body.respond(push(0.004, (0.001, 0.0005, 0.0))).force_n - straight
    twice = body.respond(push(0.004, (0.002, 0.001, 0.0))).force_n - straight
    assert twice == pytest.approx(2.0 * once, rel=1e-6)


def test_sticking_is_smooth_in_depth_and_drag(body: LinearSoftBody) -> None:
    """Push downwards and sideways at the same time, from the first contact."""
    way = np.linspace(0.0, 0.006, 400)
    answers = [body.respond(push(d, (0.5 * d, 0.0, 0.0))) for d in way]
    moves = [
        np.linalg.norm(a.displacement - b.displacement, axis=1).max()
        for a, b in itertools.pairwise(answers)
    ]
    assert max(moves) < 0.06e-3
    pulls = np.array([answer.force_n[0] for answer in answers])
    assert np.abs(np.diff(pulls)).max() < 0.02 * np.abs(pulls).max()


def test_the_position_of_first_touch_stays_until_the_finger_lifts() -> None:
    contact_nodes, held = locate_sticking(SHAPE, np.array([0.001, 0.0, RADIUS - 1e-4]), None)
    assert contact_nodes.drag_m is None
    there, held = locate_sticking(SHAPE, np.array([0.003, 0.001, RADIUS - 0.004]), held)
    assert there.surface == pytest.approx([0.001, 0.0, RADIUS])
    assert there.drag_m == pytest.approx([0.002, 0.001, 0.0])
    assert there.depth_m == pytest.approx(0.004)
    away, held = locate_sticking(SHAPE, np.array([0.003, 0.001, RADIUS + 0.01]), held)
    assert held is None
    assert away.depth_m < 0.0
    again, held = locate_sticking(SHAPE, np.array([0.005, 0.0, RADIUS - 0.001]), held)
    assert again.surface[0] == pytest.approx(0.005)


def test_slipping_leaves_the_drag_that_friction_holds() -> None:
    held = ContactAnchor(RADIUS * UP, UP)
    after = slide_anchor(SHAPE, held, np.array([0.004, 0.0, 0.0]), 0.25)
    assert after.point == pytest.approx([0.003, 0.0, RADIUS])
    around = slide_anchor(SHAPE, held, np.array([0.0, 0.004, 0.0]), 0.25)
    assert np.linalg.norm(around.point[1:]) == pytest.approx(RADIUS)


def test_what_drags_is_kept_with_the_model(
    model: SoftBodyModel, tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("drag")
    save_cached(response_cache(SPEC), folder, model)
    kept = load_cached(response_cache(SPEC), folder)
    assert kept is not None
    assert kept.drag is not None
    assert model.drag is not None
    assert np.array_equal(kept.drag.influence, model.drag.influence)
    assert np.array_equal(kept.drag.tangents, model.drag.tangents)
