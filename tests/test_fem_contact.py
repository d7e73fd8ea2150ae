"""Test the contact of the fingertip with the soft body: smoothness, uniqueness and bounds."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import minimize

from flexsheet.nodes.fem_solver.closest_contact import ContactAnchor, ContactQuery, locate
from flexsheet.nodes.fem_solver.contact import (
    LinearSoftBody,
    Response,
    SphereContact,
    sample_triangle,
    saturate_depth,
    solve_penalty_contact,
)
from flexsheet.nodes.fem_solver.precompute import SoftBodyModel, compute
from flexsheet.nodes.models.shapes import CylinderShape
from tests.examples import long_except
from tests.soft_bodies import cylinder_spec

Floats = NDArray[np.float64]

RADIUS, LENGTH, FINGER = 0.0353553, 0.12, 0.007
SPEC = cylinder_spec(RADIUS, LENGTH, touch_angle_rad=1.5, skin_spacing_m=0.006)
SHAPE = CylinderShape(RADIUS, LENGTH)


@pytest.fixture(scope="module")
def model() -> SoftBodyModel:
    return compute(SPEC, lambda done, total, need: None)


def soft_body(model: SoftBodyModel, modulus: float = 4000.0) -> LinearSoftBody:
    return LinearSoftBody(
        model.response,
        SHAPE,
        model.response.rest[model.bounds],
        young_modulus_pa=modulus,
        finger_radius_m=FINGER,
        linear_depth_m=0.006,
        max_depth_m=0.010,
    )


@pytest.fixture(scope="module")
def body(model: SoftBodyModel) -> LinearSoftBody:
    return soft_body(model)


def push(x: float, angle: float, depth: float) -> ContactQuery:
    normal = np.array([0.0, np.sin(angle), np.cos(angle)])
    point = (RADIUS - depth) * normal + np.array([x, 0.0, 0.0])
    beyond = max(0.0, abs(x) - 0.5 * LENGTH)
    return ContactQuery(point + depth * normal, normal, depth, beyond)


def largest_move(a: Response, b: Response) -> float:
    return float(np.linalg.norm(a.displacement - b.displacement, axis=1).max())


@pytest.mark.parametrize("depth", long_except([0.003, 0.006, 0.010, 0.03], 0.006, 0.03))
def test_a_slide_of_two_hundredths_of_a_millimetre_moves_no_skin_node_a_tenth(
    body: LinearSoftBody, depth: float
) -> None:
    answers = [
        body.respond(push(0.004 + 1.2e-5 * i, 0.1 + 1.6e-5 * i / RADIUS, depth)) for i in range(300)
    ]
    jumps = [largest_move(a, b) for a, b in itertools.pairwise(answers)]
    assert max(jumps) < 0.05e-3
    forces = np.array([np.linalg.norm(a.force_n) for a in answers])
    assert np.abs(np.diff(forces)).max() < 0.005 * forces.mean()
    assert np.ptp(forces) < 0.1 * forces.mean()


def test_the_answer_is_the_same_from_every_history(body: LinearSoftBody) -> None:
    there = push(0.007, 0.2, 0.004)
    first = body.respond(there)
    for depth in (0.0, 0.02, 0.004):
        body.respond(push(-0.02, -0.4, depth))
    again = body.respond(there)
    assert first.displacement.tobytes() == again.displacement.tobytes()
    assert first.force_n.tobytes() == again.force_n.tobytes()


def test_force_and_indentation_grow_from_zero_at_contact(body: LinearSoftBody) -> None:
    depths = np.concatenate([[-1e-3, -1e-6, 0.0], np.linspace(1e-6, 0.003, 200)])
    answers = [body.respond(push(0.004, 0.1, d)) for d in depths]
    forces = np.array([a.force_n @ push(0.004, 0.1, 0.0).normal for a in answers])
    assert forces[:4] == pytest.approx(0.0, abs=1e-9)
    assert (np.diff(forces) >= 0).all()
    # 0.015 mm a step: nowhere more than a sixth of a per cent of what 10 mm give
    assert np.diff(forces).max() < 1e-3
    moves = [largest_move(a, b) for a, b in itertools.pairwise(answers)]
    assert max(moves) < 0.03e-3


@given(x=st.floats(-0.04, 0.04), angle=st.floats(-1.0, 1.0))
@settings(max_examples=40, deadline=None)
def test_no_finger_falls_between_nodes(body: LinearSoftBody, x: float, angle: float) -> None:
    answer = body.respond(push(x, angle, 0.001))
    assert answer.in_range
    normal = push(x, angle, 0.0).normal
    # Hertz for E* = E / (1 - nu^2) and the mean curvature of both: 0.017 N at 1 mm
    assert 0.010 < answer.force_n @ normal < 0.05
    below = -(answer.displacement @ normal.astype(np.float32)).min()
    assert below > 0.4e-3


@pytest.mark.parametrize("depth", [0.002, 0.005])
def test_skin_under_the_finger_is_on_the_finger(
    body: LinearSoftBody, model: SoftBodyModel, depth: float
) -> None:
    where = push(0.004, 0.1, depth)
    moved = model.response.rest + body.respond(where).displacement
    centre = where.surface + (FINGER - depth) * where.normal
    inside = FINGER - np.linalg.norm(moved - centre, axis=1)
    assert inside.max() < 0.3e-3


def test_force_scales_with_the_modulus_and_the_indentation_does_not(model: SoftBodyModel) -> None:
    soft, hard = soft_body(model, 4000.0), soft_body(model, 40000.0)
    where = push(0.004, 0.1, 0.004)
    a, b = soft.respond(where), hard.respond(where)
    assert b.force_n == pytest.approx(10 * a.force_n, rel=1e-6)
    assert b.stiffness_n_per_m == pytest.approx(10 * a.stiffness_n_per_m, rel=1e-6)
    assert np.abs(a.displacement - b.displacement).max() < 1e-7


def test_the_stiffness_before_contact_is_that_of_the_push(
    body: LinearSoftBody,
) -> None:
    before = body.respond(push(0.004, 0.1, -0.05)).stiffness_n_per_m
    after = body.respond(push(0.004, 0.1, 0.006))
    assert before == pytest.approx(after.stiffness_n_per_m, rel=1e-9)
    assert np.linalg.norm(after.force_n) / 0.006 == pytest.approx(before, rel=0.05)
    assert 20.0 < before < 80.0
    along = [body.respond(push(1e-4 * i, 0.1, -0.01)).stiffness_n_per_m for i in range(300)]
    assert np.abs(np.diff(along)).max() < 0.01 * before


def test_deep_pushes_are_flagged_bounded_and_never_inverted(
    body: LinearSoftBody, model: SoftBodyModel
) -> None:
    rest = model.response.rest

    def normals(vertices: Floats) -> Floats:
        a, b, c = vertices[model.triangles].transpose(1, 0, 2)
        return np.cross(b - a, c - a)

    held = None
    last = 0.0
    for depth in np.linspace(0.0, 0.065, 66):  # straight in from the front and out behind the axis
        there, held = locate(SHAPE, np.array([0.004, 0.003, RADIUS - depth]), held)
        answer = body.respond(there)
        assert np.isfinite(answer.displacement).all()
        assert np.linalg.norm(answer.displacement, axis=1).max() < 0.0101
        alignments = np.einsum("ij,ij->i", normals(rest), normals(rest + answer.displacement))
        assert alignments.min() > 0.0
        assert answer.in_range == (answer.push_depth_m <= 0.006)
        force = float(np.linalg.norm(answer.force_n))
        assert last <= force < 10.0
        last = force
    assert last > 1.0


def test_saturation_has_no_kink() -> None:
    depths = np.linspace(-0.01, 0.1, 20001)
    bent = np.array([saturate_depth(d, 0.006, 0.010) for d in depths])
    slope = np.diff(bent) / np.diff(depths)
    assert (slope > 0).all()
    assert np.abs(np.diff(slope)).max() < 2e-3
    assert bent[0] == -0.01
    assert 0.0099 < bent[-1] < 0.010


@pytest.mark.parametrize(
    "point",
    [(0.0, 0.0, 0.0), (0.0, 0.0, 5.0), (3.0, 0.0, 0.0), (0.0, -1e-9, 1e-9), (0.0, 0.0, -0.04)],
)
def test_every_finite_position_has_an_answer(
    body: LinearSoftBody, point: tuple[float, float, float]
) -> None:
    where = np.array(point)
    there, _ = locate(SHAPE, where, None)
    assert np.linalg.norm(there.normal) == pytest.approx(1.0)
    answer = body.respond(there)
    assert np.isfinite(answer.displacement).all()
    assert np.isfinite(answer.force_n).all()
    assert answer.stiffness_n_per_m > 0.0


def test_a_position_that_is_not_finite_is_rejected() -> None:
    with pytest.raises(ValueError, match="not finite"):
        locate(SHAPE, np.array([0.0, np.nan, 0.0]), None)


def test_sliding_off_the_end_lets_go_without_a_jump(body: LinearSoftBody) -> None:
    answers = [body.respond(push(0.045 + 1e-4 * i, 0.1, 0.004)) for i in range(320)]
    moves = [largest_move(a, b) for a, b in itertools.pairwise(answers)]
    assert max(moves) < 0.4e-3  # for steps of 0.1 mm
    assert np.linalg.norm(answers[-1].force_n) == 0.0
    assert not any(a.in_range for a in answers[155:200])


def test_sliding_around_towards_the_support_lets_go_without_a_jump(body: LinearSoftBody) -> None:
    answers = [body.respond(push(0.004, 1.2 + 0.003 * i, 0.004)) for i in range(300)]
    moves = [largest_move(a, b) for a, b in itertools.pairwise(answers)]
    assert max(moves) < 0.4e-3  # for steps of 0.1 mm
    assert not answers[50].in_range
    assert np.linalg.norm(answers[-1].force_n) == 0.0


def test_a_finger_pushed_through_the_axis_keeps_its_side() -> None:
    first, held = locate(SHAPE, np.array([0.0, 0.01, 0.03]), None)
    assert first.normal == pytest.approx(np.array([0.0, 1.0, 3.0]) / np.sqrt(10))
    for point in ([0.0, 0.0, 0.0], [0.0, -0.003, -0.01], [0.0, -0.01, -0.03]):
        there, held = locate(SHAPE, np.array(point), held)
        assert there.normal == pytest.approx(first.normal)
        assert there.surface - there.depth_m * there.normal == pytest.approx(np.array(point))
    # once outside, the nearest side counts again
    outside, held = locate(SHAPE, np.array([0.0, 0.0, -0.05]), held)
    assert outside.normal[2] == -1.0
    assert held is None


@given(angle=st.floats(-1.4, 1.4), depth=st.floats(0.0, 0.02), x=st.floats(-0.05, 0.05))
def test_to_twenty_millimetres_the_contact_point_depends_on_the_finger_only(
    angle: float, depth: float, x: float
) -> None:
    normal = np.array([0.0, np.sin(angle), np.cos(angle)])
    point = (RADIUS - depth) * normal + np.array([x, 0.0, 0.0])
    fresh, _ = locate(SHAPE, point, None)
    aside = np.array([0.0, np.sin(angle + 0.5), np.cos(angle + 0.5)])
    after, _ = locate(SHAPE, point, ContactAnchor(RADIUS * aside, aside))
    assert after.depth_m == pytest.approx(depth, abs=1e-12)
    assert np.array_equal(after.surface, fresh.surface)


@given(seed=st.integers(0, 2**32 - 1), stiff=st.floats(0.0, 4.0))
@settings(max_examples=30, deadline=None)
def test_bed_forces_are_the_minimum_of_the_energy(seed: int, stiff: float) -> None:
    rng = np.random.default_rng(seed)
    size, count = 5, 14
    root = rng.normal(size=(size, size))
    compliance = root @ root.T + 0.1 * np.eye(size)
    weights = rng.uniform(0, 1, (count, size))
    weights /= weights.sum(axis=1, keepdims=True)
    below, penalty = rng.uniform(0.0, 1.0, count), np.full(count, 10.0**stiff)

    def energy(forces: Floats) -> tuple[float, Floats]:
        left = np.maximum(below - weights @ (compliance @ forces), 0.0)
        value = 0.5 * float(forces @ compliance @ forces + penalty @ left**2)
        return value, compliance @ (forces - weights.T @ (penalty * left))

    forces = solve_penalty_contact(weights, compliance, penalty, below)
    best = minimize(energy, np.zeros(size), jac=True, method="BFGS", options={"gtol": 1e-9}).fun
    assert energy(forces)[0] <= best * (1 + 1e-9) + 1e-12


def test_shape_functions_at_the_points_reproduce_a_parabola() -> None:
    shape, local = sample_triangle(4)
    assert len(local) == 16
    nodes = np.array([[0, 0], [1, 0], [0, 1], [0.5, 0], [0.5, 0.5], [0, 0.5]])

    def field(p: Floats) -> Floats:
        value: Floats = 1 + p[:, 0] - 2 * p[:, 1] + 3 * p[:, 0] * p[:, 1] + p[:, 0] ** 2
        return value

    assert shape @ field(nodes) == pytest.approx(field(local), abs=1e-14)


def test_depths_in_the_wrong_order_are_rejected(model: SoftBodyModel) -> None:
    with pytest.raises(ValueError, match="max_depth_m"):
        LinearSoftBody(
            model.response,
            SHAPE,
            model.response.rest[model.bounds],
            young_modulus_pa=4000.0,
            finger_radius_m=FINGER,
            linear_depth_m=0.01,
            max_depth_m=0.006,
        )


def test_a_finger_much_smaller_than_the_mesh_still_finds_it(model: SoftBodyModel) -> None:
    contact = SphereContact(model.response, SHAPE, young_modulus_pa=4000.0, finger_radius_m=0.002)
    for i in range(40):
        found = contact.solve(push(0.001 * i, 0.02 * i, 0.001), 0.001)
        assert found is not None
        assert found.force_n @ push(0.0, 0.02 * i, 0.0).normal > 0.0
